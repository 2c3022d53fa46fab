"""Counts the burning cells at each step."""

import torch
from torch import Tensor


def burning_cells(arrival: Tensor, horizon: int) -> Tensor:
    """Returns the number of burning cells at steps 0 to `horizon`, int64 [fires, horizon + 1]."""
    step = arrival.flatten(1).ceil().clamp(0, horizon + 1).long()
    zeros = step.new_zeros(len(step), horizon + 2)
    return zeros.scatter_add(1, step, torch.ones_like(step)).cumsum(1)[:, :-1]
