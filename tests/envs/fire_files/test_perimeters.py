"""Tests perimeters in every format, and compares them with the raster of the same fire."""

import datetime
import sqlite3
import zipfile
from contextlib import closing

import geopandas
import numpy as np
import pandas
import pytest
import shapely
import torch
from fire_files import CORNER, KINDS, UTM, Ellipses, frame_of, raster_of, write_asc

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.perimeters.times import _time_of_day
from emberlink.envs.fire_files.reader import read_fires
from emberlink.envs.utils.errors import UserError

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
    (fire,) = read_fires(config, grid, horizon)
    return fire


def overlaps(first, second, steps=(0, 250, 500, 750, 1000)):
    """Returns the intersection over union of the burnt areas at some steps."""
    pairs = [(first <= step, second <= step) for step in steps]
    return [((a & b).sum() / (a | b).sum()).item() for a, b in pairs]


@pytest.mark.parametrize("name", FIRES)
@pytest.mark.parametrize("grid", [(30, 30), (48, 36)])
def test_a_fire_is_the_same_from_its_raster_and_from_its_perimeters(tmp_path, name, grid):
    fire, span = FIRES[name], {"start": 180.0, "end": 360.0}
    raster = write_asc(tmp_path / "fire.asc", raster_of(fire, 360.0, 150, 20.0), 20.0)
    frame_of(fire, (120.0, *range(180, 390, 30)), "line").to_file(tmp_path / "fire.shp")
    cells = read(raster, grid, units="minutes", **span)
    fronts = read(tmp_path / "fire.shp", grid, **span)
    assert min(overlaps(cells, fronts)) > 0.9, overlaps(cells, fronts)
    later = torch.isfinite(cells) & torch.isfinite(fronts) & (cells > 0) & (fronts > 0)
    assert (cells - fronts)[later].abs().mean() < 0.06 * HORIZON


@pytest.mark.parametrize("name", FIRES)
@pytest.mark.parametrize("grid", [(30, 30), (48, 36)])
def test_by_default_both_begin_when_the_fire_began(tmp_path, name, grid):
    fire = FIRES[name]
    raster = write_asc(tmp_path / "fire.asc", raster_of(fire, 300.0, 150, 20.0), 20.0)
    frame_of(fire, HOURS, "line").to_file(tmp_path / "fire.shp")
    cells, fronts = read(raster, grid, units="minutes"), read(tmp_path / "fire.shp", grid)
    shares = overlaps(cells, fronts, (300, 475, 650, 825, 1000))
    assert min(shares) > 0.9, shares


def test_before_the_first_perimeter_by_hand(tmp_path):
    """Edges move 50 m an hour, so that a square of 300 m after an hour is one of 200 m at 0."""
    squares(300, 400, column="Elapsed_Mi", values=[60, 120]).to_file(tmp_path / "fire.shp")
    fire = read(tmp_path / "fire.shp", (40, 40), 120, margin=0.0)  # cells of 10 m
    assert (fire[10:30, 10:30] == 0).all()
    assert (fire == 0).sum() == 20 * 20
    assert (fire <= 60).sum() == pytest.approx(30 * 30, abs=4 * 30)
    assert (fire[5:9, 20] > 0).all()
    assert (fire[5:9, 20] < 60).all()
    # The fire was a point three hours before the first perimeter, and stays one earlier.
    for first, width in ((180, 30), (360, 30)):
        squares(300, 400, column="Elapsed_Mi", values=[first, first + 60]).to_file(
            tmp_path / "late.shp"
        )
        late = read(tmp_path / "late.shp", (40, 40), first + 60, margin=0.0)
        assert 1 <= (late == 0).sum() <= 4
        assert (late == 0)[19:21, 19:21].any()
        assert (late <= first).sum() == pytest.approx(width**2, abs=4 * width)
    # Calendar time begins at the first perimeter.
    squares(300, 400, column="date", values=["2020-08-19", "2020-08-20"]).to_file(
        tmp_path / "dates.gpkg"
    )
    dated = read(tmp_path / "dates.gpkg", (40, 40), 120, margin=0.0)
    assert (dated == 0).sum() == pytest.approx(30 * 30, abs=4 * 30)


