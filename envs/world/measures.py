"""Measures the sightings of the team and of the base at each step."""

import math

import torch
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import Cells, View
from emberlink.envs.world.knowledge import Knowledge, step_type

_EXACT = 512
"""ages below are counted one by one"""
_GROWTH = 1.01
"""ratio of the limits of the other classes of ages"""


def age_limits(horizon: int) -> Tensor:
    """Returns the lowest age of each class of the histogram, int64 [classes].

    Ages below 512 have a class each. Above, a class spans less than 1 % of its lowest age.
    """
    ages = list(range(min(_EXACT, horizon + 1)))
    while ages[-1] < horizon:
        ages.append(max(ages[-1] + 1, math.floor(ages[-1] * _GROWTH)))
    return torch.tensor(ages)


class SightingAges(nn.Module):
    """Accumulates the ages of burning cells over the steps of an episode.

    The age of a burning cell is the number of steps since its last look, or since its ignition.
    Only cells that change are touched: a run of ages begins with an ignition or a look, grows by
    one at each step, and ends with the next look or when the cell has burnt out.
    """

    since: Tensor
    """integers [envs, area]: the step of the last look at a burning cell, or of its ignition"""
    burning: Tensor
    """int64 [envs]: number of burning cells"""
    since_sum: Tensor
    """int64 [envs]: sum of `since` over them"""
    waiting: Tensor
    """int64 [envs, steps]: number of them by `since`"""
    edges: Tensor
    """int64 [envs, ages]: runs that began at an age, less the runs that ended before it"""
    total: Tensor
    """int64 [envs]: sum of all ages"""
    count: Tensor
    """int64 [envs]: number of ages"""
    _rounded: Tensor

    def __init__(self, envs: int, area: int, horizon: int):
        super().__init__()
        limits = age_limits(horizon)
        ages = torch.arange(horizon + 2)
        lower = torch.searchsorted(limits, ages, right=True) - 1
        self.register_buffer("_rounded", limits[lower], persistent=False)
        self.register_buffer("since", torch.zeros(envs, area, dtype=step_type(horizon)))
        for name in ("burning", "since_sum", "total", "count"):
            self.register_buffer(name, torch.zeros(envs, dtype=torch.int64))
        for name in ("waiting", "edges"):
            self.register_buffer(name, torch.zeros(envs, len(ages), dtype=torch.int64))

    def start_episodes(self, mask: Tensor, times: "FireTimes") -> None:
        """Begins with the fires of the environments of a mask, bool [envs]."""
        began = mask[:, None]
        self.since.copy_(torch.where(began, times.ignition, self.since))
        for record in (self.since_sum, self.total, self.count):
            record.masked_fill_(mask, 0)
        first = times.burning(torch.zeros_like(times.ignition[:, :1])).sum(-1)
        self.burning.copy_(torch.where(mask, first, self.burning))
        for record, at in (
            (self.waiting, 0),
            (self.edges, 1),
        ):  # ages begin at step 1
            record.masked_fill_(began, 0)
            record[:, at] = torch.where(mask, first, record[:, at])

    def add(
        self, step: Tensor, ignited: Tensor, ended: Cells, seen: Cells, looks: Tensor | None = None
    ) -> None:
        """Adds the ages of a step.

        Args:
            step: int64 [envs], from 1 on.
            ignited: int64 [envs], number of cells that burn since this step.
            ended: the cells that burned until this step.
            seen: burning cells with a new look, each once.
            looks: int64 [k], the steps of these looks; this step if None.
        """
        now = step.clamp(max=self.waiting.shape[1] - 2)
        self._count(torch.arange(len(now), device=now.device), now, now, ignited)
        env, cell = (torch.cat(both) for both in zip(ended, seen, strict=True))
        self._count(env, self.since[env, cell].long(), now, torch.full_like(env, -1))
        looks = now[seen[0]] if looks is None else looks
        self._count(seen[0], looks, now, torch.ones_like(looks))
        self.since[seen] = looks.to(self.since.dtype)
        self.total.add_(self.burning * now - self.since_sum)
        self.count.add_(self.burning)

    def _count(self, env: Tensor, since: Tensor, now: Tensor, by: Tensor) -> None:
        """Adds numbers of burning cells with a last look, and of runs that begin at their age."""
        first = env * self.waiting.shape[1]
        self.burning.index_add_(0, env, by)
        self.since_sum.index_add_(0, env, by * since)
        self.waiting.view(-1).index_add_(0, first + since, by)
        self.edges.view(-1).index_add_(0, first + now[env] - since, by)

    def mean(self) -> Tensor:
        """Returns the mean age, float32 [envs]; 0 without any ages."""
        return (self.total.double() / self.count.clamp(min=1)).float()

    def percentile(self, share: float, step: Tensor) -> Tensor:
        """Returns the age that at least a share of all ages do not exceed (nearest rank).

        Args:
            share: from 0 to 1.
            step: int64 [envs], the step of the last `add`.

        Returns:
            float32 [envs], rounded down to a limit of `age_limits`; 0 without any ages.
        """
        steps = self.waiting.shape[1]
        now = step.clamp(max=steps - 2).unsqueeze(-1)
        ages = torch.arange(int(now.max()) + 2, device=now.device)
        # Runs that have not ended reach from where they began to the age at this step.
        going_on = self.waiting.gather(1, (now + 1 - ages) % steps)
        counted = (self.edges[:, : len(ages)] - going_on).cumsum(1).cumsum(1)
        rank = (counted[:, -1:].double() * share).ceil()
        return self._rounded.take((counted < rank).sum(-1)).float()


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

    burnt: Tensor
    """int64 [envs]: number of cells that have ignited"""
    base_seen: Tensor
    """int64 [envs]: number of cells with a sighting in flames at the base"""
    _base: Tensor

    def __init__(self, world: WildfireConfig, envs: int, area: int):
        super().__init__()
        self._world = world
        self.times = FireTimes(envs, area, world.horizon)
        self.knowledge = self.base_ages = self.ages = None
        self.register_buffer("burnt", torch.zeros(envs, dtype=torch.int64))
        if world.measures == "all":
            self.ages = SightingAges(envs, area, world.horizon)
        if world.base is not None:
            self.knowledge = Knowledge(
                envs=envs,
                uavs=world.num_uavs,
                area=area,
                horizon=world.horizon,
                listeners=1,
                fires=True,
            )
            self.base_ages = SightingAges(envs, area, world.horizon)
            self.register_buffer("base_seen", torch.zeros(envs, dtype=torch.int64))
            base = torch.tensor([[*world.base, 0.0]], dtype=torch.float64)
            self.register_buffer("_base", base.repeat(envs, 1, 1), persistent=False)

    def start_episodes(self, mask: Tensor, arrival: Tensor, burn_out: Tensor | None) -> None:
        """Starts new episodes; see `FireTimes.start_episodes`."""
        self.times.start_episodes(mask, arrival, burn_out)
        self.burnt.copy_(torch.where(mask, (self.times.ignition == 0).sum(-1), self.burnt))
        for part in (self.ages, self.base_ages):
            if part is not None:
                part.start_episodes(mask, self.times)
        if self.knowledge is not None:
            self.knowledge.start_episodes(mask)
            self.base_seen.masked_fill_(mask, 0)

    def update(
        self,
        view: View,
        ended: Cells,
        position: Tensor,
        rng_key: Tensor,
        step: Tensor,
        alive: Tensor | None,
        burnt: Tensor,
    ) -> tuple[Tensor | None, Tensor | None]:
        """Adds successive steps.

        Args:
            view: the cells in view, [steps, envs, uavs, ...].
            ended: the cells that burned until a step, with the rows of the flat [steps, envs].
            position: float [steps, envs, uavs, 3], cells.
            rng_key: int64 [envs], `keys.RNG_KEY`.
            step: int64 [steps, envs], steps since the episode began.
            alive: bool [steps, envs, uavs]; all are alive if None.
            burnt: int64 [steps, envs], number of cells that have ignited.

        Returns:
            The burnt cells new to the base at each step, for UAVs whose messages arrived there,
            else 0, int64 [steps, envs, uavs], and `base_seen` after each, int64 [steps, envs];
            None without a base.
        """
        ignited = burnt.diff(dim=0, prepend=self.burnt.unsqueeze(0))
        self.burnt.copy_(burnt[-1])
        row, cell = ended
        envs, told, known = burnt.shape[1], [], []
        for number, now in enumerate(step):
            looks = View(*(part[number] for part in view))
            ends = row // envs == number
            gone = row[ends] % envs, cell[ends]
            if self.ages is not None:
                seen = looks.cells[looks.burning].unique()
                area = self.times.end.shape[1]
                self.ages.add(now, ignited[number], gone, (seen // area, seen % area))
            if self.knowledge is not None:
                flies = None if alive is None else alive[number]
                hears = self.hears(position[number].double(), rng_key, now, flies)
                told.append(self._report(looks, now, hears, ignited[number], gone))
                known.append(self.base_seen.clone())
        return (torch.stack(told), torch.stack(known)) if told else (None, None)

    def _report(
        self, view: View, step: Tensor, hears: Tensor, ignited: Tensor, ended: Cells
    ) -> Tensor:
        """Adds a step to the base's knowledge; returns the burnt cells that it is told."""
        knowledge, ages = self.knowledge, self.base_ages
        assert knowledge is not None
        assert ages is not None
        assert knowledge.seen_fire is not None
        before = knowledge.last_seen[:, -1].clone()
        knowledge.update(view, step, hears)
        after = knowledge.last_seen[:, -1]
        env, cell = (after > before).nonzero(as_tuple=True)
        looks = after[env, cell]
        burns = self.times.burning(step.to(looks.dtype).unsqueeze(-1))[env, cell]
        newer = burns & (looks > ages.since[env, cell])
        ages.add(step, ignited, ended, (env[newer], cell[newer]), looks[newer].long())
        seen = knowledge.seen_fire[:, -1].sum(-1)
        told = (seen - self.base_seen).unsqueeze(-1) * knowledge.reach[:, -1, :-1]
        self.base_seen.copy_(seen)
        return told

    def hears(
        self, position: Tensor, rng_key: Tensor, step: Tensor, alive: Tensor | None
    ) -> Tensor:
        """Returns the links of the UAVs and the base, which is last, bool [envs, n + 1, n + 1].

        The links between UAVs equal `radio.links` without a base.
        """
        given = rng_key, step
        return radio.links_with_base(self._world.radio, position, self._base, *given, alive)

    def values(self, step: Tensor) -> dict[str, Tensor]:
        """Returns the measures of the episode up to a step, int64 [envs], by key, [envs] each."""
        values: dict[str, Tensor] = {}
        if self.ages is not None:
            values[keys.FRONT_AGE] = self.ages.mean()
            values[keys.FRONT_AGE_P95] = self.ages.percentile(0.95, step)
        if self.knowledge is not None and self.base_ages is not None:
            values[keys.BASE_SEEN] = self.base_seen.clone()
            values[keys.BASE_AGE] = self.base_ages.mean()
        return values
