"""Tests the reading of ambiguous files: a second case for each kind of misreading."""

import re

import geopandas
import numpy as np
import pandas
import pytest
import rasterio
import torch
from fire_files import CORNER, UTM, Ellipses, answered, raster_of, squares, write_tif
from scipy.io import netcdf_file

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.envs.fire_files.times import parse_dates

FIRE = Ellipses()
IDS = "fireid FIRE_YEAR id NFIREID IncidentNa INC_NUM LocalIncidentID FIRE_UNIQUE_ID Nombre"
DAY, DAYS = ["2020-09-05"] * 3, ["2020-09-05", "2020-09-06"]


def read(path, **keys):
    """Returns the fire of a file on 20 x 20 cells, and the findings."""
    (fire,), about = read_with_summary(
        FileFireConfig(path=str(path), ring_width=None, **keys), (20, 20), 100
    )
    return fire, about


def asks(path, match, **keys):
    """Checks that a file is not understood, and that the keys of the message answer it."""
    assert re.search(match, answered(path, keys, questions=2)[2][0])


def dates(count, year=2020):
    return [f"{year}-09-05T{9 + k:02}:00Z" for k in range(count)]


@pytest.fixture
def elapsed(tmp_path):
    """Returns the fire of three squares an hour apart."""
    squares(200, 300, 400, Elapsed_Mi=[0, 60, 120]).to_file(tmp_path / "elapsed.gpkg")
    return read(tmp_path / "elapsed.gpkg")[0]


def same(path, elapsed, says="", **keys):
    fire, about = read(path, **keys)
    assert torch.equal(torch.isfinite(fire), torch.isfinite(elapsed))
    both = torch.isfinite(elapsed)
    assert torch.allclose(fire[both], elapsed[both], atol=0.05), about
    assert says in about, about


@pytest.mark.parametrize(
    ("columns", "joined"),
    [
        ({"DATE_": ["9/25/2020"] * 3, "TIME_": [2055, 2155, 2255]}, ""),
        ({"date": DAY, "hour": [9, 10, 11], "minute": [5] * 3}, "date,hour,minute"),
        ({"date": DAY, "time": ["930", "1030", "1130"], "half": ["AM"] * 3}, "date,time,half"),
        ({"date": DAY, "flight_hr": ["09", "10", "11"]}, "date,flight_hr"),
        ({"date": DAY, "overpass": ["09:00", "10:00", "11:00"]}, "date,overpass"),
        ({"fecha": DAY, "hora_det": ["9h00", "10h00", "11h00"]}, "fecha,hora_det"),
        ({"date": DAY, "time": ["0900Z", "1000Z", "1100Z"]}, ""),
    ],
)
def test_a_date_beside_a_time_of_day_is_joined_or_asked_for(tmp_path, elapsed, columns, joined):
    path, keys = tmp_path / "fire.geojson", {}
    squares(200, 300, 400, **columns).to_file(path)
    if joined:
        asks(path, rf"'fire.time_field=\[{joined}\]'")
        keys = {"time_field": tuple(joined.split(","))}
    same(path, elapsed, " and ".join(columns), **keys)


@pytest.mark.parametrize("column", IDS.split())
def test_several_fires_are_listed_and_one_is_chosen(tmp_path, elapsed, column):
    frames = [squares(200, 300, 400, date=dates(3)), squares(9, 90, at=(9e4, 0), date=dates(2))]
    frame = pandas.concat([f.assign(**{column: k + 2019}) for k, f in enumerate(frames)])
    path = tmp_path / "fire.gpkg"
    frame.to_file(path)
    asks(path, rf"{column}: 2019 \(3\), 2020 \(2\); .*incident_field={column}")
    same(path, elapsed, "3 of 5 features", incident="2019")
    asks(path, "2 groups of parts never join", incident="*")
    asks(path, "'2018' is not known; .*known: 2019, 2020", incident=2018)


def test_fires_that_merge_and_numbers_of_features(tmp_path, elapsed):
    frame = squares(200, 300, 400, t=dates(3), fireid=[7, 7, 9], mergeid=[7, 7, 7])
    frame.to_file(tmp_path / "feds.gpkg")
    asks(tmp_path / "feds.gpkg", r"fireid: 7 \(2\), 9 \(1\); expected fire.incident_field=fireid")
    same(tmp_path / "feds.gpkg", elapsed, "3 of 3", incident_field="mergeid", incident="7")
    frame = squares(200, 300, 400, date=dates(3), id=[1, 2, 3], name=["IR 1", "IR 2", "IR 3"])
    frame.to_file(tmp_path / "fire.gpkg")
    same(tmp_path / "fire.gpkg", elapsed)


