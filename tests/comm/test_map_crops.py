"""Tests the pictures of method `maps` against a scalar implementation."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scalar_maps import age_byte, picture

from emberlink.comm._crops import Crops
from emberlink.envs.config import LARGEST_SCALE

NAMES = ("none", "fire", "burnt out")
HORIZON = 400


def draw(grid, known, seen, step, centre, others, base, **more) -> torch.Tensor:
    """Draws the pictures of one UAV."""
    crops = Crops(grid, horizon=HORIZON, **more)
    points = torch.tensor([[cell for cell, _ in others]]).view(1, -1, 2).long()
    heard = torch.tensor([[when for _, when in others]]).view(1, -1).long()
    station = torch.tensor([[base]] if base else []).view(1, -1, 2).long()
    given = known[None], seen[None], torch.tensor([step]), torch.tensor([centre])
    return crops.draw(*given, points, heard, station)[0]


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    grid=st.tuples(st.integers(8, 20), st.integers(8, 20)),
    step=st.integers(0, HORIZON),
    place=st.tuples(*[st.sampled_from([0, 1]) | st.floats(0, 1)] * 2),
    pixels=st.integers(8, 11),
    scale=st.integers(1, 16),
    spread=st.integers(0, 4),
)
def test_pictures_of_any_size(grid, step, place, pixels, scale, spread):
    centre = tuple(round(at * (side - 1)) for at, side in zip(place, grid, strict=True))
    scales, base = (scale, 3), (0, 6)
    generator = torch.Generator().manual_seed(step)
    when = torch.randint(-step // 2 - 1, step + 1, grid, generator=generator)
    what = torch.randint(0, 3, grid, generator=generator)
    known = torch.where(when < 0, -1, 4 * when + what).to(torch.int16)
    seen = torch.rand(grid, generator=generator) < 0.3
    others = [((3, 2), step), ((grid[0] - 1, grid[1] - 1), 0), ((3, 2), -1), ((0, 5), step // 2)]
    more = {"pixels": pixels, "spread": spread}
    drawn = draw(grid, known, seen, step, centre, others, base, scales=scales, **more)
    looks = {
        (x, y): (int(when[x, y]), NAMES[what[x, y]])
        for x in range(grid[0])
        for y in range(grid[1])
        if when[x, y] >= 0
    }
    fires = {(int(x), int(y)) for x, y in seen.nonzero()}
    heard = [(cell, at) for cell, at in others if at >= 0]
    for index, scale in enumerate(scales):
        expected = picture(looks, fires, grid, centre, heard, base, step, scale=scale, **more)
        assert drawn[index].tolist() == expected, scale


def test_the_largest_sums_fit_into_their_bits():
    grid, side = (256, 256), LARGEST_SCALE
    crops = Crops(grid, pixels=8, scales=(side,), spread=2, horizon=HORIZON)
    never = torch.full((1, *grid), -1, dtype=torch.int16)
    points = torch.zeros(1, 0, 2).long(), torch.zeros(1, 0).long(), torch.zeros(1, 0, 2).long()
    given = torch.ones(1, *grid, dtype=torch.bool), torch.tensor([HORIZON])
    middle = torch.tensor([[128, 128]])
    fire, seen, out, near, age, outside, _, _ = crops.draw(never, *given, middle, *points)[0, 0]
    assert (age == 255).all()
    assert (seen == 255).all()
    assert not any(channel.any() for channel in (fire, out, near, outside))
    never[0, 128, 128] = 4 * HORIZON + 1
    chance = crops.draw(never, *given, middle, *points)[0, 0, 3]
    assert chance.sum() == round(255 * 24 / 256)


def test_beyond_the_horizon_what_was_never_seen_stays_so():
    known = torch.full((9, 9), -1)
    known[4, 4], known[4, 5], known[4, 6] = 4 * 9 + 1, 4 * 9, 4 * 9 + 2
    form = {"pixels": 8, "scales": (1,), "spread": 0}
    args = known, known == 37, 5 * HORIZON, (4, 4), [], None
    fire, _, out, _, age, *_ = draw((9, 9), *args, **form)[0]
    assert fire[4, 4] == out[4, 6] == 255
    assert fire.sum() == out.sum() == 255
    assert age[4, 3] == 255
    assert age[4, 4] == age[4, 5] == age[4, 6] == age_byte(HORIZON + 1)
