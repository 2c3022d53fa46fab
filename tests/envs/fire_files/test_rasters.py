"""Tests rasters of arrival times against hand-computed numbers and a loop over cells."""

import math

import numpy as np
import pytest
import rasterio
import torch
from fire_files import CORNER, Ellipses, fires_in, write_asc, write_tif
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.grid import Window
from emberlink.envs.fire_files.plane import Plane
from emberlink.envs.fire_files.rasters import as_fire
from emberlink.envs.fire_files.report import Clock, Report

INF = math.inf
PLAIN = {"units": "minutes", "ring_width": None, "margin": None, "unburned": "none"}


def read(path, grid=(8, 8), horizon=10, **keys):
    (fire,) = fires_in(FileFireConfig(path=str(path), **{**PLAIN, **keys}), grid, horizon)
    return fire


def corner(times, rows, columns):
    """Returns a raster of 8 x 8 that burns in the upper left corner only."""
    whole = np.full((8, 8), -9999.0)
    whole[:rows, :columns] = times
    return whole


@pytest.mark.parametrize("write", [write_asc, write_tif])
def test_a_raster_of_the_size_of_the_grid_is_read_cell_by_cell(tmp_path, write):
    times = corner([[0, 5, 10], [2, 4, -9999]], 2, 3)
    fire = read(write(tmp_path / f"fire.{write.__name__[6:]}", times))
    expected = torch.full((8, 8), INF)  # north up: row 0 is at y = 7; 10 minutes are 10 steps
    expected[:3, 7], expected[:2, 6] = torch.tensor([0.0, 5, 10]), torch.tensor([2.0, 4])
    assert torch.equal(fire, expected)


def test_times_of_a_coarser_raster_are_interpolated(tmp_path):
    times = np.full((4, 4), -9999.0)
    times[0, :3] = [0, 4, 8]
    fire = read(write_asc(tmp_path / "fire.asc", times), horizon=8)
    # A cell of the raster is 2 x 2 cells of the grid, each with 22 x 22 samples. The first sample
    # of the cell k lies k / 2 + 1 / 88 cells of the raster from the outer edge. Times rise by 4
    # per cell of the raster, from the centre of the first to the centre of the last.
    first = [4 * (k / 2 + 1 / 88 - 1 / 2) for k in range(1, 5)]  # the earliest is step 0
    assert fire[:6, 7].tolist() == pytest.approx([0, 0, *first[1:], 8], abs=1e-5)
    assert torch.equal(fire[2:6, 6], fire[2:6, 7])
    assert torch.isfinite(fire).sum() == 12


@pytest.mark.parametrize("never", [-9999.0, -1.0, np.nan, np.inf, -3.4028234663852886e38])
def test_cells_that_never_burn(tmp_path, never):
    burns = corner([[1, 2], [3, 4]], 2, 2)
    times = np.where(burns < 0, never, burns)
    asc = write_asc(tmp_path / "fire.asc", times, NODATA_VALUE=None)
    tif = write_tif(tmp_path / "fire.tif", times, nodata=None)
    declared = write_tif(tmp_path / "declared.tif", np.where(burns < 0, 777, burns), nodata=777)
    for path in (asc, tif, declared):
        assert torch.isfinite(read(path)).sum() == 4


def test_bytes_with_nodata_scale_and_offset(tmp_path):
    times = np.full((8, 8), 255, "uint8")
    times[0, :3] = [0, 10, 40]
    path = write_tif(tmp_path / "fire.tif", times, nodata=255)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.5,), (100.0,)
    fire = read(path, start=100.0, end=120.0, horizon=20)
    assert fire[:3, 7].tolist() == [0, 5, 20]


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({}, [0, 5, 10, 20]),
        ({"start": 5.0, "end": 10.0}, [0, 0, 20, INF]),  # cells that burn by then burn at 0
        ({"minutes_per_step": 2.0}, [0, 2.5, 5, 10]),
        ({"start": -10.0, "end": 30.0}, [5, 7.5, 10, 15]),
        ({"units": "days", "minutes_per_step": 1440.0, "start": 1.0}, [0, 4, 9, 19]),
        ({"units": "steps", "end": 10.0}, [0, 10, 20, INF]),
    ],
)
def test_the_span_of_time_fills_the_episode(tmp_path, keys, expected):
    path = write_asc(tmp_path / "fire.asc", corner([[0, 5, 10, 20]], 1, 4))
    fire = read(path, horizon=20, **keys)
    assert fire[:4, 7].tolist() == pytest.approx(expected)


