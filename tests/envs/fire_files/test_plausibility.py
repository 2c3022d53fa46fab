"""Tests that rasters of something other than arrival times are noticed."""

import re
import warnings

import numpy as np
import pytest
import rasterio
from fire_files import Ellipses, raster_of, write_asc, write_tif

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.trainers.cli.main import main

FIRE = Ellipses()
ROWS, COLUMNS = np.mgrid[0:100, 0:100] / 99
BURNT = raster_of(FIRE, 300) >= 0
ANGLE = np.arctan2(0.5 - ROWS, COLUMNS - 0.5)
SPREAD = 2.1 + 1.9 * np.cos(ANGLE - 0.7)  # metres a minute, fastest at the head
SMOOTH = np.sin(3 * ROWS) + np.cos(2 * COLUMNS)  # a hill without further hills
MODELS = np.array([101, 102, 122, 145, 165, 183])
RASTERS = {
    "Elevation": 1100 + 300 * SMOOTH,
    "Fuel": MODELS[np.digitize(SMOOTH, [0.2, 0.6, 0.9, 1.2, 1.5])],
    "Flame length": np.where(BURNT, 0.3 + 0.4 * SPREAD, -9999.0),
    "Rate of spread": np.where(BURNT, SPREAD, -9999.0),
    "Burn probability": np.exp(-8 * ((ROWS - 0.5) ** 2 + (COLUMNS - 0.4) ** 2)),
}
"""What FlamMap and FARSITE write beside arrival times: smooth, in cells of 30 m."""
SAYS = {
    "Elevation": "minutes and last for|every cell would burn",
    "Fuel": "as of fuel models",
    "Flame length": "km/h on all sides",
    "Rate of spread": "km/h on all sides",
    "Burn probability": "between 0 and 1; .*end in its middle",
}


def read(path, units="minutes"):
    """Returns the summary of a file and the warnings."""
    config = FileFireConfig(path=str(path), units=units, margin=None)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _, summary = read_with_summary(config, (30, 30), 1000)
    return summary, [str(warning.message) for warning in caught]


@pytest.mark.parametrize("name", RASTERS)
def test_a_smooth_raster_without_metadata_gives_a_warning(tmp_path, name):
    summary, (warning,) = read(write_asc(tmp_path / "fire.asc", RASTERS[name]))
    assert warning.startswith(f"{tmp_path}/fire.asc: {summary}; ")
    assert warning.endswith(": are these arrival times?")
    assert re.search(SAYS[name], warning)


@pytest.mark.parametrize("units", ["steps", "seconds", "minutes", "hours", "days"])
@pytest.mark.parametrize("name", RASTERS)
def test_a_described_raster_gives_a_warning(tmp_path, name, units):
    path = write_tif(tmp_path / "fire.tif", RASTERS[name].astype("float32"))
    with rasterio.open(path, "r+") as dataset:
        dataset.set_band_description(1, name)
    summary, (warning,) = read(path, units)
    assert summary.startswith(f"'{name}': ")
    assert f"its name is '{name}'" in warning


@pytest.mark.parametrize(
    ("about", "sign"),
    [
        ({"unit": "m"}, "its values are in m:"),
        ({"unit": "ft/min"}, "its values are in ft/min:"),
        ({"tag": "Fireline intensity"}, "its name is 'Fireline intensity'"),
        ({"name": "FLAMELENGTH.tif"}, "its name is 'FLAMELENGTH'"),
        ({"name": "ros_0000001.tif"}, "its name is 'ros_0000001'"),
        ({"name": "us_dem2020.tif"}, "its name is 'us_dem2020'"),
        ({"name": "time_of_arrival.tif", "unit": "minutes"}, None),
        ({"name": "demo_rosa_prospects.tif", "tag": "fuel model and arrival time"}, None),
    ],
)
def test_texts_of_a_geotiff_are_signs(tmp_path, about, sign):
    """Otherwise the same arrival times."""
    path = tmp_path / about.get("name", "fire.tif")
    write_tif(path, raster_of(FIRE, 300))
    with rasterio.open(path, "r+") as dataset:
        dataset.set_band_unit(1, about.get("unit", ""))
        dataset.update_tags(TIFFTAG_IMAGEDESCRIPTION=about.get("tag", ""))
    _, caught = read(path)
    assert len(caught) == (sign is not None)
    if sign:
        assert f"; {sign}" in caught[0]


def arrivals():
    """Returns arrival times in several forms, and their unit."""
    times = raster_of(FIRE, 300)
    burns = times >= 0
    yield "minutes", times
    for unit, values in (
        ("hours", times / 60),
        ("days", times / 1440),
        ("steps", np.floor(2 * times)),
        ("hours", np.floor(times / 60)),
        ("minutes", np.floor(times / 60) * 60),
        ("minutes", np.floor(times)),
        ("minutes", times + 100),
        ("days", np.floor(times / 60) + 230),  # of the year
        ("minutes", raster_of(Ellipses(origins=((900, 900), (1900, 1500))), 200)),
    ):
        yield unit, np.where(burns, values, -9999.0)
    yield "minutes", times[30:60, 40:70]  # all cells burn


@pytest.mark.parametrize("number", range(len(list(arrivals()))))
def test_arrival_times_give_no_warning(tmp_path, number):
    unit, times = list(arrivals())[number]
    assert read(write_asc(tmp_path / "fire.asc", times), unit)[1] == []


def test_preview_says_what_was_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = write_tif(tmp_path / "a.tif", RASTERS["Elevation"].astype("float32"))
    with rasterio.open(path, "r+") as dataset:
        dataset.set_band_description(1, "Elevation")
        dataset.set_band_unit(1, "m")
    with pytest.warns(UserWarning, match="are these arrival times"):
        assert main(["fire", "preview", "a.tif", "fire.units=minutes"]) == 0
    first, last = (
        f"{value:g}" for value in (RASTERS["Elevation"].min(), RASTERS["Elevation"].max())
    )
    assert (
        f"read: 'Elevation' (m): 10000 cells burn from {first} minutes to {last} minutes, "
        "beginning at 2 places"
    ) in capsys.readouterr().out
