"""Compares the batched environment with the scalar one and checks invariants of a step."""

import math

import numpy as np
import pytest
import torch
from scalar_wildfire import NEW_FIRE, NO_FIRE, OLD_FIRE, ScalarWildfire
from tensordict import TensorDict

from emberlink.envs import RewardConfig, WildfireConfig, WildfireEnv, keys

ENVS, STEPS = 2, 150
PAPER = (1.0, -4.0, -10.0, -100.0), "xyz"
RELEASED = (12.0, 6.0, -4.0, -150.0), "xy"
TUNED = (0.3, 0.0, 0.0, -1.5), "xyz"
CASES = [  # grid, UAVs, displacement, view angle, altitude, reward
    ((30, 30), 6, 1.0, 30.0, (1.0, 4.0), PAPER),
    ((30, 30), 6, 0.1, 30.0, (1.0, 4.0), RELEASED),
    ((30, 30), 6, 0.1, 30.0, (1.0, 4.0), TUNED),
    ((8, 20), 12, 1.0, 30.0, (1.0, 4.0), RELEASED),
    ((17, 9), 1, 1.0, 45.0, (0.5, 6.0), PAPER),
    ((12, 12), 12, 0.1, 20.0, (2.0, 2.0), PAPER),
    ((8, 8), 3, 1.0, 70.0, (3.3, 5.7), TUNED),
    ((25, 40), 5, 0.37, 36.86989764584402, (1.0, 4.0), RELEASED),
]


def random_fire(grid: tuple[int, int], generator: torch.Generator) -> torch.Tensor:
    """Returns fires: a third of the cells burns at 0, a third later, a third never."""
    kind = torch.randint(3, (ENVS, *grid), generator=generator)
    time = torch.rand(ENVS, *grid, generator=generator) * STEPS
    time = torch.where(time > STEPS / 2, time.round(), time)
    return torch.where(kind == 0, 0.0, torch.where(kind == 1, time, math.inf))


def random_actions(uavs: int, generator: torch.Generator) -> torch.Tensor:
    """Returns [STEPS, ENVS, uavs, 3]: noise around slowly turning values, partly beyond [-1, 1]."""
    wish = 2 * torch.rand(STEPS // 15 + 1, ENVS, uavs, 3, generator=generator) - 1
    noise = torch.randn(STEPS, ENVS, uavs, 3, generator=generator)
    return wish.repeat_interleave(15, 0)[:STEPS] + 0.5 * noise


def cells(window: torch.Tensor) -> dict[tuple[int, int], int]:
    """Returns the classes of the marked cells by their offset, from bool [3, W, W]."""
    middle = window.shape[-1] // 2
    marked = window.nonzero().tolist()
    assert len({(i, j) for _, i, j in marked}) == len(marked), "a cell has one class"
    kinds = NEW_FIRE, OLD_FIRE, NO_FIRE
    return {(i - middle, j - middle): kinds[place] for place, i, j in marked}


@pytest.mark.parametrize("case", range(len(CASES)))
def test_equals_the_scalar_environment(case):
    grid, uavs, displacement, view_angle, altitude, (worth, exit_axes) = CASES[case]
    generator = torch.Generator().manual_seed(case)
    fire, actions = random_fire(grid, generator), random_actions(uavs, generator)
    shared = {"displacement": displacement, "view_angle": view_angle, "altitude": altitude}
    new, old, none, leaving = worth
    reward = RewardConfig(
        new_fire=new, old_fire=old, no_fire=none, exit=leaving, exit_axes=exit_axes
    )
    config = WildfireConfig(
        grid=grid, num_uavs=uavs, horizon=STEPS, reward=reward, observation="window", **shared
    )
    env = WildfireEnv(ENVS, config, fire, seed=case)
    position = env.reset()[keys.POSITION].tolist()
    scalars = [
        ScalarWildfire(arrival, start, rewards=worth, exit_axes=exit_axes, **shared)
        for arrival, start in zip(fire.tolist(), position, strict=True)
    ]
    left = 0
    for step in range(STEPS):
        td = env.step(TensorDict({keys.ACTION: actions[step]}, [ENVS]))["next"]
        maps, acted = env.fire_map.numpy(), actions[step].tolist()
        classes = torch.stack([td[k] for k in (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE)], -1)
        for e, scalar in enumerate(scalars):
            counts, exits, rewards = scalar.step(acted[e])
            left += sum(map(any, exits))
            assert np.array_equal(td[keys.POSITION][e].numpy(), scalar.position)
            assert np.array_equal(maps[e], scalar.fire)
            assert classes[e].tolist() == [list(c) for c in counts]
            assert td[keys.HIT_BOUNDARY][e].tolist() == exits
            assert td[keys.REWARD][e, :, 0].tolist() == pytest.approx(rewards, abs=1e-5, rel=0)
            for uav, view in scalar.views.items():
                assert cells(td[keys.WINDOW][e, uav]) == view
            assert td[keys.SEEN][e].item() == scalar.seen()
            assert td[keys.BURNING][e].item() == scalar.burning()
    assert left > 50, "the actions were to push out of the box"
