"""Tests the level set against closed forms and the exact front from its support function."""

import math

import numpy as np
import pytest
import torch
from exact_front import exact_arrival, support
from torch import Tensor

from emberlink.envs.fire.level_set import arrival_times, disc, ellipse_rates

SIDE, CORE, HEAD, HORIZON = 30.0, 3.0, 0.01, 1000.0
STRAIGHT, TURNING = 0.0, math.pi


def computed_arrival(n: int, ratio: float, azimuth) -> Tensor:
    scale, middle = (n - 1) / SIDE, (n - 1) / 2
    start = disc(torch.full((1, 2), middle), torch.tensor([CORE * scale]))
    turning = lambda time: azimuth(torch.tensor([time]))  # noqa: E731
    args = torch.tensor([HEAD * scale]), torch.tensor([ratio]), turning
    return arrival_times(start, (n, n), *args, horizon=HORIZON, refine=1)[0]


def compare(n: int, ratio: float, turn: float) -> tuple[float, float, float]:
    """Returns the ratio of areas, the intersection over union, and the mean error of arrival."""

    def azimuth(time):
        return 0.3 + turn * time / HORIZON

    def still(times):
        return np.zeros((len(times), 2))

    scale, middle = (n - 1) / SIDE, (n - 1) / 2
    rates = [float(rate) for rate in ellipse_rates(HEAD * scale, ratio)]
    start = (n, n), (middle, middle), CORE * scale
    exact = exact_arrival(*start, rates, azimuth, still, HORIZON, steps=80)
    got, want = computed_arrival(n, ratio, azimuth), torch.from_numpy(exact)
    a, b = got.isfinite(), want.isfinite()
    error = (got - want)[a & b & (want > 0)].abs().mean() / HORIZON
    return float(a.sum() / b.sum()), float((a & b).sum() / (a | b).sum()), float(error)


def grow(grid=(24, 24), centre=(11.0, 11.0), radius=3.0, head=0.006, ratio=2.5, azimuth=0.4, **k):
    """Returns one fire from plain numbers, float32 [X, Y]."""
    start = disc(torch.tensor([centre]), torch.tensor([radius]))
    k = {"horizon": 1000, **k}
    args = (torch.tensor([v]) for v in (head, ratio, azimuth))
    return arrival_times(start, grid, *args, **k)[0]


def test_ellipse_rates_by_hand():
    a, b, c = ellipse_rates(1.0, 2.0)  # e = 0.866025, R_back = 0.071797
    torch.testing.assert_close(torch.stack([a, b, c]), torch.tensor([0.535898, 0.267949, 0.464102]))
    assert [float(r) for r in ellipse_rates(0.5, 1.0)] == [0.5, 0.5, 0.0]


@pytest.mark.parametrize("ratio", [1.0, 1.5, 4.0])
def test_front_speed_supports_the_wavelet(ratio: float):
    """Compares F(n) with the maximum along n of the ellipse R (1 - e) / (1 - e cos ψ)."""
    eccentricity = math.sqrt(ratio**2 - 1) / ratio
    psi = torch.linspace(0, 2 * math.pi, 28801, dtype=torch.float64)
    radius = (1 - eccentricity) / (1 - eccentricity * torch.cos(psi))
    normal = torch.linspace(0, 2 * math.pi, 37, dtype=torch.float64)
    reach = (radius * torch.cos(psi - normal[:, None])).amax(1)
    rates = [float(rate) for rate in ellipse_rates(torch.tensor(1.0).double(), ratio)]
    speed = torch.from_numpy(support((normal + 0.7).numpy(), *rates, 0.7))
    torch.testing.assert_close(speed, reach, atol=1e-6, rtol=0)


# Area ratio and intersection over union measured at n = 31, 61, 121.
ACCURACY = [
    pytest.param(1.0, STRAIGHT, (0.977, 0.992, 0.999), id="circle"),
    pytest.param(3.0, STRAIGHT, (0.992, 0.992, 0.998), id="ellipse"),
    pytest.param(3.0, TURNING, (0.985, 0.994, 0.998), id="wind_shift"),
]


@pytest.mark.parametrize(("ratio", "turn", "overlap"), ACCURACY)
def test_agrees_with_the_exact_front_and_converges(ratio: float, turn: float, overlap):
    areas, unions, errors = zip(*(compare(n, ratio, turn) for n in (31, 61, 121)), strict=True)
    assert all(got >= want for got, want in zip(unions, overlap, strict=True))
    assert abs(areas[0] - 1) < 0.025
    assert abs(areas[2] - 1) < 0.0015
    order = math.log2(errors[0] / errors[2]) / 2
    assert order > 1.3


