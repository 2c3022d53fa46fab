"""Tests the state of communication modules: frame skips, resets, checkpoints, transforms."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    FrameSkipTransform,
    TransformedEnv,
)
from visited_map import VisitedMap, VisitedMapConfig

from emberlink.comm.base import CommModule, Communication
from emberlink.comm.consensus import Consensus, ConsensusConfig, HeadingConfig
from emberlink.comm.positional import Positional, PositionalConfig
from emberlink.envs import keys
from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.wildfire import WildfireEnv

ENVS, UAVS = 3, 5
RADIO = RadioConfig(range=6.0)
WORLD = WildfireConfig(grid=(12, 10), num_uavs=UAVS, horizon=100, radio=RADIO)
LOSSY = replace(WORLD, radio=RadioConfig(range=6.0, loss=0.2))
FIRE = 16 * torch.rand(12, 10, generator=torch.Generator().manual_seed(0))
MODULES = {
    "consensus": lambda: Consensus(
        LOSSY,
        ConsensusConfig(
            discoverer="any_fire",
            wander=False,
            heading=HeadingConfig(form="approach", circle=2.0),
        ),
        ENVS,
    ),
    "map": lambda: VisitedMap(WORLD, VisitedMapConfig(), ENVS),
}
STATES = {"consensus": ["waypoint", "fire_score", "altitude_sum"], "map": ["map"]}


def action(step: int) -> torch.Tensor:
    return torch.rand(ENVS, UAVS, 3, generator=torch.Generator().manual_seed(step)) * 2 - 1


def bare() -> WildfireEnv:
    return WildfireEnv(ENVS, WORLD, FIRE, seed=4)


def communicating(name: str) -> TransformedEnv:
    return TransformedEnv(bare(), Communication(MODULES[name]()))


def state(env) -> dict[str, torch.Tensor]:
    """Returns the communication state of an environment, at any depth of transforms."""
    every = [part for part in env.transform.modules() if isinstance(part, CommModule)]
    (module,) = every
    return {name: value.clone() for name, value in module.state_dict().items()}


def fly(env, steps: range, td=None):
    """Returns the last time step and the rewards; the environment receives the action only."""
    td, rewards = env.reset() if td is None else td, []
    for step in steps:
        stepped = env.step(TensorDict({keys.ACTION: action(step)}, [ENVS]))
        rewards.append(stepped["next", *keys.REWARD])
        td = stepped["next"]
    return td, rewards


@pytest.mark.parametrize("name", MODULES)
def test_a_frame_skip_equals_single_steps(name):
    skip = 4
    transforms = Compose(Communication(MODULES[name]()), FrameSkipTransform(skip))
    skipping = TransformedEnv(bare(), transforms)
    plain = communicating(name)
    skipping.reset()
    plain.reset()
    for step in range(5):
        given = TensorDict({keys.ACTION: action(step)}, [ENVS])
        skipped = skipping.step(given.clone())["next"]
        rewards = 0
        for _ in range(skip):
            stepped = plain.step(given.clone())["next"]
            rewards = rewards + stepped[keys.REWARD]
        assert skipped[keys.OBSERVATION].equal(stepped[keys.OBSERVATION])
        assert skipped[keys.REWARD].equal(rewards)
        both = state(skipping), state(plain)
        for key in STATES[name]:
            assert both[0][key].equal(both[1][key]), key
    if name == "consensus":
        assert both[0]["fire_score"].max() > 5


@pytest.mark.parametrize("name", MODULES)
def test_a_partial_reset_leaves_the_state_of_the_others(name):
    others = torch.tensor([True, False, True])
    whole, interrupted = communicating(name), communicating(name)
    fly(whole, range(5))
    td, _ = fly(interrupted, range(5))
    before = state(interrupted)
    again = interrupted.reset(td.clone().set("_reset", ~others.unsqueeze(-1)))
    after = state(interrupted)
    assert again[keys.OBSERVATION][others].equal(td[keys.OBSERVATION][others])
    assert not again[keys.OBSERVATION][1].equal(td[keys.OBSERVATION][1])
    for key in before:
        assert after[key][others].equal(before[key][others]), key
    for key in STATES[name]:
        assert not after[key][1].equal(before[key][1]), key
    ended = fly(whole, range(5, 9), whole)[0]
    other = fly(interrupted, range(5, 9), interrupted)[0]
    for key in (keys.OBSERVATION, keys.REWARD):
        assert other[key][others].equal(ended[key][others])
        assert not other[key][1].equal(ended[key][1])


@pytest.mark.parametrize("name", MODULES)
def test_a_restored_state_continues_bit_for_bit(name):
    first, second = communicating(name), communicating(name)
    fly(first, range(6))
    world = {key: value.clone() for key, value in first.base_env.state_dict().items()}
    saved = {key: value.clone() for key, value in first.transform.state_dict().items()}
    assert len(saved) == len(state(first))
    fly(second, range(20, 23))  # changes the state
    for place, content in ((second.base_env, world), (second.transform, saved)):
        place.load_state_dict(content)
    restored, rewards = fly(first, range(6, 11), first)
    other, again = fly(second, range(6, 11), second)
    for key in (keys.OBSERVATION, keys.HEARS):
        assert restored[key].equal(other[key])
    assert torch.stack(rewards).equal(torch.stack(again))


def test_a_uav_observes_its_own_vector_first():
    """Without limit, UAV 1 observes the vectors of UAVs 1, 2, …, 0; unheard ones are 0."""
    for reach in (float("inf"), 4.0):
        world = replace(WORLD, radio=RadioConfig(range=reach))
        own = TransformedEnv(
            bare(), Communication(Positional(world, PositionalConfig(own_first=True), ENVS))
        )
        usual = TransformedEnv(bare(), Communication(Positional(world, PositionalConfig(), ENVS)))
        mine, theirs = own.reset()[keys.OBSERVATION], usual.reset()[keys.OBSERVATION]
        for uav in range(UAVS):
            for place in range(UAVS):
                other = (uav + place) % UAVS
                shown = mine[:, uav, 6 * place : 6 * place + 6]
                assert shown.equal(theirs[:, uav, 6 * other : 6 * other + 6])
