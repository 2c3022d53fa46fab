"""Tests that a seed in a stack of seeds learns the same as alone."""

import csv
import json
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from test_recipes import METHODS, trained

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.exploration import NOISE
from emberlink.trainers import make_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import from_values, resolve, to_values
from emberlink.trainers.evaluation import report
from emberlink.trainers.training.setup import TrainingSetup

SEEDS = [3, 11]


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("method", "setup"), [*zip(METHODS, ["released", "paper"] * 2, strict=True)]
)
def test_a_seed_of_a_stack_learns_the_same_as_alone(method, setup, tmp_path):
    """About 150 updates in float32, with operations in a different order."""
    settings = [
        *(f"setup={setup}", "env.horizon=40", "episodes=4", "num_envs=2", "env.num_uavs=3"),
        *("learner.batch_size=24", "learner.hidden=[24,16]", "evaluation.interval=0"),
    ]
    together = trained(resolve(method, [*settings, f"seeds={SEEDS}", f"output={tmp_path / 'a'}"]))
    assert together.setup.learner.updates > 140
    assert len(together.runs) == len(SEEDS)
    for team, seed in enumerate(SEEDS):
        alone = trained(resolve(method, [*settings, f"seed={seed}", f"output={tmp_path / 'b'}"]))
        weights, expected = together.setup.learner.weights(team), alone.setup.learner.weights()
        assert weights.keys() == expected.keys()
        for name, weight in expected.items():
            torch.testing.assert_close(weights[name], weight, rtol=1e-3, atol=1e-4)
        lines = zip(together.runs[team].lines(), alone.run.lines(), strict=True)
        for line, single in lines:
            assert line == pytest.approx(single, rel=1e-3, abs=1e-3)


@pytest.mark.heavy
def test_a_stack_of_networks_equals_single_networks_in_float64(tmp_path):
    """Compares 300 updates in float64 at tuned's learning rates, from recorded transitions.

    In float32, at these rates, Adam amplifies rounding errors of nearly vanishing gradients.
    """
    settings = ["setup=tuned", "env.horizon=50", "learner.batch_size=16", "learner.hidden=[24,16]"]

    def learner(seeds: str, samples: int = 0) -> tuple[Any, list]:
        setup = TrainingSetup(resolve("consensus", [*settings, seeds]))
        learner: Any = setup.learner
        for _, rollout in zip(range(samples), setup.collector, strict=False):
            learner.replay.extend(rollout)
        batches = [learner.sample().apply(widened) for _ in range(samples)]
        learner.loss.double()
        return learner, batches

    together, batches = learner("seeds=[3,11]", samples=40)
    singles = [learner(f"seed={seed}")[0] for seed in (3, 11)]
    for update in range(300):
        batch = batches[update % len(batches)]
        together.update(batch)
        for team, single in enumerate(singles):
            uavs = slice(6 * team, 6 * team + 6)
            single.update(
                TensorDict(
                    {"agents": batch["agents"][:, uavs], "next": next_of(batch, uavs)},
                    batch_size=batch.batch_size,
                )
            )
    for team, single in enumerate(singles):
        for name, weight in single.weights().items():
            learned = together.weights(team)[name]
            assert weight.dtype == torch.float64
            torch.testing.assert_close(learned, weight, rtol=1e-6, atol=1e-9)


def widened(value: torch.Tensor) -> torch.Tensor:
    return value.double() if value.is_floating_point() else value


def next_of(batch: TensorDict, uavs: slice) -> TensorDict:
    agents = batch["next", "agents"][:, uavs]
    return TensorDict({"agents": agents}, batch_size=batch.batch_size)


def test_seeds_of_a_stack_differ_in_all_random_values():
    """Compares weights, start positions, fires, noise and replay samples."""
    settings = ["fire=huygens", "env.horizon=30", "learner.batch_size=24", "learner.hidden=[8,8]"]
    setup = TrainingSetup(resolve("consensus", [*settings, f"seeds={SEEDS}"]))
    learner: Any = setup.learner
    first, second = (learner.weights(team) for team in range(2))
    assert not any(first[name].equal(second[name]) for name in first if "norm" not in name)
    world: Any = setup.env.base_env
    assert not world.arrival_time[0].equal(world.arrival_time[1])
    collected = next(iter(setup.collector))
    for key in (keys.POSITION, NOISE):
        assert not collected[key][0].isclose(collected[key][1]).any(), key
    learner.replay.extend(collected)
    sampler, storage = learner.replay._sampler, learner.replay._buffer.storage
    sampler.written.fill_(1000)
    (rows, columns), _ = sampler.sample(storage, 24)
    assert (rows[:, :6] == rows[:, 6:]).float().mean() < 0.05
    assert columns[:, :6].max() < 6 <= columns[:, 6:].min()