def test_a_crop_leaves_the_margin_on_all_sides(tmp_path):
    times = np.full((60, 50), -9999.0)
    times[20:44, 10:22] = np.arange(24)[:, None] + 1.0
    path = write_asc(tmp_path / "fire.asc", times)
    # A row burns each minute. The front at 24.5 minutes is the edge of row 24. 24 rows fill 80 %
    # of 30, so that the cells of raster and grid have the same size. 12 columns are centred.
    fire = read(path, (30, 30), horizon=100, margin=0.1, end=24.5)
    assert torch.isfinite(fire[9:21, 3:27]).all()
    assert torch.isfinite(fire).sum() == 12 * 24
    assert fire[9, 26] == 0
    assert fire[9, 3].item() == pytest.approx(100 * 24 / 24.5)
    # The front at 12 minutes is the centre of row 12, so that 11.5 rows of 12 columns are burnt.
    burnt = torch.isfinite(read(path, (30, 30), horizon=100, margin=0.1, end=12.0))
    for axis in (0, 1):
        assert burnt.any(axis).nonzero()[:, 0].tolist() == list(range(3, 27))


def test_the_inside_of_the_front_is_burnt_out(tmp_path):
    at = np.arange(30) - 14.5
    far = np.hypot(at[:, None], at[None, :])
    path = write_asc(tmp_path / "fire.asc", np.where(far < 14, far, -9999))
    keys = {"start": 8.0, "end": 14.0}
    solid, ring = read(path, (30, 30), **keys), read(path, (30, 30), **keys, ring_width=3.0)
    burnt_out = torch.isinf(ring) & torch.isfinite(solid)
    assert torch.equal(ring[~burnt_out], solid[~burnt_out])
    # Cells deeper than 3 in a disc of radius 8 are a disc of radius 5.
    assert burnt_out[far < 4.4].all()
    assert not burnt_out[far > 5.6].any()
    assert torch.equal(read(path, (30, 30), **keys, ring_width=20.0), solid)


def test_degrees_are_projected_to_metres(tmp_path):
    n, step = 60, 0.001  # at 60 degrees north a degree of longitude is half as long
    latitude = 60 + (np.arange(n)[::-1] + 0.5) * step
    longitude = -117 + (np.arange(2 * n) + 0.5) * step
    x = (longitude + 117 - n * step)[None, :] * 55.8
    y = (latitude - 60 - n * step / 2)[:, None] * 111.4
    far = np.hypot(x, y)
    times = np.where(far < 2.5, far * 10, -9999.0)
    about = {"crs": "EPSG:4326", "transform": from_origin(-117, 60 + n * step, step, step)}
    path = write_tif(tmp_path / "fire.tif", times, **about)
    plain = write_tif(tmp_path / "plain.tif", times, **{**about, "crs": None})
    fire = read(path, (30, 30), margin=0.1)
    assert torch.equal(read(plain, (30, 30), margin=0.1, crs="EPSG:4326"), fire)
    i, j = np.nonzero(torch.isfinite(fire).numpy())
    assert np.ptp(i) == pytest.approx(np.ptp(j), abs=1)
    # The fire is a disc 24 cells across without holes, with the cells on its edge.
    assert len(i) == pytest.approx(math.pi * (24 + 1) ** 2 / 4, rel=0.03)
    assert read(path, (30, 30), margin=0.1, crs="EPSG:3857").isfinite().any()


