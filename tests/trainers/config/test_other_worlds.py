"""Tests evaluations of a run in a world that it was not trained in."""

import json
import warnings
from itertools import pairwise
from typing import Any

import pytest
import torch
from fire_files import Ellipses, raster_of, write_asc
from refusal import refused
from tiny_run import TINY
from torchrl.envs.utils import check_env_specs

from emberlink import trainers
from emberlink.envs import FileFireConfig, keys, metrics
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.config_files import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import make_env
from emberlink.trainers.cli.main import main
from emberlink.trainers.config.compose import evaluated_with, in_world, resolve, to_values
from emberlink.trainers.evaluation.evaluate import scripted_config

ROUND = ("paper", "front", "relay", "blackout", "swarm", "paper", "relay", "front", "paper")


@pytest.mark.parametrize(("here", "there"), [*pairwise(ROUND)])
def test_a_run_without_settings_of_its_own_is_as_if_made_in_the_other_world(here, there):
    run, expected = (
        resolve("maps", ["setup=strong", f"world={name}", "evaluation.interval=3"])
        for name in (here, there)
    )
    assert to_values(in_world(run, there)) == to_values(expected)


def test_settings_of_the_run_are_kept_unless_the_worlds_differ_in_them():
    own = ["env.view_angle=40", "env.num_uavs=4", "env.radio.loss=0.5", "env.altitude=[1,3]"]
    run = resolve("consensus", ["setup=tuned", "world=front", *own])
    moved = in_world(run, "swarm").env
    assert (moved.view_angle, moved.radio.loss, moved.altitude) == (40, 0.5, (1, 3))
    assert (moved.num_uavs, moved.grid) == (24, (100, 100))  # swarm's values
    assert in_world(run, "relay").env.num_uavs == 4  # front and relay have six
    assert in_world(run, "relay").env.base == (0, 30)
    assert in_world(in_world(run, "relay"), "front").env.base is None
    assert in_world(run, "front") is run


def test_a_run_of_an_earlier_edition_stays_in_its_world():
    run = resolve("maps", ["setup=strong", "world=front", "edition=1"])
    with pytest.raises(UserError, match="edition 1"):
        in_world(run, "relay")
    assert in_world(run, "front") is run


def test_editions_have_their_own_test_fires():
    old = resolve("maps", ["world=front", "fire.test_seed=1000000"])
    seeds = [fires_of(config.fire).describe(2)["fire_seeds"] for config in (
        old, in_world(old, "relay"), resolve("maps"),
    )]  # fmt: skip
    assert seeds == [[at, at + 1] for at in (1_000_000, 1_500_000, 1_000_000)]
    here, there = (fires_of(run.fire) for run in (old, in_world(old, "relay")))
    both = [source.fires("test", 2, (60, 60), 1000) for source in (here, there)]
    assert not both[0].equal(both[1])
    assert both[1][1].equal(there.test_fire(1, (60, 60), 1000)[0])
    valid = [source.fires("validation", 2, (60, 60), 1000) for source in (here, there)]
    assert valid[0].equal(valid[1])


def test_a_radio_of_the_run_holds_for_the_methods_of_scripted_policies_too():
    run = resolve("maps", ["setup=tuned", "world=front", "env.radio.loss=0.3"])
    consensus = resolve("consensus", ["setup=tuned", "world=paper", "env.radio.loss=0.3"])
    played = scripted_config(in_world(run, "paper"), "follow_target")
    assert (played.comm, played.env.radio) == (consensus.comm, consensus.env.radio)
    own = resolve("positional", ["setup=tuned"])  # its radio has no limit
    assert scripted_config(own, "follow_target").env.radio == resolve("consensus").env.radio
    off = evaluated_with(own, {"env.radio.range": 0})
    assert scripted_config(off, "follow_target").env.radio.range == 0


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    alone = "evaluation.scripted=[]", "env.horizon=8", f"output={folder}"
    assert main(["train", "independent", "setup=tuned", *TINY, *alone]) == 0
    (path,) = folder.iterdir()
    return path


OTHER_MAP = pytest.mark.filterwarnings("ignore:env.*means something else here:UserWarning")


