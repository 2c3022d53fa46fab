"""Tests the scripted policies that search by maps: their belief maps and targets."""

import math

import pytest
import torch
from torchrl.envs import step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.config import RadioConfig
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.policies.scripted.map_greedy import Courier, MapGreedy, MapGreedyAll, MapGreedyAlone

NEVER = math.inf
VARIANTS = [MapGreedyAlone, MapGreedy, MapGreedyAll, Courier]


def world(**settings) -> WildfireConfig:
    """Returns a world in which UAVs see 5 x 5 cells from altitude 4."""
    return WildfireConfig(**{"grid": (30, 30), "num_uavs": 1, "displacement": 2.0} | settings)


def advance(env, policy, td):
    return step_mdp(env.step(policy(td)), keep_other=True)


def first_plan(env, kind, position):
    """Returns the targets after the first look, from still UAVs, as nested lists."""
    td = env.reset(position=torch.tensor(position))
    policy = kind(env)
    td = policy(td)
    td[keys.ACTION].zero_()
    td = step_mdp(env.step(td), keep_other=True)
    return policy(td)[MapGreedy.TARGET].tolist()


def random_fires(config, count: int, seed: int = 0):
    """Returns fires in which neighbours burn at different times, [count, 2, X, Y]."""
    draw = torch.Generator().manual_seed(seed)
    arrival = 60 * torch.rand(count, *config.grid, generator=draw) - 20
    arrival = arrival.where(arrival < 25, NEVER)
    return torch.stack((arrival, arrival + 10), 1)


# Where they fly


def test_a_uav_flies_to_the_neighbourhood_of_known_fire():
    # From (5, 5) cells 3 to 7 are seen. Around the fire at (7, 5), ten unseen cells are within 2:
    # x 8 and 9, y 3 to 7. All are seen from (7, 5), for 10 / (2 + 2); from (6, 5) five, for
    # 5 / (1 + 2); no other place is better.
    fire = torch.full((30, 30), NEVER)
    fire[7, 5] = 0
    assert first_plan(WildfireEnv(1, world(), fire), MapGreedy, [[5.0, 5, 4]]) == [[[7, 5]]]
    ashes = torch.stack((fire, fire + 1))[None]  # burnt out when it is seen: it does not spread
    assert first_plan(WildfireEnv(1, world(), ashes), MapGreedy, [[5.0, 5, 4]]) != [[[7, 5]]]


def test_uavs_that_hear_each_other_choose_different_cells():
    fire = torch.full((30, 30), NEVER)
    fire[7, 5] = 0
    env = WildfireEnv(1, world(num_uavs=2), fire)
    start = [[5.0, 5, 4], [5.0, 5, 4]]
    ((first, second),) = first_plan(env, MapGreedy, start)
    assert first == [7, 5]
    assert max(abs(a - b) for a, b in zip(first, second, strict=True)) > 2
    ((first, second),) = first_plan(env, MapGreedyAlone, start)
    assert first == second == [7, 5]
    silent = WildfireEnv(1, world(num_uavs=2, radio=RadioConfig(range=0.0)), fire)
    ((first, second),) = first_plan(silent, MapGreedy, start)
    assert first == second


@pytest.mark.parametrize(
    ("kind", "told"), [(MapGreedyAlone, False), (MapGreedy, False), (MapGreedyAll, True)]
)
def test_who_learns_of_a_fire_out_of_range(kind, told):
    # UAV 1 sees the corner of a large fire; UAV 0, 12 cells away, sees none.
    fire = torch.full((30, 30), NEVER)
    fire[14:, 14:] = 0
    env = WildfireEnv(1, world(num_uavs=2), fire)
    td = env.reset(position=torch.tensor([[3.0, 14, 4], [15, 14, 4]]))
    policy = kind(env)
    for _ in range(2):
        td = policy(td)
        td[keys.ACTION].zero_()
        td = step_mdp(env.step(td), keep_other=True)
    policy(td)
    ignited, _ = policy.maps.was_fire(policy.maps.last_seen())
    assert ignited[0, 0].any().item() is told
    assert ignited[0, 1].any()


# Belief maps


def test_the_maps_are_those_of_the_world():
    """The policy's maps in range equal the environment's in a world with a base."""
    radio = RadioConfig(range=8.0, loss=0.5)
    settings = {"num_uavs": 5, "failures": 2.5, "base": (0.0, 15.0), "horizon": 40}
    config = world(radio=radio, **settings)
    env = WildfireEnv(3, config, random_fires(config, 3), seed=4)
    policy, td = MapGreedy(env), env.reset()
    for _ in range(35):
        td = policy(td)
        if td[keys.STEP][0] > 0:
            assert policy.maps.known.last_seen[..., :-5].equal(env.knowledge.last_seen)
        td = step_mdp(env.step(td), keep_other=True)
    assert not td[keys.ALIVE].all()


@pytest.mark.parametrize("kind", VARIANTS)
def test_only_cells_that_were_seen_matter(kind):
    """Other arrival times of cells that nobody sees change no action."""
    config = world(num_uavs=3, horizon=30, displacement=0.5, base=(0.0, 15.0))
    fires = random_fires(config, 2)

    def actions(times):
        env = WildfireEnv(2, config, times, seed=1)
        policy, td, taken = kind(env), env.reset(), []
        for _ in range(30):
            td = policy(td)
            taken.append(td[keys.ACTION].clone())
            td = step_mdp(env.step(td), keep_other=True)
        policy(td)
        return torch.stack(taken), (policy.maps.last_seen() >= 0).any(1, keepdim=True)

    taken, seen = actions(fires)
    others = torch.where(seen, fires, random_fires(config, 2, seed=5))
    assert (others != fires).any()
    assert actions(others)[0].equal(taken)


# Episodes and batches


@pytest.mark.parametrize("name", sorted({*SCRIPTED.known()} - {"follow_target"}))
def test_a_reset_of_one_environment_leaves_the_others(name):
    kind = SCRIPTED.find(name)
    config = world(num_uavs=3, horizon=60, base=(0.0, 15.0))
    fires = random_fires(config, 2)
    env, undisturbed = (WildfireEnv(2, config, fires, seed=9) for _ in range(2))
    policy, same, fresh = kind(env), kind(undisturbed), kind(env)
    td, other = env.reset(), undisturbed.reset()
    for _ in range(13):
        td, other = advance(env, policy, td), advance(undisturbed, same, other)
    td["_reset"] = torch.tensor([[False], [True]])
    td = env.reset(td)
    for _ in range(13):
        new = fresh(td.clone(recurse=True))
        td, other = policy(td), same(other)
        assert td[keys.ACTION][0].equal(other[keys.ACTION][0])
        assert td[keys.ACTION][1].equal(new[keys.ACTION][1])
        td = step_mdp(env.step(td), keep_other=True)
        other = step_mdp(undisturbed.step(other), keep_other=True)
