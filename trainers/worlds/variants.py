"""Plays map_greedy with several radio ranges in one batch, which takes about half of the time."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys, metrics
from emberlink.envs.scenarios import fires_of
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.policies.planning import TeamMaps
from emberlink.policies.scripted.map_greedy import MapGreedy
from emberlink.trainers.build import build_env
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.evaluate import VALIDATION_START_SEED, play
from emberlink.trainers.evaluation.results import Measured

NO_RADIO, NO_LIMITS = 0.0, inf
"""ranges with which `map_greedy` is `map_greedy_alone` and `map_greedy_all`"""
_AT_ONCE = 100
"""environments in a batch, about"""


class RangedMapGreedy(MapGreedy):
    """Searches as `map_greedy`, with another range of the radio in each environment.

    Args:
        env: the environment that it acts in; without a base, so that only policies hear the radio.
        ranges: float [num_envs], cells; with `NO_LIMITS`, no message is lost either.
    """

    def __init__(self, env: WildfireEnv, ranges: Tensor):
        super().__init__(env)
        self.maps = _RangedMaps(env, ranges).to(env.device)


class _RangedMaps(TeamMaps):
    _ranges: Tensor

    def __init__(self, env: WildfireEnv, ranges: Tensor):
        super().__init__(env, "in range")
        self._radio = replace(env.config.radio, range=inf)
        self.register_buffer("_ranges", ranges.view(-1, 1, 1))

    @property
    def sends(self) -> Tensor:
        """Whether the UAVs of an environment send their maps, bool [envs, 1]."""
        return self._ranges.squeeze(-1) > 0

    def _hears(self, tensordict: TensorDictBase, position: Tensor, alive: Tensor) -> Tensor:
        near = radio.pairwise_distance(position) < self._ranges
        given = tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP)
        sent = radio.links(self._radio, position, *given, alive=alive)
        every = alive.unsqueeze(-1) & alive.unsqueeze(-2)
        return torch.where(self._ranges == inf, every, sent & near)


def play_ranges(config: RunConfig, ranges: Sequence[float], fires: int) -> list[Measured]:
    """Returns the measures of map_greedy on validation fires, for each range of the radio.

    Args:
        config: configuration of the world, without a base.
        ranges: cells; `NO_RADIO` and `NO_LIMITS` are possible.
        fires: number of validation fires, one episode each, with the same seeds for all ranges.
    """
    arrival = fires_of(config.fire).validation(fires, config.env.grid, config.env.horizon)
    measured: list[Measured] = [{name: [] for name in metrics.names(config.env)} for _ in ranges]
    for part in torch.arange(fires).split(max(1, _AT_ONCE // len(ranges))):
        episodes = part.repeat(len(ranges))
        env = build_env(
            config,
            num_envs=len(episodes),
            fire=arrival[episodes],
            seed=(VALIDATION_START_SEED + episodes).tolist(),
            device=config.device,
        )
        world: Any = env.base_env
        reach = torch.tensor(ranges, dtype=torch.float64).repeat_interleave(len(part))
        for name, values in play(env, RangedMapGreedy(world, reach)).items():
            for of_range, of_fires in zip(measured, values.view(len(ranges), -1), strict=True):
                of_range[name] += of_fires.tolist()
    return measured