def test_before_the_first_perimeter_each_part_shrinks(tmp_path):
    """The left, right and upper edges move 50 m, so that two squares of 200 m began as squares
    of 100 m. The lower edge does not move."""
    shapes = [
        shapely.MultiPolygon([shapely.box(0, 0, 200, 200), shapely.box(400, 0, 600, 200)]),
        shapely.box(-50, 0, 650, 250),
    ]
    shapes = [shapely.transform(shape, lambda at: at + CORNER) for shape in shapes]
    frame = geopandas.GeoDataFrame({"Elapsed_Mi": [60, 120]}, geometry=shapes, crs=UTM)
    frame.to_file(tmp_path / "fire.gpkg")
    fire = read(tmp_path / "fire.gpkg", (70, 25), 120, margin=0.0)  # cells of 10 m
    expected = torch.zeros(70, 25, dtype=torch.bool)
    expected[10:20, :15] = expected[50:60, :15] = True
    assert torch.equal(fire == 0, expected)


def test_a_small_polygon_beside_a_large_one_is_not_lost(tmp_path):
    """A spot fire of 4 m lies between samples 10 m apart."""
    spot = [shapely.box(2000, 0, 2000 + side, side) for side in (4, 8)]
    large = [shapely.box(0, 0, side, side) for side in (1000, 1200)]
    shapes = [shapely.MultiPolygon(pair) for pair in zip(large, spot, strict=True)]
    shapes = [shapely.transform(shape, lambda at: at + CORNER) for shape in shapes]
    for first in (0, 60):
        frame = geopandas.GeoDataFrame(
            {"Elapsed_Mi": [first, first + 60]}, geometry=shapes, crs=UTM
        )
        frame.to_file(tmp_path / "fire.gpkg")
        fire = read(tmp_path / "fire.gpkg")
        right = fire[25:]
        assert (right == 0).sum() == 1
        assert torch.isfinite(right).sum() == 1


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [
        (kind, suffix)
        for kind in KINDS
        for suffix in ("shp", "geojson", "gpkg")
        if (kind, suffix) != ("collection", "shp")  # a shapefile has no collections
    ],
)
def test_each_kind_of_geometry_in_each_format(tmp_path, kind, suffix):
    frame_of(FIRES["two that merge"], HOURS).to_file(tmp_path / "plain.gpkg")
    path = tmp_path / f"fire.{suffix}"
    frame_of(FIRES["two that merge"], HOURS, kind).to_file(path)
    plain, fire = read(tmp_path / "plain.gpkg"), read(path)
    assert torch.equal(torch.isfinite(fire), torch.isfinite(plain))
    both = torch.isfinite(plain)
    assert torch.allclose(fire[both], plain[both], atol=1e-2)


def squares(*sides, column, values, kind=None):
    """Returns concentric squares with the given sides in metres."""
    boxes = [shapely.box(*(np.array([-s, -s, s, s]) / 2)) for s in sides]
    shapes = [shapely.transform(box, lambda at: at + CORNER) for box in boxes]
    return geopandas.GeoDataFrame({column: values}, geometry=shapes, crs=UTM)


def test_between_two_squares_by_hand(tmp_path):
    squares(100, 500, column="Elapsed_Mi", values=[0, 400]).to_file(tmp_path / "fire.shp")
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
    """Observed perimeters may not contain each other. Their union counts."""
    frame = squares(200, 300, 310, column="Elapsed_Mi", values=[0, 60, 120])
    frame.loc[1, "geometry"] = shapely.affinity.translate(frame.geometry[1], 80, 0)
    frame.to_file(tmp_path / "fire.shp")
    fire = read(tmp_path / "fire.shp")
    burnt = [(fire <= step).sum().item() for step in (0, 500, 1000)]
    union = shapely.union_all(frame.geometry.tolist())
    cell = 385 / 24  # the whole is 385 m wide and fills 80 % of 30 cells
    assert burnt[2] == pytest.approx(union.area / cell**2, rel=0.05)
    assert burnt[0] < burnt[1] < burnt[2]


