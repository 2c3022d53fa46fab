"""Second cases: one file of each kind of misreading gives its question, and the answer its grid."""

import re

import numpy as np
import pytest
import torch
from fire_files import Ellipses, answered, raster_of, squares, write_asc, write_tif
from rasterio.transform import from_origin
from scipy.io import netcdf_file

TIMES = raster_of(Ellipses(), 300.0)
BURNS = TIMES >= 0
FILLS = np.where(np.arange(100)[:, None] < 5, -2, np.where(BURNS, 200 + TIMES // 60, 0))
CORNER = np.pad(np.arange(400.0).reshape(20, 20), ((5, 75), (70, 10)), constant_values=-1)
DAYS = [f"2020-08-{day:02}" for day in (20, 21, 22)]
HOURS = ["942", "2112", "0800"]
PARTS = {"year": [2020] * 3, "month": [9] * 3, "day": [5] * 3, "hour": [9, 10, 11]}
LATE = np.stack([BURNS & (time >= TIMES) for time in (30, 60, 200, 300)])[:, ::2, ::2].astype("i1")
METRES = {"y": 30 * np.arange(100), "x": 30 * np.arange(100)}
DEGREES = {"lat": 60 + 0.01 * np.arange(50), "lon": 243 + 0.01 * np.arange(50)}
SINUSOIDAL = {"crs": "+proj=sinu +R=6371007.181", "transform": from_origin(0, 5.56e6, 1e4, 1e4)}
PLATEAUS, MINUTES = (9999, 65535, 1e10, 305, 0), {"units": "minutes"}
UNITS = ("min.", "Minutes (elapsed)", "minutes since ignition")
STATUS = ("status", "PrescribedFire", "Tipo", "Layer", "DeleteThis", "Folder")


def table(sides=(200, 300, 400), **columns):
    def write(folder):
        squares(*sides, **columns).to_file(folder / "fire.gpkg")
        return folder / "fire.gpkg"

    return write


def names(*stems):
    def write(folder):
        for stem, side in zip(stems, (200, 300, 400), strict=True):
            squares(side).to_file(folder / f"{stem}.geojson")
        return folder

    return write


def raster(values, **about):
    return lambda folder: write_tif(folder / "fire.tif", values, **{"nodata": None, **about})


def states(folder, unburnt=0):
    maps = np.stack([BURNS & (time >= TIMES) for time in range(0, 301, 20)]).astype("uint8")
    return write_tif(folder / "fire.tif", maps + np.uint8(unburnt), nodata=None)


def netcdf(values, places, **units):
    """Writes a variable [..., y, x] of NetCDF, and the places and the units of its axes."""

    def write(folder):
        with netcdf_file(folder / "fire.nc", "w") as file:
            for name, at in places.items():
                file.createDimension(name, len(at))
                axis = file.createVariable(name, "f8", (name,))
                axis[:] = at
                axis.units = units.get(name, "1")
            fire = file.createVariable("fire", values.dtype, tuple(places))
            fire[:], fire.units = values, units.get("fire", "--")
        return folder / "fire.nc"

    return write


def arcinfo(folder):
    path = write_asc(folder / "fire.asc", TIMES)
    text = "Projection ALBERS\nDatum NAD83\nSpheroid GRS80\nUnits METERS\nParameters\n"
    text += "29 30 0.0\n45 30 0.0\n-96 0 0.0\n23 0 0.0\n0.0\n0.0\n"
    path.with_suffix(".prj").write_text(text)
    return path


def bank(folder):
    fires = np.full((2, 20, 20), 9999, "f4")
    fires[:, 4:16, 4:16] = np.arange(144).reshape(12, 12)
    fires[0, 0, 0] = np.inf
    np.save(folder / "fire.npy", fires)
    return folder / "fire.npy"


FILES = {
    "1 flights": table(date=[DAYS[0], *DAYS[:2]], flight=["am flight", "pm flight", "am IR"]),
    "1 halves": names("2020-09-05 AM", "2020-09-05 PM", "2020-09-06 AM"),
    "1 parts": table(**PARTS),
    "1 at noon": table(DATE_=[f"{DAYS[k]}T12:00:00Z" for k in (0, 0, 1)], TIME_=HOURS),
    "1 a gap": table(DATE_=DAYS, TIME_=[*HOURS[:2], ""]),
    "1 stamps": table(acq_date=DAYS[:1] * 3, acq_time=[f"2020-08-20 1{k}:30" for k in range(3)]),
    "1 zone": table(date=DAYS, time=HOURS, tz=["MDT"] * 3),
    "2 namesakes": table(date=DAYS, FireName=["Elk", "Elk", "Fox"], IRWINID=["{A}", "{B}", "{C}"]),
    "2 one each": table(date=DAYS, name=["Alder", "Birch", "Cedar"]),
    "2 words": table(date=DAYS, **{"Fire Name": ["True", "True", "False"]}),
    **{f"3 {name}": table(date=DAYS, **{name: ["No", "No", "Yes"]}) for name in STATUS},
    "4 in a corner": raster(CORNER, **SINUSOIDAL),
    **{f"5 {value:g}": raster(np.where(BURNS, TIMES + 1, value)) for value in PLATEAUS},
    "5 fills": raster(FILLS.astype("int16")),
    "5 lit": raster(np.where(BURNS, np.maximum(TIMES - 150, 0), -9999), nodata=-9999.0),
    "5 three values": raster(np.kron([[1, 2, 9999.0]], np.ones((30, 10)))),
    "5 three times": raster(np.kron([[0, 60, 180.0]], np.ones((30, 10)))),
    "5 of a bank": bank,
    "5 strip": raster(np.pad(np.where(BURNS, TIMES, 305), (0, 9))),
    "6 over New Year": table(doy=[364, 365, 1]),
    "6 years": raster(np.where(BURNS, 2020358 + TIMES // 60, -9999)),
    "7 digits": table(date=["20200820", "202008201300", "20200821013000"]),
    "7 zones": names(*(f"IR_202008{day}2130 CEST" for day in (20, 21, 22))),
    "7 no zone": names(*(f"IR 2020-08-{day} 21:30 BRT" for day in (20, 21, 22))),
    "7 start": table(date=["13.09.2020", "14.09.2020", "15.09.2020"]),
    **{f"8 {u}": raster(TIMES, nodata=-9999.0, tags={"TIME_UNITS": u}) for u in UNITS},
    "8 column": table(t=[0, 60, 120], units=["min"] * 3),
    "9 states in bands": states,
    "9 trees": lambda folder: states(folder, 1),
    "9 NODATA": raster(np.where(TIMES[::2, ::2] < 0, 99, LATE).astype("u1"), nodata=99),
    "9 times": netcdf(LATE, {"time": [0, 1, 4, 5]} | DEGREES, time="hours since 2020-09-05"),
    "10 bands": raster(np.stack([LATE[0], TIMES[::2, ::2]]).astype("f4"), nodata=-9999.0),
    "10 axis": netcdf(TIMES[None], {"time": [5]} | METRES, time="hours since 2020-09-05"),
    "10 degrees": netcdf(TIMES[::2, ::2], DEGREES, lat="degrees_north"),
    "11 union": table((200, 400, 300), date=DAYS),
    "13 ArcInfo": arcinfo,
}
# Keys, the question if there is one, and what `read:` says at last.
CASES = {
    "1 flights": ({}, r"fire.time_field=\[date,flight\]", "3 times, from 2020-08-20T00:00"),
    "1 halves": ({}, "", "3 times, from 2020-09-05T00:00.* to 2020-09-06T00:00"),
    "1 parts": ({"time_field": [*PARTS]}, "", "from 2020-09-05T09:00.*T11:00"),
    "1 at noon": ({}, "", "3 times, from 2020-08-20T09:42.* to 2020-08-21T08:00"),
    "1 a gap": ({}, r"no time in TIME_ \(1 of 3\).*fire.where=TIME_", "from DATE_ and TIME_"),
    "1 stamps": ({}, "fire.time_field=acq_time, or", "3 times, from 2020-08-20T10:30"),
    "1 zone": ({}, "", "from 2020-08-20T15:42"),
    "2 namesakes": ({}, r"Elk \(2\), Fox \(1\); expected fire.incident_field=IRWINID", ""),
    "2 one each": ({}, r"name: Alder \(1\), .*fire.incident=Alder", ""),
    "2 words": ({}, r"Fire Name: True \(2\)", "2 of 3 features used"),
    **{f"3 {name}": ({}, rf"{name}: No \(2\), Yes \(1\)", "2 of 3 features") for name in STATUS},
    "4 in a corner": ({"units": "days"}, "", "axes 1.15.* projected to"),
    **{f"5 {v:g}": (MINUTES, rf"{re.escape(f'{v:g}')} \(\d", "723 cells") for v in PLATEAUS},
    "5 fills": ({"units": "day_of_year"}, r"-2 \(5 ?% .* and 0 .*\[-2,0\]", "200 days to 204"),
    "5 lit": ({"units": "minutes"}, "", "from 0 minutes to 149"),
    "5 three values": ({"units": "hours"}, "9999 ", "600 cells"),
    "5 three times": ({"units": "minutes"}, "", "900 cells"),
    "5 of a bank": ({}, r"9999 \(64 ?%", "a bank of 2 fires .* 101 of 20 x 20"),
    "5 strip": ({"units": "minutes"}, r"0 \(\d.*305 \(.*\[0,305\]", "723 cells burn"),
    "6 over New Year": ({"time_field": "doy", "units": "days"}, "day_of_year", "364 days to 366"),
    "6 years": ({"units": "day_of_year"}, "2020362 is no day of the year", ""),
    "7 digits": ({}, "", "from 2020-08-20T00:00.* to 2020-08-21T01:30"),
    "7 zones": ({}, "", "from 2020-08-20T19:30.*times from File, zone of the file"),
    "7 no zone": ({}, r"T.geojson: feature 0: File='2020-08-20 21:30 BRT' is not a date", ""),
    **{f"8 {unit}": ({"units": "hours"}, "fire.units=minutes, not", "723 cells") for unit in UNITS},
    "8 column": ({"units": "hours"}, "fire.units=minutes, not hours", "to 120 minutes"),
    "7 start": ({"time_format": "%d.%m.%Y", "start": "2020-09-13T10:30"}, "", "3 times"),
    "9 states in bands": ({}, "the bands 1, 2.*fire.kind=masks", "to 15 maps"),
    "9 trees": ({"kind": "masks"}, r"100% of the first map.*=\[0,1\]", "to 15 maps"),
    "9 NODATA": ({"kind": "masks"}, "", "states 0, 1,"),
    "9 times": ({}, "fire.kind=masks", "from 2020-09-05T00:00.* to 2020-09-05T05:00"),
    "10 bands": ({"units": "minutes"}, 'fire.layer="1"', ""),
    "10 axis": ({"units": "minutes", "unburned": "none"}, "", "minutes; band 'fire'"),
    "10 degrees": ({"units": "minutes"}, "", "WGS 84.*to WGS 84 / UTM zone 11N"),
    "11 union": ({}, "", "1 without all that burnt before: the union counts"),
    "13 ArcInfo": ({"units": "minutes"}, "", "axes 1.21 : 1.* projected to"),
}


@pytest.mark.parametrize("name", CASES)
def test_second_case(name, tmp_path):
    keys, question, says = CASES[name]
    fires, about, questions = answered(FILES[name](tmp_path), keys)
    assert bool(questions) == bool(question), questions
    assert re.search(question, (*questions, "")[0])
    assert re.search(says, about), (about, questions)
    assert not says or torch.isfinite(fires).sum() > 100
