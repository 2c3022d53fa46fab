"""Tests invariants of every step for random configurations and actions."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from robustness import SOAK
from test_config_fuzz import FUZZ, valid_values

from emberlink.envs import keys
from emberlink.envs.world.coverage_map import with_burn_time
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import from_values, to_values

ENVS = 512 if SOAK else 64


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
    recognised = new + old + none
    assert (recognised <= total).all()
    if config.sensor == (1, 1):
        assert torch.equal(recognised, total)
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
        gained = td[keys.SEEN] - before[keys.SEEN]
        # To a UAV's own knowledge, fire that others have seen is new.
        assert (gained <= new.sum(1)).all()
        if config.knowledge == "team":
            assert torch.equal(gained, new.sum(1))
        assert torch.equal(td[keys.STEP], before[keys.STEP] + 1)
    for key, value in td.items(include_nested=True, leaves_only=True):
        if value.is_floating_point():
            assert value.isfinite().all(), key


@pytest.mark.heavy
@FUZZ
@given(valid_values(), st.integers(0, 2**32))
def test_the_invariants_hold(values, seed):
    """Plays 1.5 episodes or more."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    config = from_values(values)
    assert to_values(config) == values  # no value was coerced or left out
    fire = random_fire(rng, config, generator)
    env = build_env(config, num_envs=ENVS, fire=fire, seed=seed, device="cpu")
    td, before = env.reset(), None
    everywhere = torch.ones(ENVS, dtype=torch.bool)
    check(td, None, env, config.env, looked=~everywhere)
    for _ in range(20):
        shape = torch.Size((ENVS, config.env.num_uavs, 3))
        td[keys.ACTION] = random_actions(shape, generator)
        before = td
        after = env.step(td)["next"]
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
