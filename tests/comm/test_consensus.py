"""Tests consensus on small networks with known results."""

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from time_steps import WORLD, communication, time_step

from emberlink.comm.consensus import ConsensusConfig, HeadingConfig
from emberlink.envs import keys
from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.world import radio


def in_a_row(count: int, gap: float = 9.0) -> list[list[float]]:
    return [[gap * i, 0.0, 2.0] for i in range(count)]


def after_consensus(position, new, *, config=None, world=WORLD, **more) -> TensorDict:
    """Returns the first time step of an episode after consensus."""
    now = time_step(position, new, **more)
    return communication(now, config, world)._reset(now, now)


def follows(position, new, **more) -> list[int]:
    return after_consensus(position, new, **more)[keys.FOLLOWS][0].tolist()


@pytest.mark.parametrize(
    ("new", "more", "expected"),
    [
        ([2, 0, 3], {}, [0, 2, 2]),  # more fire from the same altitude
        ([2, 0, 2], {}, [0, 0, 2]),  # ties go to the lower index
        ([0] * 5, {}, [-1] * 5),
        ([0, 0, 0, 0, 0, 0, 1], {}, [6] * 7),  # along a chain of any length
        ([0, 0, 1, 0, 5], {}, [2, 2, 2, 4, 4]),  # a discoverer passes on nothing
        ([0, 1, 0, 0, 0, 9], {}, [1, 1, 5, 5, 5, 5]),
        ([0, 1, 0, 0, 0, 9], {"agree": False}, [1, 1, 1, -1, 5, 5]),
        ([0, 1, 0, 0, 0, 9], {"follow": "nearest"}, [1, 1, 1, 1, 5, 5]),
    ],
)
def test_who_follows_whom_in_a_row(new, more, expected):
    config = ConsensusConfig(**more)
    assert follows(in_a_row(len(new)), new, config=config) == expected


def test_the_range_is_exclusive_and_in_three_dimensions():
    position = torch.tensor([[0.0, 0.0, 1.0], [6.0, 0.0, 9.0]])
    assert not radio.neighbours(position, 10.0).any()
    assert radio.neighbours(position, 10.001).tolist() == [[False, True], [True, False]]


def test_without_wandering_there_is_no_target_and_no_bonus():
    still = ConsensusConfig(
        wander=False, target="relative", heading=HeadingConfig(form="approach", weight=2.0)
    )
    start = [[5.0, 5.0, 2.0], [30.0, 30.0, 2.0], [33.0, 34.0, 2.0]]
    moved = [[5.0, 6.0, 2.0], [30.0, 30.0, 2.0], [33.0, 33.0, 2.0]]
    first = time_step(start, [0, 4, 0], centre=[[0.0, 0.0], [30.0, 30.0], [0.0, 0.0]])
    talk = communication(first, still)
    first = talk._reset(first, first)
    assert first[keys.FOLLOWS].tolist() == [[-1, 1, 1]]
    assert first[keys.TARGET][0, 0].tolist() == start[0]
    assert first[keys.OBSERVATION][0, 0, -3:].tolist() == [0.0, 0.0, 0.0]
    second = talk._step(first, time_step(moved, [0, 0, 0], step=1))
    # UAV 0 has no target. UAV 2 moved from a distance of 5 to one of sqrt(18) to UAV 1.
    expected = torch.tensor([0.0, 0.0, 2 * (5 - 18**0.5)])
    torch.testing.assert_close(second[keys.REWARD].flatten(), expected)


def test_relative_targets_are_displacements():
    config = ConsensusConfig(target="relative")
    position = [[3.0, 4.0, 2.5], [8.0, 4.0, 1.5]]
    centre = [[3.25, 4.5], [0.0, 0.0]]
    raw = after_consensus(position, [2, 0], centre=centre, config=config)
    assert raw[keys.OBSERVATION][0, :, 6:].tolist() == [[0.25, 0.5, 0], [-5, 0, 1]]
    world = WildfireConfig(grid=(21, 11), observation_scale="box")
    scaled = after_consensus(position, [2, 0], centre=centre, config=config, world=world)
    expected = torch.tensor([[0.25 / 10, 0.5 / 5, 0], [-5 / 10, 0, 1 / 1.5]])
    torch.testing.assert_close(scaled[keys.OBSERVATION][0, :, 6:], expected)
    assert scaled[keys.TARGET].equal(raw[keys.TARGET])


