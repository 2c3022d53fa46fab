"""Tests perimeters by hand, and against the raster of the same fire."""

import geopandas
import numpy as np
import pytest
import shapely
import torch
from fire_files import (
    CORNER,
    KINDS,
    UTM,
    Ellipses,
    fires_in,
    frame_of,
    raster_of,
    squares,
    write_asc,
)

from emberlink.envs.fire_files.config import FileFireConfig

GRID, HORIZON = (30, 30), 1000
HOURS = (60.0, 120.0, 180.0, 240.0, 300.0)
FIRES = {
    "head to the north-east": Ellipses(),
    "slow and round": Ellipses(origins=((1400.0, 1600.0),), head=3.0, breadth=1.2, azimuth=200),
    "narrow, to the south": Ellipses(origins=((1500.0, 2400.0),), breadth=2.5, azimuth=-85),
    "two that merge": Ellipses(origins=((1200.0, 1300.0), (1750.0, 1500.0)), head=3.0),
}


def read(path, grid=GRID, horizon=HORIZON, **keys):
    """Returns the fire of a file, [X, Y], without burnt-out cells."""
    config = FileFireConfig(path=str(path), **{"ring_width": None, **keys})
    (fire,) = fires_in(config, grid, horizon)
    return fire


def write(path, shapes, minutes):
    """Writes perimeters around the corner of the map."""
    shapes = [shapely.transform(shape, lambda at: at + CORNER) for shape in shapes]
    geopandas.GeoDataFrame({"Elapsed_Mi": minutes}, geometry=shapes, crs=UTM).to_file(path)


@pytest.mark.parametrize("name", FIRES)
@pytest.mark.parametrize(("grid", "first"), [((30, 30), 60), ((48, 36), 180)])
def test_a_fire_is_the_same_from_its_raster_and_from_its_perimeters(tmp_path, name, grid, first):
    """All half-hourly perimeters from 60 minutes on, or the span from 180 to 360 minutes."""
    fire, span = FIRES[name], {"start": 180.0, "end": 360.0} if first == 180 else {}
    raster = write_asc(tmp_path / "fire.asc", raster_of(fire, 360.0, 150, 20.0), 20.0)
    frame_of(fire, range(first - 60 * (first > 60), 390, 30), "line").to_file(tmp_path / "fire.shp")
    cells = read(raster, grid, units="minutes", **span)
    fronts = read(tmp_path / "fire.shp", grid, **span)
    pairs = [(cells <= step, fronts <= step) for step in range(300, 1001, 50)]
    shares = [((a & b).sum() / (a | b).sum()).item() for a, b in pairs]
    assert min(shares) > 0.95, shares
    assert np.mean(shares) > 0.985, shares
    later = torch.isfinite(cells) & torch.isfinite(fronts) & (cells > 0) & (fronts > 0)
    assert (cells - fronts)[later].abs().mean() < 0.01 * HORIZON


def test_before_the_first_perimeter_by_hand(tmp_path):
    """The fire is a point at 0, in the middle of its first perimeter."""
    squares(300, 400, Elapsed_Mi=[60, 120]).to_file(tmp_path / "fire.shp")
    fire = read(tmp_path / "fire.shp", (40, 40), 120, margin=0.0)  # cells of 10 m
    assert 1 <= (fire == 0).sum() <= 4
    assert (fire <= 60).sum() == pytest.approx(30 * 30, abs=4 * 30)
    assert (fire[5:9, 20] > 0).all()
    assert (fire[5:9, 20] < 60).all()
    for first, width in ((180, 30), (360, 30)):
        squares(300, 400, Elapsed_Mi=[first, first + 60]).to_file(tmp_path / "late.shp")
        late = read(tmp_path / "late.shp", (40, 40), first + 60, margin=0.0, start=0.0)
        assert 1 <= (late == 0).sum() <= 4
        assert (late == 0)[19:21, 19:21].any()
        assert (late <= first).sum() == pytest.approx(width**2, abs=4 * width)
    # Calendar time begins at the first perimeter.
    squares(300, 400, date=["2020-08-19", "2020-08-20"]).to_file(tmp_path / "dates.gpkg")
    dated = read(tmp_path / "dates.gpkg", (40, 40), 120, margin=0.0)
    assert (dated == 0).sum() == pytest.approx(30 * 30, abs=4 * 30)


def test_a_small_polygon_beside_a_large_one_is_not_lost(tmp_path):
    """A spot fire of 4 m lies between samples 10 m apart."""
    spot = [shapely.box(2000, 0, 2000 + side, side) for side in (4, 8)]
    large = [shapely.box(0, 0, side, side) for side in (1000, 1200)]
    shapes = [shapely.MultiPolygon(pair) for pair in zip(large, spot, strict=True)]
    for first in (0, 60):
        write(tmp_path / "fire.gpkg", shapes, [first, first + 60])
        fire = read(tmp_path / "fire.gpkg")
        right = fire[25:]
        assert (right == 0).sum() == 1
        assert torch.isfinite(right).sum() == 1


# Shapefiles have no collections.
FORMATS = [(kind, "gpkg") for kind in KINDS] + [("multiline", "shp"), ("collection", "geojson")]