def test_growth_alone_accumulates(tmp_path):
    """Some maps hold the growth since the previous time."""
    whole = squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120])
    grown = whole.copy()
    grown.loc[1, "geometry"] = whole.geometry[1].difference(whole.geometry[0])
    grown.loc[2, "geometry"] = whole.geometry[2].difference(whole.geometry[1])
    whole.to_file(tmp_path / "whole.gpkg")
    grown.to_file(tmp_path / "grown.gpkg")
    assert torch.equal(read(tmp_path / "grown.gpkg"), read(tmp_path / "whole.gpkg"))


def test_an_island_is_a_line_within_a_line(tmp_path):
    outer, last = squares(300, 420, column="t", values=[0, 1]).geometry
    hole = shapely.transform(shapely.box(-60, -60, 60, 60), lambda at: at + CORNER)
    shapes = [outer.boundary, hole.boundary, last.boundary, hole.boundary]
    frame = geopandas.GeoDataFrame({"Elapsed_Mi": [0, 0, 60, 60]}, geometry=shapes, crs=UTM)
    frame.to_file(tmp_path / "lines.shp")
    areas = [outer.difference(hole), last.difference(hole)]
    frame = geopandas.GeoDataFrame({"Elapsed_Mi": [0, 60]}, geometry=areas, crs=UTM)
    frame.to_file(tmp_path / "areas.gpkg")
    lines = read(tmp_path / "lines.shp")
    assert torch.equal(lines, read(tmp_path / "areas.gpkg"))
    assert torch.isinf(lines[14:16, 14:16]).all()


def test_fire_within_an_island(tmp_path):
    """Closed lines within each other are burnt, island and burnt; the next time encloses all."""
    frame = squares(400, 240, 100, 420, column="Elapsed_Mi", values=[0, 0, 0, 60])
    frame.geometry = frame.boundary
    frame.to_file(tmp_path / "fire.shp")
    fire = read(tmp_path / "fire.shp", (42, 42), margin=0.0)  # cells of 10 m
    assert fire[21, 21] == 0  # the centre
    assert fire[5, 21] == 0  # between 120 and 200 m from it
    assert (fire[11:14, 21] > 0).all()  # between 50 and 120 m


def test_areas_that_cross_themselves(tmp_path):
    at = np.array([(0, 0), (300, 300), (300, 0), (0, 300), (0, 0)]) - 150.0
    bow = shapely.Polygon(at + np.array(CORNER))
    large = squares(500, column="t", values=[1]).geometry[0]
    for name, shapes in (("areas", [bow, large]), ("lines", [bow.boundary, large.boundary])):
        frame = geopandas.GeoDataFrame({"Elapsed_Mi": [0, 60]}, geometry=shapes, crs=UTM)
        frame.to_file(tmp_path / f"{name}.gpkg")
        fire = read(tmp_path / f"{name}.gpkg")
        assert (fire[[9, 9, 20, 20], [12, 17, 12, 17]] == 0).all()  # in the two lobes
        assert (fire[[14, 15, 14, 15], [9, 9, 20, 20]] > 0).all()  # and between them
        cell = 500 / 24
        near = shapely.make_valid(bow).buffer(cell / 2)  # a cell counts if a part of it burns
        assert (fire <= 0).sum() == pytest.approx(near.area / cell**2, rel=0.15)


def test_a_first_perimeter_smaller_than_a_cell_is_not_lost(tmp_path):
    squares(0.5, 5000, column="Elapsed_Mi", values=[0, 60]).to_file(tmp_path / "fire.shp")
    assert (read(tmp_path / "fire.shp") == 0).any()


