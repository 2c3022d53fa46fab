"""Tests rewards against hand-computed numbers."""

import math
from itertools import pairwise

import pytest
import torch
from pydantic import ValidationError

from emberlink.comm.consensus import HEADING_FORMS, HeadingConfig, heading_reward
from emberlink.envs.config import RewardConfig
from emberlink.envs.world.reward import left_box, step_reward

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


def test_step_reward_is_elementwise():
    new, old, none = torch.randint(0, 9, (3, 5, 4))
    hit_boundary = torch.rand(5, 4, 3) < 0.3
    together = step_reward(new, old, none, hit_boundary, RELEASED)
    assert together.shape == (5, 4)
    for at in [(0, 0), (2, 3), (4, 1)]:
        alone = step_reward(new[at], old[at], none[at], hit_boundary[at], RELEASED)
        assert together[at] == alone


def test_left_box():
    hit_boundary = torch.tensor([INSIDE, [False, False, True], [False, True, False]])
    assert left_box(hit_boundary, "xyz").tolist() == [False, True, True]
    assert left_box(hit_boundary, "xy").tolist() == [False, False, True]


def point(degrees: float, length: float = 1.0) -> list[float]:
    """Returns a point in a direction from (5, 5), at another altitude."""
    angle = math.radians(degrees)
    return [5 + length * math.cos(angle), 5 + length * math.sin(angle), 2 + length]


def heading(form: str, target: float, moved: float, weight: float = 1.0) -> float:
    where = torch.tensor([[5.0, 5, 1], point(moved, 0.5), point(target, 8)])
    config = HeadingConfig(form=form, weight=weight)
    return heading_reward(*where.unsqueeze(1), config).item()


@pytest.mark.parametrize(
    ("target", "moved", "folded", "true"),
    [
        (0, 0, 0, 0),
        (0, 90, 90, 90),
        (30, 75, 45, 45),
        (90, -90, 0, 180),  # folded: left and right are equivalent
        (170, -170, 0, 20),
        (150, -60, 90, 150),
        (-135, 45, 90, 180),
        (180, 0, 180, 180),
    ],
)
def test_heading_forms(target, moved, folded, true):
    assert heading("folded_linear", target, moved) == pytest.approx((180 - folded) / 10, abs=1e-4)
    assert heading("folded_exponential", target, moved) == pytest.approx(
        20 * 0.94**folded, rel=1e-4
    )
    assert heading("linear", target, moved) == pytest.approx((90 - true) / 90, abs=1e-5)
    assert heading("linear", target, moved, 0.5) == pytest.approx((90 - true) / 180, abs=1e-5)


def test_heading_by_hand():
    assert heading("folded_linear", 0, 90) == pytest.approx(9.0, abs=1e-4)
    assert heading("folded_exponential", 0, 10) == pytest.approx(10.77230, abs=1e-3)
    assert heading("linear", 10, -20) == pytest.approx(2 / 3, abs=1e-5)


def test_approach_is_the_decrease_of_the_distance():
    config = HeadingConfig(form="approach", weight=2.0)
    before = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [3, 0, 1]])
    after = torch.tensor([[3.0, 0, 1], [0, 0, 2], [0, 0, 1], [0, 0, 1]])
    target = torch.tensor([[3.0, 4, 1], [0, 0, 4], [3, 4, 1], [3, 4, 1]])
    assert heading_reward(before, after, target, config).tolist() == [2, 2, 0, -2]


def test_heading_without_a_move():
    here, target = torch.tensor([5.0, 5, 1]), torch.tensor([5.0, 9, 1])
    terms = {f: heading_reward(here, here, target, HeadingConfig(form=f)) for f in HEADING_FORMS}
    assert terms["linear"] == 0
    assert terms["folded_linear"] == pytest.approx(9)  # an angle of 0, as atan2(0, 0) is
    up = here + torch.tensor([0.0, 0, 0.1])
    assert heading_reward(here, up, target, HeadingConfig(form="linear")) == 0


def test_heading_is_precise_for_small_moves():
    before = torch.tensor([25.0, 25.0, 1.0])
    step = torch.tensor([1e-3, 1e-3, 0.0])
    term = heading_reward(before, before + step, before + 4 * step, HeadingConfig(form="linear"))
    assert term.item() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("form", list(HEADING_FORMS))
def test_heading_does_not_decrease_with_a_straighter_move(form):
    terms = [heading(form, 0, moved) for moved in range(0, 181, 15)]
    assert all(near > far for near, far in pairwise(terms))


@pytest.mark.parametrize(
    "bad", [{"new_fire": math.nan}, {"exit": "much"}, {"exit_axes": "yz"}, {"new_fires": 1.0}]
)
def test_bad_constants_are_named(bad):
    with pytest.raises(ValidationError, match=next(iter(bad))):
        RewardConfig(**bad)
    with pytest.raises(ValidationError, match="form"):
        HeadingConfig(form="straight")
