"""Tests invariants of every step for random configurations and actions."""

import copy
import functools
import math

import numpy as np
import pytest
import torch
from robustness import SOAK

from emberlink.envs import keys
from emberlink.envs.utils.config_files import known
from emberlink.envs.world.coverage_map import with_burn_time
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import from_values, resolve, to_values

STEPS = 10_000_000 if SOAK else 40_000
"""environment steps in all"""
ENVS = 512 if SOAK else 64
METHODS, SETUPS = known("method"), known("setup")


@functools.cache
def recipe(method: str, setup: str) -> dict:
    return to_values(resolve(method, [f"setup={setup}"]))


def random_settings(rng: np.random.Generator) -> dict:
    """Returns a recipe with random valid values for all settings of the environment."""
    method, setup = str(rng.choice(METHODS)), str(rng.choice(SETUPS))
    values = copy.deepcopy(recipe(method, setup))
    altitude = np.sort(rng.choice([0.01, 0.5, 1.0, 3.3, 7.0, 40.0], 2))
    # Wide views from high altitude cover the whole map. This bounds the window, for speed.
    angle = float(rng.choice([0.01, 15.0, 30.0, 45.0, 80.0]))
    values["env"] |= {
        "grid": [int(side) for side in rng.choice([8, 9, 13, 24], 2)],
        "num_uavs": int(rng.choice([1, 2, 3, 7])),
        "horizon": int(rng.choice([1, 2, 9, 14])),
        "altitude": altitude.tolist(),
        "view_angle": angle,
        "displacement": float(rng.choice([1e-3, 0.1, 1.0, 5.5, 256.0])),
        "observation_scale": str(rng.choice(["raw", "box"])),
        "radio": {
            "range": float(rng.choice([0.0, 3.0, 10.0, math.inf])),
            "loss": float(rng.choice([0.0, 0.5, 1.0])),
        },
        "base": [None, [0.0, 0.0], [7.0, 3.5]][rng.integers(3)],
        "failures": float(rng.choice([0.0, 0.5, 1.0])),
        "measures": str(rng.choice(["paper", "all"])),
    }
    values["env"]["reward"] = {
        "exit_axes": str(rng.choice(["xyz", "xy"])),
        **{name: float(rng.normal(0, 50)) for name in ("new_fire", "old_fire", "no_fire", "exit")},
    }
    if values["comm"]["name"] == "consensus":
        heading = ["folded_linear", "folded_exponential", "linear", "approach"]
        values["comm"] |= {
            "discoverer": str(rng.choice(["new_fire", "any_fire"])),
            "jitter": float(rng.choice([0.0, 0.75, 1e6])),
            "target": str(rng.choice(["absolute", "relative"])),
            "agree": bool(rng.integers(2)),
            "follow": str(rng.choice(["best", "nearest"])),
            "wander": bool(rng.integers(2)),
            "redraw": [None, 1, 7][rng.integers(3)],
            "heading": {
                "form": str(rng.choice(heading)),
                "weight": float(rng.normal(0, 3)),
                "circle": float(rng.choice([0.0, 3.0])),
            },
        }
    return values


def random_fire(rng: np.random.Generator, config, generator: torch.Generator):
    """Returns random arrival times, shared or per environment, or the name of the scenario."""
    kind = rng.integers(6)
    shape = [*([ENVS] if rng.integers(2) else []), *config.env.grid]
    if kind == 0:
        return config.fire.__class__(**{**vars(config.fire), "num_train_fires": 2})
    if kind == 1:
        return torch.full(shape, math.inf)
    if kind == 2:
        return torch.zeros(shape)
    arrival = torch.rand(shape, generator=generator) * (config.env.horizon + 3)
    if kind == 3:
        return arrival.round() - 1  # burning since before the start, and at whole steps
    never = torch.rand(shape, generator=generator) < 0.5
    arrival = arrival.masked_fill(never, math.inf) if kind == 4 else -arrival * 1e30
    if rng.integers(2):
        return arrival
    each = arrival if arrival.ndim == 3 else arrival.unsqueeze(0)
    return with_burn_time(each, float(rng.choice([1.0, 2.5, 1e6])))


def random_actions(shape: torch.Size, generator: torch.Generator) -> torch.Tensor:
    """Returns actions, half of them valid, the others NaN, infinite, huge or just out of bounds."""
    odd = torch.tensor([math.nan, math.inf, -math.inf, 3e38, -3e38, 1.0001, -1.0, 1e-45, -0.0])
    sane = torch.rand(shape, generator=generator) * 2 - 1
    picked = odd[torch.randint(len(odd), shape, generator=generator)]
    return torch.where(torch.rand(shape, generator=generator) < 0.5, sane, picked)


