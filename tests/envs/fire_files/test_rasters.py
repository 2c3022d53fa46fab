"""Tests rasters of arrival times against hand-computed numbers and a loop over cells."""

import math
import os
import socket
import subprocess
import sys
import warnings

import numpy as np
import pytest
import rasterio
import torch
from fire_files import CORNER, UTM, Ellipses, raster_of, write_asc, write_tif
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from emberlink.envs.fire_files import rasters
from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.plausibility import beginnings
from emberlink.envs.fire_files.raster_source import RasterSource, Window
from emberlink.envs.fire_files.rasters import read_geotiff
from emberlink.envs.fire_files.reader import read_fires, with_checksum
from emberlink.envs.utils.errors import UserError

INF = math.inf
PLAIN = {"units": "minutes", "ring_width": None, "margin": None}


def read(path, grid=(8, 8), horizon=10, **keys):
    """Returns the fire of a file, [X, Y]."""
    (fire,) = read_fires(FileFireConfig(path=str(path), **{**PLAIN, **keys}), grid, horizon)
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
    # North up: row 0 is at y = 7; 10 minutes are 10 steps.
    expected = torch.full((8, 8), INF)
    expected[0, 7], expected[1, 7], expected[2, 7] = 0, 5, 10
    expected[0, 6], expected[1, 6] = 2, 4
    assert torch.equal(fire, expected)


def test_the_earliest_cell_within_a_coarse_cell_counts(tmp_path):
    times = np.full((16, 24), -9999.0)
    times[:2, :3] = [[9, 8, 4], [7, -9999, 6]]
    times[15, 23] = 14
    # A cell of the grid is 3 x 3 cells of the raster. 1 1/3 cells stay free below and above.
    fire = read(write_asc(tmp_path / "fire.asc", times), horizon=10)
    # The raster's rows 0 and 1 are the northern two of 16; the grid's rows of 3 begin 4 lower.
    assert fire[0, 6] == 0  # the earliest of all six, 4 minutes, is step 0
    assert fire[7, 1] == 10
    assert torch.isfinite(fire).sum() == 2


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


def test_the_earliest_arrival_is_kept_where_the_grid_is_finer(tmp_path):
    times = np.full((5, 5), -9999.0)
    times[1:4, 1:4] = [[6, 5, 6], [5, 1, 5], [6, 5, 6]]
    fire = read(write_asc(tmp_path / "fire.asc", times), (9, 9), horizon=100)
    assert fire.min() == 0
    assert fire[4, 4] == 0
    assert (fire[fire > 0] > 20).all()
    assert torch.isfinite(fire).sum() > 9


@pytest.mark.parametrize("never", [-9999.0, -1.0, np.nan, np.inf, -3.4028234663852886e38])
def test_cells_that_never_burn(tmp_path, never):
    times = np.where(corner([[1, 2], [3, 4]], 2, 2) < 0, never, corner([[1, 2], [3, 4]], 2, 2))
    asc = write_asc(tmp_path / "fire.asc", times, NODATA_VALUE=None)
    tif = write_tif(tmp_path / "fire.tif", times, nodata=None)
    declared = write_tif(
        tmp_path / "declared.tif", np.where(times == never, 777, times), nodata=777
    )
    for path in (asc, tif) if np.isnan(never) else (asc, tif, declared):
        assert torch.isfinite(read(path)).sum() == 4


def test_zero_is_a_time(tmp_path):
    times = corner([[0, 0, 3]], 1, 3)
    fire = read(write_asc(tmp_path / "fire.asc", times), horizon=6)
    assert fire[:3, 7].tolist() == [0, 0, 6]