TEN = datetime.datetime(2020, 8, 19, 22, tzinfo=datetime.UTC)
DATED = [TEN + datetime.timedelta(hours=k) for k in range(3)]
COLUMNS = {
    "iso text": ("poly_DateCurrent", [d.isoformat() for d in DATED]),
    "text with slashes": ("date", [d.strftime("%Y/%m/%d %H:%M:%S+00") for d in DATED]),
    "milliseconds": ("poly_DateC", [int(d.timestamp() * 1000) for d in DATED]),
    "timestamps": ("GDB_FROM_DATE", pandas.to_datetime(DATED)),
    "naive timestamps": ("timestamp", pandas.to_datetime([d.replace(tzinfo=None) for d in DATED])),
    "zones that differ": (
        "date",
        ["2020-08-19T22:00:00Z", "2020-08-19T16:00:00-07:00", "2020-08-20T02:00:00+02:00"],
    ),
    "RFC 2822": ("date", [d.strftime("%a, %d %b %Y %H:%M:%S GMT") for d in DATED]),
    "American": ("date", ["8/19/2020 10:00:00 PM", "8/19/2020 23:00", "8/20/2020 12:00 AM"]),
}


@pytest.mark.parametrize("suffix", ["geojson", "gpkg", "shp"])
@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")
def test_calendar_times(tmp_path, name, suffix):
    column, values = COLUMNS[name]
    if (name, suffix) == ("milliseconds", "shp"):
        values = [float(value) for value in values]
    squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120]).to_file(tmp_path / "e.shp")
    squares(200, 300, 400, column=column, values=values).to_file(tmp_path / f"fire.{suffix}")
    elapsed, path = read(tmp_path / "e.shp"), tmp_path / f"fire.{suffix}"
    assert torch.equal(read(path), elapsed)
    half = read(tmp_path / "e.shp", start=60.0)
    assert torch.equal(read(path, start="2020-08-19T23:00"), half)
    assert torch.equal(read(path, start="2020-08-19T16:00-07:00", end="2020-08-20 00:00Z"), half)
    assert torch.equal(read(path, start=1.0, units="hours"), half)
    assert torch.equal(read(path, start="2020-08-19T23:00", minutes_per_step=0.06), half)


def test_the_mapping_time_has_priority_over_the_edit_time(tmp_path):
    """Tests the columns of NIFC and GeoMAC, also in the short form of a .dbf."""
    squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120]).to_file(tmp_path / "e.shp")
    elapsed, changed = read(tmp_path / "e.shp"), [DATED[0], DATED[2], DATED[2]]
    columns = {
        "poly_PolygonDateTime": "poly_DateCurrent",
        "poly_Polyg": "poly_DateC",
        "perimeterdatetime": "datecurrent",
    }
    for number, (mapped, edited) in enumerate(columns.items()):
        frame = squares(200, 300, 400, column=edited, values=[d.isoformat() for d in changed])
        frame[mapped] = [d.isoformat() for d in DATED]
        suffix = "shp" if len(mapped) <= 10 else "gpkg"
        frame.to_file(tmp_path / f"{number}.{suffix}")
        assert torch.equal(read(tmp_path / f"{number}.{suffix}"), elapsed), mapped
    frame = squares(200, 300, 400, column="poly_PolygonDateTime", values=[None, None, None])
    frame["poly_DateCurrent"] = [d.isoformat() for d in DATED]
    frame.to_file(tmp_path / "none.gpkg")
    assert torch.equal(read(tmp_path / "none.gpkg"), elapsed)
    frame.loc[0, "poly_PolygonDateTime"] = DATED[0].isoformat()
    frame.loc[0, "poly_DateCurrent"] = "2021-01-01T00:00Z"
    frame.to_file(tmp_path / "one.gpkg")
    assert torch.equal(read(tmp_path / "one.gpkg"), elapsed)


@pytest.mark.parametrize(
    "times", [["2200", "2300", "0000"], [2200, 2300, 0], ["22:00", "23:00", "0:00"]]
)
def test_geomacs_date_and_time(tmp_path, times):
    """Without the time of day, three perimeters would have two dates."""
    squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120]).to_file(tmp_path / "e.shp")
    dates = pandas.to_datetime(["2020-08-19", "2020-08-19", "2020-08-20"])
    for values in (dates.date, dates.strftime("%m/%d/%Y")):
        frame = squares(200, 300, 400, column="DATE_", values=values)
        frame["TIME_"] = times
        frame.to_file(tmp_path / "fire.shp")
        assert torch.equal(read(tmp_path / "fire.shp"), read(tmp_path / "e.shp"))
    frame["TIME_"] = ["2200", "2365", "0000"]
    frame.to_file(tmp_path / "wrong.shp")
    with pytest.raises(ValueError, match=r"feature 1 has DATE_=.*TIME_=2365; expected a date and"):
        read(tmp_path / "wrong.shp")


