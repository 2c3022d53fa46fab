"""Tests that every learner learns, resumes exactly, and goes through every command."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

from emberlink.envs import keys, parallel_env
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import load, make_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.evaluate import play
from emberlink.trainers.training.setup import TrainingSetup

HORIZON = 20
SMALL = [
    *("setup=tuned", f"env.horizon={HORIZON}", "env.num_uavs=3", "num_envs=4", "episodes=2"),
    *("learner.hidden=[8,8]", "evaluation.interval=1", "evaluation.interval_episodes=2"),
    *("evaluation.episodes=2", "evaluation.scripted=[lawnmower]", "fire.num_train_fires=2"),
]
MAP = ["env.observation=map", "env.map.pixels=8"]
IPPO = ["learner=ippo", "policy.memory=gru", "learner.epochs=2", "learner.minibatches=2"]
CASES = {
    "ddpg": ["learner=ddpg", "policy.hold=5", "learner.batch_size=8"],
    "ddpg-team": ["learner=ddpg", "learner.critic=team", "learner.batch_size=8"],
    "ddpg-window": [
        *("learner=ddpg", "learner.batch_size=8", "env.observation=window"),
        *("learner.share_parameters=true", "env.failures=1"),
    ],
    "td3": [
        *("learner=td3", "policy.agent_index=true", "policy.hold=2", "learner.batch_size=8", *MAP)
    ],
    "td3-team": [
        *("learner=td3", "learner.critic=team", "learner.batch_size=8"),
        "learner.share_parameters=true",
    ],
    "ippo": [*IPPO, "policy.hold=5", *MAP],
    "ippo-own": [*IPPO, "learner.share_parameters=false"],
    "mappo": [
        *("learner=mappo", *IPPO[1:], "policy.agent_index=true", "env.failures=1"),
        *("policy.message=attention", "policy.message_size=4", "learner.chunk=2"),
        "env.radio.delay=1",
    ],
    "mappo-map": ["learner=mappo", "learner.critic_map=true", "policy.hold=4"],
    "imitation": ["learner=imitation", "policy.hold=5", "learner.samples=8", *MAP],
    "imitation-gru": [
        *("learner=imitation", "policy.memory=gru", "policy.hold=2", "learner.samples=8"),
        *("learner.sequence=4", "policy.message=mean", "policy.message_size=4", *MAP),
        "env.radio.delay=3",
    ],
}
IN_CI = {"ddpg", "td3", "ippo", "mappo", "imitation-gru"}
EACH = [case if case in IN_CI else pytest.param(case, marks=pytest.mark.heavy) for case in CASES]


def method_of(case: str) -> str:
    return "maps" if case == "imitation-gru" else "consensus"


def made(case: str, *more: str) -> TrainingSetup:
    return TrainingSetup(resolve(method_of(case), [*SMALL, *CASES[case], *more]))


@pytest.mark.parametrize("case", CASES)
def test_every_network_is_trained_and_a_resumed_training_is_the_same_bit_for_bit(case):
    check_that_it_learns_and_resumes(lambda: made(case))


def check_that_it_learns_and_resumes(make: Callable[[], TrainingSetup]) -> None:
    """Checks that a training changes all weights; others stop in an episode and at its end."""
    whole, resumed = make(), make()
    before = {name: value.clone() for name, value in whole.learner.loss.named_parameters()}
    assert before
    whole.dry_run(2 * HORIZON)
    assert whole.learner.updates
    for name, value in whole.learner.loss.named_parameters():
        assert value.isfinite().all(), name
        used = name != "log_std" or whole.config.learner.name != "imitation"
        assert value.equal(before[name]) != used, name
    for stop in (10, HORIZON, 2 * HORIZON):
        state, step = {k: v.clone() for k, v in resumed.state_dict().items()}, resumed.step
        resumed = make()
        torch.manual_seed(1)  # no effect
        resumed.load_state_dict(state, step)
        resumed.dry_run(stop - step)
    expected, state = whole.state_dict(), resumed.state_dict()
    assert state.keys() == expected.keys()
    for name, value in expected.items():
        assert value.numpy().tobytes() == state[name].numpy().tobytes(), name


@pytest.mark.parametrize("learner", ["ddpg", "ippo"])
def test_a_seed_repeats_a_training_and_another_does_not(learner):
    weights = []
    for seed in (3, 3, 4):
        torch.manual_seed(len(weights))  # no effect
        setup = made(learner, f"seed={seed}")
        setup.dry_run(HORIZON)
        weights.append(setup.learner.weights())
    for name, value in weights[0].items():
        assert value.equal(weights[1][name]), name
    assert any(not value.equal(weights[2][name]) for name, value in weights[0].items())


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
def test_a_learner_without_a_memory_refuses_one(learner):
    with pytest.raises(UserError, match=f"the networks of learner={learner} have none"):
        made(learner, "policy.memory=gru")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Returns a function that gives the run folder of a case, trained by the command."""

    @cache
    def of(case: str) -> Path:
        folder = tmp_path_factory.mktemp(case)
        arguments = [method_of(case), *SMALL, *CASES[case], f"output={folder}"]
        assert main.main(["train", *arguments]) == 0
        (run,) = folder.iterdir()
        return run

    return of