@OTHER_MAP
def test_an_evaluation_in_another_world(run, capsys):
    assert main(["eval", str(run), "world=relay"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "huygens" not in printed
    written = json.loads((run / "eval_world=relay.json").read_text())
    assert written["world"] == "relay"
    assert set(written["results"]) == {"front"}
    assert "courier" in written["results"]["front"]
    assert "base_coverage" in written["results"]["front"]["learned"]
    by_python = trainers.evaluate(run, world="relay", scripted=False)
    assert by_python["front"]["learned"] == written["results"]["front"]["learned"]
    assert (run / "figures" / "replay_world=relay.html").exists()


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("world=moon", "known: blackout, file, front, paper, relay, swarm"),
        ("fire.burn_time=5", "needs world=NAME, too"),
        ("world=swarm", "uavs=24"),
    ],
)
def test_worlds_that_a_run_cannot_be_evaluated_in(setting, said, run, capsys):
    files = sorted(run.rglob("*"))
    refused(["eval", run, setting], capsys, said)
    assert sorted(run.rglob("*")) == files


def test_networks_that_never_saw_a_base_are_warned_of():
    with pytest.warns(UserWarning, match=r"^env\.base=\[0\.0, 30\.0\] \(in training null\)"):
        trainers.load("pretrained:maps", world="relay")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        trainers.load("pretrained:maps", world="swarm", grid=[40, 30])
    with pytest.warns(UserWarning, match=r"^env\.grid=\[40, 30\] .*something else here"):
        trainers.load("pretrained:consensus", grid=[40, 30])  # which observes where it is


def test_a_run_is_evaluated_on_a_fire_of_a_file(run, tmp_path):
    write_asc(tmp_path / "fire.asc", raster_of(Ellipses(), 240))
    fire = f"fire.path={tmp_path / 'fire.asc'}", "fire.units=minutes"
    with pytest.warns(UserWarning, match="means something else here"):
        assert (
            main(["eval", str(run), "world=file", *fire, "env.grid=[30,30]", "--fires", "1"]) == 0
        )
    (file,) = run.glob("eval_world=file*.json")
    written = json.loads(file.read_text())
    assert written["environment"]["grid"] == [30, 30]
    (held_out,) = written["held_out"].values()
    assert "fire.asc" in json.dumps(held_out)
    file.unlink()
    path: dict[str, Any] = {"fire.path": tmp_path / "fire.asc", "fire.units": "minutes"}
    with pytest.warns(UserWarning, match="means something else here"):
        policy = trainers.load(run, world="file", grid=[30, 30], **path)
    assert isinstance(policy.config.fire, FileFireConfig)
    assert policy.config.fire.path == str(tmp_path / "fire.asc")


def test_a_run_is_trained_on_a_fire_of_a_file(tmp_path):
    write_asc(tmp_path / "fire.asc", raster_of(Ellipses(), 240))
    fire = f"fire.path={tmp_path / 'fire.asc'}", "fire.units=minutes", "env.grid=[12,10]"
    more = *TINY, "evaluation.scripted=[]", f"output={tmp_path / 'runs'}"
    assert main(["train", "consensus", "setup=tuned", "world=file", *fire, *more]) == 0
    (evaluated,) = tmp_path.glob("runs/*/eval.json")
    assert set(json.loads(evaluated.read_text())["results"]) == {"file"}


WORLDS = [world for world in known("world") if world != "file"]


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("method", known("method"))
def test_every_method_has_an_environment_in_every_world(method, world):
    small = {"num_envs": 2, "seed": 0, "num_train_fires": 2}
    env = make_env(method, "tuned", world=world, **small)
    check_env_specs(env)
    steps = env.rollout(3)["next"]
    measured = metrics.episode_metrics(steps)
    assert tuple(measured) == metrics.names(env.base_env.config)
    assert resolve(method, [f"world={world}"]).evaluation.headline in measured
    assert all(value.isfinite().all() for value in measured.values())


@pytest.mark.parametrize("method", ["consensus", "independent"])
def test_a_base_changes_neither_rewards_nor_observations(method):
    """So docs/worlds.md uses networks of front in relay."""

    def flight(world: str):
        torch.manual_seed(0)  # of the random actions
        return make_env(method, "tuned", world=world, seed=0, num_train_fires=2).rollout(30)["next"]

    front, relay = flight("front"), flight("relay")
    for key in (keys.OBSERVATION, keys.REWARD, keys.POSITION):
        assert front[key].equal(relay[key])