def test_features_are_filtered(tmp_path, elapsed):
    path, kinds = tmp_path / "fire.gpkg", ["WF", "WF", "WF", "RX", "WF"]
    frame = squares(200, 300, 400, 4000, 9000, date=dates(5), IncidentTypeCategory=kinds)
    frame.assign(layer=[*"aaaab"]).to_file(path)
    asks(path, r"IncidentTypeCategory: WF \(4\), RX \(1\); expected 'fire.where=")
    asks(path, r"layer: a .*'fire.where=\[\".*=WF\",\"layer=a", where="IncidentTypeCategory=WF")
    same(path, elapsed, "2 left out", where=("incidenttypecategory=wf", "layer=a"))
    asks(path, "keeps no feature", where="IncidentTypeCategory=x*")
    squares(200, 300, 400, 900, date=[*dates(3), None]).to_file(path)
    asks(path, r"feature 3 has no time in date \(1 of 4\); .*fire.where=date")
    same(path, elapsed, "1 left out by fire.where=date", where="date")


def test_a_raster_in_a_projection_that_bends(tmp_path):
    plain = write_tif(tmp_path / "plain.tif", raster_of(FIRE, 300.0, 80, 40.0), 40.0)
    bent, crs = tmp_path / "bent.tif", "+proj=sinu +R=6371007.181"
    nearest = rasterio.enums.Resampling.nearest
    with (
        rasterio.open(plain) as source,
        rasterio.vrt.WarpedVRT(source, crs=crs, resampling=nearest) as view,
        rasterio.open(bent, "w", **{**view.profile, "driver": "GTiff"}) as target,
    ):
        target.write(view.read())
    right, about = read(plain, units="minutes")
    assert "axes 1.00 : 1" in about
    fire, about = read(bent, units="minutes")
    assert "UTM zone 11N (axes 1.00 : 1" in about
    for step in (40, 70, 100):
        one, other = right <= step, fire <= step
        assert (one & other).sum() / (one | other).sum() > 0.9
    asks(plain, "has axes 3.* : 1", units="minutes", crs="+proj=sinu +lon_0=0")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2020-08-19T13:00-07:00", "2020-08-19T13:00:00-07:00"),
        ("8/19/2015 1:55:00 PM", "2015-08-19T13:55:00"),
        ("Fri, 13 Feb 2026 14:30:58 GMT", "2026-02-13T14:30:58+00:00"),
        ("Saturday, September 5, 2020 12:30:00 AM", "2020-09-05T00:30:00"),
        ("Sat Sep 05 2020 13:30:00 GMT-0700 (Pacific Daylight Time)", "2020-09-05T13:30:00-07:00"),
        ("202009051800 (NZST)", "2020-09-05T18:00:00+12:00"),
        ("2020-245", "2020-09-01T00:00:00"),
        ("1598274000", "2020-08-24T13:00:00+00:00"),
        ("1599328800000", "2020-09-05T18:00:00+00:00"),
    ],
)
def test_forms_of_dates(text, expected):
    assert parse_dates([text], None, "t")[0].isoformat() == expected


@pytest.mark.parametrize(
    ("texts", "form", "match"),
    [
        (["05-08-2020"], None, "fits day_first .2020-08-05 .* or month_first"),
        (["05.08.20"], None, "day_first .* or month_first .* or year_first"),
        (["1808192000"], None, "fits seconds .2027-04-20 .* or %y%m%d%H%M .2018-08-19"),
        (["2018081920"], None, "fits seconds .2033-12-.* or %Y%m%d%H .2018-08-19"),
        (["2020-09-05 13:30 PM"], None, "is not a date"),
        (["13/08/2020", "08/14/2020"], None, "is not a date"),
    ],
)
def test_dates_that_are_asked_about(texts, form, match):
    with pytest.raises(ValueError, match=match):
        parse_dates(texts, form, "t")


