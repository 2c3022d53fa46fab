"""Random numbers as a pure function of a key, a counter and a position.

A `torch.Generator` is one sequence for a whole batch, so the draws of one environment would depend
on the number of environments and on the device. Here every draw is a hash of a key: the same on
every device and for any batch, without a state to carry or to save. Keys are int64 tensors; a key
is derived from another with `fold_in`.
"""

from collections.abc import Sequence
from enum import IntEnum, unique

import torch
from torch import Tensor

from emberlink.envs.utils.errors import UserError

_GOLDEN = -0x61C8864680B583EB  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_MIX_A = -0x40A7B892E31B1A47  # 0xBF58476D1CE4E5B9
_MIX_B = -0x6B2FB644ECCEEE15  # 0x94D049BB133111EB


@unique
class Use(IntEnum):
    """The purposes that random numbers are drawn for; each has a number of its own.

    Numbers from 500 to 999 are left to other packages, as the `use` of `step_key`.
    """

    # of an episode's key, with `fold_in`
    START_POSITION = 0
    EPISODE_FIRE = 1
    STEPS = 2
    # of a step, with `step_key`
    WAYPOINT = 100
    TARGET_JITTER = 101
    MESSAGE_LOSS = 102
    FIRST_WAYPOINT_REDRAW = 103
    SCRIPTED_WAYPOINT = 200
    SCRIPTED_ACTION = 201
    EXPLORATION_NOISE = 300
    # of a seed, with `fold_in`, beside its environments' indices
    FIRE_PARAMETER = 0xF12E
    REPLAY_SAMPLE = 2**40
    TARGET_NOISE = 2**40 + 1


def _shift(x: Tensor, bits: int) -> Tensor:
    """Shifts right logically; torch's `>>` on int64 copies the sign."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    """Applies the finaliser of SplitMix64 (Steele, Lea and Flood 2014, OOPSLA, figure 17)."""
    x = (x ^ _shift(x, 30)) * _MIX_A
    x = (x ^ _shift(x, 27)) * _MIX_B
    return x ^ _shift(x, 31)


def _signed(value: int) -> int:
    """Wraps a Python integer to a signed 64-bit one, as tensors wrap by themselves."""
    return (value + 2**63) % 2**64 - 2**63


def fold_in(key: Tensor, counter: Tensor | int) -> Tensor:
    """Returns a new key from a key and a counter.

    Args:
        key: int64, any shape.
        counter: int64 or an integer, broadcast against `key`.

    Returns:
        int64 of the broadcast shape; different counters give unrelated keys.
    """
    offset = (counter + 1) * _GOLDEN
    if isinstance(offset, int):
        offset = _signed(offset)
    return _mix(_mix(key + _GOLDEN) + offset)


def step_key(key: Tensor, step: Tensor, use: int | Tensor) -> Tensor:
    """Returns the key for one purpose at one step of an episode.

    Args:
        key: of the episode's steps (`keys.RNG_KEY`), int64 [...].
        step: int64 [...].
        use: a `Use` below 1000; purposes with the same number would draw the same numbers.
    """
    return fold_in(key, step * 1000 + use)


def seed_keys(seed: int, count: int, device: torch.device | str | None = None) -> Tensor:
    """Returns one key per environment: int64 [count], of which key i depends on (seed, i) alone."""
    root = torch.full((count,), seed, dtype=torch.int64, device=device)
    return fold_in(root, torch.arange(count, device=device))


def check_seeds(seed: int | Sequence[int], num_envs: int) -> list[int]:
    """Returns one or several seeds as a list.

    Raises:
        UserError: a negative seed, or a number of environments that the seeds cannot share evenly.
    """
    seeds = list(seed) if isinstance(seed, Sequence) else [int(seed)]
    if min(seeds, default=-1) < 0:
        raise UserError(f"seed={seed}: a number that is not negative is needed")
    if num_envs % len(seeds):
        raise UserError(f"num_envs={num_envs} is no multiple of the {len(seeds)} seeds")
    return seeds


def _bits(key: Tensor, count: int) -> Tensor:
    """Returns `count` times 64 random bits per key, int64 [..., count]."""
    return fold_in(key.unsqueeze(-1), torch.arange(count, device=key.device))


def integers(key: Tensor, count: int, limit: int | Tensor) -> Tensor:
    """Returns whole numbers from 0 to limit - 1, all equally likely to within limit / 2³².

    Args:
        key: int64 [...].
        count: numbers per key.
        limit: at most 2³¹.

    Returns:
        int64 [..., count].
    """
    return (_shift(_bits(key, count), 32) * limit) >> 32


def uniform(key: Tensor, count: int) -> Tensor:
    """Returns uniform numbers from (0, 1), both ends excluded.

    Args:
        key: int64 [...].
        count: numbers per key.

    Returns:
        float32 [..., count]: odd multiples of 2⁻²⁴.
    """
    return (_shift(_bits(key, count), 41).to(torch.float32) + 0.5) * 2.0**-23


def normal(key: Tensor, count: int) -> Tensor:
    """Returns standard normal numbers, float32 [..., count], by inversion of `uniform`."""
    return torch.special.ndtri(uniform(key, count))
