"""Tests the pixels of links, roles, targets, panels and legend."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from emberlink.envs import keys
from emberlink.envs.rendering import marks, panels
from emberlink.envs.rendering.frame import BASE, BURNT_OUT, FAILED, FIELD_OF_VIEW, MISSED, UAV
from emberlink.envs.rendering.marks import LINK, ROLE_COLOURS, ROLES, FrameData
from emberlink.envs.rendering.panels import Episode, Screen
from emberlink.policies.scripted.follow_target import FollowTarget
from emberlink.policies.scripted.map_greedy import MapGreedy
from emberlink.policies.scripted.map_greedy_alone import MapGreedyAlone
from emberlink.trainers import make_env
from emberlink.trainers.evaluation import record_episode

WHERE = [(2, 2, 1), (12, 2, 1), (22, 12, 1)]


def frame(**changes) -> FrameData:
    values = {
        "step": 4,
        "seen": 3,
        "burnt": 8,
        "fire_map": np.zeros((30, 20), np.uint8),
        "position": np.array(WHERE, np.float32),
    }
    return FrameData(**{**values, **changes})


def screen(*frames: FrameData, size: int = 360, **options) -> Screen:
    shown = [Episode(title="one", view_angle=30.0, frames=[frame_data]) for frame_data in frames]
    return Screen(shown, size=size, **options)


def drawn(*frames: FrameData, panel: int = 0, **options) -> np.ndarray:
    """Draws one panel and returns its map."""
    made = screen(*frames, **options)
    (x, y), (width, height) = made.map_corner(panel), made.map_size
    return made.picture(0)[y : y + height, x : x + width]


def around(image: np.ndarray, x: float, y: float, reach: int = 2) -> set[tuple[int, ...]]:
    """Returns the colours near a position in cells of a 30 x 20 grid."""
    scale = image.shape[1] // 30
    across, down = int((x + 0.5) * scale), int((19.5 - y) * scale)
    part = image[down - reach : down + reach + 1, across - reach : across + reach + 1]
    return {tuple(colour) for colour in part.reshape(-1, 3).tolist()}


def all_of(image: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(colour) for colour in np.unique(image.reshape(-1, 3), axis=0).tolist()}


def linked(*pairs: tuple[int, int], n: int = 3) -> np.ndarray:
    links = np.zeros((n, n), bool)
    for i, j in pairs:
        links[i, j] = links[j, i] = True
    return links


def test_links_are_drawn_between_neighbours_only():
    image = drawn(frame(links=linked((0, 1))))
    assert LINK in around(image, 7, 2)
    assert LINK not in around(image, 17, 7)  # between UAV 1 and UAV 2
    assert LINK not in around(image, 12, 7)  # between UAV 0 and UAV 2
    assert LINK in around(drawn(frame(links=linked((1, 2)))), 17, 7)
    assert LINK not in all_of(drawn(frame()))


def test_a_uav_has_a_ring_in_the_colour_of_its_role():
    image = drawn(frame(roles=np.array([0, 1, 2])))
    for (x, y, _), colour in zip(WHERE, ROLE_COLOURS, strict=True):
        near = around(image, x, y, reach=6)
        assert {UAV, colour} <= near
        assert not (set(ROLE_COLOURS) - {colour}) & near
    plain = all_of(drawn(frame()))
    assert UAV in plain
    assert not set(ROLE_COLOURS) & plain


def test_roles_differ_in_shape():
    shapes = set()
    for role in range(len(ROLES)):
        image = drawn(frame(roles=np.full(3, role)))
        shapes.add((image == ROLE_COLOURS[role]).all(-1).tobytes())
    assert len(shapes) == 3


def test_a_target_is_a_cross_with_a_line_to_it():
    target = np.array([(2, 12, 1), (12, 14, 1), (22, 2, 1)], np.float32)
    image = drawn(frame(roles=np.array([0, 1, 2]), target=target))
    for (x, y, _), colour in zip(target.tolist(), ROLE_COLOURS, strict=True):
        assert colour in around(image, x, y)
    assert ROLE_COLOURS[1] in around(image, 12, 8, reach=5)
    assert marks.TARGET in around(drawn(frame(target=target)), 2, 12)


def test_a_large_team_has_no_lines_to_its_targets():
    n = marks.MANY + 1
    position = np.tile(np.array([[2, 2, 1]], np.float32), (n, 1))
    target = np.tile(np.array([[2, 16, 1]], np.float32), (n, 1))
    options = {"position": position, "roles": np.zeros(n, int), "target": target}
    image = drawn(frame(**options))
    assert ROLE_COLOURS[0] in around(image, 2, 16)
    assert ROLE_COLOURS[0] not in around(image, 2, 9, reach=20)


def test_a_higher_uav_has_a_larger_square():
    low, high = (
        (drawn(frame(position=np.array([(9, 9, z)], np.float32))) == (255, 255, 0)).all(-1).sum()
        for z in (1, 4)
    )
    assert high > 8 * low


def test_each_panel_shows_its_own_episode():
    left, right = frame(roles=np.zeros(3, int), links=linked((0, 1))), frame()
    assert {LINK, ROLE_COLOURS[0]} <= all_of(drawn(left, right, panel=0))
    assert not {LINK, ROLE_COLOURS[0]} & all_of(drawn(left, right, panel=1))


def test_the_legend_has_the_visible_marks_only():
    def words(*frames, **options):
        return [word for word, _ in screen(*frames, **options)._legend()]

    whole = frame(roles=np.zeros(3, int), links=linked(), target=np.zeros((3, 3)))
    ends = [*ROLES, "hear each other", "target"]
    assert words(frame()) == ["fire", "field of view", "UAV"]
    assert words(whole) == ["fire", "field of view", *ends]
    assert words(frame(), whole) == ["fire", "field of view", "UAV", *ends]
    assert words(frame(), grey_seen=True)[:2] == ["fire", "fire, seen"]


def test_the_legend_has_what_only_some_worlds_have():
    burnt = np.zeros((30, 20), np.uint8)
    burnt[4, 4], burnt[5, 5] = 3, 4
    lost = frame(alive=np.array([True, False, True]), base=(0.0, 9.0), fire_map=burnt)
    words = [word for word, _ in screen(frame(), lost)._legend()]
    assert words[3:] == ["base", "failed", "burnt out, seen", "burnt out, not seen"]


def test_burnt_out_cells_are_dark_and_missed_ones_differ():
    burnt = np.zeros((30, 20), np.uint8)
    burnt[25, 5], burnt[27, 5] = 3, 4
    image = drawn(frame(fire_map=burnt))
    assert around(image, 25, 5) == {BURNT_OUT}
    assert around(image, 27, 5) == {MISSED}


def test_a_failed_uav_is_a_grey_cross_without_a_view_or_a_target():
    target = np.array([(2, 12, 1)] * 3, np.float32)
    image = drawn(frame(alive=np.array([False, False, True]), target=target))
    assert around(image, 12, 2) >= {FAILED}
    assert not around(image, 12, 2, reach=9) & {UAV, FIELD_OF_VIEW}
    assert UAV in around(image, 22, 12)
    image = drawn(frame(alive=np.zeros(3, bool), target=target))
    assert not all_of(image) & {UAV, FIELD_OF_VIEW, marks.TARGET}


def test_the_base_is_drawn():
    assert around(drawn(frame(base=(20, 5))), 20, 5) == {BASE}
    assert BASE not in all_of(drawn(frame()))


@pytest.mark.heavy
def test_the_environment_draws_failed_uavs_and_the_base():
    env = make_env("consensus", "tuned", world="blackout", seed=1)
    env.reset()
    env.base_env._fail_step.fill_(0)
    shown = all_of(env.base_env.render())
    assert {BASE, FAILED} <= shown
    assert not shown & {UAV, FIELD_OF_VIEW}


def test_seen_fire_has_a_colour_only_on_request():
    fire = np.zeros((30, 20), np.uint8)
    fire[25, 5], fire[27, 5] = 1, 2
    assert around(drawn(frame(fire_map=fire)), 25, 5) == {(255, 255, 255)}
    image = drawn(frame(fire_map=fire), grey_seen=True)
    assert around(image, 25, 5) == {panels.SEEN_FIRE}
    assert around(image, 27, 5) == {(255, 255, 255)}


def test_panels_show_step_and_coverage():
    first, second = screen(frame()).picture(0), screen(frame(seen=4)).picture(0)
    assert not np.array_equal(first[:50], second[:50])
    assert frame().coverage == 37.5
    assert frame(seen=0, burnt=0).coverage == 100


@pytest.mark.parametrize("grid", [(8, 8), (30, 30), (60, 40), (8, 256), (256, 8), (256, 256)])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_panels_do_not_overlap_and_sides_are_even(grid, count):
    empty = frame(fire_map=np.zeros(grid, np.uint8), position=np.zeros((1, 3), np.float32))
    made = screen(*[empty] * count, size=250)
    height, width, _ = made.picture(0).shape
    assert height % 2 == width % 2 == 0
    covered = np.zeros((height, width), int)
    for panel in range(count):
        x, y = made.map_corner(panel)
        covered[y : y + made.map_size[1], x : x + made.map_size[0]] += 1
    assert covered.max() == 1
    assert covered.sum() == count * made.map_size[0] * made.map_size[1]


def test_four_square_maps_are_arranged_two_by_two():
    made = screen(*[frame(fire_map=np.zeros((30, 30), np.uint8))] * 4)
    corners = [made.map_corner(panel) for panel in range(4)]
    assert len({x for x, _ in corners}) == len({y for _, y in corners}) == 2


def tensordict(features: int, **agents) -> TensorDict:
    entries = {
        "observation": torch.zeros(3, features),
        "position": torch.tensor(WHERE, dtype=torch.float32),
        **agents,
    }
    counts = {name: torch.tensor(5) for name in (keys.STEP, keys.SEEN, keys.BURNT)}
    entries = {keys.ALIVE[1]: torch.ones(3, dtype=torch.bool), **entries}
    return TensorDict({keys.AGENTS: TensorDict(entries, [3]), **counts}, [])


def test_roles_are_derived_from_the_followed_uavs():
    follows = torch.tensor([0, 0, -1, 3, 1])
    assert [ROLES[role] for role in record_episode.roles(follows)] == [
        *("discoverer", "seeker", "wanderer", "discoverer", "seeker")
    ]


def test_links_roles_and_targets_are_drawn_from_the_tensordict():
    nothing = torch.zeros(30, 20, dtype=torch.uint8)
    hears = torch.from_numpy(linked((0, 1)))
    entries = {
        keys.FOLLOWS[1]: torch.tensor([0, 0, -1]),
        keys.TARGET[1]: torch.ones(3, 3),
    }

    def data(td, **choices):
        return record_episode.frame_data(td, nothing, **choices)

    seen = data(tensordict(9, **entries), links=hears, advised=True)
    assert np.array_equal(seen.links, hears)
    assert seen.roles.tolist() == [0, 1, 2]
    assert np.array_equal(seen.target, np.ones((3, 3)))
    links_alone = data(tensordict(18), links=hears, advised=True)
    assert np.array_equal(links_alone.links, hears)
    assert links_alone.roles is links_alone.target is None
    for silent in (
        data(tensordict(6), links=None, advised=True),
        data(tensordict(9, **entries), links=None, advised=False),
    ):
        assert silent.links is silent.roles is silent.target is None


@pytest.mark.parametrize(("loss", "drawn"), [(0.0, True), (1.0, False)])
def test_links_are_received_messages(loss, drawn):
    fire = torch.zeros(12, 12)
    env = make_env("consensus", fire=fire, horizon=4, seed=0, **{"env.radio.loss": loss})
    policy = FollowTarget(env.base_env)
    frames = record_episode.record_episode(env, policy, steps=range(5), advised=True)
    assert len(frames) == 5
    assert all(frame.links.any() == drawn for frame in frames)


@pytest.mark.parametrize(
    ("policy", "base", "shape"),
    [
        (MapGreedy, None, (3, 3)),
        (MapGreedyAlone, None, None),
        (MapGreedyAlone, [0, 6], (4, 4)),
        (MapGreedy, [0, 6], (4, 4)),
    ],
)
def test_links_of_every_policy_that_hears_and_of_the_base_are_drawn(policy, base, shape):
    fire = torch.zeros(12, 12)
    settings = {"env.base": base, "env.radio.range": 7.0, "env.num_uavs": 3}
    env = make_env("independent", fire=fire, horizon=4, seed=0, **settings)
    frames = record_episode.record_episode(env, policy(env.base_env), steps=range(5), advised=False)
    for shown in frames:
        assert (None if shown.links is None else shown.links.shape) == shape
        if shape:
            places = [*shown.position.tolist(), *([[*base, 0.0]] if base else [])]
            near = [[0 < math.dist(a, b) < 7 for b in places] for a in places]
            assert shown.links.tolist() == near


def test_a_link_to_the_base_is_drawn():
    links = np.zeros((4, 4), bool)
    links[0, 3] = True
    shown = frame(links=links, base=(WHERE[0][0], WHERE[0][1] + 6.0))
    assert LINK in around(drawn(shown), int(WHERE[0][0]), int(WHERE[0][1]) + 3)