@pytest.mark.parametrize(
    "times",
    [
        ["1:55:00", "2:55:00", "3:55:00"],
        ["01:55", "02:55:00", "355"],
        ["12:05 AM", "01:05AM", "2:05 AM"],
        ["11:05 AM", "12:05 PM", "1:05:00 PM"],
        ["9:55 PM", "10:55 PM", "11:55 PM"],
    ],
)
def test_forms_of_the_time_of_day(tmp_path, times):
    squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120]).to_file(tmp_path / "e.shp")
    frame = squares(200, 300, 400, column="DATE_", values=["2020-08-19"] * 3)
    frame["TIME_"] = times
    frame.to_file(tmp_path / "fire.shp")
    assert torch.equal(read(tmp_path / "fire.shp"), read(tmp_path / "e.shp"))


def test_the_hour_of_a_time_of_day():
    hours = {
        "12:05 AM": 5,
        "11:55 PM": 1435,
        "11:55 pm": 1435,
        "12:00 PM": 720,
        "1:55:00": 115,
        "155.0": 115,
        "23": 23,
    }
    for text, minutes in hours.items():
        assert _time_of_day(text) == datetime.timedelta(minutes=minutes)
    wrong = ["24:00", "2400", "1:60", "0:00 AM", "13:00 PM", "1:5", "23000", "1.5", "-100"]
    for text in [*wrong, "", "nan", "1:55:60", "1:55 XM", "2::3"]:
        with pytest.raises(UserError, match="is not a time of day"):
            _time_of_day(text)


def test_date_and_time_beside_other_columns(tmp_path):
    squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120]).to_file(tmp_path / "e.shp")
    expected = read(tmp_path / "e.shp")
    frame = squares(200, 300, 400, column="DATE_", values=["2020-08-19"] * 3)
    frame["TIME_"] = ["1000", "1100", "1200"]
    frame.to_file(tmp_path / "both.gpkg")
    assert torch.equal(read(tmp_path / "both.gpkg", time_field="date_"), expected)
    frame["date"] = ["2020-08-19", "2020-08-20", "2020-08-25"]
    frame.to_file(tmp_path / "date.gpkg")
    with pytest.raises(ValueError, match=r"DATE_, date may hold .* fire\.time_field=DATE_"):
        read(tmp_path / "date.gpkg")
    del frame["date"]
    frame["perDatTime"] = [None] * 3
    frame.to_file(tmp_path / "empty.gpkg")
    assert torch.equal(read(tmp_path / "empty.gpkg"), expected)
    frame["TIME_"] = ["1000", "1005", "1006"]
    frame["perDatTime"] = [d.isoformat() for d in DATED]
    frame.to_file(tmp_path / "whole.gpkg")
    assert torch.equal(read(tmp_path / "whole.gpkg"), expected)


def test_a_kmz_holds_one_kml_in_lower_or_upper_case(tmp_path):
    ring = "<outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing>"
    marks = ""
    for k in (1, 2):
        at = [(-117 + x * k / 100, 36 + y * k / 100) for x, y in ((0, 0), (1, 0), (1, 1), (0, 0))]
        text = ring.format(" ".join(f"{x},{y}" for x, y in at)) + "</outerBoundaryIs>"
        when = f"<TimeStamp><when>2020-08-19T1{k}:00:00Z</when></TimeStamp>"
        marks += f"<Placemark>{when}<Polygon>{text}</Polygon></Placemark>"
    text = f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{marks}</Document></kml>'
    fires = []
    for number, names in enumerate((["doc.kml"], ["DOC.KML"], ["a/b.Kml"], ["a.kml", "B.KML"])):
        path = tmp_path / f"{number}.kmz"
        with zipfile.ZipFile(path, "w") as archive:
            for name in names:
                archive.writestr(name, text)
        if len(names) == 1:
            fires.append(read(path))
            continue
        with pytest.raises(ValueError, match=r"2 \.kml: a\.kml, B\.KML; expected one$"):
            read(path)
    assert torch.equal(fires[1], fires[0])
    assert torch.equal(fires[2], fires[0])


