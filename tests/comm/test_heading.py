"""Tests the bonuses for approaching and for circling against hand-computed numbers."""

from dataclasses import replace

import pytest
import torch
from time_steps import WORLD, communication, time_step

from emberlink.comm.consensus import ConsensusConfig, HeadingConfig, circling
from emberlink.envs import keys
from emberlink.envs.config import RadioConfig, RewardConfig, WildfireConfig

INSIDE = (False, False, False)


@pytest.mark.parametrize(("axes", "exits"), [("xyz", [18, 0, 0, 0]), ("xy", [18, 0, 0, 18])])
def test_the_heading_term_is_added_unless_the_uav_left_the_box(axes, exits):
    world = WildfireConfig(grid=(64, 64), reward=RewardConfig(exit_axes=axes))
    before = time_step([[10.0 * i, 5.0, 2.0] for i in range(4)], [1] * 4, centre=[[60.0, 5.0]] * 4)
    talk = communication(before, world=world)
    before = talk._reset(before, before)
    # All UAVs fly straight to their target. Their next target is elsewhere.
    after = time_step(
        [[10.0 * i + 1, 5.0, 2.0] for i in range(4)],
        [1] * 4,
        centre=[[0.0, 60.0]] * 4,
        hit_boundary=[INSIDE, (True, False, False), (False, True, False), (False, False, True)],
    )
    after.set(keys.REWARD, torch.full((1, 4, 1), -7.0))
    reward = talk._step(before, after)[keys.REWARD]
    assert reward.flatten().tolist() == [value - 7 for value in exits]


@pytest.mark.parametrize(
    ("target", "move", "bonus"),
    [
        # Flying north, a target at 1 cell to the west (left): the whole move counts,
        ([-1.0, 0.0], [0.0, 0.1], 0.1),
        ([1.0, 0.0], [0.0, 0.1], -0.1),  # to the right: it counts negatively
        ([-2.0, 0.0], [0.0, 0.1], 0.08),  # 2 d / (1 + d²) = 4/5
        ([-0.5, 0.0], [0.0, 0.1], 0.08),  # 1 / 1.25
        ([0.0, 0.0], [0.0, 0.1], 0.0),
        ([-1.0, 0.0], [-0.1, 0.0], 0.0),  # straight at it
        ([0.0, 1.0], [0.1, 0.0], 0.1),
        ([0.6, 0.8], [0.05, 0.0], 0.04),  # 0.05 · 0.8
    ],
)
def test_circling_by_hand(target, move, bonus):
    here = torch.tensor([10.0, 10.0, 2.0])
    there = here + torch.tensor([*move, 0.3])
    way = here + torch.tensor([*target, -1.0])
    assert circling(here, there, way).item() == pytest.approx(bonus, abs=1e-6)


def test_circling_is_for_discoverers_with_old_fire_only():
    heading = HeadingConfig(form="approach", weight=2.0, circle=5.0)
    config = ConsensusConfig(discoverer="any_fire", heading=heading)
    # UAV 0 sees old fire only, UAV 1 old and new fire, UAV 2 hears UAV 1, UAV 3 hears no UAV.
    places = [[10.0, 10.0, 2.0], [30.0, 10.0, 2.0], [33.0, 10.0, 2.0], [50.0, 50.0, 2.0]]
    before = time_step(
        places,
        [0, 2, 0, 0],
        [3, 3, 0, 0],
        centre=[[0.0, 0.0], [31.0, 10.0], [0.0, 0.0], [0.0, 0.0]],
        old_centre=[[9.0, 10.0], [28.0, 10.0], [0.0, 0.0], [0.0, 0.0]],
    )
    talk = communication(before, config, replace(WORLD, radio=RadioConfig(range=5.0)))
    before = talk._reset(before, before)
    assert before[keys.FOLLOWS].flatten().tolist() == [0, 1, 1, -1]
    after = time_step([[x, y + 0.5, z] for x, y, z in places], [0] * 4)
    waypoint = before["agents", "target"][0, 3]
    start = torch.tensor(places[3])
    nearer = (waypoint - start).norm() - (waypoint - start - torch.tensor([0, 0.5, 0])).norm()
    gained = [5.0 * 0.5, 2 * (1 - 1.25**0.5), 2 * (3 - 9.25**0.5), 2 * nearer.item()]
    reward = talk._step(before, after)[keys.REWARD]
    assert reward.flatten().tolist() == pytest.approx(gained, abs=1e-5)
