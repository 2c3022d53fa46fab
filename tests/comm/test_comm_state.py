"""Tests the state of communication modules: frame skips, resets, checkpoints, transforms."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    ExcludeTransform,
    FrameSkipTransform,
    RewardSum,
    TransformedEnv,
    check_env_specs,
    step_mdp,
)
from visited_map import VisitedMap, VisitedMapConfig

from emberlink.comm.base import CommModule, Communication
from emberlink.comm.consensus import Consensus, ConsensusConfig, HeadingConfig
from emberlink.comm.positional import Positional, PositionalConfig
from emberlink.envs import keys
from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.radio import neighbours

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
STATES = {"consensus": ["streak", "waypoint", "fire_score", "altitude_sum"], "map": ["map"]}


def action(step: int) -> torch.Tensor:
    return torch.rand(ENVS, UAVS, 3, generator=torch.Generator().manual_seed(step)) * 2 - 1


class Heard(VisitedMap):
    """Rewards a UAV for each UAV that it hears."""

    def shaping(self, tensordict):
        return tensordict[keys.HEARS].sum(-1).float()


def test_links_are_computed_before_the_reward_is_shaped():
    env = TransformedEnv(bare(), Communication(Heard(WORLD, VisitedMapConfig(), ENVS)))
    plain = bare()
    tds = [environment.reset() for environment in (env, plain)]
    for step in range(5):
        tds = [
            environment.step(td.set(keys.ACTION, action(step)))["next"]
            for environment, td in zip((env, plain), tds, strict=True)
        ]
        shaped, reward = (td[keys.REWARD][..., 0] for td in tds)
        links = neighbours(tds[0][keys.POSITION], 6.0)
        assert links.any()
        assert shaped.equal(reward + links.sum(-1))


def bare() -> WildfireEnv:
    return WildfireEnv(ENVS, WORLD, FIRE, seed=4)


def communicating(name: str) -> TransformedEnv:
    return TransformedEnv(bare(), Communication(MODULES[name]()))


def state(env) -> dict[str, torch.Tensor]:
    """Returns the communication state of an environment, at any depth of transforms."""
    every = [part for part in env.transform.modules() if isinstance(part, CommModule)]
    (module,) = every or [
        part for part in env.base_env.transform.modules() if isinstance(part, CommModule)
    ]
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
@pytest.mark.parametrize("nested", [False, True])
def test_a_frame_skip_equals_single_steps(name, nested):
    skip = 4
    if nested:
        skipping = TransformedEnv(communicating(name), FrameSkipTransform(skip), auto_unwrap=False)
    else:
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
        assert both[0]["streak"].max() > 5


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


@pytest.mark.parametrize("name", MODULES)
def test_further_transforms_may_drop_keys_of_the_communication(name):
    transforms = Compose(
        Communication(MODULES[name]()),
        RewardSum(in_keys=[keys.REWARD], out_keys=["sum"]),
        ExcludeTransform(keys.HEARS, keys.POSITION, keys.NEW_FIRE),
    )
    changed, plain = TransformedEnv(bare(), transforms), communicating(name)
    check_env_specs(changed)
    changed.base_env.set_seed(4)
    actions = torch.stack([action(step) for step in range(6)], 1)
    tds = [env.reset() for env in (changed, plain)]
    for step in range(6):
        tds = [
            step_mdp(env.step(td.set(keys.ACTION, actions[:, step])))
            for env, td in zip((changed, plain), tds, strict=True)
        ]
    first, second = tds
    assert keys.POSITION not in first
    assert first[keys.OBSERVATION].equal(second[keys.OBSERVATION])


@pytest.mark.parametrize("name", MODULES)
def test_a_missing_input_gives_a_named_error(name):
    dropping = Compose(ExcludeTransform(keys.POSITION), Communication(MODULES[name]()))
    env = TransformedEnv(bare(), dropping)
    with pytest.raises(ValueError, match=r"key \('agents', 'position'\) is missing: .* reads it"):
        env.reset()


class Crooked(VisitedMap):
    """Registers state without the dimension of the environments."""

    def __init__(self, *given):
        super().__init__(*given)
        self.register_buffer("best", torch.zeros(UAVS))


def test_state_has_a_row_per_environment():
    with pytest.raises(ValueError, match=r"Crooked: buffer 'best' of shape \[5\]"):
        Communication(Crooked(WORLD, VisitedMapConfig(), ENVS))


@pytest.mark.parametrize(("limit", "loss"), [(6.0, 0.0), (6.0, 0.4), (float("inf"), 1.0)])
def test_links_are_written_once(limit, loss):
    world = replace(WORLD, radio=RadioConfig(range=limit, loss=loss))
    module = VisitedMap(world, VisitedMapConfig(), ENVS)
    env = TransformedEnv(bare(), Communication(module))
    rollout = env.rollout(10)["next"]
    hears, position = rollout[keys.HEARS], rollout[keys.POSITION].double()
    near = (position.unsqueeze(-2) - position.unsqueeze(-3)).norm(dim=-1) < limit
    near &= ~torch.eye(UAVS, dtype=torch.bool)
    assert hears.shape == (ENVS, 10, UAVS, UAVS)
    assert not (hears & ~near).any()
    if loss in (0.0, 1.0):
        assert hears.equal(near if loss == 0 else torch.zeros_like(near))
    else:
        assert 0.3 < 1 - hears.sum() / near.sum() < 0.5


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


def test_positional_links_all_uavs():
    world = replace(WORLD, radio=RadioConfig(range=float("inf")))
    env = TransformedEnv(bare(), Communication(Positional(world, PositionalConfig(), ENVS)))
    hears = env.reset()[keys.HEARS]
    assert hears.equal((~torch.eye(UAVS, dtype=torch.bool)).expand(ENVS, -1, -1))