@pytest.mark.parametrize("column", ["FireName", "fire_nm", "FIRE_NAME"])
def test_an_empty_column_of_incidents_is_skipped(tmp_path, column):
    frame = squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 90])
    frame.iloc[:2].to_file(tmp_path / "two.gpkg")
    frame["poly_IncidentName"] = [None] * 3
    frame[column] = ["Creek", "Creek", "August"]
    frame.to_file(tmp_path / "fire.gpkg")
    with pytest.raises(ValueError, match="2 incidents: August, Creek"):
        read(tmp_path / "fire.gpkg")
    chosen = read(tmp_path / "fire.gpkg", incident="Creek")
    assert torch.equal(chosen, read(tmp_path / "two.gpkg"))


def test_columns_that_may_both_hold_the_times_are_named(tmp_path):
    frame = squares(200, 300, 400, column="date", values=[d.isoformat() for d in DATED])
    frame["timestamp"] = ["2020-08-19", "2020-09-19", "2020-10-19"]
    frame.to_file(tmp_path / "fire.gpkg")
    with pytest.raises(ValueError, match=r"date, timestamp may hold .* fire\.time_field=date"):
        read(tmp_path / "fire.gpkg")
    squares(200, 300, 400, column="seen", values=[d.isoformat() for d in DATED]).to_file(
        tmp_path / "seen.gpkg"
    )
    expected = read(tmp_path / "seen.gpkg", time_field="seen")
    assert torch.equal(read(tmp_path / "fire.gpkg", time_field="date"), expected)


def test_an_end_before_the_first_perimeter(tmp_path):
    """The fire began at 0, so that its first half hour is a valid span."""
    squares(300, 400, 500, column="Elapsed_Mi", values=[60, 120, 180]).to_file(tmp_path / "f.shp")
    early = read(tmp_path / "f.shp", end=30.0)
    assert torch.equal(early, read(tmp_path / "f.shp", start=0.0, end=30.0))
    assert torch.isfinite(early).any()


@pytest.mark.parametrize(
    ("column", "keys"),
    [
        ("hours", {}),
        ("HOURS", {"units": "hours"}),
        ("time", {"units": "hours"}),
        ("size", {"units": "hours", "time_field": "size"}),
        ("Size", {"units": "hours", "time_field": "size"}),
    ],
)
def test_elapsed_times(tmp_path, column, keys):
    squares(200, 300, 400, column=column, values=[0, 1, 2]).to_file(tmp_path / "fire.gpkg")
    squares(200, 300, 400, column="Elapsed_Mi", values=[0, 60, 120]).to_file(tmp_path / "e.shp")
    assert torch.equal(read(tmp_path / "fire.gpkg", **keys), read(tmp_path / "e.shp"))


def test_degrees_are_projected(tmp_path):
    plain = frame_of(FIRES["two that merge"], HOURS)
    plain.to_file(tmp_path / "plain.gpkg")
    degrees = plain.to_crs("EPSG:4326")
    degrees.to_file(tmp_path / "fire.geojson")
    bare = degrees.set_crs(None, allow_override=True)
    bare.to_file(tmp_path / "bare.shp")
    expected = read(tmp_path / "plain.gpkg")
    for name, keys in (("fire.geojson", {}), ("bare.shp", {"crs": "EPSG:4326"})):
        got = read(tmp_path / name, **keys)
        assert min(overlaps(got, expected)) > 0.97


def test_projected_geojson_without_a_projection(tmp_path):
    plain = frame_of(FIRES["two that merge"], HOURS)
    plain.to_file(tmp_path / "plain.gpkg")
    plain.set_crs(None, allow_override=True).to_file(tmp_path / "fire.geojson")
    assert torch.allclose(read(tmp_path / "fire.geojson"), read(tmp_path / "plain.gpkg"), atol=0.01)


