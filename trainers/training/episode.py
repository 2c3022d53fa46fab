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
    """Records the measures and losses of an episode for all seeds.

    Args:
        teams: number of seeds that are trained in parallel.
    """

    def __init__(self, teams: int):
        self.teams = teams
        self.steps: list[TensorDictBase] = []
        """measured tensors of each rollout, batch size [environments, steps]"""
        self.losses: dict[str, list[Tensor]] = {}
        """losses of each update by name, [seeds * uavs]"""

    def add(self, rollout: TensorDictBase, losses: list[Losses]) -> None:
        """Adds a rollout and the losses of the updates that followed it."""
        self.steps.append(rollout.get("next").select(*metrics.STEP_KEYS, strict=False).clone())
        for update in losses:
            for name, value in update.items():
                self.losses.setdefault(name, []).append(value)

    def clear(self) -> None:
        """Removes all records, at the beginning of an episode."""
        self.steps, self.losses = [], {}

    def measures(self) -> list[dict[str, float]]:
        """Returns the episode's measures and mean losses by name, for each seed."""
        episode: Any = torch.cat(cast(Any, self.steps), dim=1)
        table = {
            name: value.unflatten(0, (self.teams, -1)).mean(1)
            for name, value in metrics.episode_metrics(episode).items()
        }
        values = {name: column.tolist() for name, column in (table | self._mean_losses()).items()}
        return [
            {name: column[team] for name, column in values.items()} for team in range(self.teams)
        ]

    def _mean_losses(self) -> dict[str, Tensor]:
        """Returns the means of losses over updates and UAVs, [teams] each."""
        means: dict[str, Tensor] = {}
        for count in dict.fromkeys(len(values) for values in self.losses.values()):
            # Losses with equal numbers of updates share one sum: its order affects the last digit.
            names = sorted(name for name, v in self.losses.items() if len(v) == count)
            stacked = torch.stack([torch.stack(self.losses[name]) for name in names], dim=1)
            of_uavs = stacked.mean(0).unflatten(1, (self.teams, -1))
            means |= {f"loss_{name}": of_uavs.mean(2)[k] for k, name in enumerate(names)}
        return dict(sorted(means.items()))

    def state_dict(self) -> dict[str, Tensor]:
        """Returns all records by name."""
        steps: Any = torch.cat(cast(Any, self.steps), dim=1) if self.steps else None
        losses = {name: torch.stack(values) for name, values in self.losses.items()}
        return prefixed(steps=flatten(steps) if self.steps else {}, losses=losses)

    def load_state_dict(self, state: Mapping[str, Tensor], device: torch.device | str) -> None:
        """Restores the records of `state_dict`."""
        steps = group(state, "steps")
        self.steps = [unflatten(steps, 2, device)] if steps else []
        self.losses = {
            name: list(values.to(device).unbind(0))
            for name, values in group(state, "losses").items()
        }
