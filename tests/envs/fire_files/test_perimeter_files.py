"""Tests perimeters as published by agencies: KML, KMZ, a file per date, several incidents."""

import json
import shlex
import socket
import zipfile

import geopandas
import numpy as np
import pytest
import scipy.io
import shapely
import torch
from fire_files import UTM, Ellipses, frame_of

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_fires, with_checksum
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.values import parse

HOURS = (60.0, 120.0, 180.0)
DATES = [f"2020-08-19T{hour}:00:00Z" for hour in (22, 23)] + ["2020-08-19T17:00:00-07:00"]


def read(path, **keys):
    """Returns the only fire of a file, [X, Y]."""
    (fire,) = read_fires(FileFireConfig(path=str(path), **keys), (30, 30), 1000)
    return fire


def refused(path, **keys):
    """Returns the error message for a file."""
    with pytest.raises(UserError) as error:
        read(path, **keys)
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert len(message) < 600
    return message


@pytest.fixture
def frame():
    """Returns perimeters with dates, in degrees."""
    frame = frame_of(Ellipses(), HOURS).to_crs("EPSG:4326")
    return frame.drop(columns="Elapsed_Mi").assign(date=DATES)


def kml_of(frame, time="<TimeStamp><when>{}</when></TimeStamp>"):
    """Returns KML with a folder per perimeter, each with a hot spot beside the polygon."""
    folders = []
    for date, shape in zip(frame["date"], frame.geometry, strict=True):
        ring = " ".join(f"{x!r},{y!r},0" for x, y in np.asarray(shape.exterior.coords).tolist())
        x, y = shape.centroid.coords[0]
        folders.append(
            f"<Folder><name>Heat {date}</name><Placemark><name>{date}</name>{time.format(date)}"
            "<Polygon><outerBoundaryIs><LinearRing><coordinates>"
            f"{ring}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>"
            f"<Placemark><name>hot</name><Point><coordinates>{x},{y}</coordinates></Point>"
            "</Placemark></Folder>"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2">'
        f"<Document>{''.join(folders)}</Document></kml>"
    )


def write_kmz(path, text, name="doc.kml"):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, text)


TIMES = {
    "TimeStamp": ("<TimeStamp><when>{}</when></TimeStamp>", {}),
    "TimeSpan": ("<TimeSpan><begin>{}</begin></TimeSpan>", {}),
    "Name": ("", {"time_field": "Name"}),
}


@pytest.mark.parametrize("name", TIMES)
def test_kml_and_kmz_equal_geojson(tmp_path, frame, name):
    time, keys = TIMES[name]
    frame.to_file(tmp_path / "fire.geojson", COORDINATE_PRECISION=15)
    expected = read(tmp_path / "fire.geojson")
    (tmp_path / "fire.kml").write_text(kml_of(frame, time))
    write_kmz(tmp_path / "fire.kmz", kml_of(frame, time))
    for suffix in ("kml", "kmz"):
        got = read(tmp_path / f"fire.{suffix}", **keys)
        assert torch.equal(got.isfinite(), expected.isfinite())
        assert torch.allclose(got, expected, atol=1e-2)


def test_points_of_a_multigeometry_are_ignored(tmp_path, frame):
    (tmp_path / "fire.kml").write_text(kml_of(frame))
    point = "<Point><coordinates>-117,36</coordinates></Point>"
    hot = f"<Placemark><name>hot</name><MultiGeometry>{point}{point}</MultiGeometry></Placemark>"
    text = kml_of(frame).replace("</Document>", f"{hot}</Document>")
    (tmp_path / "points.kml").write_text(text)
    assert torch.equal(read(tmp_path / "points.kml"), read(tmp_path / "fire.kml"))


STAMP = "<TimeStamp><when>{}</when></TimeStamp>"
SPAN = "<TimeSpan><begin>{}</begin><end>2021-01-01T00:00:00Z</end></TimeSpan>"
DATA = "<ExtendedData><Data name='date'><value>{}</value></Data></ExtendedData>"
LATE = "2021-01-01T00:00:00Z"


def kml_with(frame, times):
    """Returns KML whose placemarks have different elements of time; `{}` is the right one."""
    texts = [kml_of(frame.iloc[[k]], time) for k, time in enumerate(times)]
    parts = [text.split("<Document>")[1].split("</Document>")[0] for text in texts]
    return f"{texts[0].split('<Document>')[0]}<Document>{''.join(parts)}</Document></kml>"


