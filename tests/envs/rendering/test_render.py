"""Tests pictures: colours, orientation, size, animation, window."""

import numpy as np
import pytest
import torch
from PIL import Image

from emberlink.envs import WildfireConfig, WildfireEnv
from emberlink.envs.rendering import frame
from emberlink.envs.rendering.window import Window

BLACK, WHITE, YELLOW, BLUE = (0, 0, 0), (255, 255, 255), (255, 255, 0), (0, 0, 255)


def picture(fire=(), positions=(), grid=(30, 20), **options) -> np.ndarray:
    fire_map = np.zeros(grid, np.uint8)
    for i, j in fire:
        fire_map[i, j] = 2
    position = np.array(positions, np.float32).reshape(-1, 3)
    return frame.frame(fire_map, position, **{"view_angle": 30.0, **options})


def colour(image: np.ndarray, x: float, y: float, grid=(30, 20)) -> tuple[int, ...]:
    """Returns the colour at a position in cells."""
    scale = image.shape[1] / grid[0]
    row, column = int((grid[1] - 0.5 - y) * scale), int((x + 0.5) * scale)
    return tuple(image[row, column].tolist())


def test_colours():
    image = picture(fire=[(10, 5), (11, 5), (20, 15)], positions=[(10, 6, 4)])
    assert colour(image, 10, 6) == BLUE
    assert colour(image, 10, 5) == WHITE  # fire in view
    assert colour(image, 20, 15) == WHITE
    assert colour(image, 9, 7) == YELLOW
    assert colour(image, 12, 8) == YELLOW
    assert colour(image, 13, 9) == BLACK  # 3 > 4 tan 30
    assert colour(image, 25, 2) == BLACK
    assert colour(image, 10 + 2.2, 6) == YELLOW  # the view ends 2.309 away


def test_pictures_have_four_colours_only():
    positions = [(10, 6, 4), (11, 7, 3), (0, 0, 1), (29, 19, 4)]
    image = picture(fire=[(i, 6) for i in range(30)], positions=positions)
    assert {tuple(c) for c in image.reshape(-1, 3).tolist()} == {BLACK, WHITE, YELLOW, BLUE}


def test_seen_and_unseen_fire_look_the_same():
    seen, unseen = np.zeros((2, 9, 9), np.uint8)
    seen[3, 4], unseen[3, 4] = 1, 2
    nobody = np.zeros((0, 3), np.float32)
    assert np.array_equal(*(frame.frame(m, nobody, view_angle=30.0) for m in (seen, unseen)))


def test_x_points_to_the_right_and_y_upwards():
    image = picture(fire=[(29, 0)], positions=[(0, 19, 1)])
    height, width = image.shape[:2]
    assert tuple(image[height - 3, width - 3]) == WHITE
    assert tuple(image[2, width - 3]) == BLACK
    blue = np.argwhere((image == BLUE).all(-1))
    assert blue[:, 0].mean() < height / 10
    assert blue[:, 1].mean() < width / 10


def test_a_cell_fills_its_square():
    image = picture(fire=[(3, 4)], grid=(8, 8))
    rows, columns = np.nonzero((image == WHITE).all(-1))
    scale = 360 // 8
    assert (columns.min(), columns.max()) == (3 * scale, 4 * scale - 1)
    assert (rows.min(), rows.max()) == (3 * scale, 4 * scale - 1)  # row 3 from the top is y = 4


@pytest.mark.parametrize(
    ("grid", "shape"),
    [((30, 30), (360, 360, 3)), ((8, 16), (352, 176, 3)), ((256, 100), (200, 512, 3))],
)
def test_size(grid, shape):
    image = picture(grid=grid)
    assert image.shape == shape
    assert image.dtype == np.uint8


def test_a_uav_is_visible_on_the_largest_grid():
    image = picture(grid=(256, 256), positions=[(100, 100, 1)])
    assert (image == BLUE).all(-1).sum() >= 30


def test_the_width_of_the_view_follows_from_the_angle():
    for angle in (15.0, 30.0, 60.0):
        image = picture(positions=[(15, 10, 3)], view_angle=angle)
        width = 2 * 3 * np.tan(np.radians(angle)) * 12
        yellow = np.nonzero((image == YELLOW).all(-1))[1]
        assert np.ptp(yellow) == pytest.approx(min(width, 359), abs=2)


def test_the_environment_renders_one_of_its_members():
    fire = torch.full((2, 12, 12), torch.inf)
    fire[1, 2, 3] = 0
    env = WildfireEnv(2, WildfireConfig(grid=(12, 12), num_uavs=1), fire)
    env.reset(position=torch.tensor([[9.0, 9, 2]]))
    empty, burning = env.render(), env.render("rgb_array", env=1)
    assert colour(empty, 2, 3, (12, 12)) == BLACK
    assert colour(burning, 2, 3, (12, 12)) == WHITE
    assert colour(burning, 9, 9, (12, 12)) == BLUE
    with pytest.raises(ValueError, match=r"'ansi'.*'rgb_array'"):
        env.render("ansi")


def test_animation(tmp_path):
    frames = [picture(fire=[(3 + t, 5)], positions=[(2 * t, 6, 4)]) for t in range(7)]
    path = tmp_path / "episode.gif"
    frame.write_gif(path, iter(frames), fps=10)
    with Image.open(path) as film:
        assert film.n_frames == 7
        assert film.info["duration"] == 100
        assert film.info["loop"] == 0
        for index, expected in enumerate(frames):
            film.seek(index)
            assert np.array_equal(np.asarray(film.convert("RGB")), expected)


def test_an_animation_without_frames_is_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"none\.gif"):
        frame.write_gif(tmp_path / "none.gif", [])
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("error")
def test_window_shows_the_last_picture(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    window = Window("test")
    first, last = picture(positions=[(3, 3, 4)]), picture(positions=[(9, 9, 4)])
    assert window.show(first) is None
    assert window.show(last) is None
    assert np.array_equal(window._image.get_array(), last)
    other = Window("test")
    other.show(first)
    assert np.array_equal(window._image.get_array(), last)
    other.close()
    assert window._pyplot.fignum_exists(window._figure.number)
    window.close()


@pytest.mark.parametrize("altitude", [0.0, 1e-3, 0.1])
def test_a_view_smaller_than_a_pixel(altitude):
    assert colour(picture(positions=[(5, 5, altitude)]), 5, 5) == BLUE


def test_an_animation_keeps_colours_of_later_frames():
    frames = [np.full((4, 6, 3), shade, np.uint8) for shade in range(0, 250, 5)]
    frames[7][0, 0] = (1, 2, 250)
    images = [Image.fromarray(original).quantize(256) for original in frames]
    shared = frame._share_palette(images)
    assert len({bytes(image.getpalette()) for image in shared}) == 1
    for image, original in zip(shared, frames, strict=True):
        assert np.array_equal(np.asarray(image.convert("RGB")), original)
