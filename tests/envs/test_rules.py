"""Tests views, points in the box and rewards against hand-computed numbers."""

import math

import pytest
import torch

from emberlink.envs.config import RewardConfig
from emberlink.envs.world import motion
from emberlink.envs.world.reward import step_reward
from emberlink.envs.world.sensor import Sensor, view_radius

LOW = torch.tensor([0.0, 0, 1], dtype=torch.float64)
HIGH = torch.tensor([29.0, 19, 4], dtype=torch.float64)
INSIDE = [False, False, False]
RELEASED = RewardConfig(new_fire=12.0, old_fire=6.0, no_fire=-4.0, exit=-150.0, exit_axes="xy")


@pytest.mark.parametrize(
    ("counts", "hit_boundary", "paper", "released"),
    [
        ((0, 0, 0), INSIDE, 0, 0),
        ((1, 0, 0), INSIDE, 1, 12),
        ((0, 1, 0), INSIDE, -4, 6),
        ((0, 0, 1), INSIDE, -10, -4),
        ((3, 5, 17), INSIDE, 3 - 20 - 170, 36 + 30 - 68),
        ((3, 5, 17), [True, False, False], -100, -150),
        ((3, 5, 17), [False, True, False], -100, -150),
        ((3, 5, 17), [False, False, True], -100, 36 + 30 - 68),
        ((3, 5, 17), [True, True, True], -100, -150),
    ],
)
def test_step_reward(counts, hit_boundary, paper, released):
    classes, out = [torch.tensor([count]) for count in counts], torch.tensor([hit_boundary])
    assert step_reward(*classes, out, RewardConfig()).tolist() == [paper]
    assert step_reward(*classes, out, RELEASED).tolist() == [released]
    assert step_reward(*classes, out, RELEASED).dtype == torch.float32


@pytest.mark.parametrize(("told", "left", "expected"), [(0, 0, 7), (8, 0, 11), (8, 1, -100)])
def test_reward_for_what_the_base_learns(told, left, expected):
    config = RewardConfig(new_fire=1.0, old_fire=0.0, no_fire=0.0, base=0.5)
    counts, out = torch.tensor([7, 2, 3]), torch.tensor([bool(left), False, False])
    assert step_reward(*counts, out, config, torch.tensor(told)) == expected


@pytest.mark.parametrize(
    ("unseen", "left", "expected"),
    [(0, 0, 7), (1, 0, 7 - 0.5 * math.log(2)), (9, 1, -100 - 0.5 * math.log(10))],
)
def test_reward_for_fire_that_no_uav_has_seen(unseen, left, expected):
    config = RewardConfig(new_fire=1.0, old_fire=0.0, no_fire=0.0, unseen=-0.5)
    counts, out = torch.tensor([7, 2, 3]), torch.tensor([bool(left), False, False])
    reward = step_reward(*counts, out, config, None, torch.tensor(unseen))
    assert reward.item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("altitude", "radius"), [(1, 0.57735), (2, 1.15470), (4, 2.30940)])
def test_view_radius(altitude, radius):
    assert view_radius(altitude, 30.0) == pytest.approx(radius, abs=1e-5)
    assert view_radius(altitude, 45.0) == pytest.approx(altitude)


def test_count_classes():
    view = Sensor((30, 20), view_angle=30.0, altitude=(1.0, 4.0))  # a window of 5 x 5 cells
    classes = torch.zeros(2, 3, 5, 5, dtype=torch.bool)
    classes[0, 0, 0, 4] = classes[0, 0, 1, 4] = classes[0, 0, 4, 1] = True
    classes[1, 1] = True
    centre = torch.tensor([[10.0, 7], [0, 19]], dtype=torch.float64)
    counts, means = view.count_classes(classes.flatten(-2), centre)
    assert counts.tolist() == [[3, 0, 0], [0, 25, 0]]
    # (8, 9), (9, 9) and (12, 6); then the whole window
    expected = torch.tensor([[[29 / 3, 8], [0, 0], [0, 0]], [[0, 0], [0, 19], [0, 0]]])
    assert means.equal(expected)


def test_scale_to_box():
    points = torch.tensor([[0.0, 0, 1], [29, 19, 4], [14.5, 9.5, 2.5], [7.25, 19, 1.75]])
    expected = [[-1, -1, -1], [1, 1, 1], [0, 0, 0], [-0.5, 1, -0.5]]
    assert motion.scale_to_box(points, LOW, HIGH).tolist() == expected


def test_random_points_fill_the_box():
    points = motion.random_points(torch.arange(500), 4, LOW, HIGH)
    assert points.shape == (500, 4, 3)
    assert points.dtype == torch.float32
    flat = points.flatten(0, 1)
    assert ((flat >= LOW) & (flat <= HIGH)).all()
    assert torch.allclose(flat.double().mean(0), (LOW + HIGH) / 2, rtol=0.04)
    spread = (HIGH - LOW) / math.sqrt(12)
    assert torch.allclose(flat.double().std(0), spread, rtol=0.04)
