"""Tests scripted policies against hand-computed paths, and properties that they share."""

import functools
import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs import step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.utils.config_files import known
from emberlink.envs.world.sensor import view_radius
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.policies.scripted.lawnmower import Lawnmower, search_path
from emberlink.policies.scripted.oracle import Oracle
from emberlink.policies.scripted.simple import FollowTarget
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve

NEVER = math.inf
THREE = math.degrees(math.atan(1.2 / 4))  # the view angle: 3 x 3 cells are in view from altitude 4


def world(grid=(9, 9), uavs=1, **settings) -> WildfireConfig:
    return WildfireConfig(grid=grid, num_uavs=uavs, **settings)


def episode(env, policy, steps: int, **reset):
    """Yields the time steps of an episode with the policy's actions."""
    tds, td = [], env.reset(**reset)
    for _ in range(steps):
        td = policy(td)
        tds.append(td.clone())
        td = step_mdp(env.step(td), keep_other=True)
    return tds


# Lawnmower


def test_lawnmower_with_one_uav_by_hand():
    # The view is 3 cells wide. 8 x 9 cells: strips of x 0-1, 2-4, 5-7, each in y 0-2, 3-5, 6-8.
    path = [[0.5, 1], [0.5, 4], [0.5, 7], [3, 7], [3, 4], [3, 1], [6, 1], [6, 4], [6, 7]]
    assert search_path((8, 9), 1.2).tolist() == path
    env = WildfireEnv(1, world((8, 9), displacement=3.0, view_angle=THREE), torch.zeros(8, 9))
    tds = episode(env, Lawnmower(env), 20, position=torch.tensor([[3.5, 4.0, 4.0]]))
    path = [[*ground, 4] for ground in path]
    expected = [[3.5, 4, 4], *path, *path[-2::-1], path[1], path[2]]
    places = torch.stack([td[keys.POSITION][0, 0] for td in tds])
    torch.testing.assert_close(places, torch.tensor(expected), atol=5e-4, rtol=0)


@pytest.mark.heavy
@settings(max_examples=20, deadline=None)
@given(
    grid=st.tuples(st.integers(8, 21), st.integers(8, 21)),
    uavs=st.integers(1, 9),
    angle=st.floats(2, 75),
    ceiling=st.floats(1, 6),
    displacement=st.floats(0.9, 40),
)
def test_lawnmower_covers_every_cell(grid, uavs, angle, ceiling, displacement):
    config = world(
        grid,
        uavs,
        view_angle=angle,
        altitude=(0.8, ceiling),
        displacement=displacement,
        horizon=2500,
    )
    env = WildfireEnv(
        1, config, torch.zeros(grid)
    )  # all cells burn, so that seen cells are counted
    mower = Lawnmower(env)
    flight = len(mower.path) * (2 + math.ceil(max(grid) / displacement)) // uavs
    td = env.reset()
    for _ in range(3 * max(grid) + 2 * flight):
        td = step_mdp(env.step(mower(td)), keep_other=True)
        if td[keys.SEEN].item() == grid[0] * grid[1]:
            return
    pytest.fail(f"{td[keys.SEEN].item()} of {grid[0] * grid[1]} cells were seen")


# FollowTarget


def test_follow_target_flies_straight_to_the_target_by_hand():
    env = WildfireEnv(1, world(uavs=3, displacement=0.5), torch.full((9, 9), NEVER))
    td = env.reset(position=torch.tensor([[1.0, 1, 2], [5, 5, 4], [3, 3, 3]]))
    td[keys.TARGET] = torch.tensor([[[5.0, 3, 1], [5, 5, 3.75], [3, 3, 3]]])
    action = FollowTarget(env)(td)[keys.ACTION].mul(1e4).round() / 1e4
    # By (4, 2, -1) cells: 8, 4, -2 units. By (0, 0, -0.25): half a unit, then it stops.
    assert action.tolist() == [[[1, 0.5, -0.25], [0, 0, -0.5], [0, 0, 0]]]


# Oracle


