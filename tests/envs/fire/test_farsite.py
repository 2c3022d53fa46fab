"""Tests the comparison with FARSITE on fires with known fronts."""

import math

import farsite
import pytest
import torch

pytestmark = pytest.mark.drawn


@pytest.mark.parametrize(
    ("name", "minutes", "towards"),
    [
        ("3mph0deg7hr", 0, (0, -1)),  # a north wind drives the fire to the south
        ("3mph120deg7hr", 0, (-math.sqrt(3) / 2, 0.5)),
        ("clockwise1hr", 59.9, (0, 1)),
        ("clockwise1hr", 60, (math.sqrt(3) / 2, 0.5)),  # from 240°, the south-west
        ("counterClockwise3hr", 180, (-math.sqrt(3) / 2, 0.5)),  # from 120°, the south-east
    ],
)
def test_the_wind_of_a_name(name: str, minutes: float, towards: tuple[float, float]):
    azimuth = farsite.wind_of(name)(minutes)
    got = torch.cat([azimuth.cos(), azimuth.sin()])
    torch.testing.assert_close(got, torch.tensor(towards, dtype=got.dtype), atol=1e-5, rtol=0)


def test_the_fit_recovers_the_rates_of_a_simulated_run():
    nothing, wind = torch.full((21, 21), 240.0), farsite.wind_of("3mph300deg")
    nothing[8:13, 8:13] = 0  # the initial fire; the run ends at 240 minutes
    run = farsite.Run("a", nothing, wind)
    known = run._replace(arrival=farsite.simulate(run, 0.03, 1.5))
    assert farsite.fit(known) == pytest.approx((0.03, 1.5), rel=0.01)


def test_overlap_by_hand():
    arrival = torch.tensor([[0.0, 10.0], [20.0, math.inf]])
    run = farsite.Run("a", arrival, farsite.wind_of("3mph0deg"))
    got = torch.tensor([[0.0, 12.0], [math.inf, 18.0]])
    assert run.end == 20
    assert farsite.compare(run, got) == ([1.0, 0.5, 1.0, 0.5], 1.0, 2.0)
    assert farsite.misfit(got, run) == (0 + 2 + 0 + 2) / 4
