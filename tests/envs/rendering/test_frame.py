"""Tests pictures of an environment: colours, orientation, size, GIF, video, window."""

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ImageColor import getrgb

from emberlink.envs import WildfireConfig, WildfireEnv
from emberlink.envs.rendering import film
from emberlink.envs.rendering.frame import BASE, FAILED, UAV, frame
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import make_env

BLACK, WHITE, YELLOW, BLUE = (0, 0, 0), (255, 255, 255), (255, 255, 0), (0, 0, 255)


def picture(fire=(), positions=(), grid=(30, 20), **options) -> np.ndarray:
    fire_map = np.zeros(grid, np.uint8)
    for i, j in fire:
        fire_map[i, j] = 2
    position = np.array(positions, np.float32).reshape(-1, 3)
    return frame(fire_map, position, **{"view_angle": 30.0, **options})


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


def test_x_points_to_the_right_and_y_upwards():
    image = picture(fire=[(29, 0)], positions=[(0, 19, 1)])
    height, width = image.shape[:2]
    assert tuple(image[height - 3, width - 3]) == WHITE
    assert tuple(image[2, width - 3]) == BLACK
    blue = np.argwhere((image == BLUE).all(-1))
    assert blue[:, 0].mean() < height / 10
    assert blue[:, 1].mean() < width / 10


def test_the_environment_draws_one_of_its_members():
    fire = torch.full((2, 12, 12), torch.inf)
    fire[1, 2, 3] = 0
    env = WildfireEnv(2, WildfireConfig(grid=(12, 12), num_uavs=1), fire)
    env.reset(position=torch.tensor([[9.0, 9, 2]]))
    empty, burning = env.render(), env.render("rgb_array", env=1)
    assert colour(empty, 2, 3, (12, 12)) == BLACK
    assert colour(burning, 2, 3, (12, 12)) == WHITE
    assert colour(burning, 9, 9, (12, 12)) == BLUE
    with pytest.raises(UserError, match="ansi"):
        env.render("ansi")


@pytest.mark.heavy
def test_the_environment_draws_failed_uavs_and_the_base():
    env = make_env("consensus", "tuned", world="blackout", seed=1, num_train_fires=1)
    env.reset()
    env.base_env._fail_step.fill_(0)
    shown = {tuple(c) for c in env.base_env.render().reshape(-1, 3).tolist()}
    base, failed, uav = (getrgb(style["color"]) for style in (BASE, FAILED, UAV))
    assert {base, failed} <= shown
    assert not shown & {uav, YELLOW}


def test_a_gif_has_every_frame(tmp_path):
    frames = [picture(fire=[(3 + t, 5)], positions=[(2 * t, 6, 4)]) for t in range(7)]
    frames[5] = frames[5].copy()
    frames[5][0, 0] = (1, 2, 250)  # a colour that earlier frames lack
    path = tmp_path / "episode.gif"
    film.write_gif(path, iter(frames), fps=10)
    with Image.open(path) as shown:
        assert shown.n_frames == 7
        assert shown.info["duration"] == 100
        assert shown.info["loop"] == 0
        for index, expected in enumerate(frames):
            shown.seek(index)
            assert np.array_equal(np.asarray(shown.convert("RGB")), expected)