@pytest.mark.parametrize(("kind", "suffix"), FORMATS)
def test_each_kind_of_geometry_in_each_format(tmp_path, kind, suffix):
    frame_of(FIRES["two that merge"], HOURS).to_file(tmp_path / "plain.gpkg")
    path = tmp_path / f"fire.{suffix}"
    frame_of(FIRES["two that merge"], HOURS, kind).to_file(path)
    plain, fire = read(tmp_path / "plain.gpkg"), read(path)
    assert torch.equal(torch.isfinite(fire), torch.isfinite(plain))
    both = torch.isfinite(plain)
    assert torch.allclose(fire[both], plain[both], atol=1)  # a thousandth of the episode


def test_between_two_squares_by_hand(tmp_path):
    squares(100, 500, Elapsed_Mi=[0, 400]).to_file(tmp_path / "fire.shp")
    # Of 25 x 25 cells of 20 m, the middle 5 x 5 burn at 0 and the outermost last.
    fire = read(tmp_path / "fire.shp", (25, 25), 400, margin=0.0)
    assert (fire[10:15, 10:15] == 0).all()
    assert torch.isfinite(fire).all()
    row = fire[12, 15:]
    assert (row.diff() > 0).all()
    # There are ten cells between the fronts.
    assert row.tolist() == pytest.approx([k * 40 for k in range(10)], abs=20)
    assert torch.allclose(fire, fire.flip(0), atol=1e-3)
    assert torch.allclose(fire, fire.T, atol=1e-3)


def test_burnt_area_stays_burnt(tmp_path):
    """Perimeters may not contain each other, or hold the growth alone. Their union counts."""
    frame = squares(200, 300, 310, Elapsed_Mi=[0, 60, 120])
    moved = shapely.affinity.translate(frame.geometry[1], 80, 0)
    frame.loc[1, "geometry"] = moved.difference(frame.geometry[0])
    frame.to_file(tmp_path / "fire.shp")
    fire = read(tmp_path / "fire.shp")
    burnt = [(fire <= step).sum().item() for step in (0, 500, 1000)]
    union = shapely.union_all(frame.geometry.tolist())
    cell = 385 / 24  # the whole is 385 m wide and fills 80 % of 30 cells
    assert burnt[2] == pytest.approx(union.area / cell**2, rel=0.05)
    assert burnt[0] < burnt[1] < burnt[2]


def test_an_island_is_a_line_within_a_line(tmp_path):
    outer, last, hole = (shapely.box(-s, -s, s, s) for s in (150, 210, 60))
    edges = [outer.boundary, hole.boundary, last.boundary, hole.boundary]
    write(tmp_path / "lines.shp", edges, [0, 0, 60, 60])
    write(tmp_path / "areas.gpkg", [outer.difference(hole), last.difference(hole)], [0, 60])
    lines = read(tmp_path / "lines.shp")
    assert torch.equal(lines, read(tmp_path / "areas.gpkg"))
    assert torch.isinf(lines[14:16, 14:16]).all()


def test_areas_that_cross_themselves(tmp_path):
    at = np.array([(0, 0), (300, 300), (300, 0), (0, 300), (0, 0)]) - 150.0
    bow, large = shapely.Polygon(at), shapely.box(-250, -250, 250, 250)
    for name, shapes in (("areas", [bow, large]), ("lines", [bow.boundary, large.boundary])):
        write(tmp_path / f"{name}.gpkg", shapes, [0, 60])
        fire = read(tmp_path / f"{name}.gpkg")
        assert (fire[[9, 9, 20, 20], [12, 17, 12, 17]] == 0).all()  # in the two lobes
        assert (fire[[14, 15, 14, 15], [9, 9, 20, 20]] > 0).all()  # and between them
        cell = 500 / 24
        near = shapely.make_valid(bow).buffer(cell / 2)  # a cell counts if a part of it burns
        assert (fire <= 0).sum() == pytest.approx(near.area / cell**2, rel=0.15)


@pytest.mark.heavy
def test_a_front_far_outside_the_map_is_measured_to_its_boundary(tmp_path):
    """Between circles of 50 and 5000 m, a day apart, the radius after an hour is 256 m.

    A cell burns if one of its samples does, so the burnt cells reach half a cell farther.
    """
    circles = [shapely.Point(CORNER).buffer(radius, quad_segs=64) for radius in (50, 5000)]
    dates = {"date": ["2020-08-19T13:00", "2020-08-20T13:00"]}
    geopandas.GeoDataFrame(dates, geometry=circles, crs=UTM).to_file(tmp_path / "fire.geojson")
    fire = read(tmp_path / "fire.geojson", end=60.0, units="minutes")
    radius, side = 50 + 4950 / 24, 2 * (50 + 4950 / 24) / (30 * 0.8)
    assert fire.isfinite().sum().item() == pytest.approx(
        np.pi * (radius / side + 0.5) ** 2, rel=0.03
    )
    halfway = (fire <= 500).sum().item()
    assert halfway == pytest.approx(np.pi * ((50 + radius) / 2 / side + 0.5) ** 2, rel=0.1)
