"""Tests the comparison with FARSITE on fires with known fronts."""

import math
from pathlib import Path

import farsite
import numpy as np
import pytest
import torch
from exact_front import exact_arrival

from emberlink.envs.fire.level_set import ellipse_rates

pytestmark = pytest.mark.drawn

SIDE, RADIUS, HEAD, RATIO, END = 45, 4.0, 0.035, 1.5, 420.0
HEADER = "ncols {0}\nnrows {1}\nxllcorner 0\nyllcorner 0\ncellsize 30\nNODATA_value -9999\n"
WINDS = ("3mph300deg", "3mph45deg7hr", "clockwise1hr", "counterClockwise3hr")


def write(path: Path, rows: np.ndarray) -> None:
    text = "\n".join(" ".join(f"{value:.3f}" for value in row) for row in rows)
    path.write_text(HEADER.format(*rows.shape[::-1]) + text + "\n", encoding="ascii")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Writes four runs with known rates, computed by the support function."""
    path = tmp_path_factory.mktemp("runs")
    rates = [float(rate) for rate in ellipse_rates(HEAD, RATIO)]
    for name in WINDS:
        wind = farsite.wind_of(name)
        azimuth = np.vectorize(lambda time, wind=wind: float(wind(time)))
        still = lambda times: np.zeros((len(times), 2))  # noqa: E731
        centre = (SIDE // 2, SIDE // 2)
        known = exact_arrival((SIDE, SIDE), centre, RADIUS, rates, azimuth, still, END)
        rows = np.where(np.isfinite(known), known, -9999.0).T[::-1]
        write(path / (name + farsite.SUFFIX), rows)
    return path


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


def test_the_fit_recovers_known_rates(folder: Path):
    runs = farsite.read_runs(folder)
    assert sorted(runs) == sorted(WINDS)
    head_rate, ratio = farsite.fit(runs["3mph300deg"])
    assert head_rate == pytest.approx(HEAD, rel=0.03)
    assert ratio == pytest.approx(RATIO, rel=0.05)
    for run in runs.values():
        overlaps, area, error = farsite.compare(run, farsite.simulate(run, head_rate, ratio))
        assert overlaps[-1] > 0.97
        assert (
            min(overlaps) > 0.93
        )  # the initial fire has a hundred cells, a third of them on its edge
        assert area == pytest.approx(1, abs=0.02)
        assert error < 0.02 * END


def test_overlap_by_hand():
    arrival = torch.tensor([[0.0, 10.0], [20.0, math.inf]])
    run = farsite.Run("a", arrival, farsite.wind_of("3mph0deg"))
    got = torch.tensor([[0.0, 12.0], [math.inf, 18.0]])
    assert run.end == 20
    assert farsite.overlap(got, run, 20) == 0.5
    assert farsite.compare(run, got) == ([1.0, 0.5, 1.0, 0.5], 1.0, 2.0)
    assert farsite.misfit(got, run) == (0 + 2 + 0 + 2) / 4
