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
        ("3mph90deg", 400, (-1, 0)),
        ("3mph120deg7hr", 0, (-math.sqrt(3) / 2, 0.5)),
        ("clockwise1hr", 59.9, (0, 1)),
        ("clockwise1hr", 60, (math.sqrt(3) / 2, 0.5)),  # from 240°, the south-west
        ("clockwise1hr", 200, (0, -1)),
        ("counterClockwise3hr", 179, (0, 1)),
        ("counterClockwise3hr", 180, (-math.sqrt(3) / 2, 0.5)),  # from 120°, the south-east
        ("counterClockwise3hr", 360, (-math.sqrt(3) / 2, -0.5)),
    ],
)
def test_the_wind_of_a_name(name: str, minutes: float, towards: tuple[float, float]):
    azimuth = farsite.wind_of(name)(minutes)
    got = torch.cat([azimuth.cos(), azimuth.sin()])
    torch.testing.assert_close(got, torch.tensor(towards, dtype=got.dtype), atol=1e-5, rtol=0)


def test_a_grid_is_read_north_up(tmp_path: Path):
    write(tmp_path / "a.asc", np.array([[1, 2, 3], [0, -9999, 5.5]]))
    got = farsite.read_grid(tmp_path / "a.asc")
    assert got.tolist() == [[0, 1], [math.inf, 2], [5.5, 3]]  # [x, y]: the lower row has y = 0


def test_the_distance_to_squares_by_hand():
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[3:6, 4] = True  # x from 2.5 to 5.5, y from 3.5 to 4.5
    x = torch.tensor([0.0, 2.5, 4.0, 7.5])[None, :, None]
    y = torch.tensor([4.0, 6.5])[None, None]
    got = farsite.around(mask)(x, y)
    want = [[2.5, math.hypot(2.5, 2)], [0, 2], [-0.5, 2], [2, math.hypot(2, 2)]]
    torch.testing.assert_close(got[0], torch.tensor(want))


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


def test_another_wind_does_not_fit(folder: Path):
    """An overlap of 0.9 separates the correct wind from a wrong wind."""
    run = farsite.read_runs(folder)["3mph300deg"]
    other = run._replace(wind=farsite.wind_of("3mph120deg"))
    assert farsite.overlap(farsite.simulate(other, HEAD, RATIO), run, END) < 0.75


def test_overlap_by_hand():
    arrival = torch.tensor([[0.0, 10.0], [20.0, math.inf]])
    run = farsite.Run("a", arrival, farsite.wind_of("3mph0deg"))
    got = torch.tensor([[0.0, 12.0], [math.inf, 18.0]])
    assert run.end == 20
    assert farsite.overlap(got, run, 20) == 0.5
    assert farsite.compare(run, got) == ([1.0, 0.5, 1.0, 0.5], 1.0, 2.0)
    assert farsite.misfit(got, run) == (0 + 2 + 0 + 2) / 4


def test_the_program(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch):
    monkeypatch.setattr(farsite, "fit", lambda run: (HEAD, RATIO) if run.name == WINDS[1] else None)
    picture = tmp_path / "fronts.png"
    farsite.main([str(folder), "--fit", WINDS[1], "--figure", str(picture)])
    printed = capsys.readouterr().out
    assert f"fitted on {WINDS[1]}: 0.0350 cells a minute, length-to-breadth 1.500" in printed
    rows = [line for line in printed.splitlines() if line.startswith("| `")]
    assert [row.split("`")[1] for row in rows] == sorted(WINDS)
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_a_run_with_other_weather_has_no_wind_in_its_name():
    for name in ("3mph0deg7hr_otherRAWS", "clockwise1hr_otherRAWS"):
        with pytest.raises(ValueError, match="no wind in this name"):
            farsite.wind_of(name)


def test_errors_are_one_line(tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "strange").mkdir()
    write(tmp_path / "strange" / "upwards_ArrivalTime.asc", np.array([[0.0, 1.0]]))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "3mph0deg_ArrivalTime.asc").write_text("ncols two\n")
    for arguments, message in (
        ([str(tmp_path)], "no *_ArrivalTime.asc in it"),
        ([str(folder), "--fit", "east"], "unknown run 'east'; known: 3mph300deg"),
        ([str(tmp_path / "strange")], "upwards: no wind in this name"),
        ([str(tmp_path / "broken")], "3mph0deg_ArrivalTime.asc: line 1"),
    ):
        with pytest.raises(SystemExit) as stop:
            farsite.main(arguments)
        assert stop.value.code == 2
        assert message in capsys.readouterr().err