@pytest.mark.parametrize(
    "times",
    [
        (STAMP, DATA, SPAN),
        (STAMP + DATA.format(LATE), STAMP, STAMP + DATA.format(LATE)),
        (SPAN + DATA.format(LATE), SPAN + DATA.format(LATE), DATA),
        (SPAN, STAMP, SPAN),
    ],
)
def test_the_time_of_a_placemark_is_the_first_of_stamp_span_and_data(tmp_path, frame, times):
    (tmp_path / "stamps.kml").write_text(kml_of(frame))
    (tmp_path / "mixed.kml").write_text(kml_with(frame, times))
    assert torch.equal(read(tmp_path / "mixed.kml"), read(tmp_path / "stamps.kml"))


def test_the_data_of_a_placemark_can_be_chosen(tmp_path, frame):
    (tmp_path / "stamps.kml").write_text(kml_of(frame))
    (tmp_path / "both.kml").write_text(kml_with(frame, (STAMP.format(LATE) + DATA,) * 3))
    got = read(tmp_path / "both.kml", time_field="date")
    assert torch.equal(got, read(tmp_path / "stamps.kml"))


def test_several_dates_in_the_data_of_a_placemark_are_refused(tmp_path, frame):
    one = "<Data name='{}'><value>{{0}}</value></Data>"
    data = f"<ExtendedData>{one.format('date')}{one.format('datetime')}</ExtendedData>"
    (tmp_path / "fire.kml").write_text(kml_with(frame, (STAMP, data, STAMP)))
    assert "the columns timestamp, date, datetime may hold the times" in refused(
        tmp_path / "fire.kml"
    )


def test_kml_without_times_names_the_columns(tmp_path, frame):
    (tmp_path / "fire.kml").write_text(kml_of(frame, ""))
    assert "expected fire.time_field, one of Name" in refused(tmp_path / "fire.kml")


def test_a_layer_of_kml_is_chosen(tmp_path, frame):
    path = tmp_path / "fire.kml"
    path.write_text(kml_of(frame))
    assert "one perimeter" in refused(path, layer=f"Heat {DATES[0]}")
    assert "no layer 'Cold'" in refused(path, layer="Cold")


