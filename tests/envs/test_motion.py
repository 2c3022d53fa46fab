"""Tests motion against hand-computed positions."""

import math

import pytest
import torch

from emberlink.envs.world import motion

LOW = torch.tensor([0.0, 0, 1], dtype=torch.float64)
HIGH = torch.tensor([29.0, 19, 4], dtype=torch.float64)


def move(position, action, displacement=1.0):
    where, hit_boundary = motion.move(
        torch.tensor(position), torch.tensor(action), displacement=displacement, low=LOW, high=HIGH
    )
    assert where.dtype == torch.float32
    return where.tolist(), hit_boundary.tolist()


@pytest.mark.parametrize(
    ("position", "action", "displacement", "expected", "hit_boundary"),
    [
        ([3.0, 4, 2], [0.5, -0.25, 1], 1.0, [3.5, 3.75, 3], [False, False, False]),
        ([3.0, 4, 2], [0.5, -0.25, 1], 0.1, [3.05, 3.975, 2.1], [False, False, False]),
        ([3.0, 4, 2], [2, -9, 0], 1.0, [4, 3, 2], [False, False, False]),
        ([28.5, 18.5, 3.5], [1, 1, 1], 1.0, [29, 19, 4], [True, True, True]),
        ([0.5, 0.5, 1.5], [-1, -1, -1], 1.0, [0, 0, 1], [True, True, True]),
        ([28.0, 1, 2], [1, -1, 0], 1.0, [29, 0, 2], [False, False, False]),
        ([29.0, 0, 4], [0.01, -0.01, 0.01], 1.0, [29, 0, 4], [True, True, True]),
    ],
)
def test_move(position, action, displacement, expected, hit_boundary):
    where, out = move(position, action, displacement)
    assert where == pytest.approx(expected)
    assert out == hit_boundary


def test_move_takes_any_batch():
    position = torch.rand(2, 3, 4, 3) + 2
    where, hit_boundary = motion.move(position, position, displacement=0.1, low=LOW, high=HIGH)
    assert where.shape == hit_boundary.shape == (2, 3, 4, 3)


def test_distance():
    points = torch.tensor([[1.0, 2, 3], [1, 2, 3]])
    others = torch.tensor([[3.0, 5, 9], [1, 2, 3]])
    assert motion.distance(points, others).tolist() == [7, 0]


def test_scale_to_box():
    points = torch.tensor([[0.0, 0, 1], [29, 19, 4], [14.5, 9.5, 2.5], [7.25, 19, 1.75]])
    expected = [[-1, -1, -1], [1, 1, 1], [0, 0, 0], [-0.5, 1, -0.5]]
    assert motion.scale_to_box(points, LOW, HIGH).tolist() == expected


def test_scale_to_a_box_of_no_height():
    flat = torch.tensor([29.0, 19, 1], dtype=torch.float64)
    assert motion.scale_to_box(torch.tensor([0.0, 0, 1]), LOW, flat).tolist() == [-1, -1, -1]


def test_random_points_fill_the_box():
    points = motion.random_points(torch.arange(500), 4, LOW, HIGH)
    assert points.shape == (500, 4, 3)
    assert points.dtype == torch.float32
    flat = points.flatten(0, 1)
    assert ((flat >= LOW) & (flat <= HIGH)).all()
    assert torch.allclose(flat.double().mean(0), (LOW + HIGH) / 2, rtol=0.04)
    spread = (HIGH - LOW) / math.sqrt(12)
    assert torch.allclose(flat.double().std(0), spread, rtol=0.04)


def test_only_reached_waypoints_change():
    position = torch.tensor([[[5.0, 5, 2], [5, 5, 2], [5, 5, 2]]])
    waypoint = torch.tensor([[[5.0, 5.99, 2], [5, 6, 2], [20, 1, 3]]])
    new = motion.next_waypoint(waypoint, position, torch.tensor([7]), LOW, HIGH)
    assert torch.equal(new[0, 1:], waypoint[0, 1:])
    assert torch.equal(new[0, 0], motion.random_points(torch.tensor([7]), 3, LOW, HIGH)[0, 0])


def test_nan_actions_do_not_move_the_uav():
    position = torch.tensor([[5.0, 6.0, 2.0]])
    action = torch.tensor([[math.nan, math.inf, -math.inf]])
    low, high = torch.zeros(3).double(), torch.full((3,), 9.0).double()
    moved, hit_boundary = motion.move(position, action, displacement=1.5, low=low, high=high)
    assert moved.tolist() == [[5.0, 7.5, 0.5]]
    assert not hit_boundary.any()