def test_a_raster_turned_by_its_transform(tmp_path):
    """Compares a fire on cells along x and y with the fire on cells rotated by 30 degrees."""
    fire, n, cell = Ellipses(origins=((0.0, 0.0),)), 120, 25.0
    turned = rasterio.Affine.translation(*CORNER) @ rasterio.Affine.rotation(30)
    turned = turned @ rasterio.Affine.scale(cell, -cell) @ rasterio.Affine.translation(-60, -60)
    row, column = np.mgrid[:n, :n] + 0.5
    x, y = turned.a * column + turned.b * row, turned.d * column + turned.e * row
    times = fire.arrival(x + turned.c - CORNER[0], y + turned.f - CORNER[1])
    path = write_tif(tmp_path / "turned.tif", np.where(times < 250, times, -9999), transform=turned)
    at = (np.arange(n) - 59.5) * cell
    straight = fire.arrival(at[None, :], at[::-1, None])
    other = write_tif(tmp_path / "straight.tif", np.where(straight < 250, straight, -9999), cell)
    rotated, upright = (read(p, (30, 30), margin=0.1, end=250.0) for p in (path, other))
    for step, least in ((4, 0.88), (6, 0.88), (8, 0.88), (10, 0.93)):
        a, b = rotated <= step, upright <= step
        assert (a & b).sum() / (a | b).sum() > least


@pytest.mark.parametrize("first", [0.0, 10.5, 700.0])
def test_a_fire_of_elapsed_times_begins_at_0_or_is_asked_about(tmp_path, first):
    """Burns a cell every ten minutes."""
    path = write_asc(tmp_path / "fire.asc", corner([[first + t for t in (0, 10, 20, 30)]], 1, 4))
    if first > 30:
        with pytest.raises(ValueError, match=r"expected fire.start=0 .* or fire.start=700"):
            read(path)
    later = [100 * (first + t) / (first + 30) for t in (10, 20, 30)]
    given = read(path, horizon=100, start=0.0)[:4, 7]
    assert given.tolist() == pytest.approx([100 * first / (first + 30), *later], abs=1e-3)
    if first < 30:
        assert read(path, horizon=100)[:4, 7].tolist() == pytest.approx([0.0, *later], abs=1e-3)
    steps = read(path, horizon=800, units="steps")[:4, 7]
    assert steps.tolist() == pytest.approx([first + t for t in (0, 10, 20, 30)])


@pytest.mark.parametrize("internal", [True, False])
def test_a_mask_marks_cells_that_never_burn(tmp_path, internal):
    times = np.full((8, 8), 3.0, "float32")
    times[:2, :2] = [[0, 2], [4, 6]]
    path = write_tif(tmp_path / "fire.tif", times, nodata=None)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=internal), rasterio.open(path, "r+") as dataset:
        dataset.write_mask(times != 3)
    assert (tmp_path / "fire.tif.msk").is_file() != internal
    assert torch.isfinite(read(path, horizon=3)).sum() == 4


def by_loops(times, window):
    """Returns the earliest centre in each cell of the grid that contains one."""
    earliest, rows = {}, len(times)
    for r, row in enumerate(times):
        for c, time in enumerate(row):
            i = math.floor((c + 0.5 - window.x) / window.side + 1e-6)
            j = math.floor((rows - r - 0.5 - window.y) / window.side + 1e-6)
            if 0 <= i < 8 and 0 <= j < 9:
                earliest[i, j] = min(time, earliest.get((i, j), INF))
    return earliest


PLACE = st.floats(-3, 3)


@settings(max_examples=60, deadline=None)
@given(
    *(st.integers(2, 12), st.integers(2, 12)),
    *(st.floats(0.3, 4), PLACE, PLACE, st.integers(0, 2**32 - 1)),
)
def test_no_arrival_is_lost(rows, columns, side, x, y, seed):
    random = np.random.default_rng(seed)
    times = random.uniform(0, 100, (rows, columns))
    times[random.random(times.shape) < 0.3] = INF
    times[0, 0], times[-1, -1] = 5.0, 60.0
    window, last = Window(x, y, side, (8, 9)), times[times < INF].max()
    for plane in (Plane(""), None):  # None: a map of the whole grid
        fire = as_fire(times, Clock("minutes"), plane)
        got = fire.on(window, INF, Report())
        assert (got >= times.min() - 1e-9).all()
        assert (np.isinf(got) | (got <= last + 1e-9)).all()
        for (i, j), expected in by_loops(times, window).items():
            assert expected > times.min() or got[i, j] == expected
