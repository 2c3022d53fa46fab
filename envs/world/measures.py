"""Measures the sightings of the team and of the base at each step."""

import math

import torch
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import NEVER, Knowledge, step_type

_EXACT = 512
"""ages below are counted one by one"""
_GROWTH = 1.01
"""ratio of the limits of the other classes of ages"""


def cell_ages(step: Tensor, last_seen: Tensor, ignition: Tensor) -> Tensor:
    """Returns the steps since the later of each cell's last look and its ignition.

    Args:
        step: [...], the current step.
        last_seen: [...], the step of the last look at the cell, negative for none.
        ignition: [...], the first step at which the cell burned.

    Returns:
        [...]; meaningful for burning cells.
    """
    return step - torch.maximum(last_seen, ignition)


def age_limits(horizon: int) -> Tensor:
    """Returns the lowest age of each class of the histogram, int64 [classes].

    Ages below 512 have a class each. Above, a class spans less than 1 % of its lowest age.
    """
    ages = list(range(min(_EXACT, horizon + 1)))
    while ages[-1] < horizon:
        ages.append(max(ages[-1] + 1, math.floor(ages[-1] * _GROWTH)))
    return torch.tensor(ages)


def percentile(histogram: Tensor, limits: Tensor, share: float) -> Tensor:
    """Returns the age that at least a share of all counted ages do not exceed.

    Args:
        histogram: int64 [..., classes], number of ages in each class.
        limits: int64 [classes], lowest age of each class.
        share: from 0 to 1.

    Returns:
        float32 [...]: the lowest age of the class in which the percentile lies (nearest rank); 0
        without any ages.
    """
    total = histogram.cumsum(-1)
    rank = (total[..., -1:].double() * share).ceil()
    place = (total < rank).sum(-1).clamp(max=len(limits) - 1)
    return limits.take(place).float()


class SightingAges(nn.Module):
    """Accumulates the ages of burning cells over the steps of an episode.

    The memory does not grow with the number of steps.
    """

    total: Tensor
    """int64 [envs]: sum of all ages"""
    count: Tensor
    """int64 [envs]: number of ages"""
    histogram: Tensor
    """int64 [envs, classes]"""
    _limits: Tensor
    _class: Tensor

    def __init__(self, envs: int, horizon: int):
        super().__init__()
        limits = age_limits(horizon)
        classes = torch.searchsorted(limits, torch.arange(horizon + 1), right=True) - 1
        self.register_buffer("_limits", limits, persistent=False)
        self.register_buffer("_class", classes, persistent=False)
        for name in ("total", "count"):
            self.register_buffer(name, torch.zeros(envs, dtype=torch.int64))
        self.register_buffer("histogram", torch.zeros(envs, len(limits), dtype=torch.int64))

    def start_episodes(self, mask: Tensor) -> None:
        """Removes all ages of the environments of a mask, bool [envs]."""
        self.total.masked_fill_(mask, 0)
        self.count.masked_fill_(mask, 0)
        self.histogram.masked_fill_(mask[:, None], 0)

    def add(self, ages: Tensor, env: Tensor) -> None:
        """Adds the ages of one step, int64 [cells], in the environments int64 [cells]."""
        one = torch.ones_like(env)
        self.total.scatter_add_(0, env, ages)
        self.count.scatter_add_(0, env, one)
        place = self._class.take(ages).add_(env, alpha=len(self._limits))
        self.histogram.view(-1).scatter_add_(0, place, one)

    def mean(self) -> Tensor:
        """Returns the mean age, float32 [envs]; 0 without any ages."""
        return (self.total.double() / self.count.clamp(min=1)).float()

    def percentile(self, share: float) -> Tensor:
        """Returns a percentile of the ages, float32 [envs]; see `percentile`."""
        return percentile(self.histogram, self._limits, share)


class FireTimes(nn.Module):
    """Stores the first step at which each cell burns and the first at which it no longer does.

    Args:
        envs: number of environments.
        area: cells of a padded map (`Sensor.area`).
        horizon: steps of an episode; later steps are stored as `horizon + 1`.
    """

    ignition: Tensor
    """integers [envs, area]"""
    end: Tensor
    """integers [envs, area]"""

    def __init__(self, envs: int, area: int, horizon: int):
        super().__init__()
        self._never = horizon + 1
        for name in ("ignition", "end"):
            steps = torch.full((envs, area), self._never, dtype=step_type(horizon))
            self.register_buffer(name, steps)

    def start_episodes(self, mask: Tensor, arrival: Tensor, burn_out: Tensor | None) -> None:
        """Stores new fires, steps [envs, area] (NaN outside), where a mask, bool [envs], is set."""
        for steps, times in ((self.ignition, arrival), (self.end, burn_out)):
            if times is not None:
                known = times.nan_to_num(nan=self._never).clamp(0, self._never).ceil()
                steps.copy_(torch.where(mask[:, None], known.to(steps.dtype), steps))

    def burning(self, step: Tensor) -> Tensor:
        """Returns whether each cell burns at a step, bool [envs, area]; [envs, 1]."""
        return (self.ignition <= step) & (step < self.end)


