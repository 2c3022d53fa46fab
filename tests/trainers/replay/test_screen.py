"""Tests the pixels of links, roles, targets, panels and legend."""

import math

import numpy as np
import pytest
import torch
from small_episode import STEPS, play_small

from emberlink.envs import WildfireConfig, keys
from emberlink.envs.rendering.frame import BASE, BURNT_OUT, FAILED, FIELD_OF_VIEW, MISSED, UAV
from emberlink.policies.scripted.map_greedy import MapGreedy, MapGreedyAlone
from emberlink.trainers import make_env
from emberlink.trainers.evaluation.evaluate import play
from emberlink.trainers.replay import screen as screens
from emberlink.trainers.replay.recording import ROLES, Episode, Recorder, Recording
from emberlink.trainers.replay.screen import LINK, ROLE_COLOURS, TARGET, Screen

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


def screen(*episodes: Recording, size: int = 360, **options) -> Screen:
    shown = [Episode(title="one", recording=episode) for episode in episodes]
    return Screen(shown, size=size, **options)


def drawn(*episodes: Recording, panel: int = 0, **options) -> np.ndarray:
    """Draws the last step and returns the map of one panel."""
    made = screen(*episodes, **options)
    (x, y), (width, height) = made.map_corner(panel), made.map_size
    return made.picture(1)[y : y + height, x : x + width]


def around(image: np.ndarray, x: float, y: float, reach: int = 2) -> set[tuple[int, ...]]:
    """Returns the colours near a position in cells of a 30 x 20 grid."""
    scale = image.shape[1] // 30
    across, down = int((x + 0.5) * scale), int((19.5 - y) * scale)
    return all_of(image[down - reach : down + reach + 1, across - reach : across + reach + 1])


def all_of(image: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(colour) for colour in np.unique(image.reshape(-1, 3), axis=0).tolist()}


def linked(*pairs: tuple[int, int], n: int = 3) -> np.ndarray:
    links = np.zeros((n, n), bool)
    for i, j in pairs:
        links[i, j] = True
    return links


def test_links_are_drawn_between_neighbours_only():
    image = drawn(recorded(hears=linked((0, 1))))
    assert LINK in around(image, 7, 2)
    assert LINK not in around(image, 17, 7)  # between UAV 1 and UAV 2
    assert LINK not in around(image, 12, 7)  # between UAV 0 and UAV 2
    assert LINK in around(drawn(recorded(hears=linked((2, 1)))), 17, 7)
    assert LINK not in all_of(drawn(recorded()))
    base = (WHERE[0][0], WHERE[0][1] + 6.0)
    to_base = recorded(hears=linked((0, 3), n=4), base=base)
    assert LINK in around(drawn(to_base), 2, 5)


def test_a_uav_has_a_shape_and_a_colour_for_its_role():
    image = drawn(recorded(follows=FOLLOWS))
    shapes = set()
    for (x, y, _), colour in zip(WHERE, ROLE_COLOURS, strict=True):
        near = around(image, x, y, reach=6)
        assert {UAV, colour} <= near
        assert not (set(ROLE_COLOURS) - {colour}) & near
        rows, columns = np.nonzero((image == colour).all(-1))
        shapes.add((*(rows - rows.min()), *(columns - columns.min())))
    assert len(shapes) == 3
    plain = all_of(drawn(recorded()))
    assert UAV in plain
    assert not set(ROLE_COLOURS) & plain


def test_a_target_is_a_cross_with_a_line_to_it():
    target = np.array([(2, 12, 1), (12, 14, 1), (22, 2, 1)], np.float32)
    image = drawn(recorded(follows=FOLLOWS, target=target))
    for (x, y, _), colour in zip(target.tolist(), ROLE_COLOURS, strict=True):
        assert colour in around(image, x, y)
    assert ROLE_COLOURS[1] in around(image, 12, 8, reach=5)
    assert TARGET in around(drawn(recorded(target=target)), 2, 12)


def test_each_panel_shows_its_own_episode():
    left, right = recorded(follows=FOLLOWS, hears=linked((0, 1))), recorded()
    assert {LINK, ROLE_COLOURS[0]} <= all_of(drawn(left, right, panel=0))
    assert not {LINK, ROLE_COLOURS[0]} & all_of(drawn(left, right, panel=1))
    first = screen(recorded()).picture(1)
    second = screen(recorded(seen=[(0, 0)])).picture(1)
    assert not np.array_equal(first[-30:], second[-30:])
    assert recorded().coverage(1) == 37.5


