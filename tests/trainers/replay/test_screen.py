"""Tests the pixels of links, roles, targets and cells."""

import numpy as np
import pytest
from PIL.ImageColor import getrgb

from emberlink.envs import WildfireConfig
from emberlink.envs.rendering import frame
from emberlink.trainers.replay import screen
from emberlink.trainers.replay.recording import Recording

WHERE = [(2, 2, 1), (12, 2, 1), (22, 12, 1)]
FOLLOWS = np.array([0, 0, -1])
"""UAV 0 is a discoverer, UAV 1 follows it, UAV 2 wanders"""


def recorded(
    *, position=WHERE, burns=(), missed=(), seen=(), base=None, grid=(30, 20), **steps
) -> Recording:
    """Returns an episode of two equal steps; a list of cells gives the state of the fire."""
    position = np.array(position, np.float32)
    uavs = len(position)
    ignition, end = np.full((2, *grid), 2)
    view = np.tile([1, 0, 1, 0], (2, uavs, 1))
    for cell in (*burns, *missed, *seen):
        ignition[cell] = 0
    for cell in (*missed, *seen):
        end[cell] = 1
    values = {
        "position": position,
        "alive": np.ones(uavs, bool),
        "hears": np.zeros((uavs, uavs), bool),
        "seen": np.array(3),
        "burnt": np.array(8),
    }
    listens = "hears" in steps
    made = {name: np.stack([value] * 2) for name, value in (values | steps).items()}
    world = WildfireConfig(grid=grid, num_uavs=uavs, view_angle=30.0, base=base)
    episode = Recording(
        world=world, listens=listens, ignition=ignition, end=end, steps={**made, "view": view}
    )
    for cell in seen:
        episode.first_seen[cell] = 0
    return episode


def around(episode: Recording, place, reach: int = 2, **options) -> set[tuple[int, ...]]:
    """Returns the colours of the last step near a position in cells."""
    made = screen.Screen([episode], size=360, **options)
    image = made.picture(1)
    across, up = made.axes[0].transData.transform(place).round().astype(int)
    near = image[::-1][up - reach : up + reach + 1, across - reach : across + reach + 1]
    return {tuple(colour) for colour in near.reshape(-1, 3).tolist()}


def linked(i: int, j: int, n: int = 3) -> np.ndarray:
    links = np.zeros((n, n), bool)
    links[i, j] = True
    return links


FIRE, BURNT_OUT, MISSED, FIELD_OF_VIEW, LINK, TARGET, SEEN_FIRE = map(
    getrgb,
    (
        *(frame.FIRE, frame.BURNT_OUT, frame.MISSED, frame.FIELD_OF_VIEW),
        *(screen.LINK, screen.NO_ROLE, screen.SEEN_FIRE),
    ),
)
ROLE_COLOURS = [getrgb(style["color"]) for style in screen.ROLE_MARKS]
UAV, FAILED = getrgb(frame.UAV["color"]), getrgb(frame.FAILED["color"])
CELLS = {"burns": [(25, 5)], "seen": [(27, 5)], "missed": [(27, 7)]}
FAILED_UAV = {"alive": np.array([False, False, True]), "target": np.full((3, 3), 12.0, np.float32)}


@pytest.mark.parametrize(
    ("drawn", "place", "present", "absent"),
    [
        ({}, (12, 2), {UAV, FIELD_OF_VIEW}, {LINK, TARGET, *ROLE_COLOURS}),
        ({"hears": linked(0, 1)}, (7, 2), {LINK}, set()),
        ({"hears": linked(0, 1)}, (17, 7), set(), {LINK}),  # between UAV 1 and UAV 2
        ({"hears": linked(0, 3, 4), "base": (2, 8)}, (2, 5), {LINK}, set()),
        ({"follows": FOLLOWS}, (2, 2), {UAV, ROLE_COLOURS[0]}, {*ROLE_COLOURS[1:]}),
        ({"follows": FOLLOWS}, (22, 12), {UAV, ROLE_COLOURS[2]}, {*ROLE_COLOURS[:2]}),
        ({"target": np.array([(2, 12, 1)] * 3, np.float32)}, (2, 12), {TARGET}, set()),
        (CELLS, (25, 5), {FIRE}, set()),
        (CELLS, (27, 5), {BURNT_OUT}, {FIRE}),
        (CELLS, (27, 7), {MISSED}, {FIRE}),
        (FAILED_UAV, (12, 2), {FAILED}, {UAV, FIELD_OF_VIEW, TARGET}),
    ],
)
def test_what_is_drawn_at_a_place(drawn, place, present, absent):
    found = around(recorded(**drawn), place, reach=2 if place[0] > 24 else 6)
    assert present <= found
    assert not absent & found


def test_fire_that_was_seen_is_grey_if_asked():
    found = recorded(burns=[(25, 5)])
    found.first_seen[25, 5] = 0
    assert around(found, (25, 5)) == {FIRE}
    assert around(found, (25, 5), grey_seen=True) == {SEEN_FIRE}
