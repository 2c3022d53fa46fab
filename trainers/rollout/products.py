"""Chooses the library of float32 matrix products on the CPU."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor

_UNSET = "none"
_SIZE = 256
_TOLERANCE = 1e-5
"""largest error of a float32 product over the largest entry; that of bfloat16 is above 1e-3"""


@contextmanager
def fast_products() -> Iterator[None]:
    """Computes float32 products with oneDNN within a `with` block, where they stay float32.

    By default, torch computes them with MKL, which does not use AVX-512 on processors of AMD;
    oneDNN does. torch hands float32 products to oneDNN only with the permission to round inputs to
    bfloat16. oneDNN rounds them on processors with AMX units, and computes in float32 on others.
    The permission is given only if an example shows no rounding, and withdrawn after the block. A
    precision that the program has chosen itself (`torch.set_float32_matmul_precision`,
    `torch.backends.mkldnn`) is kept.
    """
    if _settings().fp32_precision != _UNSET or not _stays_float32():
        yield
        return
    with _permitted():
        yield


def _settings() -> Any:
    return torch.backends.mkldnn.matmul  # pyright: ignore[reportAttributeAccessIssue]


@contextmanager
def _permitted() -> Iterator[None]:
    _settings().fp32_precision = "bf16"
    try:
        yield
    finally:
        _settings().fp32_precision = _UNSET


@cache
def _stays_float32() -> bool:
    """Returns whether oneDNN computes an example in float32 on this processor."""
    if not torch.backends.mkldnn.is_available():
        return False
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, _SIZE, _SIZE, dtype=torch.float32, generator=generator)
    with _permitted():
        product = a @ b
    return is_float32(product, a, b)


def is_float32(product: Tensor, a: Tensor, b: Tensor) -> bool:
    """Returns whether a product differs from that in float64 by float32 rounding only."""
    exact = a.double() @ b.double()
    return bool((product - exact).abs().max() < _TOLERANCE * exact.abs().max())
