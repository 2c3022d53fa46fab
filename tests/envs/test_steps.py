"""Compares the batched environment with the scalar one and checks invariants of a step."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scalar_wildfire import ScalarWildfire
from tensordict import TensorDict

from emberlink.envs import RewardConfig, WildfireConfig, WildfireEnv, keys

ENVS, STEPS = 4, 315
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


@pytest.mark.slow
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
    config = WildfireConfig(grid=grid, num_uavs=uavs, horizon=STEPS, reward=reward, **shared)
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
            assert td[keys.SEEN][e].item() == scalar.seen()
            assert td[keys.BURNING][e].item() == scalar.burning()
    assert left > 100, "the actions were to push out of the box"


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    grid=st.tuples(st.integers(8, 40), st.integers(8, 40)),
    uavs=st.integers(1, 16),
    view_angle=st.floats(0.5, 80),
    altitude=st.tuples(st.floats(0.1, 20), st.floats(0.1, 20)).map(
        lambda pair: tuple(sorted(pair))
    ),
    displacement=st.floats(0.01, 20),
    observation_scale=st.sampled_from(["raw", "box"]),
    seed=st.integers(0, 2**31 - 1),
)
def test_invariants_of_every_step(seed, grid, uavs, **changes):
    generator = torch.Generator().manual_seed(seed)
    fire = torch.rand(*grid, generator=generator) * 8 - 1
    config = WildfireConfig(grid=grid, num_uavs=uavs, horizon=6, **changes)
    env = WildfireEnv(2, config, fire, seed)
    env.reset()
    low, high = (torch.tensor(corner) for corner in (config.low, config.high))
    before = env.fire_map
    for _ in range(4):
        action = torch.randn(2, uavs, 3, generator=generator)
        td = env.step(TensorDict({keys.ACTION: action}, [2]))["next"]
        after = env.fire_map
        assert (after[before > 0] > 0).all(), "a burning cell went out"
        assert (after[before == 1] == 1).all(), "a seen cell was forgotten"
        assert ((after > 0) == (fire <= td[keys.STEP][:, None, None])).all()
        assert (td[keys.SEEN] == (after == 1).sum((1, 2))).all()
        assert (td[keys.BURNING] == (after > 0).sum((1, 2))).all()
        new = td[keys.NEW_FIRE]
        assert (new.sum(-1) == ((after == 1) & (before != 1)).sum((1, 2))).all()
        position = td[keys.POSITION]
        assert ((position >= low) & (position <= high)).all()
        total = new + td[keys.OLD_FIRE] + td[keys.NO_FIRE]
        assert torch.equal(total, cells_in_view(position, config))
        assert all(value.isfinite().all() for value in td.values(True, True))
        before = after


def cells_in_view(position: torch.Tensor, config: WildfireConfig) -> torch.Tensor:
    """Returns the number of cells in view, columns times rows, int64 [..., n]."""
    radius = position[..., 2:].double() * math.tan(math.radians(config.view_angle))
    sides = [
        ((torch.arange(side) - position[..., axis, None].double()).abs() <= radius).sum(-1)
        for axis, side in enumerate(config.grid)
    ]
    return sides[0] * sides[1]


def test_the_largest_world_runs():
    config = WildfireConfig(grid=(256, 256), num_uavs=64, horizon=5)
    env = WildfireEnv(2, config, "paper")
    steps = env.rollout(5)
    assert steps.batch_size == (2, 5)
    assert steps["next"][keys.REWARD].isfinite().all()
    assert (steps["next"][keys.BURNING] > 77).all()


def test_the_widest_view_covers_the_whole_grid():
    config = WildfireConfig(grid=(8, 256), num_uavs=1, altitude=(256.0, 256.0), view_angle=80.0)
    env = WildfireEnv(1, config, torch.zeros(8, 256))
    td = env.rollout(1)["next"]
    assert td[keys.NEW_FIRE].item() == 8 * 256
    assert td[keys.SEEN].item() == td[keys.BURNING].item() == 8 * 256
