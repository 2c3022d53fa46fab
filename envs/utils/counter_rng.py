"""Generates random numbers as a pure function of a key and a counter.

A `torch.Generator` produces one sequence for a whole batch, so the random numbers of an environment
would depend on the number of environments and on the device. Here, random numbers are hashes of a
key. They are the same on every device and for any batch size, and there is no state to save. Keys
are int64 tensors; `fold_in` derives a key from another.
"""

from collections.abc import Sequence
from enum import IntEnum, unique
from operator import index

import torch
from torch import Tensor

from emberlink.envs.utils.errors import UserError

_GOLDEN = -0x61C8864680B583EB  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_MIX_A = -0x40A7B892E31B1A47  # 0xBF58476D1CE4E5B9
_MIX_B = -0x6B2FB644ECCEEE15  # 0x94D049BB133111EB


@unique
class Use(IntEnum):
    """The purposes of random numbers, each with a unique number.

    Numbers from 500 to 999 are reserved for the `use` of `step_key` in other packages.
    """

    # for `fold_in` with an episode's key
    START_POSITION = 0
    EPISODE_FIRE = 1
    STEPS = 2
    FAILURE = 3
    # for `step_key`
    WAYPOINT = 100
    TARGET_JITTER = 101
    MESSAGE_LOSS = 102
    FIRST_WAYPOINT_REDRAW = 103
    REPORT_LOSS = 104
    RECOGNITION = 105
    MESSAGE_FADE = 106
    REPORT_FADE = 107
    SCRIPTED_WAYPOINT = 200
    SCRIPTED_ACTION = 201
    TEACHER = 301
    # for `fold_in` with the seed of a fire
    FIRE_PARAMETER = 0xF12E


def _shift(x: Tensor, bits: int) -> Tensor:
    """Shifts right logically; torch's `>>` on int64 is arithmetic."""
    return (x >> bits).bitwise_and_((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    """Applies the finaliser of SplitMix64 (Steele, Lea and Flood 2014, OOPSLA, figure 17)."""
    x = _shift(x, 30).bitwise_xor_(x).mul_(_MIX_A)
    x = _shift(x, 27).bitwise_xor_(x).mul_(_MIX_B)
    return _shift(x, 31).bitwise_xor_(x)


def fold_in(key: Tensor, counter: Tensor | int) -> Tensor:
    """Returns a key for each key and counter, int64 of their broadcast shape.

    Different counters give statistically independent keys.
    """
    offset = (counter + 1) * _GOLDEN
    if isinstance(offset, int):  # wrapped to signed 64 bits, as int64 tensors are
        offset = (offset + 2**63) % 2**64 - 2**63
    return _mix(_mix(key + _GOLDEN) + offset)


def step_key(key: Tensor, step: Tensor, use: int | Tensor) -> Tensor:
    """Returns the key for a use, below 1000, at a step of the episode of a `keys.RNG_KEY`."""
    return fold_in(key, step * 1000 + use)


def seed_keys(seed: int, count: int, device: torch.device | str | None = None) -> Tensor:
    """Returns one key per environment, int64 [count]; key i depends only on the seed and i."""
    root = torch.full((count,), seed, dtype=torch.int64, device=device)
    return fold_in(root, torch.arange(count, device=device))


def check_seeds(seed: int | Sequence[int], num_envs: int) -> list[int]:
    """Returns one or several seeds as a list; `num_envs` is a multiple of their number."""
    seeds = [index(number) for number in (seed if isinstance(seed, Sequence) else [seed])]
    for number in seeds:
        if not 0 <= number < 2**63:
            raise UserError(f"seed={number}: expected a whole number from 0 to 2^63 - 1")
    if not seeds or num_envs % len(seeds):
        raise UserError(f"num_envs={num_envs} is not a multiple of the {len(seeds)} seeds")
    return seeds


def uniform(key: Tensor, count: int) -> Tensor:
    """Returns `count` numbers per key, uniform in (0, 1): odd multiples of 2⁻²⁴, float32."""
    bits = fold_in(key.unsqueeze(-1), torch.arange(count, device=key.device))
    return _shift(bits, 41).to(torch.float32).add_(0.5).mul_(2.0**-23)


def normal(key: Tensor, count: int) -> Tensor:
    """Returns `count` standard normal numbers per key, by inverse transform of `uniform`."""
    return torch.special.ndtri(uniform(key, count))