@pytest.mark.parametrize("kind", ["int16", "int32", "uint16", "float32", "float64"])
def test_numbers_of_any_real_type(tmp_path, kind):
    never = 65535 if kind == "uint16" else -9999
    times = corner([[0, 2], [4, 6]], 2, 2)
    times = np.where(times < 0, never, times).astype(kind)
    fire = read(write_tif(tmp_path / "fire.tif", times, nodata=never), horizon=3)
    assert fire[0, 7] == 0
    assert fire[1, 6] == 3
    assert torch.isfinite(fire).sum() == 4


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
        ({"start": 10.0}, [0, 0, 0, 20]),  # cells that burn by then burn at 0
        ({"start": 5.0}, [0, 0, 20 / 3, 20]),
        ({"end": 10.0}, [0, 10, 20, INF]),
        ({"start": 5.0, "end": 10.0}, [0, 0, 20, INF]),
        ({"minutes_per_step": 0.5}, [0, 10, 20, INF]),
        ({"minutes_per_step": 2.0}, [0, 2.5, 5, 10]),
        ({"start": -10.0, "end": 30.0}, [5, 7.5, 10, 15]),
        ({"units": "hours", "minutes_per_step": 60.0}, [0, 5, 10, 20]),
        ({"units": "seconds", "minutes_per_step": 1 / 60}, [0, 5, 10, 20]),
        ({"units": "days", "minutes_per_step": 1440.0, "start": 1.0}, [0, 4, 9, 19]),
        ({"units": "steps"}, [0, 5, 10, 20]),
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
    assert burnt.any(1).nonzero()[:, 0].tolist() == list(range(3, 27))
    assert burnt.any(0).nonzero()[:, 0].tolist() == list(range(3, 27))


def test_the_inside_of_the_front_is_burnt_out(tmp_path):
    at = np.arange(30) - 14.5
    far = np.hypot(at[:, None], at[None, :])
    path = write_asc(tmp_path / "fire.asc", np.where(far < 14, far, -9999))
    keys = {"start": 8.0, "end": 14.0}
    solid = read(path, (30, 30), **keys)
    ring = read(path, (30, 30), **keys, ring_width=3.0)
    burnt_out = torch.isinf(ring) & torch.isfinite(solid)
    assert torch.equal(ring[~burnt_out], solid[~burnt_out])
    # Cells deeper than 3 in a disc of radius 8 are a disc of radius 5.
    inner, outer = torch.as_tensor(far < 4.4), torch.as_tensor(far < 5.6)
    assert (burnt_out >= inner).all()
    assert (burnt_out <= outer).all()
    wider = read(path, (30, 30), **keys, ring_width=20.0)
    assert torch.equal(wider, solid)


def test_a_ring_is_scaled_with_the_grid_and_a_lake_has_no_front(tmp_path):
    at = np.arange(60) - 29.5
    far = np.hypot(at[:, None], at[None, :])
    times = np.where(far < 28, far, -9999.0)
    times[29:31, 29:31] = -9999.0
    path = write_asc(tmp_path / "fire.asc", times)
    fire = read(path, (60, 60), start=16.0, ring_width=3.0)
    assert torch.isinf(fire[torch.as_tensor(far < 9)]).all()
    assert (fire[torch.as_tensor((far > 11) & (far < 16))] == 0).all()


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
    for step in (4, 6, 8, 10):
        assert iou(rotated <= step, upright <= step) > 0.88
    assert iou(rotated <= 10, upright <= 10) > 0.93


def iou(a, b):
    return ((a & b).sum() / (a | b).sum()).item()


@pytest.mark.parametrize("first", [0.0, 3.0, 10.0, 10.5, 700.0])
def test_a_fire_begins_at_0_where_its_first_cell_allows_it(tmp_path, first):
    """Burns a cell every ten minutes, so that an ignition at the edge of the first cell was at
    most ten minutes earlier."""
    path = write_asc(tmp_path / "fire.asc", corner([[first + t for t in (0, 10, 20, 30)]], 1, 4))
    began = 0.0 if first <= 10 else first
    fire = read(path, horizon=100)[:4, 7]
    last = first + 30 - began
    later = [100 * (first + t - began) / last for t in (10, 20, 30)]
    assert fire.tolist() == pytest.approx([0.0, *later], abs=1e-3)
    given = read(path, horizon=100, start=0.0)[:4, 7]
    assert given[0].item() == pytest.approx(100 * first / (first + 30), abs=1e-3)
    steps = read(path, horizon=800, units="steps")[:4, 7]
    assert steps.tolist() == pytest.approx([first + t for t in (0, 10, 20, 30)])


