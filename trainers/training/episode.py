"""Records the measures and losses of the current episode."""

from collections.abc import Mapping
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import metrics
from emberlink.trainers.learners.base import Losses
from emberlink.trainers.learners.tensors import flatten, group, prefixed, unflatten


class EpisodeRecord:
    """Records the measures and losses of an episode."""

    def __init__(self):
        self.clear()

    def add(self, rollout: TensorDictBase, losses: list[Losses]) -> None:
        """Adds a rollout and the losses of the updates that followed it."""
        self.steps.append(metrics.measured_steps(rollout.get("next")).clone())
        for update in losses:
            for name, value in update.items():
                self.losses.setdefault(name, []).append(value)

    def clear(self) -> None:
        """Removes all records, at the beginning of an episode."""
        self.steps: list[TensorDictBase] = []
        """measured tensors of each rollout, batch size [environments, steps]"""
        self.losses: dict[str, list[Tensor]] = {}
        """losses of each update by name, [uavs]"""

    def measures(self) -> dict[str, float]:
        """Returns the episode's measures and mean losses by name."""
        episode: Any = torch.cat(cast(Any, self.steps), dim=1)
        measured = metrics.episode_metrics(episode)
        # Means over updates and UAVs.
        losses = {f"loss_{name}": torch.stack(self.losses[name]) for name in sorted(self.losses)}
        return {name: value.mean().item() for name, value in (measured | losses).items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Returns all records by name."""
        joined: Any = torch.cat(cast(Any, self.steps), dim=1) if self.steps else None
        steps = flatten(joined) if self.steps else {}
        losses = {name: torch.stack(values) for name, values in self.losses.items()}
        return prefixed(steps=steps, losses=losses)

    def load_state_dict(self, state: Mapping[str, Tensor], device: torch.device | str) -> None:
        """Restores the records of `state_dict`."""
        steps = group(state, "steps")
        self.steps = [unflatten(steps, 2, device)] if steps else []
        losses = group(state, "losses").items()
        self.losses = {name: list(values.to(device).unbind(0)) for name, values in losses}
