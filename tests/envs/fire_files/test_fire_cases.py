"""Nineteen files that were misread: each gives the right grid, or the right question.

`cases/NN_name` holds a file made after a public report, and `expected.npy`, the right grid [x, y]
in steps of 1000, where it is known.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from fire_files import answered

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary

CASES = Path(__file__).parent / "cases"
FIRES = {"time_field": "tUTC"}, r"Alder \(6\), Birch \(6\)", {"incident": "Alder"}
DECLARED = {"units": "minutes", "minutes_per_step": 0.5}
# file, keys, the question if there is one, keys that answer it, what `read:` says
TABLE = {
    "01_acq_date_acq_time/viirs_areas.geojson": ({}, "", {}, "8 times, .*T09:42.*T21:12"),
    "02_gofer_two_fires/fireProg.shp": (*FIRES, "6 of 12 features used"),
    "03_same_name/perimeters.geojson": (
        {"incident": "Creek"},
        r"poly_IRWINID: \{A\} \(6\), \{B\} \(6\)",
        {"incident": "{A}", "incident_field": "poly_IRWINID"},
        "6 of 12 features",
    ),
    "04_modis_sinusoidal/fired_daily.shp": ({}, "", {}, r"3\.\d+ : 1.* UTM zone 10N"),
    "05_zero_is_unburned/arrival.tif": (
        {"units": "minutes"},
        r"0 \(86 ?% .*fire.unburned=0",
        {"unburned": 0.0},
        "1309 cells",
    ),
    "06_new_year/day_of_burn.tif": (
        {"units": "days"},
        "days 1 to 6 and 358 to 365.*fire.units=day_of_year",
        {"units": "day_of_year"},
        "from 358 days to 371 days.*; 1 place",
    ),
    "07_pm_ignored/perimeters.geojson": ({}, "", {}, "8 times, .*05T01:30.*08T13:30"),
    "08_day_first/perimetros.geojson": (
        {},
        "fits day_first .* month_first .*fire.time_format=day_first",
        {"time_format": "day_first"},
        "from 2020-08-05T02:00.* to 2020-08-08T14:00",
    ),
    "09_wrfout_name/wrfout_d01_2012-09-09_12:00:00": (
        {"units": "seconds"},
        r"3005 \(45 ?% .* fire.unburned=3005",
        {"unburned": 3005.0},
        "TIGN_G.* the last of 2 times",
    ),
    "10_firms_command/fire_archive_SV-C2_1.csv": (
        {},
        "80 points.*fire.radius",
        {"radius": 375.0},
        "4 times.*acq_date and acq_time",
    ),
    "11_declared_unit/arrival.tif": (
        DECLARED,
        "seconds; expected fire.units=seconds",
        {"units": "seconds"},
        "time_of_arrival",
    ),
    "12_mask_frames/fire_maps.npy": (
        {},
        r"20 maps of the states 0 \(78 ?%\), 1 .*fire.kind=masks",
        {"kind": "masks"},
        "137 cells burn from 0 maps to 19 maps",
    ),
    "13_tfr_polygon/event_polygon.geojson": (
        {},
        r"Perimeter \(6\), Temporary Flight Restriction \(1\); .*fire.where=",
        {"where": "FeatureCategory=Wildfire*"},
        "6 of 7 features used",
    ),
    "14_yymmddhhmm/perimeters.geojson": (
        {},
        "fits seconds .2027-04-20 03:33. or %y%m%d%H%M .2018-08-19 20:00",
        {"time_format": "%y%m%d%H%M"},
        "2018-08-19T20:00.*2018-08-20T03:00",
    ),
    "15_shapefile_date_only/Perimeters.shp": ({}, "", {}, "3 times"),
    "16_active_areas/active.geojson": ({}, "", {}, "1 within the area burnt before"),
    "17_forefire_geojson/fronts": ({}, "", {}, "5 times, .*T18:00.*T22:00.*from valid_at"),
    "18_kml_folder_time/ir.kml": ({}, "", {}, "5 times, .*T18:00.*T22:00"),
    "19_arcinfo_prj/toa.asc": ({"units": "minutes"}, "", {}, "582 cells.*axes 1.00 : 1"),
}


@pytest.mark.parametrize("name", TABLE)
@pytest.mark.filterwarnings("ignore:.*order is lost")
def test_case(name):
    keys, _, answer, says = TABLE[name]
    config = {"path": str(CASES / name), "ring_width": None, **keys, **answer}
    (fire,), read = read_with_summary(FileFireConfig(**config), (30, 30), 1000)
    assert re.search(says, read), read
    if (expected := CASES / name.split("/")[0] / "expected.npy").exists():
        right = np.load(expected)
        least = 0.8 if name.startswith("15") else 0.92
        for step in (250, 500, 750, 1000):
            one, other = right <= step, fire.numpy() <= step
            assert (one & other).sum() / (one | other).sum() > least, (step, read)


@pytest.mark.parametrize("name", [name for name, case in TABLE.items() if case[1]])
@pytest.mark.filterwarnings("ignore")
def test_the_keys_that_messages_print_can_be_copied(name):
    fires, _, questions = answered(CASES / name, TABLE[name][0])
    assert re.search(TABLE[name][1], questions[0])
    assert fires is not None, questions


def test_lost_order_is_said():
    config = FileFireConfig(path=str(CASES / "15_shapefile_date_only" / "Perimeters.shp"))
    with pytest.warns(UserWarning, match=r"8 features have 3 dates .* order is lost"):
        read_with_summary(config, (30, 30), 1000)