def test_orders_and_the_future(tmp_path, elapsed):
    assert parse_dates(["05/08/2020", "13/08/2020"], None, "t")[0].day == 5
    assert parse_dates(["05/08/2020"], "month_first", "t")[0].month == 5
    squares(200, 300, 400, date=dates(3, 2090)).to_file(tmp_path / "fire.geojson")
    with pytest.warns(UserWarning, match="2090-09-05 is in the future"):
        same(tmp_path / "fire.geojson", elapsed)
    squares(200, 300, 400, date=[*DAY[:2], "2020-09-06T09:30"]).to_file(tmp_path / "mixed.gpkg")
    with pytest.warns(UserWarning, match="2 features have 1 dates .* order is lost"):
        read(tmp_path / "mixed.gpkg")


def test_a_unit_in_the_file_is_used_and_contradicts(tmp_path):
    path = write_tif(tmp_path / "fire.tif", raster_of(FIRE, 300.0))
    plain = read(path, units="minutes")[0]
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("minutes",)
    assert torch.equal(read(path)[0], plain)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("weeks",)
    with pytest.warns(UserWarning, match="is in 'weeks', read as hours"):
        read(path, units="hours")
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ("kW/m",)
    asks(path, "is in kW/m, no unit of time", units="minutes")
    squares(200, 300, 400, Elapsed_Mi=[0, 60, 120]).to_file(tmp_path / "fire.shp")
    asks(tmp_path / "fire.shp", "is in minutes; expected", units="hours")


@pytest.mark.parametrize("name", ["fire_archive_SV-C2_1.csv", "SUOMI_VIIRS_C2_2023001.txt"])
def test_detections_of_firms_by_hand(tmp_path, name):
    """Two detections a kilometre apart and a radius of 600 m: 2.2 km wide, 1.2 km high."""
    clocks = ("00:08", "12:30") if name.endswith("txt") else ("8", "1230")
    rows = ["latitude,longitude,bright_ti4,acq_date,acq_time,daynight"]
    rows += [f"{45},{-117 + k * 0.01268},330,2020-09-05,{clocks[k]},N" for k in range(2)]
    (tmp_path / name).write_text("\n".join([*rows, ""]))
    asks(tmp_path / name, "2 points, .*expected fire.radius")
    fire, about = read(tmp_path / name, radius=600.0, margin=0.0)
    assert "from 2020-09-05T00:08+00:00 to 2020-09-05T12:30+00:00" in about
    assert "times from acq_date and acq_time, no zone" in about
    wide, high = (torch.isfinite(fire).any(axis).sum() for axis in (1, 0))
    assert (wide, high) == (20, pytest.approx(11, abs=1))
    places = geopandas.points_from_xy([-117, -116.98732], [45, 45], crs="EPSG:4326")
    frame = geopandas.GeoDataFrame({"date": DAYS}, geometry=places).to_crs("EPSG:3857")
    frame.to_file(tmp_path / "mercator.gpkg")
    fire, _ = read(tmp_path / "mercator.gpkg", radius=600.0, margin=0.0)
    assert torch.isfinite(fire).any(0).sum() == 12, "as many rows as in metres"


def test_wrf_sfire_is_read_without_a_conversion(tmp_path):
    """Two times of a fire that starts in the south-west."""
    y, x = np.mgrid[:20, :24]
    times = np.hypot(x - 5, y - 4) * 60.0
    path = tmp_path / "wrfout_d01_2012-09-09_12:00:00"
    dimensions = {"Time": 2, "south_north_subgrid": 20, "west_east_subgrid": 24}
    with netcdf_file(path, "w") as file:
        for name, size in dimensions.items():
            file.createDimension(name, size)
        for name in ("FGRNHFX", "TIGN_G"):
            variable = file.createVariable(name, "f4", tuple(dimensions))
            variable[0], variable[1] = np.minimum(times, 305), np.where(times < 600, times, 605)
        variable.units = "seconds since 2012-09-09"
    asks(path, "2 variables: FGRNHFX, TIGN_G; .*fire.layer=TIGN_G")
    asks(path, "fire.units=.*seconds .*WRF-SFIRE", layer="FGRNHFX")
    fire, about = read(path, layer="TIGN_G", unburned=605.0, margin=None)
    assert "from 2012-09-09T00:00+00:00 to 2012-09-09T00:09+00:00" in about
    assert max(np.unravel_index(int(fire.argmin()), fire.shape)) < 6, "the south is below"
    late = read(path, layer="TIGN_G", unburned=605.0, start="2012-09-09T00:05")[0]
    assert (late <= 0).sum() > (fire <= 0).sum()