def test_damaged_kml_and_kmz_are_refused(tmp_path, frame):
    text = kml_of(frame)
    path = tmp_path / "fire.kml"
    for content, words in (
        (text[: len(text) // 2], "expected KML"),
        (text.replace("<Folder>", "<Older>", 1), "expected KML"),
        ("<?xml version='1.0'?><gpx></gpx>", "expected KML"),
        (f"<!DOCTYPE a [<!ENTITY b 'c'>]>{text[38:]}", "expected KML"),
        (kml_of(frame.iloc[:0]), "expected perimeters"),
    ):
        path.write_text(content)
        assert words in refused(path)
    kmz = tmp_path / "fire.kmz"
    write_kmz(kmz, text)
    whole = kmz.read_bytes()
    for length in (len(whole) // 2, len(whole) - 9):
        kmz.write_bytes(whole[:length])
        assert "expected KMZ" in refused(kmz)
    kmz.write_bytes(whole[:200] + bytes(8) + whole[208:])
    assert "expected KMZ" in refused(kmz)
    write_kmz(kmz, text, "fire.txt")
    assert "no .kml" in refused(kmz)
    write_kmz(kmz, text[: len(text) // 2])
    assert "expected KML" in refused(kmz)
    write_kmz(kmz, " " * 400_000_000)
    assert "400000000 bytes" in refused(kmz)


@pytest.mark.parametrize("suffix", ["shp", "geojson", "gpkg"])
def test_a_file_per_date_is_one_fire(tmp_path, frame, suffix):
    """GeoMAC has a shapefile per flight, with columns in upper or lower case."""
    frame.to_file(tmp_path / f"all.{suffix}")
    folder = tmp_path / "fire"
    folder.mkdir()
    (folder / "readme.txt").write_text("Perimeters of a fire")
    for number in (2, 0, 1):
        name = "DATE_" if number else "date_"
        part = frame.iloc[[number]].rename(columns={"date": name})
        part.to_file(folder / f"flight_{number}.{suffix}")
    expected = read(tmp_path / f"all.{suffix}")
    assert torch.equal(read(folder), expected)


def test_the_files_of_a_folder_may_have_different_projections(tmp_path, frame):
    frame.to_file(tmp_path / "all.gpkg")
    folder = tmp_path / "fire"
    folder.mkdir()
    frame.iloc[:1].to_file(folder / "a.gpkg")
    frame.iloc[1:].to_crs(UTM).to_file(folder / "b.geojson")
    assert torch.allclose(read(folder), read(tmp_path / "all.gpkg"), atol=1)
    frame.iloc[1:].to_crs(UTM).set_crs(None, allow_override=True).to_file(folder / "b.geojson")
    assert "b.geojson: no projection, which a.gpkg has" in refused(folder)


@pytest.mark.parametrize("place", ["collection", "geometry"])
@pytest.mark.parametrize("key", ["crs", "CRS"])
@pytest.mark.parametrize("kind", [("type", "link"), ("type", "Url"), ("Type", "link")])
def test_a_linked_projection_is_not_fetched(tmp_path, frame, place, kind, key, monkeypatch):
    """The owner of a file would learn who reads it."""
    monkeypatch.setenv("GDAL_HTTP_TIMEOUT", "1")  # so that a fetch would not block
    content = json.loads(frame.to_json())
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"http://127.0.0.1:{server.getsockname()[1]}/crs"
        place = content if place == "collection" else content["features"][0]["geometry"]
        place.pop("crs", None)
        place[key] = {kind[0]: kind[1], "properties": {"href": address, "url": address}}
        name = '"crs": {"type": "name", "properties": {"name": "EPSG:4326"}}'
        text = json.dumps(content)
        for repeated in ("", f"{name}, ", f", {name}"):
            start, end = text.index(f'"{key}"'), text.index("}}", text.index(f'"{key}"')) + 2
            linked = text[start:end]
            both = linked + repeated if repeated.startswith(",") else repeated + linked
            (tmp_path / "fire.geojson").write_text(text[:start] + both + text[end:])
            assert "its crs is a link: {'" in refused(tmp_path / "fire.geojson")
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


VRT = "<OGRVRTDataSource><OGRVRTLayer name='OGRGeoJSON'>{}"
PDS4 = "<Product_Observational xmlns='http://pds.nasa.gov/pds4/pds/v1'>{}"


@pytest.mark.parametrize("text", [VRT, PDS4])
def test_a_text_does_not_make_geojson_another_format(text, tmp_path, frame, monkeypatch):
    """A format of GDAL, VRT, names other files and addresses from which features are read."""
    monkeypatch.setenv("GDAL_HTTP_TIMEOUT", "1")
    frame.to_file(tmp_path / "plain.geojson")
    content = json.loads((tmp_path / "plain.geojson").read_text())
    frame.assign(geometry=frame.buffer(0.1)).to_file(tmp_path / "secret.gpkg", layer="secret")
    with socket.create_server(("127.0.0.1", 0)) as server:
        network = f"/vsicurl/http://127.0.0.1:{server.getsockname()[1]}/x.geojson"
        for source in (str(tmp_path / "secret.gpkg"), network):
            link = f"<SrcDataSource>{source}</SrcDataSource><SrcLayer>secret</SrcLayer>"
            layer = text.format(f"{link}</OGRVRTLayer></OGRVRTDataSource>")
            hostile = {"type": content.pop("type"), "description": layer, **content}
            content["type"] = hostile["type"]
            (tmp_path / "fire.geojson").write_text(json.dumps(hostile))
            fire = read(tmp_path / "fire.geojson")
            assert fire.equal(read(tmp_path / "plain.geojson"))
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


def test_an_error_in_a_folder_names_the_file(tmp_path, frame):
    folder = tmp_path / "fire"
    folder.mkdir()
    assert "a folder without perimeters" in refused(folder)
    frame.iloc[:2].to_file(folder / "a.gpkg")
    frame.iloc[2:].assign(date="soon").to_file(folder / "b.gpkg")
    assert "b.gpkg: feature 0 has date='soon'" in refused(folder)
    line = shapely.LineString([(-117, 36), (-116.9, 36.1)])
    geopandas.GeoDataFrame({"date": DATES[2:]}, geometry=[line], crs=4326).to_file(
        folder / "b.gpkg"
    )
    assert "b.gpkg: feature 0: a line of 2 points is not closed" in refused(folder)
    (folder / "c.gpkg").write_bytes(b"nothing")
    assert "c.gpkg: begins with 'nothing'" in refused(folder)


def test_the_checksum_of_a_folder_is_that_of_its_perimeters(tmp_path, frame):
    folder = tmp_path / "fire"
    folder.mkdir()
    frame.iloc[:2].to_file(folder / "a.shp")
    frame.iloc[2:].to_file(folder / "b.geojson")
    config = with_checksum(FileFireConfig(path=str(folder)))
    (folder / "readme.txt").write_text("Perimeters of a fire")
    assert with_checksum(config) == config
    (folder / "a.dbf").write_bytes((folder / "a.dbf").read_bytes().replace(b"2020", b"2021"))
    with pytest.raises(UserError, match="has changed"):
        with_checksum(config)


@pytest.mark.parametrize(
    ("suffix", "column"), [("gpkg", "attr_IncidentName"), ("shp", "FIRE_NAME")]
)
def test_an_incident_is_chosen_among_several(tmp_path, frame, suffix, column):
    frame.to_file(tmp_path / f"one.{suffix}")
    other = frame.translate(0.02, 0.01)
    both = geopandas.GeoDataFrame(
        {"date": DATES * 2, column: ["August", "AUGUST ", "August", "Creek", "Creek", None]},
        geometry=[*frame.geometry, *other],
        crs=4326,
    )
    path = tmp_path / f"both.{suffix}"
    both.to_file(path)
    message = refused(path)
    assert "2 incidents: August, Creek; expected fire.incident=August, or fire.inc" in message
    assert torch.equal(read(path, incident="august"), read(tmp_path / f"one.{suffix}"))
    assert read(path, incident="Creek").isfinite().any()
    both.drop(columns=column).to_file(tmp_path / f"all.{suffix}")
    assert torch.equal(read(path, incident="*"), read(tmp_path / f"all.{suffix}"))
    assert "fire.incident='Crek' is not known; did you mean Creek?" in refused(
        path, incident="Crek"
    )
    assert "no column of incidents" in refused(tmp_path / f"one.{suffix}", incident="Creek")


def test_other_formats_are_named_with_a_command_that_converts_them(tmp_path):
    wrf = tmp_path / "wrfout_d01.nc"
    with scipy.io.netcdf_file(wrf, "w") as file:
        file.createDimension("x", 3)
        file.createVariable("TIGN_G", "f4", ("x",))[:] = 0
    message = refused(wrf)
    assert "NetCDF" in message
    assert "gdal_translate" in message
    assert "TIGN_G" in message
    wrf.rename(tmp_path / "wrfout_d01_2020-08-19_22:00:00")
    assert "gdal_translate" in refused(tmp_path / "wrfout_d01_2020-08-19_22:00:00")
    firms = tmp_path / "fire_nrt_J1V-C2_1.csv"
    firms.write_text("latitude,longitude,bright_ti4,scan,track,acq_date,acq_time\n36,-117,330,1,1,")
    message = refused(firms)
    assert "FIRMS" in message
    assert "ogr2ogr" in message
    for start in ("\ufefflatitude,longitude,", "country_id,latitude,longitude,"):
        firms.write_text(start + "bright_ti4,acq_date\n", encoding="utf-8")
        assert "FIRMS" in refused(firms)
    grid = tmp_path / "ForestGrid07.csv"
    grid.write_text("0,0,0,0\n0,1,0,0\n")
    message = refused(grid)
    assert "Cell2Fire" in message
    assert "ForestGrid*.csv" in message


@pytest.mark.parametrize("content", [b"CDF\x01", b"latitude,longitude,acq_date"])
@pytest.mark.parametrize("name", ["a;reboot;.nc", "$(reboot).nc", "-o a.nc", "`a`.nc"])
def test_a_name_is_no_part_of_a_command_unless_it_is_plain(tmp_path, content, name):
    path = tmp_path / name
    path.write_bytes(content)
    command = refused(path).partition("expected")[2]
    assert name.removesuffix(".nc") not in command
    assert "FILE" in command


@pytest.mark.parametrize(
    "name", ["Elk Creek", "O'Brien", 'A "B" \\ C', "A,B", "12", "null", "$HOME"]
)
def test_the_suggested_incident_can_be_copied(tmp_path, frame, name):
    frame.assign(incident=[name, *["~"] * (len(frame) - 1)]).to_file(tmp_path / "fire.gpkg")
    message = refused(tmp_path / "fire.gpkg")
    suggested = message.partition("expected ")[2].partition(", or ")[0]
    (argument,) = shlex.split(suggested)
    assert parse(argument) == ("fire.incident", name)


def test_the_command_for_cell2fire_writes_a_bank(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    times = np.full((9, 8), np.inf)
    times[1, 2:6] = [0, 1, 3, 4]  # rows from north to south
    for hour in range(6):
        np.savetxt(f"ForestGrid{hour:02}.csv", times <= hour, fmt="%d", delimiter=",")
    message = refused(tmp_path / "ForestGrid00.csv")
    exec(message.split('python -c "')[1].split('"')[0], {})
    (fire,) = read_fires(FileFireConfig(path="fire.npy"), (8, 9), 6)
    assert torch.equal(fire, torch.from_numpy(times[::-1].T.astype(np.float32)))
