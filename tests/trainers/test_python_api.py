"""Tests the Python API, which equals the commands but does not print or exit."""

import json

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from tensordict.nn import TensorDictModule

import emberlink.trainers as trainers
from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.run_folder import RunFolder

POLICIES = ["lawnmower"]
SHORT = {
    "episodes": 2,
    "horizon": 15,
    "num_uavs": 2,
    "num_envs": 2,
    "hidden": [8, 8],
    "batch_size": 8,
    "evaluation.episodes": 2,
    "evaluation.interval": 0,
    "evaluation.scripted": POLICIES,
}


@pytest.fixture(autouse=True)
def _silent(capfd):
    """Checks that a test prints nothing, neither in Python nor in libraries."""
    yield
    assert capfd.readouterr().out == ""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Calls `train` and returns its run."""
    steps, more = [], {"output": str(tmp_path_factory.mktemp("runs")), **SHORT}
    more["progress"] = lambda now: steps.append(now.step)
    run = trainers.train("consensus", setup="tuned", fire="paper", **more)
    assert steps == list(range(1, 31))
    return run


def test_evaluate_is_the_evaluation_of_the_training(trained):
    before = sorted(trained.path.rglob("*"))
    played = []
    results = trainers.evaluate(trained.path, progress=lambda *now: played.append(now))
    assert results == trained.results
    assert results == json.loads((trained.path / "eval.json").read_text())["results"]
    assert RunFolder(trained.path).config() == trained.config
    assert ("paper", "learned") in played
    alone = trainers.evaluate(str(trained.path), episodes=1, scripted=False, device="cpu")
    assert alone["huygens"].keys() == {"learned"}
    assert alone["huygens"]["learned"]["coverage"] == results["huygens"]["learned"]["coverage"][:1]
    with pytest.raises(UserError, match=r"evaluation\.episodes"):
        trainers.evaluate(trained.path, episodes=65_537)
    deaf = trainers.evaluate(trained.path, scripted=False, **{"env.radio.loss": 1.0})
    assert deaf.keys() == results.keys()
    assert sorted(trained.path.rglob("*")) == before


def test_load_gives_the_trained_policy_and_its_environment(trained):
    policy = trainers.load(trained.path)
    assert isinstance(policy, TensorDictModule)
    assert policy.in_keys == [keys.OBSERVATION]
    assert policy.out_keys == [keys.ACTION]
    assert policy.checkpoint == RunFolder(trained.path).newest
    assert not any(weight.requires_grad for weight in policy.parameters())
    env = trainers.make_env(policy.config, num_envs=3, seed=1)
    rollout = env.rollout(5, policy)
    assert rollout[keys.ACTION].shape == (3, 5, 2, 3)
    assert rollout[keys.ACTION].abs().max() > 0
    again = trainers.load(trained.path, checkpoint=policy.checkpoint)
    assert again(rollout[:, 0].clone())[keys.ACTION].equal(rollout[:, 0][keys.ACTION])
    larger = trainers.make_env(policy.config, grid=[40, 20], fire="huygens")
    assert larger.rollout(1, policy)[keys.ACTION].shape == (1, 1, 2, 3)


def test_the_hydra_state_of_a_program_is_kept(tmp_path):
    (tmp_path / "mine.yaml").write_text("answer: 42\n")
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.2"):
        mine = GlobalHydra.instance().hydra
        env = trainers.make_env("consensus", "tuned", horizon=3, num_train_fires=2)
        assert env.rollout(2).shape == (1, 2)
        assert GlobalHydra.instance().hydra is mine
        assert hydra.compose("mine").answer == 42
    assert not GlobalHydra.instance().is_initialized()
