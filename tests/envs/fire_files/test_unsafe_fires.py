"""Tests that damaged and hostile files give one line that names the file, at the one door."""

import json
import os
import shutil
import socket
import sys
import zipfile

import geopandas
import numpy as np
import pytest
import rasterio
import torch
from fire_files import (
    UTM,
    Ellipses,
    fires_in,
    frame_of,
    points_text,
    raster_of,
    write_asc,
    write_tif,
)

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import with_checksum

FIRE, TIMES = Ellipses(), (60.0, 120.0, 180.0, 240.0, 300.0)
NEEDS = {
    **{suffix: {"units": "minutes"} for suffix in (".asc", ".tif")},
    **{suffix: {"time_field": "Elapsed_Mi"} for suffix in (".kml", ".kmz")},
}


def read(path, **keys):
    keys = NEEDS.get(path.suffix, {}) | keys
    return fires_in(FileFireConfig(path=str(path), **keys), (12, 10), 50)


def refused(path, match, **keys):
    with pytest.raises(ValueError, match=match) as caught:
        read(path, **keys)
    text = str(caught.value)
    assert "\n" not in text
    assert path.name[:60] in text
    assert len(text) < 700


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Writes a valid file of each format."""
    folder = tmp_path_factory.mktemp("wholes")
    times, frame = raster_of(FIRE, 300.0, cells=40, cell=75.0), frame_of(FIRE, TIMES)
    write_asc(folder / "fire.asc", times, 75.0)
    write_tif(folder / "fire.tif", times.astype("float32"), 75.0)
    np.save(folder / "bank.npy", np.where(times < 0, np.inf, times / 6).astype("f4")[None])
    for suffix in ("shp", "geojson", "gpkg"):
        frame.to_file(folder / f"front.{suffix}")
    frame.to_crs("EPSG:4326").to_file(folder / "front.kml", driver="LIBKML")
    with zipfile.ZipFile(folder / "front.kmz", "w") as archive:
        archive.write(folder / "front.kml", "DOC.KML")
    (folder / "front.txt").write_text(points_text(FIRE, 6040, points=24))
    return folder


@pytest.fixture
def wholes(written, tmp_path):
    """Returns copies of the valid files, which a test may damage."""
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    beside = (".dbf", ".shx", ".prj", ".cpg")
    return {p.suffix: p for p in sorted(tmp_path.iterdir()) if p.suffix not in beside}


@pytest.mark.filterwarnings("ignore")
def test_cut_and_overwritten_files(wholes, tmp_path):
    """Files that are cut off or have other bytes are refused, or give the same fire."""
    random = np.random.default_rng(7)
    assert len(wholes) == 9
    for suffix, path in wholes.items():
        whole, content = read(path), path.read_bytes()
        assert 4 < torch.isfinite(whole[0]).sum() <= 120
        spoilt = [content[: len(content) * k // 10] for k in (1, 5, 9)]
        spoilt += [random.bytes(1000), b"seen from the tower\n" * 40, b""]
        spoilt += [random.bytes(64) + content[64:]]
        for number, damaged in enumerate(spoilt):
            folder = tmp_path / f"{suffix[1:]}_{number}"
            folder.mkdir()
            for part in tmp_path.glob(f"{path.stem}.*") if suffix == ".shp" else [path]:
                shutil.copy(part, folder)
            (folder / path.name).write_bytes(damaged)
            if suffix == ".txt" and number < 3:
                continue  # a text may end after any line
            message = path.name
            try:
                assert torch.equal(read(folder / path.name), whole), (suffix, number)
            except ValueError as error:
                message = str(error)
            assert path.name in message.splitlines()[0], (suffix, number)


def test_no_regular_files_and_no_addresses(tmp_path, wholes):
    os.mkfifo(tmp_path / "pipe.tif")
    (tmp_path / "empty").mkdir()
    with (tmp_path / "large.geojson").open("wb") as file:
        file.write(b"{")
        file.truncate(150_000_001)  # a hole, which takes no space
    for name, match in {
        "pipe.tif": "not a regular file",
        "none.gpkg": "No such file",
        "empty": "a folder with 0 files of fires",
        "large.geojson": "150000001 bytes; .* at most 150000000",
    }.items():
        refused(tmp_path / name, match)
    for text in ("/vsicurl/http://localhost:9/fire.tif", "http://localhost:9/fire.geojson"):
        with pytest.raises(ValueError, match="No such file"):
            fires_in(FileFireConfig(path=text), (12, 10), 50)


@pytest.mark.parametrize("ending", [".msk", ".MSK", ".ovr"])
def test_nothing_is_fetched_through_a_file_beside_a_raster(tmp_path, ending, wholes, monkeypatch):
    def no_network(*_):
        raise AssertionError("opens a socket")

    monkeypatch.setattr(socket.socket, "connect", no_network)
    beside = tmp_path / f"fire.tif{ending}"
    beside.write_text('<VRTDataset rasterXSize="40" rasterYSize="40"><VRTRasterBand band="1"/>')
    refused(wholes[".tif"], f"fire.tif{ending}, beside it, is no TIFF")
    beside.unlink()
    os.mkfifo(beside)
    refused(wholes[".tif"], "not a regular file")


def test_links_declarations_and_sizes_in_texts_are_refused(tmp_path, wholes):
    whole = json.loads(wholes[".geojson"].read_text())
    link = {"type": "link", "properties": {"href": "http://localhost:9/", "type": "proj4"}}
    bomb = "".join(f'<!ENTITY z{k + 1} "{f"&z{k};" * 10}">' for k in range(9))
    rows = wholes[".asc"].read_text()
    for name, text, match in (
        ("fire.asc", rows.replace("NCOLS 40", "NCOLS 1000000000"), "40 x 1000000000|expected"),
        ("fire.json", json.dumps({**whole, "crs": link}), "crs is a link, which is not followed"),
        ("fire.kml", f'<!DOCTYPE kml [<!ENTITY z0 "zz">{bomb}]><kml>&z9;</kml>', "amplification"),
    ):
        (tmp_path / name).write_text(text)
        refused(tmp_path / name, match)


def test_parts_of_a_shapefile(wholes):
    table = wholes[".shp"].with_suffix(".dbf")
    content = table.read_bytes()
    table.write_bytes(content[: len(content) // 2])
    refused(wholes[".shp"], "fread.*expected perimeters in front.shp")
    table.unlink()
    refused(wholes[".shp"], "which column holds the times: none.*fire.time_field=")


def test_values_that_are_no_times(tmp_path):
    times, path = raster_of(FIRE, 300.0, cells=40, cell=75.0), tmp_path / "fire.tif"
    one = np.full_like(times, -9999.0)
    one[20, 20] = 5.0
    for values, match in (
        (np.full_like(times, np.nan), "cells that burn: 0"),
        (one, "cells that burn: 1"),
        (np.where(times >= 0, 3.0, times), "no fire spreads"),
        (np.where(one == 5, -0.5, times), r"-0.5 \(1 ?% .*fire.unburned=-0.5"),
        (np.where(times < 0, -32768.0, times), "fire.unburned=-32768"),
        (times.astype("complex64"), "real numbers"),
    ):
        refused(write_tif(path, values), match)
    refused(write_tif(path, times, crs="EPSG:4326"), "are not the degrees of WGS 84")
    small = rasterio.Affine(0.001, 0, -117, 0, -0.001, 45)
    refused(write_tif(path, times, crs=None, transform=small), "may be degrees.*fire.crs=EPSG:4326")


def test_geometries_that_enclose_nothing(tmp_path):
    path, shapes = tmp_path / "fire.gpkg", [*frame_of(FIRE, TIMES).geometry]
    half = type(shapes[0].boundary)([*shapes[0].boundary.coords][:40])
    for geometry, match in (
        ([shapes[0].centroid] * 5, "5 points"),
        ([half, *shapes[1:]], "feature 0: a line is not closed"),
        ([None] * 5, "0 points, no areas"),
    ):
        geopandas.GeoDataFrame({"Elapsed_Mi": TIMES}, geometry=geometry, crs=UTM).to_file(path)
        refused(path, match)
    for layer in ("one", "two"):
        frame_of(FIRE, TIMES).to_file(tmp_path / "several.gpkg", layer=layer)
    refused(tmp_path / "several.gpkg", "2 layers .*fire.layer=one, or fire.layer=two")
    assert read(tmp_path / "several.gpkg", layer="two").isfinite().any()


@pytest.mark.parametrize("ending", [".aux.xml", ".msk", ".tfw"])
def test_the_checksum_contains_the_files_beside(wholes, ending):
    config = FileFireConfig(path=str(wholes[".tif"]), units="minutes")
    before = with_checksum(config).sha256
    other = wholes[".tif"].parent / f"fire{ending}"
    other.write_text("x")
    assert with_checksum(config).sha256 != before
    other.unlink()
    assert with_checksum(config).sha256 == before


@pytest.mark.parametrize(("module", "suffix"), [("rasterio", ".tif"), ("geopandas", ".gpkg")])
def test_without_the_extra_the_message_names_it(wholes, module, suffix, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    refused(wholes[suffix], r"is not installed: pip install '.\[geo\]'")
    assert read(wholes[".npy"]).isfinite().any()
