"""Tests the bonus for flying towards the target against hand-computed numbers."""

import math

import pytest
import torch
from time_steps import communication, time_step
from torch import Tensor

from emberlink.comm.consensus import HeadingConfig, heading_reward
from emberlink.envs import keys
from emberlink.envs.config import RewardConfig, WildfireConfig

INSIDE = (False, False, False)


@pytest.mark.parametrize(
    ("aimed", "moved", "folded", "angle"),
    [(90, 0, 90, 90), (45, 45, 0, 0), (90, -90, 0, 180), (170, -170, 0, 20), (-30, 120, 90, 150)],
)
def test_heading_forms_by_hand(aimed, moved, folded, angle):
    def towards(degrees: float, length: float) -> Tensor:
        angle = math.radians(degrees)
        return torch.tensor([5 + length * math.cos(angle), 7 + length * math.sin(angle), 2.0])

    before = torch.tensor([5.0, 7.0, 3.0])
    expected = {
        "folded_linear": (180 - folded) / 10,
        "folded_exponential": 20 * 0.94**folded,
        "linear": (90 - angle) / 90,
    }
    for form, value in expected.items():
        config = HeadingConfig(form=form, weight=0.5)
        term = heading_reward(before, towards(moved, 1.0), towards(aimed, 12.0), config)
        assert term.item() == pytest.approx(0.5 * value, abs=1e-3), form


def test_no_heading_bonus_without_a_move():
    here = torch.tensor([5.0, 7.0, 3.0])
    up, target = torch.tensor([5.0, 7.0, 4.0]), torch.tensor([9.0, 7.0, 3.0])
    assert heading_reward(here, up, target, HeadingConfig(form="linear")) == 0


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