class Measures(nn.Module):
    """Measures the ages of sightings, and what reaches the base station.

    Args:
        world: the world and the team.
        envs: number of environments.
        area: cells of a padded map (`Sensor.area`).
    """

    team_seen: Tensor
    """integers [envs, area]: the last step at which any UAV saw the cell"""
    base_seen: Tensor
    """int64 [envs]: number of cells with a sighting in flames at the base"""
    told: Tensor | None
    """int64 [envs, uavs]: number of burnt cells new to the base in the last step, for UAVs whose
    messages arrived there, else 0; None without a base"""
    _base: Tensor

    def __init__(self, world: WildfireConfig, envs: int, area: int):
        super().__init__()
        self._world = world
        self.times = FireTimes(envs, area, world.horizon)
        self.knowledge = self.base_ages = self.ages = self.told = None
        if world.measures == "all":
            self.ages = SightingAges(envs, world.horizon)
            seen = torch.full((envs, area), NEVER, dtype=step_type(world.horizon))
            self.register_buffer("team_seen", seen)
        if world.base is not None:
            self.knowledge = Knowledge(
                envs=envs,
                uavs=world.num_uavs,
                area=area,
                horizon=world.horizon,
                listeners=1,
                fires=True,
            )
            self.base_ages = SightingAges(envs, world.horizon)
            self.register_buffer("base_seen", torch.zeros(envs, dtype=torch.int64))
            base = torch.tensor([[*world.base, 0.0]], dtype=torch.float64)
            self.register_buffer("_base", base.repeat(envs, 1, 1), persistent=False)

    def start_episodes(self, mask: Tensor, arrival: Tensor, burn_out: Tensor | None) -> None:
        """Starts new episodes; see `FireTimes.start_episodes`."""
        self.times.start_episodes(mask, arrival, burn_out)
        for part in (self.ages, self.base_ages, self.knowledge):
            if part is not None:
                part.start_episodes(mask)
        if self.ages is not None:
            self.team_seen.masked_fill_(mask[:, None], NEVER)
        if self.knowledge is not None:
            self.base_seen.masked_fill_(mask, 0)

    def update(
        self, view: View, position: Tensor, rng_key: Tensor, step: Tensor, alive: Tensor | None
    ) -> None:
        """Adds one step.

        Args:
            position: float64 [envs, uavs, 3], cells.
            rng_key: int64 [envs], `keys.RNG_KEY`.
            step: int64 [envs], steps since the episode began.
            alive: bool [envs, uavs]; all are alive if None.
        """
        now = step.to(self.times.end.dtype).view(-1, 1, 1)
        if self.ages is not None:
            seen = torch.where(view.in_view, now, NEVER)
            flat = self.team_seen.view(-1)
            flat.scatter_reduce_(0, view.cells.view(-1), seen.view(-1), "amax")
            self._add_ages(self.ages, self.team_seen, step)
        if self.knowledge is not None and self.base_ages is not None:
            self.knowledge.update(view, step, self.hears(position, rng_key, step, alive))
            self._add_ages(self.base_ages, self.knowledge.last_seen[:, -1], step)
            self._tell(self.knowledge)

    def _tell(self, knowledge: Knowledge) -> None:
        """Counts the burnt cells new to the base, for the UAVs whose messages arrived."""
        assert knowledge.seen_fire is not None
        seen = knowledge.seen_fire[:, -1].sum(-1)
        self.told = (seen - self.base_seen).unsqueeze(-1) * knowledge.reach[:, -1, :-1]
        self.base_seen.copy_(seen)

    def _add_ages(self, ages: SightingAges, last_seen: Tensor, step: Tensor) -> None:
        """Adds the ages of the burning cells of all environments, from int [envs, area]."""
        ignition = self.times.ignition
        burning = self.times.burning(step.to(ignition.dtype).unsqueeze(-1)).flatten()
        cell = burning.nonzero().squeeze(-1)
        env = cell // ignition.shape[1]
        age = cell_ages(step.take(env), last_seen.take(cell), ignition.take(cell))
        ages.add(age.clamp(min=0), env)

    def hears(
        self, position: Tensor, rng_key: Tensor, step: Tensor, alive: Tensor | None
    ) -> Tensor:
        """Returns the links of the UAVs and the base, which is last, bool [envs, n + 1, n + 1].

        The links between UAVs equal `radio.links` without a base.
        """
        given = rng_key, step
        return radio.links_with_base(self._world.radio, position, self._base, *given, alive)

    def values(self) -> dict[str, Tensor]:
        """Returns the measures of the episode so far by key, [envs] each."""
        values: dict[str, Tensor] = {}
        if self.ages is not None:
            values[keys.FRONT_AGE] = self.ages.mean()
            values[keys.FRONT_AGE_P95] = self.ages.percentile(0.95)
        if self.knowledge is not None and self.base_ages is not None:
            values[keys.BASE_SEEN] = self.base_seen.clone()
            values[keys.BASE_AGE] = self.base_ages.mean()
        return values
