"""Tests that methods, learners and other views of the environment work in every world."""

import json

import pytest
import torch
from tiny_run import TINY
from torchrl.envs.utils import check_env_specs

from emberlink.envs import WildfireConfig, metrics, parallel_env
from emberlink.envs.utils.config_files import known
from emberlink.trainers import load, make_env, train
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve

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
def test_a_training_in_relay_is_that_in_front(method, tmp_path):
    """A base changes neither rewards nor observations, so docs/worlds.md uses networks of front."""
    small = {"episodes": 2, "horizon": 15, "num_envs": 2, "num_train_fires": 2, "batch_size": 8}
    shared = {"setup": "tuned", "evaluate_after": False, "interval": 0, **small}
    front, relay = (
        load(train(method, world=world, output=str(tmp_path / world), **shared).path).state_dict()
        for world in ("front", "relay")
    )
    assert any(value.abs().sum() > 0 for value in front.values())
    assert front.keys() == relay.keys()
    assert all(torch.equal(front[name], relay[name]) for name in front)


@pytest.mark.heavy
def test_a_run_in_a_world_is_trained_resumed_and_evaluated(tmp_path, capsys):
    output = f"output={tmp_path / 'runs'}"
    assert main.main(["train", "consensus", *TINY, "world=blackout", output]) == 0
    (run,) = (tmp_path / "runs").iterdir()
    before = json.loads((run / "eval.json").read_text())
    (fire,) = before["results"]
    assert fire == "front"
    assert list(before["results"][fire]["learned"]) == list(metrics.ALL)
    assert main.main(["eval", str(run)]) == 0
    assert json.loads((run / "eval.json").read_text()) == before
    picture = run / "one.png"
    assert main.main(["render", str(run), "--policy", "courier", "--output", str(picture)]) == 0
    assert picture.exists()
    assert main.main(["train", f"resume={run}", "episodes=3"]) == 0
    assert "base_coverage" in (run / "metrics.jsonl").read_text().splitlines()[-1]


def test_failed_uavs_leave_pettingzoo():
    world = WildfireConfig(grid=(8, 8), num_uavs=3, horizon=12, failures=3.0)
    env = parallel_env(config=world, fire="paper", seed=0)
    env.reset(seed=1)
    env._core._fail_step.copy_(torch.tensor([[4, 13, 2]]))
    flying = {1: 3, 2: 2, 3: 2, **dict.fromkeys(range(4, 12), 1), 12: 0}
    for step, count in flying.items():
        before = list(env.agents)
        actions = {agent: env.action_space(agent).sample() for agent in before}
        observations, rewards, terminations, truncations, infos = env.step(actions)
        for part in (observations, rewards, terminations, truncations, infos):
            assert list(part) == before
        assert len(env.agents) == count
        assert [agent for agent, ended in terminations.items() if ended] == {
            2: ["uav_2"],
            4: ["uav_0"],
        }.get(step, [])
        assert all(rewards[agent] == 0 for agent in before if terminations[agent])
    assert all(truncations.values())
