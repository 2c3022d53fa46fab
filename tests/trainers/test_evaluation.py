"""Tests the evaluation protocol: fires and starts are shared, and results are reproducible."""

import itertools
import json
import math
import os

import pytest
import torch
from rich.table import Column, Table

from emberlink.envs import metrics
from emberlink.envs.fire.generator import fire_seeds, load_scenario, make_fires
from emberlink.trainers.build import build_actor, build_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import evaluate, scores
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.terminal.console import PlainConsole

SMALL = ["env.horizon=12", "env.num_uavs=2", "learner.hidden=[8,8]", "env.grid=[12,10]"]


def small(method: str = "consensus", *more: str):
    return resolve(method, ["setup=tuned", *SMALL, *more])


def untrained(config):
    """Returns an untrained actor with large actions."""
    env = build_env(config, num_envs=1, fire="paper", seed=0, device="cpu")
    actor = build_actor(config, env, torch.Generator().manual_seed(0))
    draw = torch.Generator().manual_seed(1)
    weight = actor.module.action.weight
    weight.data = torch.randn(weight.shape, generator=draw)
    return actor.requires_grad_(False)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Returns an empty cache folder."""
    monkeypatch.setenv("EMBERLINK_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def played(monkeypatch):
    """Counts the batches of episodes that are simulated."""
    count, play = [], evaluate.play
    monkeypatch.setattr(evaluate, "play", lambda *args: (count.append(args), play(*args))[1])
    return count


@pytest.mark.slow
def test_an_episode_does_not_depend_on_the_others(cache):
    config = small()
    actor = untrained(config)
    few, more, many = (evaluate.evaluate(config, actor, fires=n) for n in (1, 3, 53))
    for fire, policy, name in itertools.product(many, many["huygens"], metrics.NAMES):
        numbers = many[fire][policy][name]
        assert len(numbers) == 53
        assert few[fire][policy][name] == numbers[:1]
        assert more[fire][policy][name] == numbers[:3]
    assert len(set(many["huygens"]["learned"]["coverage_auc"])) > 25


def test_all_policies_have_the_same_fires_and_starts(cache, monkeypatch):
    config = small("independent", "fire=paper")
    begun: dict = {}

    def play(env, policy, *_):
        td = env.reset()
        world = env.base_env
        seen = td["agents", "position"].tolist(), world.arrival_time.tolist()
        begun.setdefault(len(begun), seen)
        return {name: torch.zeros(evaluate.BLOCK) for name in metrics.NAMES}

    monkeypatch.setattr(evaluate, "play", play)
    evaluate.evaluate(config, untrained(config), fires=4)
    policies = 1 + len(POLICIES)
    assert len(begun) == 2 * policies
    seeds = fire_seeds("test", 4)
    for panel, scenario in enumerate(("huygens", "paper")):
        fires = make_fires(load_scenario(scenario), seeds, (12, 10), 12).tolist()
        for place in range(policies):
            starts, arrival = begun[panel * policies + place]
            assert starts == begun[0][0]
            assert arrival[:4] == fires
    # Episode i depends only on the seed START_SEED + i.
    alone = build_env(config, num_envs=1, fire="paper", seed=evaluate.START_SEED + 2, device="cpu")
    assert alone.reset()["agents", "position"][0].tolist() == begun[0][0][2]


def test_no_rule_of_a_method_changes_the_flight_of_a_scripted_policy(cache):
    """In `maps`, UAVs would fly home."""
    measured = []
    for method in ("maps", "independent"):
        more = ["env.horizon=60", "fire.num_train_fires=2", "evaluation.episodes=2"]
        config = resolve(method, ["world=relay", "setup=tuned", *more])
        arrival = evaluate.evaluation_fires(config, 2)["front"]
        measured.append(evaluate.play_scripted(config, "map_greedy", arrival, block=2))
    assert measured[0] == measured[1]


def scripted_in(world, name, *keys):
    more = ["env.horizon=60", "fire.num_train_fires=2", "env.radio.bandwidth=20"]
    config = resolve("consensus", [f"world={world}", "setup=strong", *more, *keys])
    arrival = evaluate.evaluation_fires(config, 2)["front"]
    return evaluate.play_scripted(config, name, arrival, block=2)


def test_scripted_policies_send_reports_and_no_learned_messages(cache):
    assert min(scripted_in("relay", "stationary")["bytes_per_step"]) > 0, "of reports alone"
    silent = scripted_in("front", "follow_target")
    for file in cache.glob("scripted-*"):
        file.unlink()
    says = ("policy.message=mean", "policy.message_size=16")
    assert scripted_in("front", "follow_target", *says) == silent


def test_eval_json_describes_the_evaluation(run, cache):
    assert main.main(["eval", str(run), "--fires", "3"]) == 0
    content = json.loads((run / "eval.json").read_text())
    config = RunFolder(run).config()
    assert content["method"] == "consensus"
    assert content["checkpoint"] == RunFolder(run).newest.name
    assert content["fires"] == 3
    assert content["environment"]["horizon"] == config.env.horizon
    assert content["versions"].keys() >= {"emberlink", "torch", "python"}
    assert list(content["results"]) == list(content["held_out"]) == ["huygens", "paper"]
    for fire, about in content["held_out"].items():
        assert about["fire_seeds"] == [1_000_000, 1_000_001, 1_000_002]
        assert about["scenario"]["name"] == fire
        by_policy = content["results"][fire]
        assert list(by_policy) == ["learned", *POLICIES] == list(content["communication"])
        for measured in by_policy.values():
            assert list(measured) == list(metrics.NAMES)
            for numbers in measured.values():
                assert len(numbers) == 3
                assert all(math.isfinite(x) for x in numbers)


def lawnmower(config, fires: int = 2, **protocol: int):
    fires_of_test = evaluate.evaluation_fires(config, fires)["huygens"]
    return evaluate.play_scripted(config, "lawnmower", fires_of_test, **protocol)


def test_a_scripted_policy_is_played_once_for_all_runs_in_an_environment(cache, played):
    first = lawnmower(small())
    assert len(played) == 1
    assert lawnmower(small("consensus", "seed=3", "episodes=7", "learner.batch_size=9")) == first
    assert len(played) == 1
    for change in ("env.displacement=0.7", "env.radio.range=4", "comm.heading.weight=2"):
        lawnmower(small("consensus", change))
    lawnmower(small(), fires=3)
    lawnmower(small(), start_seed=5)
    assert len(played) == 6
    (file, *_) = sorted(cache.glob("scripted-*"), key=os.path.getmtime)
    file.write_text('{"cover')
    assert lawnmower(small()) == first
    assert len(played) == 7


POLICIES = resolve("consensus").evaluation.scripted
"""the scripted policies of the paper's world"""