def test_degrees_across_the_antimeridian_are_refused(tmp_path):
    at = np.arange(10) - 4.5
    times = np.hypot(at[:, None], at[None, :]) * 10
    for west, refused in ((176.995, False), (179.995, True), (-180.005, True)):
        about = {"crs": "EPSG:4326", "transform": from_origin(west, 0.005, 0.001, 0.001)}
        path = write_tif(tmp_path / f"{west}.tif", times, **about)
        if not refused:
            assert torch.isfinite(read(path, (30, 30))).sum() > 700
            continue
        with pytest.raises(ValueError, match=r"longitudes from .*; expected -180 to 180"):
            read(path, (30, 30))


def test_ascii_dialects(tmp_path):
    times = corner([[0, 5, 10], [2, 4, -9999]], 2, 3)
    plain = read(write_asc(tmp_path / "fire.asc", times))
    text = (tmp_path / "fire.asc").read_text()
    for number, other in enumerate(
        [
            text.lower(),
            text.replace("\n", "\r\n"),
            text.replace(" ", "\t"),
            text.replace("\n", " \n"),
            text.rstrip("\n"),
            "\ufeff" + text,
            text + "\n\n",
            text.replace("CELLSIZE 30.0", "DX 30\nDY 30"),
            text.replace("XLLCORNER", "XLLCENTER").replace("YLLCORNER", "YLLCENTER"),
            text.replace("NODATA_VALUE -9999.0\n", ""),
            text.replace("NODATA_VALUE -9999.0", "NODATA_VALUE nan").replace("-9999.0", "nan"),
        ]
    ):
        path = tmp_path / f"{number}.asc"
        path.write_bytes(other.encode())
        assert torch.equal(read(path), plain)


def test_a_projection_file_of_an_asc(tmp_path):
    times = corner([[0, 5, 10], [2, 4, 9]], 2, 3)
    path = write_asc(tmp_path / "fire.asc", times)
    plain = read(path)
    (tmp_path / "fire.prj").write_text(rasterio.crs.CRS.from_string(UTM).to_wkt())
    assert torch.equal(read(path), plain)
    degrees = write_asc(tmp_path / "deg.asc", times, 0.001, XLLCORNER=-117.0, YLLCORNER=36.0)
    with pytest.raises(ValueError, match=r"deg\.asc: .*fire\.crs=EPSG:4326"):
        read(degrees)
    (tmp_path / "deg.prj").write_text(rasterio.crs.CRS.from_string("EPSG:4326").to_wkt())
    assert torch.isfinite(read(degrees, margin=0.1)).any()


@pytest.mark.parametrize("write", [write_asc, write_tif])
def test_an_incident_of_a_raster_is_refused(tmp_path, write):
    path = write(tmp_path / f"fire.{write.__name__[6:]}", corner([[0, 5], [2, 4]], 2, 2))
    with pytest.raises(ValueError, match=r"fire\.incident=Creek chooses among perimeters; .*$"):
        read(path, incident="Creek")


@pytest.mark.parametrize(
    "name",
    [
        *("fire.prj", "fire.PRJ", "fire.cpg", "fire.tfw", "fire.aux"),
        *("fire.tif.aux.xml", "fire.tif.MSK", "fire.tif.ovr"),
    ],
)
def test_no_regular_file_beside_a_raster(tmp_path, name):
    path = write_tif(tmp_path / "fire.tif", corner([[0, 5], [2, 4]], 2, 2))
    part = tmp_path / name
    for make in (part.mkdir, lambda: os.mkfifo(part), lambda: part.symlink_to("none")):
        make()
        with pytest.raises(ValueError, match=rf"fire\.tif: {name}, beside it, is no regular file$"):
            read(path)
        part.rmdir() if part.is_dir() else part.unlink()


@pytest.mark.parametrize("ending", [".msk", ".MSK", ".ovr"])
def test_a_virtual_mask_is_not_fetched(tmp_path, ending, monkeypatch):
    """GDAL would open it, and the owner of the file would learn who reads it."""
    monkeypatch.setenv("GDAL_HTTP_TIMEOUT", "1")  # so that a fetch would not block
    path = write_tif(tmp_path / "fire.tif", corner([[0, 5], [2, 4]], 2, 2), nodata=None)
    part = '{0}="0" {1}="0" xSize="8" ySize="8"'.format
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"/vsicurl/http://127.0.0.1:{server.getsockname()[1]}/mask.tif"
        (tmp_path / f"fire.tif{ending}").write_text(
            '<VRTDataset rasterXSize="8" rasterYSize="8"><Metadata>'
            '<MDI key="INTERNAL_MASK_FLAGS_1">2</MDI></Metadata>'
            '<VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
            f"<SourceFilename>{address}</SourceFilename><SourceBand>1</SourceBand>"
            f"<SrcRect {part('xOff', 'yOff')}/><DstRect {part('xOff', 'yOff')}/>"
            "</SimpleSource></VRTRasterBand></VRTDataset>"
        )
        with pytest.raises(UserError, match=rf"fire\.tif{ending}, beside it, is no TIFF"):
            read(path)
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