def test_a_waypoint_is_redrawn_only_by_a_wanderer_closer_than_one():
    # 0 and 1 wander, 2 is a discoverer, 3 follows it. All but 1 are at their waypoint.
    position = [[5.0, 5.0, 2.0], [30.0, 5.0, 2.0], [50.0, 50.0, 2.0], [55.0, 50.0, 2.0]]
    waypoint = torch.tensor(
        [[[5.0, 5.9, 2.0], [30.0, 6.0, 2.0], [50.0, 50.5, 2.0], [55.0, 50.0, 2.5]]]
    )
    now = time_step(position, [0, 0, 1, 0], step=3)
    talk = communication(now)
    talk.module.waypoint.copy_(waypoint)
    now = talk._step(now, now)
    assert now[keys.FOLLOWS].tolist() == [[-1, -1, 2, 2]]
    kept = (talk.module.waypoint == waypoint).all(-1)
    assert kept.tolist() == [[False, True, True, True]]
    assert now[keys.TARGET][0, :2].equal(talk.module.waypoint[0, :2])


def test_a_first_waypoint_closer_than_one_is_drawn_again():
    world = WildfireConfig(grid=(8, 8), num_uavs=1, altitude=(2.0, 2.0))
    position = torch.tensor([[3.5, 3.5, 2.0]]).expand(4000, 1, 3)
    target = after_consensus(position, [0], world=world)[keys.TARGET]
    # A random point is near with probability pi / 49 = 0.064, two in a row with 0.004.
    assert ((target - position).norm(dim=-1) < 1).float().mean() < 0.02


@pytest.mark.parametrize(("step", "redrawn"), [(49, False), (50, True)])
def test_waypoints_that_are_not_reached_are_drawn_again_in_time(step, redrawn):
    # 0 and 1 wander far from their waypoints, 2 is a discoverer.
    position = [[5.0, 5.0, 2.0], [30.0, 5.0, 2.0], [50.0, 50.0, 2.0]]
    waypoint = torch.tensor([[[5.0, 40.0, 2.0], [30.0, 40.0, 2.0], [50.0, 5.0, 2.0]]])
    now = time_step(position, [0, 0, 1], step=step)
    talk = communication(now, ConsensusConfig(redraw=50))
    talk.module.waypoint.copy_(waypoint)
    now = talk._step(now, now)
    changed = (talk.module.waypoint != waypoint).any(-1)
    assert changed.tolist() == [[redrawn, redrawn, False]]
    assert now[keys.TARGET][0, :2].equal(talk.module.waypoint[0, :2])


def test_jitter_changes_x_and_y_of_near_targets_only():
    # 0 sees fire 0.5 cells away, 1 sees fire 1 cell away, 2 follows 0 from 3 cells away.
    position = torch.tensor([[20.0, 20.0, 2.0], [40.0, 40.0, 3.0], [20.0, 23.0, 2.0]])
    more = {
        "position": position.expand(4000, 3, 3),
        "new": [9, 9, 0],
        "centre": [[20.0, 20.5], [41.0, 40.0], [0.0, 0.0]],
    }
    calm = after_consensus(**more)[keys.TARGET]
    noise = after_consensus(config=ConsensusConfig(jitter=0.75), **more)[keys.TARGET] - calm
    assert noise[:, 1:].abs().max() == 0
    assert noise[..., 2].abs().max() == 0
    near = noise[:, 0, :2]
    # N(0, 0.75) clipped to +-1 has the variance 0.396; a share of 0.182 is clipped.
    assert near.abs().max() <= 1 + 1e-5
    assert near.mean().abs() < 0.03
    assert near.var().item() == pytest.approx(0.396, abs=0.02)
    assert (near.abs() > 1 - 1e-5).float().mean().item() == pytest.approx(0.182, abs=0.02)
    assert abs(torch.corrcoef(near.T)[0, 1]) < 0.05
    later = after_consensus(config=ConsensusConfig(jitter=0.75), step=1, **more)[keys.TARGET] - calm
    assert abs(torch.corrcoef(torch.stack((near[:, 0], later[:, 0, 0])))[0, 1]) < 0.05


@pytest.mark.parametrize(
    ("more", "limit", "sent"),
    [
        ({}, 10.0, [16, 16, 32, 0, 32, 16]),
        ({"agree": False}, 10.0, [0, 16, 0, 0, 0, 16]),
        ({}, 0.0, [0] * 6),
    ],
)
def test_bytes_by_hand(more, limit, sent):
    """UAVs 1 and 5 discover. UAV 3 has failed, so 2 and 4 pass on what both sides say."""
    world = dataclasses.replace(WORLD, measures="all", radio=RadioConfig(range=limit))
    now = time_step(in_a_row(6), [0, 1, 0, 0, 0, 9])
    now[keys.ALIVE] = torch.tensor([[True, True, True, False, True, True]])
    after = communication(now, ConsensusConfig(**more), world)._reset(now, now)
    assert after[keys.BYTES_SENT][0].tolist() == sent