@pytest.mark.parametrize("columns", ["40", "120"])
def test_narrow_tables_keep_every_number(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    measured = {name: [1000.5 + place] * 2 for place, name in enumerate(metrics.NAMES)}
    results = {"huygens": dict.fromkeys(("learned", *POLICIES), measured)}
    scores.print_results(PlainConsole(), results, resolve("shared_memory", ["setup=released"]))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= int(columns)
    words = " ".join(lines).split()
    for name, (number, _) in measured.items():
        shown = f"{number:.{scores.DIGITS.get(name, 1)}f}"
        assert words.count(shown) == 1 + len(POLICIES)


def test_words_make_room_for_numbers(monkeypatch, capsys):
    table = Table("measure", "policy", Column("interval", justify="right"))
    table.add_row("time_to_coverage of", "random waypoints", "[1000.0, 1000.0]")
    for columns in range(48, 70):
        monkeypatch.setenv("COLUMNS", str(columns))
        PlainConsole().print(table)
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= columns
        assert "[1000.0, 1000.0]" in " ".join(lines)


def test_validation_has_fires_and_starts_of_its_own(cache, monkeypatch):
    config, given = small("independent", "fire=paper", "evaluation.interval_episodes=3"), []

    def play(config, policy, arrival, *, start_seed, block, watch):
        given.append((arrival, start_seed, block))
        return {name: [1.0] for name in metrics.NAMES}

    monkeypatch.setattr(evaluate, "play_blocks", play)
    evaluate.validate(config, lambda td: td)
    seeds = fire_seeds("validation", 3)
    assert seeds.tolist() == [2_000_000, 2_000_001, 2_000_002]
    for (arrival, start, block), scenario in zip(given, ("huygens", "paper"), strict=True):
        assert arrival.equal(make_fires(load_scenario(scenario), seeds, (12, 10), 12))
        assert (start, block) == (20_350_923, 3)
    assert (evaluate.START_SEED, evaluate.BLOCK) == (20_250_923, 50)
