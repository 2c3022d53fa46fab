"""Second cases: one file of each kind of misreading gives its question, and the answer its grid."""

import re

import numpy as np
import pytest
import torch
from fire_files import Ellipses, answered, raster_of, squares, write_asc, write_tif

TIMES = raster_of(Ellipses(), 300.0)
BURNS = TIMES >= 0
DAYS = [f"2020-08-{day:02}" for day in (20, 21, 22)]
KML = "<kml><Document>{}</Document></kml>"


def table(name, **columns):
    def write(folder):
        squares(200, 300, 400, **columns).to_file(folder / name)
        return folder / name

    return write


def raster(values, **about):
    return lambda folder: write_tif(folder / "fire.tif", values, **{"nodata": None, **about})


def in_names(folder):
    areas = squares(200, 300, 400).to_crs("EPSG:4326").geometry
    marks = ""
    for day, area in enumerate(areas, 5):
        ring = " ".join(f"{x},{y}" for x, y in area.exterior.coords)
        marks += f"<Placemark><name>Creek 0{day}/08/2020</name><LinearRing><coordinates>{ring}"
        marks += "</coordinates></LinearRing></Placemark>"
    (folder / "fire.kml").write_text(KML.format(marks))
    return folder / "fire.kml"


def states(folder):
    maps = np.stack([BURNS & (time >= TIMES) for time in range(0, 301, 20)]).astype("uint8")
    return write_tif(folder / "fire.tif", maps, nodata=None)


def arcinfo(folder):
    path = write_asc(folder / "fire.asc", TIMES)
    text = "Projection ALBERS\nDatum NAD83\nSpheroid GRS80\nUnits METERS\nParameters\n"
    text += "29 30 0.0\n45 30 0.0\n-96 0 0.0\n23 0 0.0\n0.0\n0.0\n"
    path.with_suffix(".prj").write_text(text)
    return path


def bank(folder):
    fires = np.full((2, 20, 20), 9999, "f4")
    fires[:, 4:16, 4:16] = np.arange(144).reshape(12, 12)
    np.save(folder / "fire.npy", fires)
    return folder / "fire.npy"


# How the file is written, keys, the question if there is one, and what `read:` says at last.
CASES = {
    "1 flights of a day": (
        table("fire.gpkg", date=[DAYS[0], DAYS[0], DAYS[1]], flight=["AM", "PM", "AM"]),
        ({}, r"fire.time_field=\[date,flight\]", "3 times, from 2020-08-20T00:00"),
    ),
    "3 status": (
        table("fire.geojson", date=DAYS, status=["final", "final", "draft"]),
        ({}, r"status: final \(2\), draft \(1\)", "2 of 3 features used"),
    ),
    "5 end and five seconds": (
        raster(np.where(BURNS, TIMES, 305)[25:75, 25:75]),
        ({"units": "seconds"}, r"305 \(75 ?% ", "seconds to 298.853"),
    ),
    "5 of a bank": (bank, ({}, r"9999 \(64 ?%", "a bank of 2 fires .* 101 of 20 x 20")),
    "6 over New Year": (
        table("fire.gpkg", doy=[364, 365, 1]),
        ({"time_field": "doy", "units": "days"}, "units=day_of_year", "364 days to 366 days"),
    ),
    "9 states in bands": (states, ({}, "15|16 bands; .*fire.kind=masks", "to 15 maps")),
    "11 shrinking": (
        table("fire.gpkg", date=[DAYS[2], DAYS[1], DAYS[0]]),
        ({}, "no fire spreads", ""),
    ),
    "12 names": (in_names, ({}, "fits day_first", "times from Name")),
    "13 ArcInfo": (arcinfo, ({"units": "minutes"}, "", "axes 1.21 : 1.* projected to")),
}


@pytest.mark.parametrize("name", CASES)
def test_second_case(name, tmp_path):
    write, (keys, question, says) = CASES[name]
    path = write(tmp_path)
    fires, about, questions = answered(path, keys)
    assert bool(questions) == bool(question)
    assert re.search(question, (*questions, "")[0])
    assert re.search(says, about), (about, questions)
    assert not says or torch.isfinite(fires).sum() > 100