def test_a_byte_order_mark_before_a_projection(tmp_path):
    path = write_asc(tmp_path / "fire.asc", raster_of(Ellipses(), 300.0))
    fire = read(path, (30, 30))
    wkt = rasterio.crs.CRS.from_string(UTM).to_wkt()
    (tmp_path / "fire.prj").write_text(wkt, encoding="utf-8-sig")
    assert torch.equal(read(path, (30, 30)), fire)


def test_a_large_projection_file_is_refused(tmp_path):
    path = write_asc(tmp_path / "fire.asc", corner([[0, 5], [2, 4]], 2, 2))
    wkt = rasterio.crs.CRS.from_string(UTM).to_wkt()
    (tmp_path / "fire.prj").write_text(wkt + " " * 1_000_000)
    with pytest.raises(ValueError, match=r"fire\.prj, beside it: it has more than 1000000 bytes$"):
        read(path)


def test_the_largest_integer_is_no_time(tmp_path):
    for kind in ("uint16", "uint32", "int32", "int16"):
        never = np.iinfo(kind).max
        times = corner([[0, 2], [4, 6]], 2, 2)
        times = np.where(times < 0, np.float64(never), times).astype(kind)
        fire = read(write_tif(tmp_path / f"{kind}.tif", times, nodata=None), horizon=3)
        assert torch.isfinite(fire).sum() == 4


def test_a_mask_marks_cells_that_never_burn(tmp_path):
    times = np.full((8, 8), 3.0, "float32")
    times[:2, :2] = [[0, 2], [4, 6]]
    path = write_tif(tmp_path / "fire.tif", times, nodata=None)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as dataset:
        dataset.write_mask(times != 3)
    assert torch.isfinite(read(path, horizon=3)).sum() == 4


def test_a_mask_beside_the_file_marks_cells_that_never_burn(tmp_path):
    times = np.full((8, 8), 3.0, "float32")
    times[:2, :2] = [[0, 2], [4, 6]]
    path = write_tif(tmp_path / "fire.tif", times, nodata=None)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(path, "r+") as dataset:
        dataset.write_mask(times != 3)
    assert (tmp_path / "fire.tif.msk").is_file()
    assert torch.isfinite(read(path, horizon=3)).sum() == 4


def test_a_small_fire_in_a_large_raster_keeps_its_resolution(tmp_path):
    fire = raster_of(Ellipses(), 300.0).astype("float32")
    large = np.full((2200, 6300), -9999.0, "float32")
    large[901:1001, 4003:4103] = fire
    small = read(write_tif(tmp_path / "small.tif", fire), (30, 30), margin=0.1)
    path = write_tif(tmp_path / "large.tif", large, compress="deflate")
    assert torch.allclose(read(path, (30, 30), margin=0.1), small, atol=1e-2)
    with pytest.raises(ValueError, match="no fire spreads"):  # margin=None takes the whole file
        read(path, (60, 20))