def test_a_folder_of_cell2fire(tmp_path):
    for step in range(11):
        grid = np.zeros((10, 12), int)
        grid[5, 5 - min(step, 5) : 6 + step // 2] = 1
        np.savetxt(tmp_path / f"ForestGrid{step}.csv", grid, "%d", ",")
    asks(tmp_path, "11 maps of the states 0 .*fire.kind=masks")
    fire, about = read(tmp_path, kind="masks", margin=None)
    assert "from 0 maps to 10 maps; 11 maps of 12 x 10 cells, states 0, 1" in about
    assert (fire == 0).any(0).nonzero().flatten().tolist() == [8, 9]  # the sixth row from above


@pytest.mark.parametrize("place", ["file", "collection", "folder", "placemark", "document"])
def test_times_outside_the_features(tmp_path, place):
    whole = squares(200, 300, 400, date=dates(3)).to_crs("EPSG:4326")
    (tmp_path / "dated.geojson").write_text(whole.to_json())
    stamps = [f"2020-09-05T{9 + k:02}:00:00Z" for k in range(3)]
    path = tmp_path / "fire"
    if place in ("file", "collection"):
        path.mkdir()
        names = ("Creek_2020_09_05_0900", "2020-09-05_10-00 IR", "IR 20200905_1100")
        for k, name in enumerate(names if place == "file" else "abc"):
            text = whole.iloc[k : k + 1].drop(columns="date").to_json()[:-1]
            about = f', "timestamp": {1599296400.25 + 3600 * k}' * (place == "collection")
            (path / f"{name}.geojson").write_text(f"{text}{about}}}")
    else:
        marks = []
        for stamp, shape in zip(stamps, whole.geometry, strict=True):
            ring = " ".join(f"{x},{y},0" for x, y in shape.exterior.coords)
            line = f"<LinearRing><coordinates>{ring}</coordinates></LinearRing>"
            area = f"<Polygon><outerBoundaryIs>{line}</outerBoundaryIs></Polygon>"
            time = f"<TimeSpan><begin>{stamp}</begin></TimeSpan>"
            spot = "<Placemark><Point><coordinates>1,2</coordinates></Point></Placemark>"
            inner = f"<Placemark><name>Heat</name>{area}</Placemark>{spot}"
            kinds = {
                "folder": f"<Folder><name>IR {stamp}</name>{inner}</Folder>",
                "document": f"<Folder>{time}<Folder>{inner}</Folder></Folder>",
                "placemark": f"<Placemark><name>IR {stamp}</name>{line}</Placemark>",
            }
            marks.append(kinds[place])
        path.write_text(f"<kml><Document>{''.join(marks)}</Document></kml>")
    same(path, read(tmp_path / "dated.geojson")[0])


@pytest.mark.parametrize("suffix", ["gpkg", pytest.param("geojson", marks=pytest.mark.heavy)])
@pytest.mark.filterwarnings("ignore")
def test_a_fire_of_8000_detections(tmp_path, suffix):
    random = np.random.default_rng(0)
    passes = np.sort(random.integers(0, 76, 8000))
    angle, far = random.uniform(0, 2 * np.pi, 8000), random.uniform(0.5, 1, 8000) * passes * 200
    x, y = far * np.cos(angle) * 1.4 + CORNER[0], far * np.sin(angle) + CORNER[1]
    stamps = [pandas.Timestamp("2020-09-05T09:42") + pandas.Timedelta(hours=12 * k) for k in passes]
    points = geopandas.GeoSeries(geopandas.points_from_xy(x, y), crs=UTM).to_crs("EPSG:4326")
    days, clocks = ([f"{t:{form}}" for t in stamps] for form in ("%Y-%m-%d", "%H%M"))
    about = {"acq_date": days, "acq_time": clocks}
    frame = geopandas.GeoDataFrame(about, geometry=points.buffer(0.002), crs="EPSG:4326")
    frame.to_file(tmp_path / f"viirs.{suffix}")
    fire, read_as = read(tmp_path / f"viirs.{suffix}")
    assert "76 times" in read_as
    assert torch.isfinite(fire).sum() > 150