def test_a_layer_is_chosen(tmp_path):
    path = tmp_path / "fires.gpkg"
    for layer, name in (("one", "slow and round"), ("two", "two that merge")):
        frame_of(FIRES[name], HOURS).to_file(path, layer=layer)
    frame_of(FIRES["two that merge"], HOURS).to_file(tmp_path / "two.gpkg")
    assert torch.equal(read(path, layer="two"), read(tmp_path / "two.gpkg"))


def test_the_order_of_features_does_not_matter(tmp_path):
    frame = frame_of(FIRES["slow and round"], HOURS)
    frame.to_file(tmp_path / "fire.shp")
    frame.iloc[[3, 0, 4, 2, 1]].to_file(tmp_path / "other.shp")
    assert torch.equal(read(tmp_path / "other.shp"), read(tmp_path / "fire.shp"))


def test_a_fire_that_begins_smaller_than_a_sample(tmp_path):
    frame_of(Ellipses(azimuth=346, breadth=3.0), [1, 2, 3, 4, 60, 120, 300]).to_file(
        tmp_path / "fire.gpkg"
    )
    assert torch.isfinite(read(tmp_path / "fire.gpkg")).any()


def test_a_line_beside_a_polygon_is_ignored(tmp_path):
    frame = frame_of(FIRES["slow and round"], HOURS)
    frame.to_file(tmp_path / "plain.gpkg")
    left = shapely.LineString([CORNER, (CORNER[0] + 900, CORNER[1] + 900)])
    frame.geometry = [shapely.GeometryCollection([shape, left]) for shape in frame.geometry]
    frame.to_file(tmp_path / "fire.gpkg")
    assert torch.equal(read(tmp_path / "fire.gpkg"), read(tmp_path / "plain.gpkg"))


def test_an_open_line_is_named(tmp_path):
    frame = frame_of(FIRES["slow and round"], [60, 60, 120], "line")
    frame.loc[1, "geometry"] = shapely.LineString([CORNER, (CORNER[0] + 9, CORNER[1] + 900)])
    frame.to_file(tmp_path / "fire.gpkg")
    with pytest.raises(ValueError, match="feature 1: a line of 2 points is not closed"):
        read(tmp_path / "fire.gpkg")


@pytest.mark.parametrize("keys", [{}, {"units": "days"}, {"time_field": "date"}])
def test_dates_as_numbers(tmp_path, keys):
    for values in ([20200831, 20200901, 20200902], ["20200831", "20200901", "20200902"]):
        squares(200, 300, 400, column="date", values=values).to_file(tmp_path / "fire.gpkg")
        squares(200, 300, 400, column="days", values=[0, 1, 2]).to_file(tmp_path / "e.gpkg")
        assert torch.equal(read(tmp_path / "fire.gpkg", **keys), read(tmp_path / "e.gpkg"))
    squares(200, 300, 400, column="date", values=[20200830, 20200831, 20200832]).to_file(
        tmp_path / "wrong.gpkg"
    )
    with pytest.raises(ValueError, match=r"feature 2 has date='?20200832'?, which is not a date"):
        read(tmp_path / "wrong.gpkg", **keys)


@pytest.mark.heavy
def test_a_front_far_outside_the_map_is_measured_to_its_boundary(tmp_path):
    """Between circles of 50 and 5000 m, a day apart, the radius after an hour is 256 m.

    A cell burns if one of its samples does, so the burnt cells reach half a cell farther.
    """
    circles = [shapely.Point(CORNER).buffer(radius, quad_segs=64) for radius in (50, 5000)]
    frame = geopandas.GeoDataFrame({"date": DATED[:2]}, geometry=circles, crs=UTM)
    frame["date"] = ["2020-08-19T13:00", "2020-08-20T13:00"]
    frame.to_file(tmp_path / "fire.geojson")
    fire = read(tmp_path / "fire.geojson", end=60.0, units="minutes")
    radius, side = 50 + 4950 / 24, 2 * (50 + 4950 / 24) / (30 * 0.8)
    assert fire.isfinite().sum().item() == pytest.approx(
        np.pi * (radius / side + 0.5) ** 2, rel=0.03
    )
    halfway = (fire <= 500).sum().item()
    assert halfway == pytest.approx(np.pi * ((50 + radius) / 2 / side + 0.5) ** 2, rel=0.1)


