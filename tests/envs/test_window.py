"""Compares the window observation with an independent scalar re-implementation."""

import math
import random

import pytest
import torch
from scalar_wildfire import ScalarWildfire
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.trainers import make_env

CLASSES = ("new_fire", "old_fire", "no_fire")


class ScalarWindow(ScalarWildfire):
    """Computes the class of each cell in view, by its offset from the cell nearest to the UAV."""

    def look(self, n):
        x, y, z = (float(c) for c in self.position[n])
        radius = z * self.slope
        view = {}
        for i in range(len(self.fire)):
            for j in range(len(self.fire[0])):
                if abs(i - x) <= radius and abs(j - y) <= radius:
                    view[i - round(x), j - round(y)] = ("no_fire", "old_fire", "new_fire")[
                        self.fire[i][j]
                    ]
        self.views = {**getattr(self, "views", {}), n: view}
        return super().look(n)


def cells(window: torch.Tensor) -> dict[tuple[int, int], str]:
    """Returns the classes of the marked cells by their offset, from bool [3, W, W]."""
    middle = window.shape[-1] // 2
    marked = window.nonzero().tolist()
    assert len({(i, j) for _, i, j in marked}) == len(marked), "a cell has one class"
    return {(i - middle, j - middle): CLASSES[place] for place, i, j in marked}


def environment(fire, *, num_envs=1, **changes) -> WildfireEnv:
    settings = {"grid": tuple(fire.shape[-2:]), "horizon": 40, "observation": "window", **changes}
    return WildfireEnv(num_envs, WildfireConfig(**settings), fire, seed=0)


@pytest.mark.parametrize("altitude", [(1.0, 4.0), (0.5, 0.5), (3.3, 9.7), (2.0, 40.0)])
@pytest.mark.parametrize("grid", [(12, 9), (8, 16)])
def test_windows_equal_a_scalar_program(altitude, grid):
    draw = random.Random(repr((altitude, grid)))
    arrival = [
        [draw.choice([0, 2.5, 7, 15, math.inf]) for _ in range(grid[1])] for _ in range(grid[0])
    ]
    uavs, displacement = 5, 1.7
    env = environment(
        torch.tensor(arrival), num_uavs=uavs, altitude=altitude, displacement=displacement
    )
    corners = [
        [a, b, altitude[c]] for a in (0, grid[0] - 1) for b in (0, grid[1] - 1) for c in (0, 1)
    ]
    position = torch.tensor([corners[draw.randrange(8)] for _ in range(uavs)], dtype=torch.float32)
    env.reset(position=position)
    scalar = ScalarWindow(
        arrival,
        position.tolist(),
        displacement=displacement,
        view_angle=30.0,
        altitude=altitude,
        rewards=(1, -4, -10, -100),
        exit_axes="xyz",
    )
    for _ in range(40):
        action = torch.tensor([[draw.uniform(-1.2, 1.2) for _ in range(3)] for _ in range(uavs)])
        following = env.step(TensorDict({keys.ACTION: action[None]}, [1]))["next"]
        scalar.step(action.tolist())
        for uav in range(uavs):
            assert cells(following[keys.WINDOW][0, uav]) == scalar.views[uav]


def test_uav_0_has_priority_for_new_fire_and_the_margin_is_empty():
    env = environment(torch.zeros(12, 12), num_uavs=2)  # 4 tan 30 = 2.3: a window of 5 x 5
    env.reset(position=torch.tensor([[0.0, 11, 4], [1, 11, 4]]))
    window = env.step(TensorDict({keys.ACTION: torch.zeros(1, 2, 3)}, [1]))["next"][keys.WINDOW][0]
    new, old, none = window[0].unbind()
    assert new.nonzero().tolist() == [[i, j] for i in (2, 3, 4) for j in (0, 1, 2)]
    assert not old.any()
    assert not none.any()
    new, old, none = window[1].unbind()
    assert new.nonzero().tolist() == [[4, j] for j in (0, 1, 2)]
    assert old.nonzero().tolist() == [[i, j] for i in (1, 2, 3) for j in (0, 1, 2)]
    assert not none.any()


@pytest.mark.filterwarnings("error")
def test_specs_and_reset():
    env = environment(torch.rand(3, 9, 12), num_envs=3, num_uavs=2)
    check_env_specs(env)
    reset = env.reset()
    assert reset[keys.WINDOW].shape == (3, 2, 3, 5, 5)
    assert reset[keys.WINDOW].dtype == torch.bool
    assert not reset[keys.WINDOW].any()


@pytest.mark.parametrize("method", ["positional", "consensus"])
def test_recipes_keep_the_window(method):
    fire = torch.rand(9, 12) * 30
    env = make_env(method, num_envs=2, fire=fire, horizon=10, **{"env.observation": "window"})
    check_env_specs(env)
    assert keys.WINDOW in env.rollout(3)["next"].keys(True)


def test_counts_equal_the_sums_of_the_windows():
    steps = environment(torch.rand(4, 16, 9) * 30, num_envs=4, num_uavs=3).rollout(40)["next"]
    sums = steps[keys.WINDOW].sum((-1, -2))
    counts = torch.stack([steps[k] for k in (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE)], -1)
    assert sums.equal(counts)


def test_the_window_does_not_change_other_entries():
    fire = torch.rand(2, 12, 9) * 30
    action = torch.rand(20, 2, 3, 3) * 2 - 1
    window, vector = (
        environment(fire, num_envs=2, num_uavs=3, observation=kind) for kind in ("window", "vector")
    )
    first, second = window.reset(), vector.reset()
    assert keys.WINDOW not in second.keys(True)
    assert (first.exclude(keys.WINDOW) == second).all()
    for push in action:
        first = window.step(TensorDict({keys.ACTION: push}, [2]))["next"]
        second = vector.step(TensorDict({keys.ACTION: push}, [2]))["next"]
        assert (first.exclude(keys.WINDOW) == second).all()


def test_observation_keys_are_in_a_fixed_order():
    fire = torch.zeros(12, 9)
    both = keys.observation_keys(environment(fire).observation_spec)
    assert both == [keys.OBSERVATION, keys.WINDOW]
    alone = keys.observation_keys(environment(fire, observation="vector").observation_spec)
    assert alone == [keys.OBSERVATION]