def test_the_legend_names_what_occurs():
    whole = recorded(follows=FOLLOWS, hears=linked(), target=np.zeros((3, 3)))
    ends = [*ROLES, "hear each other", "target"]
    assert [*screen(recorded()).legend()] == ["fire", "field of view", "UAV"]
    assert [*screen(recorded(), whole).legend()] == ["fire", "field of view", "UAV", *ends]
    lost = recorded(
        alive=np.array([True, False, True]), base=(0.0, 9.0), seen=[(4, 4)], missed=[(5, 5)]
    )
    words = [*screen(recorded(), lost, grey_seen=True).legend()]
    rest = ["UAV", "base", "failed", "burnt out, seen", "burnt out, not seen"]
    assert words == ["fire", "fire, seen", "field of view", *rest]


def test_cells_have_the_colour_of_their_state():
    episode = recorded(burns=[(25, 5)], seen=[(27, 5)], missed=[(27, 7)])
    image = drawn(episode)
    assert around(image, 25, 5) == {(255, 255, 255)}
    assert around(image, 27, 5) == {BURNT_OUT}
    assert around(image, 27, 7) == {MISSED}
    found = recorded(burns=[(25, 5), (27, 5)])
    found.first_seen[25, 5] = 0
    assert around(drawn(found), 25, 5) == {(255, 255, 255)}
    image = drawn(found, grey_seen=True)
    assert around(image, 25, 5) == {screens.SEEN_FIRE}
    assert around(image, 27, 5) == {(255, 255, 255)}


def test_a_failed_uav_is_a_grey_cross_without_a_view_or_a_target():
    target = np.array([(2, 12, 1)] * 3, np.float32)
    image = drawn(recorded(alive=np.array([False, False, True]), target=target))
    assert around(image, 12, 2) >= {FAILED}
    assert not around(image, 12, 2, reach=9) & {UAV, FIELD_OF_VIEW}
    assert UAV in around(image, 22, 12)
    image = drawn(recorded(alive=np.zeros(3, bool), target=target))
    assert not all_of(image) & {UAV, FIELD_OF_VIEW, TARGET}


def test_the_base_is_drawn():
    assert around(drawn(recorded(base=(20, 5))), 20, 5) == {BASE}
    assert BASE not in all_of(drawn(recorded()))


@pytest.mark.parametrize("grid", [(60, 40), (8, 256)])
@pytest.mark.parametrize("count", [1, 3, 7])
def test_panels_do_not_overlap_and_sides_are_even(grid, count):
    made = screen(*[recorded(grid=grid, position=[(0, 0, 0)])] * count, size=250)
    height, width, _ = made.picture(0).shape
    assert height % 2 == width % 2 == 0
    covered = np.zeros((height, width), int)
    for panel in range(count):
        x, y = made.map_corner(panel)
        covered[y : y + made.map_size[1], x : x + made.map_size[0]] += 1
    assert covered.max() == 1
    assert covered.sum() == count * made.map_size[0] * made.map_size[1]


def test_a_recording_has_the_map_of_the_environment():
    episode = play_small()
    for step in range(STEPS + 1):
        assert np.array_equal(episode.recording.fire_map(step), episode.fire_map[step].numpy())
        now = episode.steps[step]
        covered = 100 * now[keys.SEEN].item() / max(1, now[keys.BURNT].item())
        assert episode.recording.coverage(step) == pytest.approx(covered)


@pytest.mark.parametrize(
    ("policy", "base", "listens"),
    [
        (MapGreedy, None, True),
        (MapGreedyAlone, None, False),
        (MapGreedyAlone, [0, 6], True),
    ],
)
def test_links_of_every_policy_that_hears_and_of_the_base_are_drawn(policy, base, listens):
    settings = {"env.base": base, "env.radio.range": 7.0, "env.num_uavs": 3}
    env = make_env("independent", fire=torch.zeros(12, 12), horizon=4, seed=0, **settings)
    recorder = Recorder(advised=False, hears=policy.hears)
    play(env, policy(env.base_env), recorder.add)
    episode = recorder.recording()
    assert episode.listens == listens
    for position, hears in zip(episode.steps["position"], episode.steps["hears"], strict=True):
        places = [*position.tolist(), *([[*base, 0.0]] if base else [])]
        near = [[0 < math.dist(a, b) < 7 for b in places] for a in places]
        assert hears.tolist() == near
