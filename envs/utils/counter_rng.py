"""Random numbers as a pure function of a key: one independent stream per environment.

A `torch.Generator` is one sequence for a whole batch, so an environment's draws would depend on
how many others run beside it, and on the device. Here a draw is a hash of (stream, counter,
lane): the same on every device, for any batch, with no state to carry or to save.
"""

import torch
from torch import Tensor

_GOLDEN = -0x61C8864680B583EB  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_MIX_A = -0x40A7B892E31B1A47  # 0xBF58476D1CE4E5B9
_MIX_B = -0x6B2FB644ECCEEE15  # 0x94D049BB133111EB


def _shift(x: Tensor, bits: int) -> Tensor:
    """Logical right shift; torch's `>>` on int64 copies the sign."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014, OOPSLA, figure 17)."""
    x = (x ^ _shift(x, 30)) * _MIX_A
    x = (x ^ _shift(x, 27)) * _MIX_B
    return x ^ _shift(x, 31)


def _signed(value: int) -> int:
    """A Python integer wrapped to a signed 64-bit one, as tensors wrap by themselves."""
    return (value + 2**63) % 2**64 - 2**63


def fold(stream: Tensor, counter: Tensor | int) -> Tensor:
    """A new stream from a stream and a counter.

    Args:
        stream: int64, any shape.
        counter: int64 or an integer, broadcast against `stream`.

    Returns:
        int64 of the broadcast shape; different counters give unrelated streams.
    """
    offset = (counter + 1) * _GOLDEN
    if isinstance(offset, int):
        offset = _signed(offset)
    return _mix(_mix(stream + _GOLDEN) + offset)


def at(stream: Tensor, step: Tensor, use: int) -> Tensor:
    """The stream of one use at one step of an episode.

    Args:
        stream: of the episode, int64 [...].
        step: int64 [...].
        use: what for, below 1000; every use has numbers of its own.
    """
    return fold(stream, step * 1000 + use)


def streams(seed: int, count: int, device: torch.device | str | None = None) -> Tensor:
    """One stream per environment: int64 [count], stream i depends on (seed, i) alone."""
    root = torch.full((count,), seed, dtype=torch.int64, device=device)
    return fold(root, torch.arange(count, device=device))


def _lanes(stream: Tensor, lanes: int) -> Tensor:
    """64 random bits per stream and lane, int64 [..., lanes]."""
    return fold(stream.unsqueeze(-1), torch.arange(lanes, device=stream.device))


def integers(stream: Tensor, lanes: int, limit: int | Tensor) -> Tensor:
    """Whole numbers 0 ... limit - 1, all equally likely to within limit / 2³².

    Args:
        stream: int64 [...].
        lanes: how many numbers per stream.
        limit: at most 2³¹.

    Returns:
        int64 [..., lanes].
    """
    return (_shift(_lanes(stream, lanes), 32) * limit) >> 32


def uniform(stream: Tensor, lanes: int) -> Tensor:
    """Uniform numbers on (0, 1), both ends left out.

    Args:
        stream: int64 [...].
        lanes: how many numbers per stream.

    Returns:
        float32 [..., lanes]: odd multiples of 2⁻²⁴.
    """
    return (_shift(_lanes(stream, lanes), 41).to(torch.float32) + 0.5) * 2.0**-23


def normal(stream: Tensor, lanes: int) -> Tensor:
    """Standard normal numbers, float32 [..., lanes], by inversion of `uniform`."""
    return torch.special.ndtri(uniform(stream, lanes))