def test_a_straight_front_moves_at_its_speed():
    front = lambda x, y: (x - 3.3) + 0 * y  # noqa: E731
    args = torch.tensor([0.01]), torch.tensor([2.0]), torch.tensor([1.0])
    got = arrival_times(front, (12, 9), *args, horizon=900)[0]
    speed = support(0.0, *map(float, ellipse_rates(0.01, 2.0)), 1.0)
    want = ((torch.arange(12.0) - 3.3) / speed).clamp_min(0)[:, None].expand(12, 9)
    want = want.masked_fill(want > 900, math.inf)
    torch.testing.assert_close(got, want, rtol=1e-4, atol=0.01)


def test_symmetry_with_fuel():
    field = torch.rand(1, 24, 24, generator=torch.Generator().manual_seed(5))
    even = {"centre": (11.5, 11.5), "ratio": 1.0, "head": 0.02}
    base = grow(rate_field=field, **even)
    for axes in ((0,), (1,), (0, 1)):
        flipped = grow(rate_field=field.flip([a + 1 for a in axes]), **even)
        torch.testing.assert_close(flipped.flip(axes), base, rtol=0, atol=0.01)
    torch.testing.assert_close(grow(rate_field=field.mT, **even).mT, base, rtol=0, atol=0.01)


def test_arrival_never_decreases_outwards():
    """With patchy fuel, every cell has an earlier neighbour."""
    field = torch.rand(1, 24, 24, generator=torch.Generator().manual_seed(3))
    patchy = grow(rate_field=field, head=0.024)
    around = (
        torch.nn.functional.pad(patchy, (1, 1, 1, 1), value=math.inf)
        .unfold(0, 3, 1)
        .unfold(1, 3, 1)
    )
    later = (patchy > 0) & patchy.isfinite()
    assert later.sum() > 50
    assert (around.flatten(2).amin(2) < patchy)[later].all()


def test_half_the_rate_everywhere_is_half_the_speed():
    half = torch.full((1, 24, 24), 0.5)
    same = grow(rate_field=half, head=0.012, max_rate=0.012)
    torch.testing.assert_close(same, grow(head=0.006, max_rate=0.012), rtol=0, atol=0.01)


def test_the_edge_of_the_grid_has_no_effect():
    field = torch.rand(1, 40, 40, generator=torch.Generator().manual_seed(1))
    more = {"azimuth": -0.3, "max_rate": 0.006}
    for whole, inside in ((torch.ones(1, 40, 40), 0), (field, 3)):
        inner = grow(centre=(19.0, 5.0), rate_field=whole[:, 8:32, 8:32], **more)
        outer = grow((40, 40), (27.0, 13.0), rate_field=whole, **more)[8:32, 8:32]
        assert inner[23].isfinite().any()
        # Fuel outside the grid equals that at the edge, so that fires with patches differ there.
        cut = (slice(0, 24 - inside), slice(inside, 24))
        worst = 0.1 if inside else 4.0
        torch.testing.assert_close(inner[cut], outer[cut], rtol=0, atol=worst)


def test_batch_and_horizon_do_not_matter():
    centres = torch.tensor([[9.3, 11.0], [12.0, 8.0], [11.0, 11.0]])
    radii, heads = torch.tensor([3.0, 2.0, 4.0]), torch.tensor([0.004, 0.006, 0.005])
    ratios, winds = torch.tensor([1.5, 3.0, 2.0]), torch.tensor([0.1, 2.0, -1.0])
    common = {"horizon": 1000, "max_rate": 0.006}
    batch = arrival_times(disc(centres, radii), (20, 24), heads, ratios, winds, **common)
    assert batch.shape == (3, 20, 24)
    assert batch.dtype == torch.float32
    for k in range(3):
        fire = slice(k, k + 1)
        start = disc(centres[fire], radii[fire])
        alone = arrival_times(start, (20, 24), heads[fire], ratios[fire], winds[fire], **common)
        assert torch.equal(alone[0], batch[k])
    half = arrival_times(
        disc(centres, radii), (20, 24), heads, ratios, winds, horizon=500, max_rate=0.006
    )
    assert torch.equal(half, batch.masked_fill(batch > 500, math.inf))
