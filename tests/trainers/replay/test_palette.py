"""Tests that the colours of replays differ for people with each kind of colour blindness."""

import re
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest

CSS = (Path(__file__).parents[3] / "trainers" / "replay" / "web" / "page.css").read_text()
LIGHT, DARK = (
    dict(re.findall(r"--([\w-]+): (#\w{6})", block))
    for block in re.findall(r":root {(.*?)}", CSS, re.S)
)
PALETTES = {"light": LIGHT, "dark": {**LIGHT, **DARK}}
# Machado, Oliveira and Fernandes 2009, table 1, severity 1; of linear RGB
SEEN = {
    "as it is": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
CELLS = ("ground", "unknown", "fire", "unseen", "burnt", "missed")
OTHERS = (
    [f"uav-{number}" for number in range(6)],  # they also have numbers
    [f"panel-{number}" for number in range(4)],  # they also have dashes
    ["discoverer", "seeker", "wanderer"],  # they also have shapes
)


def lab(colour: str, eye) -> np.ndarray:
    """Returns a colour in CIELAB as an eye sees it."""
    rgb = np.array([int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    white = XYZ.sum(1)
    part = XYZ @ np.clip(np.array(eye) @ linear, 0, 1) / white
    f = np.where(part > 0.008856, np.cbrt(part), 7.787 * part + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("eye", SEEN)
@pytest.mark.parametrize("scheme", PALETTES)
def test_colours_differ(scheme, eye):
    shown = {name: lab(colour, SEEN[eye]) for name, colour in PALETTES[scheme].items()}

    def apart(names) -> float:
        return min(np.linalg.norm(shown[a] - shown[b]) for a, b in combinations(names, 2))

    assert apart(CELLS) > 13  # 2.3 is just noticeable
    assert all(apart(names) > 7 for names in OTHERS)
    lightness = [shown[f"heat-{place}"][0] for place in range(5)]
    assert all(one - other > 10 for one, other in pairwise(lightness))
