"""Tests that actions are held, by a policy and by the environment, and what learners receive."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import TransformedEnv, check_env_specs, step_mdp

from emberlink.comm.base import Communication
from emberlink.envs import WildfireEnv, keys, metrics
from emberlink.envs.utils.errors import UserError
from emberlink.policies.hold import HELD, Held
from emberlink.policies.state import Stateful
from emberlink.trainers import make_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import build_comm
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.training.setup import TrainingSetup

COUNT = (keys.AGENTS, "count")


class Counting(Stateful):
    """Writes the number of its decisions as the action."""

    def __init__(self):
        super().__init__(2, {COUNT: 3}, reads=[], writes=[keys.ACTION])

    def forward(self, tensordict):
        before = tensordict.get(COUNT, None)
        before = torch.zeros_like(tensordict.get(keys.POSITION)) if before is None else before
        tensordict.set(("next", *COUNT), before + 1)
        return tensordict.set(keys.ACTION, before + 1)


def test_an_action_is_held_and_what_is_carried_changes_at_decisions_alone():
    env = make_env("independent", num_envs=2, num_uavs=2, horizon=8, seed=1)
    policy = Held(Counting(), 3, 2)
    env.append_transform(policy.make_tensordict_primer())
    rollout = env.rollout(8, policy)
    actions = rollout[keys.ACTION][:, :, 0, 0]
    assert actions.tolist() == [[1, 1, 1, 2, 2, 2, 3, 3]] * 2
    assert rollout["next", *COUNT][:, :, 0, 0].equal(actions)


def test_environments_decide_at_their_own_steps():
    """Environment 1 begins a new episode while the action of environment 0 is held."""
    env = make_env("independent", num_envs=2, num_uavs=2, seed=1)
    policy, td = Held(Counting(), 3, 2), env.reset()
    for _ in range(2):
        td = step_mdp(env.step(policy(td)))
    td[keys.STEP] = torch.tensor([2, 0])
    acted = policy(td)
    assert acted[keys.ACTION][:, 0, 0].tolist() == [1, 2]
    assert acted["next", *HELD].equal(acted[keys.ACTION])
    assert acted["next", *COUNT][:, 0, 0].tolist() == [1, 2]


LOST = ["env.failures=2.0", "env.radio.loss=0.3", "env.measures=all", "fire.burn_time=15.0"]
BASED = ["world=blackout", "env.horizon=40", "env.grid=[24, 24]", "env.base=[3.0, 12.0]"]
BURSTS = ["env.radio.burst=5.0", "env.radio.fade=true", "env.radio.shared=true"]
METHODS = ["independent", "positional", "consensus", "maps"]
WORLDS = {
    "plain": (2, []),
    "lost messages, failures, burning out": (10, LOST),
    "base, limited radio": (4, [*BASED, "env.radio.bandwidth=90", "env.radio.range=15.0"]),
    "late, bursty, limited": (5, [*BASED, "env.radio.delay=7", "env.radio.bandwidth=90", *BURSTS]),
    "spells of losses": (5, ["env.radio.loss=0.5", "env.radio.burst=20.0"]),
    "late": (5, ["env.measures=all", "env.radio.delay=2"]),
    "window": (10, ["env.observation=window", "env.observation_scale=raw", *LOST]),
    "map": (10, ["env.observation=map", *LOST]),
}


def make_pair(method: str, hold: int, options: list[str]):
    """Returns environments that are stepped one by one, and ones that hold their actions."""
    fires = ["setup=strong", "fire=front", "fire.num_train_fires=3", "env.horizon=40"]
    small = f"policy.hold={hold}", "env.map.pixels=8"
    config = resolve(method, [*fires, *options, *small])
    envs = []
    for steps in (1, hold):
        core = WildfireEnv(3, config.env, config.fire, 5, hold=steps)
        envs.append(TransformedEnv(core, Communication(build_comm(config, 3))))
    return envs


@pytest.mark.parametrize(
    ("method", "world"),
    [
        *((method, "lost messages, failures, burning out") for method in METHODS),
        *(("independent", "plain"), ("positional", "window"), ("consensus", "map")),
        *((method, "base, limited radio") for method in ("consensus", "maps")),
        *((method, "late, bursty, limited") for method in ("consensus", "maps")),
        *(("positional", "late"), ("positional", "spells of losses")),
    ],
)
def test_a_held_action_equals_its_steps_one_by_one(method, world):
    """To the last digit, in the transitions, the state of the world and the measures."""
    hold, options = WORLDS[world]
    single, holding = make_pair(method, hold, options)
    generator, decisions, ends = torch.Generator().manual_seed(hold), [], 0
    now, later, steps = single.reset(), holding.reset(), []
    for _ in range(60 // hold):
        action = 3 * torch.rand(3, 6, 3, generator=generator) - 1.5
        for step in range(hold):
            done, now = single.step_and_maybe_reset(now.set(keys.ACTION, action.clone()))
            steps.append(done["next"])
            if step < hold - 1:  # an episode ends with a decision
                assert not done["next", "done"].any()
        one, later = holding.step_and_maybe_reset(later.set(keys.ACTION, action.clone()))
        decisions.append(one["next"])
        ends += int(one["next", "done"].sum())
        expected, taken = steps[-1], torch.stack(steps[-hold:], 1)
        for key in expected.keys(True, True):
            if key != keys.REWARD:
                assert one["next"][key].equal(expected[key]), key
        assert one["next"][keys.REWARD].equal(taken[keys.REWARD].sum(1))
        for key in one["next", keys.STEPS].keys(True, True):
            assert one["next", keys.STEPS][key].equal(taken[key]), key
        for key in now.exclude(keys.ACTION).keys(True, True):
            assert later[key].equal(now[key]), key
    for part in ("base_env", "transform"):
        states = getattr(single, part).state_dict(), getattr(holding, part).state_dict()
        for name, value in states[0].items():
            assert value.nan_to_num(nan=-9).equal(states[1][name].nan_to_num(nan=-9)), name
    assert ends
    measured = [
        metrics.episode_metrics(metrics.measured_steps(torch.stack(each, 1)))
        for each in (steps, decisions)
    ]
    assert measured[0].keys() == measured[1].keys()
    for name, value in measured[0].items():
        assert value.equal(measured[1][name]), name


@pytest.mark.parametrize("method", METHODS)
def test_specs_of_environments_that_hold_actions(method):
    check_env_specs(make_pair(method, 4, LOST)[1])


@pytest.mark.parametrize("learner", ["ddpg", "td3", "ippo"])
def test_learners_receive_decisions(learner):
    config = resolve(
        "consensus",
        [f"learner={learner}", "policy.hold=5", "env.horizon=20", "episodes=3", "num_envs=2"],
    )
    setup = TrainingSetup(config)
    received = []
    learn = setup.learner.learn
    setup.learner.learn = lambda rollout: received.append(rollout) or learn(rollout)
    setup.dry_run(40)
    assert setup.step == 40
    decisions = torch.cat(received, 1)
    assert decisions.shape == (2, 8)
    assert decisions[keys.STEP][0].tolist() == [0, 5, 10, 15] * 2
    actions = decisions[keys.ACTION]
    assert not actions[:, 1:].isclose(actions[:, :-1]).any()  # noise is drawn at each decision


def test_the_horizon_is_a_multiple_of_the_held_steps():
    config = resolve("independent", ["policy.hold=7", "env.horizon=20"])
    with pytest.raises(UserError, match="hold=7: expected a divisor of the horizon"):
        TrainingSetup(config)


def test_an_evaluation_of_held_actions_equals_one_step_by_step():
    config = resolve("consensus", ["setup=strong", "policy.hold=5", "env.horizon=40"])
    config = replace(config, fire=replace(config.fire, num_train_fires=1))
    actor = TrainingSetup(replace(config, num_envs=1)).actor
    (fires,) = evaluate.evaluation_fires(config, 3).values()
    assert isinstance(actor, Held)
    together = evaluate.play_learned(config, actor, fires, block=2)
    assert together == evaluate.play_blocks(config, lambda _: actor, fires, block=2)
    assert len(together["coverage"]) == 3