@pytest.mark.slow
def test_a_large_raster_needs_bounded_memory(tmp_path):
    """Checks that 6000 x 8000 cells need less than 1.2 GB, also if the file is compressed."""
    path, height, width = tmp_path / "large.tif", 6000, 8000
    about = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": -9999.0, "crs": UTM}
    about |= {"sparse_ok": True, "tiled": True, "transform": from_origin(*CORNER, 30, 30)}
    at = np.arange(1024) - 511.5
    far = np.hypot(at[:, None], at[None, :]).astype("float32")
    with rasterio.open(path, "w", height=height, width=width, **about) as dataset:
        dataset.write(far, 1, window=rasterio.windows.Window(4096, 2048, 1024, 1024))
    program = (
        "import resource, sys; from emberlink.envs.fire_files.reader import *\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "config = FileFireConfig(path=sys.argv[1], units='minutes', end=500.0, ring_width=None)\n"
        "fire = read_fires(config, (30, 30), 1000)[0]\n"
        "after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(int(fire.isfinite().sum()), after - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, path], capture_output=True, text=True, timeout=60
    )
    assert done.stderr == ""
    cells, kilobytes = map(int, done.stdout.split())
    assert cells == pytest.approx(math.pi * 12**2, rel=0.15)
    assert kilobytes < 1_200_000
    with rasterio.open(tmp_path / "larger.tif", "w", height=20_000, width=8000, **about):
        pass
    with pytest.raises(ValueError, match=rf"8000 x 20000 cells; at most {rasters.MAX_CELLS} are"):
        read(tmp_path / "larger.tif")


def by_loops(times, window):
    """Returns the earliest centre in each cell of the grid that contains one."""
    earliest = {}
    rows = len(times)
    for r, row in enumerate(times):
        for c, time in enumerate(row):
            i = math.floor((c + 0.5 - window.x) / window.side + 1e-6)
            j = math.floor((rows - r - 0.5 - window.y) / window.side + 1e-6)
            earliest[i, j] = min(time, earliest.get((i, j), INF))
    return earliest


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 12),
    st.integers(2, 12),
    st.floats(0.3, 4),
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.integers(0, 2**32 - 1),
)
@example(2, 2, 1.0, 0.0, -1.5, 2)  # centres on the edges of cells
def test_no_arrival_is_lost(rows, columns, side, x, y, seed):
    random = np.random.default_rng(seed)
    times = random.uniform(0, 100, (rows, columns))
    times[random.random(times.shape) < 0.3] = INF
    times[0, 0] = 5.0
    window = Window(x, y, side, (8, 9))
    source = RasterSource(times, (0, rows), (1, 1), Clock("minutes"))
    got = source.on(window, INF)
    cells = RasterSource(times, (0, rows), (1, 1), Clock("steps"), whole=True)
    cells = cells.on(window, INF)
    assert (got >= times.min() - 1e-9).all()
    assert (np.isinf(got) | (got <= times[times < INF].max() + 1e-9)).all()
    expected = by_loops(times, window)
    for i in range(8):
        for j in range(9):
            if (i, j) not in expected:
                continue
            if side >= 1:
                assert cells[i, j] == expected[i, j]
                assert got[i, j] <= expected[i, j]
            if expected[i, j] == times.min():
                assert got[i, j] == times.min()


@pytest.mark.parametrize("suffix", [".aux.xml", ".msk", ".MSK"])
def test_the_checksum_of_a_raster_contains_the_files_that_gdal_reads_beside_it(tmp_path, suffix):
    """A mask, or NODATA in .aux.xml, changes the fire."""
    values = raster_of(Ellipses(), 300.0)
    path = write_tif(tmp_path / "fire.tif", np.where(values < 0, 400.0, values), nodata=None)
    config = FileFireConfig(path=str(path), units="minutes")
    before, (fire,) = with_checksum(config), read_fires(config, (30, 30), 1000)
    other = tmp_path / f"fire.tif{suffix}"
    if suffix == ".aux.xml":
        band = '<PAMRasterBand band="1"><NoDataValue>400</NoDataValue></PAMRasterBand>'
        other.write_text(f"<PAMDataset>{band}</PAMDataset>")
    else:
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(path, "r+") as dataset:
            dataset.write_mask(values >= 0)
        (tmp_path / "fire.tif.msk").rename(other)
    (changed,) = read_fires(config, (30, 30), 1000)
    assert not torch.equal(changed, fire)
    assert with_checksum(config) != before
    with pytest.raises(UserError, match="has changed"):
        with_checksum(before)