@pytest.mark.slow
@pytest.mark.parametrize("case", EACH)
def test_a_run_trains_and_its_evaluation_can_be_repeated(case, trained, capsys):
    run = trained(case)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert len(lines) == 2
    for line in lines:
        losses = {key for key in line if key.startswith("loss_")}
        imitates = case.startswith("imitation")
        assert losses >= ({"loss_imitation"} if imitates else {"loss_actor", "loss_critic"})
        assert line.keys() >= {"coverage", "huygens/coverage"}
    before = json.loads((run / "eval.json").read_text())["results"]
    assert main.main(["eval", str(run)]) == 0
    assert json.loads((run / "eval.json").read_text())["results"] == before
    capsys.readouterr()


@pytest.mark.slow
@pytest.mark.parametrize("case", EACH)
def test_a_loaded_policy_needs_no_further_code(case, trained):
    """TorchRL's rollout, PettingZoo and the evaluation give the same episode."""
    policy = load(trained(case))

    def env():
        return make_env(policy.config, num_envs=1, seed=7)

    with torch.no_grad():
        rollout = env().rollout(HORIZON, policy)
    flight = rollout["next", *keys.POSITION][0]
    assert flight.shape == (HORIZON, 3, 3)
    measured = play(env(), policy)
    assert measured["coverage"].isfinite().all()
    pettingzoo = parallel_env(env())
    pettingzoo.reset()
    for step in range(HORIZON):
        *_, infos = pettingzoo.step(pettingzoo.act(policy))
        for uav in range(3):
            assert infos[f"uav_{uav}"]["position"].tolist() == flight[step, uav].tolist()
    assert not pettingzoo.agents


def test_pictures_are_stored_as_bytes_in_a_bounded_buffer():
    more = ["learner.batch_size=6", "learner.buffer_size=20", "env.map.pixels=24", "policy.hold=1"]
    setup: Any = TrainingSetup(resolve("maps", [*SMALL, "learner=ddpg", *more]))
    setup.dry_run(16)
    state = setup.learner.state_dict()
    pictures = [v for k, v in state.items() if k.startswith("replay/rows") and k.endswith("crops")]
    assert [(v.dtype, v.shape) for v in pictures] == [(torch.uint8, (7, 3, 2, 8, 24, 24))] * 2


def test_what_a_uav_observes_of_maps_does_not_depend_on_the_team():
    shapes = set()
    for uavs, grid in ((1, "[20,20]"), (24, "[128,128]")):
        config = resolve("maps", [f"env.num_uavs={uavs}", f"env.grid={grid}", "env.horizon=4"])
        spec = make_env(config).observation_spec
        shapes.add(tuple(map(tuple, keys.observation_shapes(spec))))
    assert shapes == {((2,), (2, 8, 24, 24))}