def test_environments_of_several_seeds_equal_those_of_single_seeds():
    together = WildfireEnv(6, fire="huygens", seed=[5, 9])
    singles = [WildfireEnv(3, fire="huygens", seed=seed) for seed in (5, 9)]
    tds = [env.reset() for env in singles]
    whole = together.reset()
    for team, td in enumerate(tds):
        rows = slice(3 * team, 3 * team + 3)
        assert whole[rows][keys.POSITION].equal(td[keys.POSITION])
        assert whole[rows][keys.RNG_KEY].equal(td[keys.RNG_KEY])
        assert together.arrival_time[rows].equal(singles[team].arrival_time)


@pytest.mark.parametrize("seeds", [[], [1, -1], [1, 2]])
def test_environments_not_divisible_by_seeds(seeds):
    with pytest.raises(ValueError, match="seed"):
        WildfireEnv(3, seed=seeds)


@pytest.mark.heavy
def test_every_seed_has_a_run_folder_that_can_be_evaluated(tmp_path, capsys):
    small = [
        *("episodes=2", "env.horizon=15", "env.num_uavs=2", "learner.hidden=[8,8]"),
        *("learner.batch_size=8", "evaluation.episodes=2", "evaluation.interval=1"),
        "evaluation.interval_episodes=2",
    ]
    arguments = ["train", "positional", *small, "seeds=[7,8]", f"output={tmp_path}"]
    assert main.main(arguments) == 0
    folders = sorted(tmp_path.iterdir())
    assert [folder.name[-2:] for folder in folders] == ["s7", "s8"]
    evaluated = []
    for folder, seed in zip(folders, (7, 8), strict=True):
        run = report.RunFolder(folder)
        config = run.config()
        assert (config.seed, config.seeds) == (seed, (7, 8))
        assert [line["episode"] for line in run.lines()] == [1, 2]
        assert "huygens/coverage" in run.lines()[0]
        result = json.loads((folder / "eval.json").read_text())
        assert result["seed"] == seed
        assert main.main(["eval", str(folder)]) == 0
        # The checkpoint's policy equals that of the stack.
        assert json.loads((folder / "eval.json").read_text()) == result
        evaluated.append(result["results"]["paper"]["learned"])
    assert evaluated[0] != evaluated[1]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["seeds=[1,2]", "seed=3"], "seed=3 and seeds=[1, 2]: give only one of them"),
        (["seeds=[1,1]"], "seeds=[1, 1]: a seed is repeated"),
        (["seeds=[1,-2]"], "seeds.1=-2"),
        (["seeds=3"], "seeds=3"),
        (["seeds=[a]"], "seeds.0=a"),
    ],
)
def test_invalid_seeds(overrides, message, capsys, tmp_path):
    assert main.main(["train", "consensus", *overrides, f"output={tmp_path}"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_seeds_from_python():
    for seeds in ([1, 2], (1, 2), range(1, 3)):
        assert resolve("consensus", seeds=seeds).seeds == (1, 2)
    assert resolve("consensus", seeds=[4, 2]).seed == 4
    assert WildfireEnv(2, seed=torch.tensor(3)).reset()[keys.RNG_KEY].shape == (2,)
    with pytest.raises(ValueError, match="an environment takes seed="):
        make_env("consensus", seeds=[1, 2])


def test_a_configuration_without_the_key_seeds():
    values = to_values(resolve("consensus"))
    del values["seeds"]
    assert from_values(values) == resolve("consensus")


def test_every_seed_has_a_separate_tracker(tmp_path):
    small = ["env.horizon=8", "episodes=2", "learner.batch_size=8", "learner.hidden=[4,4]"]
    more = [f"seeds={SEEDS}", "logger=csv", f"output={tmp_path}", "evaluation.interval=0"]
    for run in trained(resolve("independent", [*small, *more])).runs:
        with (run.path / "metrics.csv").open(newline="") as file:
            logged = [float(row["mean_reward"]) for row in csv.DictReader(file)]
        assert logged == pytest.approx([line["mean_reward"] for line in run.lines()])