def scalar_oracle(position, arrival, seen, step, config) -> list[tuple[float, float]]:
    """Returns the destination of each UAV of one environment, computed with loops."""
    radius = view_radius(config.altitude[1], config.view_angle)
    cells = list(itertools.product(range(config.grid[0]), range(config.grid[1])))
    left = {c for c in cells if arrival[c[0]][c[1]] <= config.horizon and not seen[c[0]][c[1]]}

    def far(uav, cell):
        x, y, _ = position[uav]
        wait = max(arrival[cell[0]][cell[1]] - step, 0.0)
        return max(abs(x - cell[0]), abs(y - cell[1])) + wait * 1000.0

    uavs = range(len(position))
    order = sorted(uavs, key=lambda u: (min((far(u, c) for c in left), default=NEVER), u))
    sent = {}
    for uav in order:
        if not left:
            sent[uav] = tuple(position[uav][:2])
            continue
        sent[uav] = chosen = min(left, key=lambda c: (far(uav, c), c))
        left = {c for c in left if max(abs(c[0] - chosen[0]), abs(c[1] - chosen[1])) > radius}
    return [sent[uav] for uav in uavs]


def sent(env, oracle, td):
    """Returns the oracle's destinations for steps of any length, [num_envs, n, 2]."""
    action = oracle(td.clone())[keys.ACTION]
    return td[keys.POSITION][..., :2] + action[..., :2] * env.config.displacement


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    grid=st.tuples(st.integers(8, 12), st.integers(8, 12)),
    uavs=st.integers(1, 7),
    angle=st.floats(5, 60),
)
def test_the_oracle_equals_loops(seed, grid, uavs, angle):
    draw = torch.Generator().manual_seed(seed)
    envs, horizon = 3, 8
    config = world(grid, uavs, view_angle=angle, displacement=32.0, horizon=horizon)
    # Few integer values give ties. Some cells never burn.
    arrival = torch.randint(-3, 14, (envs, *grid), generator=draw).float()
    arrival[torch.rand(arrival.shape, generator=draw) < 0.6] = NEVER
    env = WildfireEnv(envs, config, arrival, seed=seed)
    oracle = Oracle(env)
    position = torch.rand(envs, uavs, 3, generator=draw) * torch.tensor([*grid, 0.0])
    position = position.floor() + torch.tensor([0.0, 0.0, 4.0])
    td = env.reset(position=position)
    for step in range(4):
        seen = (env.fire_map == 1).tolist()
        expected = [
            scalar_oracle(td[keys.POSITION][e].tolist(), env.arrival_time[e].tolist(), *rest)
            for e, rest in enumerate(zip(seen, [step] * envs, [config] * envs, strict=True))
        ]
        assert (sent(env, oracle, td) - torch.tensor(expected)).abs().max() < 1e-4
        # Half a step further, so that positions lie between cells.
        td = oracle(td)
        td[keys.ACTION] = td[keys.ACTION] / 2
        td = step_mdp(env.step(td), keep_other=True)


# All policies


def fires(shape, count: int):
    """Returns random fires that grow, [count, X, Y]."""
    draw = torch.Generator().manual_seed(count)
    arrival = 60 * torch.rand(count, *shape[0], generator=draw) - 20
    return arrival.where(arrival < 30, NEVER)


@functools.cache
def world_of(name: str):
    """Returns the configuration of a world with a short horizon."""
    return resolve("consensus", ["setup=tuned", f"world={name}", "env.horizon=8"])


@pytest.mark.parametrize("place", [name for name in known("world") if name != "file"])
@pytest.mark.parametrize("name", SCRIPTED.known())
def test_every_policy_in_every_world(name, place):
    config = world_of(place)
    arrival = fires((config.env.grid,), 2)
    both = arrival if place == "paper" else torch.stack((arrival, arrival + 8), 1)

    def actions(seeds, fire):
        env = build_env(config, num_envs=len(seeds), fire=fire, seed=seeds, device="cpu")
        tds = episode(env, SCRIPTED.find(name)(env.base_env), 8)
        if name != "random_actions":  # policies that fly to points in the box do not leave it
            assert not any(td[keys.HIT_BOUNDARY].any() for td in tds)
        return torch.stack([td[keys.ACTION] for td in tds])

    batch = actions([5, 6], both)
    assert batch.shape[1:3] == (2, config.env.num_uavs)
    assert batch.isfinite().all()
    assert batch.abs().max() <= 1
    # The second environment alone equals the second of the batch.
    assert actions([6], both[1:])[:, 0].equal(batch[:, 1])