def test_a_raster_without_arrival_times_gives_a_warning(tmp_path):
    """Checks that elevation is noticed, but not fires that merge or times in whole hours."""
    hills = np.random.default_rng(0).random((60, 60))
    hills = 900 + 100 * gaussian_filter(hills, 2)
    path = write_tif(tmp_path / "hills.tif", hills.astype("float32"))
    with rasterio.open(path, "r+") as dataset:
        dataset.set_band_description(1, "Elevation")
    with pytest.warns(UserWarning, match="'Elevation': 3600 cells burn .* are these arrival times"):
        read(path, (30, 30))
    merging = Ellipses(origins=((1200.0, 1300.0), (1900.0, 1500.0)), breadth=1.5)
    times = raster_of(merging, 300.0)
    hours = np.where(times < 0, times, np.floor(times / 60))
    for values, units in ((times, "minutes"), (hours, "hours")):
        assert beginnings(source_of(values).times) == 2
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read(write_asc(tmp_path / "fire.asc", values), (30, 30), units=units)


def test_a_front_of_many_points_gives_no_warning(tmp_path):
    places = [f"{12 + 3 * (k % 8)},{12 + 3 * (k // 8)},1," for k in range(40)]
    (tmp_path / "fire.txt").write_text("\n".join(["1,1,1,"] * 6000 + places))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(tmp_path / "fire.txt", (30, 30), units="steps")


def source_of(times):
    return RasterSource(np.where(times < 0, INF, times), (0, 0), (1, 1), Clock("minutes"))


def test_a_raster_from_south_to_north_is_not_resampled(tmp_path):
    times = np.arange(64.0).reshape(8, 8)
    x, y = CORNER
    fires = [
        read(write_tif(tmp_path / f"{a}_{e}.tif", grid, transform=rasterio.Affine(*affine)), (8, 8))
        for a, e, grid, affine in (
            (30, -30, times, (30, 0, x, 0, -30, y)),
            (30, 30, times[::-1], (30, 0, x, 0, 30, y - 240)),
            (-30, -30, times[:, ::-1], (-30, 0, x + 240, 0, -30, y)),
        )
    ]
    assert torch.equal(fires[1], fires[0])
    assert torch.equal(fires[2], fires[0])


@pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:4326"])
@pytest.mark.parametrize("first", [9.0, 15.0])
def test_the_projection_does_not_decide_when_a_fire_began(tmp_path, crs, first):
    """A projected raster has smaller cells, which the front crosses faster."""
    at = np.arange(20) - 9.5
    times = first + 10 * (np.hypot(at[:, None] - 0.5, at[None, :] - 0.5))
    cell = 30.0 if crs == "EPSG:32631" else 30.0 / 111_000
    place = from_origin(5e5, 4e6, cell, cell) if cell == 30 else from_origin(3.0, 0.1, cell, cell)
    path = write_tif(tmp_path / "fire.tif", times, transform=place, crs=crs)
    assert (read_geotiff(path, "minutes", None).began == 0) == (first < 10 * 2**0.5)


def test_a_raster_that_is_large_when_projected_is_refused(tmp_path):
    turned = rasterio.Affine(21, 21, 5e5, -21, 21, 4e6)
    path = write_tif(tmp_path / "line.tif", np.arange(12_000.0)[None], transform=turned)
    with pytest.raises(ValueError, match="cells after its projection to a plane; at most"):
        read(path)


def test_blocks_larger_than_a_raster_are_refused(tmp_path):
    about = {"tiled": True, "blockxsize": 8192, "blockysize": 8192, "compress": "deflate"}
    path = write_tif(tmp_path / "fire.tif", np.arange(64.0, dtype="f4").reshape(8, 8), **about)
    with pytest.raises(ValueError, match="blocks of 8192 x 8192 cells"):
        read(path)


def test_a_bank_is_in_steps(tmp_path):
    fire = np.arange(64, dtype="i2").reshape(8, 8)
    np.save(tmp_path / "bank.npy", fire)
    (tmp_path / "bank.json").write_text('{"horizon": Infinity}')
    with pytest.raises(ValueError, match=r"fire\.units=minutes: a bank is in steps"):
        read(tmp_path / "bank.npy", horizon=100)
    with pytest.raises(ValueError, match=r"fire\.minutes_per_step: a bank is in steps"):
        read(tmp_path / "bank.npy", horizon=100, units=None, minutes_per_step=0.5)
    assert read(tmp_path / "bank.npy", horizon=100, units=None).max() == 63
    path = write_tif(tmp_path / "bank.tif", fire, tags={"units": "steps"}, crs=None, nodata=None)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales = (0.1,)
    with pytest.raises(ValueError, match="scaled values; expected a bank without scale"):
        read(path, horizon=100, units=None)