def test_seconds_since_1970_are_dates(tmp_path):
    seconds = [1597842000, 1597842000 + 43200, 1597842000 + 86400]
    squares(200, 300, 400, column="timestamp", values=seconds).to_file(tmp_path / "s.gpkg")
    squares(200, 300, 400, column="hours", values=[0, 12, 24]).to_file(tmp_path / "e.gpkg")
    assert torch.equal(read(tmp_path / "s.gpkg"), read(tmp_path / "e.gpkg"))


def test_a_first_perimeter_long_after_time_0_gives_a_warning(tmp_path):
    squares(200, 300, 400, column="DOY", values=[230, 231, 232]).to_file(tmp_path / "doy.gpkg")
    given = {"time_field": "DOY", "units": "days"}
    with pytest.warns(UserWarning, match=r"would begin at time 0 \(fire.start=230: at the first\)"):
        read(tmp_path / "doy.gpkg", **given)


@pytest.mark.parametrize("other", [{"Date": 1}, {"Geometry": 1}])
def test_columns_that_differ_in_case_only(tmp_path, other):
    folder = tmp_path / "fire"
    folder.mkdir()
    frame = squares(200, 300, column="date", values=[20200831, 20200901]).assign(**other)
    frame.to_file(folder / "a.geojson")
    name = next(iter(other)).lower()
    with pytest.raises(ValueError, match=rf"a\.geojson: columns that differ in .*: {name}"):
        read(folder)


def test_elapsed_times_of_a_dbf(tmp_path):
    """A .dbf cuts `elapsed_hours` to ten letters."""
    squares(200, 300, 400, column="elapsed_ho", values=[0, 1, 2]).to_file(tmp_path / "e.shp")
    with pytest.raises(ValueError, match=r"elapsed_ho is in hours; expected fire\.units=hours"):
        read(tmp_path / "e.shp", units="minutes")


def test_an_incident_without_a_name_is_none(tmp_path):
    frame = squares(200, 300, 400, column="hours", values=[0, 1, 2])
    frame.assign(IncidentName=["", "Creek", "Creek"]).to_file(tmp_path / "fire.gpkg")
    frame.to_file(tmp_path / "plain.gpkg")
    assert torch.equal(read(tmp_path / "fire.gpkg"), read(tmp_path / "plain.gpkg"))


def test_a_geopackage_that_says_fewer_features_than_it_has(tmp_path):
    path = tmp_path / "fire.gpkg"
    squares(200, 300, 400, column="hours", values=[0, 1, 2]).to_file(path, layer="fire")
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE gpkg_ogr_contents SET feature_count = 2")
        database.commit()
    with pytest.raises(ValueError, match="layer 'fire' has 3 features and says 2"):
        read(path)


def test_a_plane_of_its_own_gets_the_projection_of_the_user(tmp_path):
    frame = squares(200, 300, 400, column="hours", values=[0, 1, 2])
    frame.to_file(tmp_path / "plain.shp")
    frame.to_file(tmp_path / "local.shp")
    (tmp_path / "local.prj").write_text('LOCAL_CS["x",UNIT["m",1]]')
    assert torch.equal(read(tmp_path / "local.shp", crs=UTM), read(tmp_path / "plain.shp"))
    with pytest.raises(ValueError, match=r"fire\.crs=EPSG:4978 is not one of a map"):
        read(tmp_path / "plain.shp", crs="EPSG:4978")


def test_a_time_after_the_year_9999(tmp_path):
    squares(200, 300, column="date", values=[20200831, 20200901]).to_file(tmp_path / "fire.gpkg")
    with pytest.raises(ValueError, match="not a calendar time"):
        read(tmp_path / "fire.gpkg", start="Fri, 13 Feb 99999999999 10:00:00")
