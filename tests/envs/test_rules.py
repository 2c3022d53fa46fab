"""Tests views, points in the box and rewards against hand-computed numbers."""

import math

import torch

from emberlink.envs.world import motion
from emberlink.envs.world.sensor import Sensor

LOW = torch.tensor([0.0, 0, 1], dtype=torch.float64)
HIGH = torch.tensor([29.0, 19, 4], dtype=torch.float64)


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


def test_random_points_fill_the_box():
    points = motion.random_points(torch.arange(500), 4, LOW, HIGH)
    assert points.shape == (500, 4, 3)
    assert points.dtype == torch.float32
    flat = points.flatten(0, 1)
    assert ((flat >= LOW) & (flat <= HIGH)).all()
    assert torch.allclose(flat.double().mean(0), (LOW + HIGH) / 2, rtol=0.04)
    spread = (HIGH - LOW) / math.sqrt(12)
    assert torch.allclose(flat.double().std(0), spread, rtol=0.04)