def footprint(position: torch.Tensor, config) -> torch.Tensor:
    """Returns the cells of the grid within |i - x| <= z tan(angle), |j - y| <= z tan(angle)."""
    here = position.double()
    half = here[..., 2:] * math.tan(math.radians(config.view_angle))
    near = [
        ((torch.arange(side).double() - here[..., axis, None]).abs() <= half).sum(-1)
        for axis, side in enumerate(config.grid)
    ]
    return near[0] * near[1]


def check(td, before, env, config, looked: torch.Tensor) -> None:
    """Checks the invariants of a time step, and of the transition to it from `before`, if given.

    UAVs do not observe at a reset. `looked`, bool [ENVS], marks environments after a step.
    """
    world = env.base_env
    position = td[keys.POSITION]
    low, high = (torch.tensor(corner, dtype=torch.float32) for corner in (config.low, config.high))
    assert ((low <= position) & (position <= high)).all()
    new, old, none = (td[key] for key in (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE))
    assert (new >= 0).all()
    assert (old >= 0).all()
    assert (none >= 0).all()
    alive = td[keys.ALIVE]
    assert alive.all() or config.failures
    total = footprint(position, config) * looked[:, None] * alive
    assert torch.equal(new + old + none, total)
    now = td[keys.STEP][:, None, None]
    burnt, seen = world.arrival_time <= now, world._map.seen
    burning = burnt if world.burn_out is None else burnt & (now < world.burn_out)
    assert not (seen & ~burnt).any()
    assert torch.equal(td[keys.SEEN], seen.sum((1, 2)))
    assert torch.equal(td[keys.BURNING], burning.sum((1, 2)))
    assert torch.equal(td[keys.BURNT], burnt.sum((1, 2)))
    if config.base is not None:
        assert (td[keys.BASE_SEEN] <= td[keys.SEEN]).all()
    if config.base is not None and config.measures == "all":
        assert (td[keys.BASE_AGE] >= td[keys.FRONT_AGE]).all()
    if before is not None:
        assert (td[keys.BURNT] >= before[keys.BURNT]).all()
        assert not (alive & ~before[keys.ALIVE]).any()
        assert not td[keys.REWARD][~alive].any()
        assert torch.equal(td[keys.SEEN] - before[keys.SEEN], new.sum(1))
        assert torch.equal(td[keys.STEP], before[keys.STEP] + 1)
    for key, value in td.items(include_nested=True, leaves_only=True):
        if value.is_floating_point():
            assert value.isfinite().all(), key


def play(seed: int, steps: int) -> int:
    """Runs a random configuration for 1.5 episodes or more; returns the number of steps."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    config = from_values(random_settings(rng))
    fire = random_fire(rng, config, generator)
    env = build_env(config, num_envs=ENVS, fire=fire, seed=seed, device="cpu")
    td, before, taken = env.reset(), None, 0
    everywhere = torch.ones(ENVS, dtype=torch.bool)
    check(td, None, env, config.env, looked=~everywhere)
    for _ in range(steps):
        shape = torch.Size((ENVS, config.env.num_uavs, 3))
        td[keys.ACTION] = random_actions(shape, generator)
        before = td
        after = env.step(td)["next"]
        taken += ENVS
        check(after, before, env, config.env, looked=everywhere)
        assert torch.equal(after["done"].squeeze(-1), after[keys.STEP] >= config.env.horizon)
        again = after["done"].squeeze(-1) | (torch.rand(ENVS, generator=generator) < 0.05)
        td = after.exclude(keys.REWARD).clone()
        if again.any():
            td["_reset"] = again.unsqueeze(-1)
            td = env.reset(td)
            check(td, None, env, config.env, looked=~again)
            same = ~again
            assert torch.equal(td[keys.OBSERVATION][same], after[keys.OBSERVATION][same])
    return taken


def sweep(steps: int, first: int = 0) -> int:
    """Runs random configurations until the given number of environment steps is reached."""
    taken, seed = 0, first
    while taken < steps:
        taken += play(seed, steps=20)
        seed += 1
    return taken


@pytest.mark.heavy
@pytest.mark.parametrize("part", range(4))
def test_the_invariants_hold(part):
    assert sweep(STEPS // 4, first=1_000_000 * part) >= STEPS // 4
