"""Tests that the memory and held actions of a policy survive in somebody else's loop."""

import warnings
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from emberlink.envs import keys, parallel_env
from emberlink.envs.utils.errors import UserError
from emberlink.policies.gaussian import MEMORY
from emberlink.policies.hold import HELD
from emberlink.trainers.build import build_actor, build_env, make_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.policy import TrainedPolicy

HORIZON, STEPS = 12, 24
"""two episodes"""
LATE = ["policy.message=attention", "env.radio.delay=4"]
CONFIGS = {
    "gru": ("independent", ["learner=ippo", "policy.memory=gru", "policy.units=8", *LATE]),
    "maps": ("maps", ["setup=tuned"]),
}


def config_of(name):
    method, given = CONFIGS[name]
    short = {"policy.hold": 3, "env.horizon": HORIZON, "env.num_uavs": 3}
    return resolve(method, given, **short)


@cache
def policy_of(name):
    """Returns actors with random weights that move the UAVs, frozen."""
    config = config_of(name)
    actor = build_actor(config, make_env(config, seed=0), torch.Generator().manual_seed(0))
    with torch.no_grad():
        for value in actor.module.parameters():
            value.mul_(3)
    return TrainedPolicy(actor, config, Path()).requires_grad_(False)


def make(config, seed):
    return make_env(config, num_envs=1, seed=seed)


@cache
def alone(policy):
    """Returns the actions of two environments, each in a separate rollout."""
    runs = [
        make(policy.config, seed).rollout(STEPS, policy, break_when_any_done=False)
        for seed in (3, 4)
    ]
    return torch.stack([run[keys.ACTION][0] for run in runs])


def flown(env, act):
    """Returns the actions of an episode in which a function acts on each time step."""
    td, actions = env.reset(), []
    for _ in range(HORIZON):
        td = act(td)
        actions.append(td[keys.ACTION].clone())
        td = step_mdp(env.step(td))
    return torch.stack(actions, 1)[0]


@pytest.fixture(params=CONFIGS)
def policy(request):
    return policy_of(request.param)


def test_state_is_declared(policy):
    carried = [HELD, MEMORY] if MEMORY in policy.in_keys else [HELD]
    assert set(carried) <= set(policy.in_keys)
    assert {("next", *key) for key in carried} <= set(policy.out_keys)
    env = make(policy.config, 3)
    check_env_specs(env)
    assert not env.reset()[HELD].any()


def test_only_declared_keys_are_read(policy):
    def act(td):
        return td.update(policy(td.select(*policy.in_keys)).select(*policy.out_keys))

    assert flown(make(policy.config, 3), act).equal(alone(policy)[0, :HORIZON])


# A ParallelEnv starts processes, which import torch for seconds.
@pytest.mark.parametrize(
    ("cls", "collected"),
    [
        (SerialEnv, False),
        (SerialEnv, True),
        (partial(ParallelEnv, mp_start_method="fork"), False),
        pytest.param(ParallelEnv, True, marks=pytest.mark.heavy),
    ],
)
def test_batched_environments_act_as_alone(policy, cls, collected):
    env = cls(2, [partial(make, policy.config, seed) for seed in (3, 4)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if collected:
            collector = Collector(env, policy, frames_per_batch=2 * STEPS, total_frames=2 * STEPS)
            run = next(iter(collector))
        else:
            run = env.rollout(STEPS, policy, break_when_any_done=False)
    actions = run[keys.ACTION].squeeze(1).clone()
    if not env.is_closed:
        env.close()
    assert torch.allclose(actions, alone(policy), atol=1e-5)


def inputs(policy, td):
    present = td.keys(True)
    names = [key for key in policy.in_keys if key in present]
    return {"_".join(k) if isinstance(k, tuple) else k: td[k] for k in names}


def test_exported_policy_acts_as_the_policy(policy):
    start = make(policy.config, 3).reset()
    program = torch.export.export(policy, args=(), kwargs=inputs(policy, start), strict=False)
    exported = program.module()

    def act(td):
        for key, value in zip(policy.out_keys, exported(**inputs(policy, td)), strict=True):
            td[key] = value.clone()
        return td

    actions = flown(make(policy.config, 3), act)
    assert torch.allclose(actions, alone(policy)[0, :HORIZON], atol=1e-5)


@pytest.mark.slow  # torch.compile is imported for seconds
def test_compiled_policy_acts_as_the_policy(policy):
    compiled = torch.compile(policy, backend="eager")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = make(policy.config, 3).rollout(HORIZON, compiled)
    assert torch.allclose(run[keys.ACTION][0], alone(policy)[0, :HORIZON], atol=1e-5)


def test_pettingzoo_carries_the_state(policy):
    env, actions = parallel_env(make(policy.config, 3)), []
    env.reset()
    while env.agents:
        actions.append(np.stack([*env.act(policy).values()]))
        env.step(dict(zip(env.agents, actions[-1], strict=True)))
    assert np.array_equal(np.stack(actions), alone(policy)[0, :HORIZON].numpy())


def test_policy_without_its_state_says_so_after_the_first_step(policy):
    env = make(policy.config, 3)
    td = env.reset().exclude(HELD, MEMORY)
    td = step_mdp(env.step(policy(td)))
    with pytest.raises(UserError, match=r"carries .*held.* from step to step"):
        policy(td.exclude(HELD))


def test_own_loop_without_primer_keeps_the_state(policy):
    config = policy.config
    env = build_env(config, num_envs=1, fire=config.fire, seed=3, device="cpu")
    assert flown(env, policy).equal(alone(policy)[0, :HORIZON])
