"""Measures the sightings of the team and of the base at each step."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.world.coverage_map import CoverageMap, Look, View
from emberlink.envs.world.exchange import Exchange, cell_bytes, share
from emberlink.envs.world.knowledge import Knowledge, step_type
from emberlink.envs.world.radio import Channel, budget

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
    waiting: Tensor
    """int64 [envs, steps]: number of burning cells by `since`"""
    edges: Tensor
    """int64 [envs, ages]: runs that began at an age, less the runs that ended before it"""
    _rounded: Tensor

    def __init__(self, envs: int, area: int, horizon: int):
        super().__init__()
        limits = age_limits(horizon)
        ages = torch.arange(horizon + 2)
        lower = torch.searchsorted(limits, ages, right=True) - 1
        self.register_buffer("_rounded", limits[lower], persistent=False)
        self.register_buffer("since", torch.zeros(envs, area, dtype=step_type(horizon)))
        for name in ("waiting", "edges"):
            self.register_buffer(name, torch.zeros(envs, len(ages), dtype=torch.int64))

    def start_episodes(self, mask: Tensor, ignition: Tensor, burning: Tensor) -> None:
        """Begins with new fires in the environments of a mask, bool [envs].

        Args:
            ignition: integers [envs, area], see `whole_steps`.
            burning: int64 [envs], number of cells that burn at step 0.
        """
        began = mask[:, None]
        self.since.copy_(torch.where(began, ignition, self.since))
        for record, at in ((self.waiting, 0), (self.edges, 1)):  # ages begin at step 1
            record.masked_fill_(began, 0)
            record[:, at] = torch.where(mask, burning, record[:, at])

    def add(
        self, step: Tensor, ignited: Tensor, events: Tensor, looks: Tensor | None = None
    ) -> None:
        """Adds the ages of successive steps.

        Args:
            step: int64 [steps, envs], from 1 on.
            ignited: int64 [steps, envs], number of cells that burn since a step.
            events: int64 [k], from `number_events`: looks at burning cells and ends of burning.
            looks: integers [envs, area], the steps of the looks; the step of the event if None.
        """
        steps, envs = step.shape
        now = step.clamp(max=self.waiting.shape[1] - 2).flatten()
        place, ends = events >> 1, (events & 1).bool()
        cell = place // steps
        env = cell // self.since.shape[1]
        row = place % steps * envs + env
        look = now[row] if looks is None else looks.view(-1)[cell].long()
        # The look before a look or an end, among these steps or earlier ones.
        before = self.since.view(-1)[cell].long()
        again = cell[1:] == cell[:-1]
        before[1:] = torch.where(again, look[:-1], before[1:])
        seen = ~ends
        look, at = look[seen], row[seen]
        self.since.view(-1).scatter_reduce_(0, cell[seen], look.to(self.since.dtype), "amax")
        # Runs that begin with an ignition, runs that end, and runs that begin with a look.
        every = torch.arange(len(now), device=now.device)
        row, since = torch.cat((every, row, at)), torch.cat((now, before, look))
        ones = torch.ones_like(events)
        by = torch.cat((ignited.flatten(), -ones, ones[: len(look)]))
        env = row % envs * self.waiting.shape[1]
        self.waiting.view(-1).index_add_(0, env + since, by)
        self.edges.view(-1).index_add_(0, env + now[row] - since, by)

    def counted(self, step: Tensor) -> Tensor:
        """Returns the number of ages so far up to 0, 1, ..., int64 [envs, ages].

        Args:
            step: int64 [envs], the step of the last `add`.
        """
        steps = self.waiting.shape[1]
        now = step.clamp(max=steps - 2).unsqueeze(-1)
        ages = torch.arange(int(now.max()) + 2, device=now.device)
        # Runs that have not ended reach from where they began to the age at this step.
        going_on = self.waiting.gather(1, (now + 1 - ages) % steps)
        return (self.edges[:, : len(ages)] - going_on).cumsum(1).cumsum(1)

    def percentile(self, counted: Tensor, share: float) -> Tensor:
        """Returns the age that at least a share of `counted` do not exceed (nearest rank).

        float32 [envs], rounded down to a limit of `age_limits`; 0 without any ages.
        """
        rank = (counted[:, -1:].double() * share).ceil()
        return self._rounded.take((counted < rank).sum(-1)).float()


def mean_age(counted: Tensor) -> Tensor:
    """Returns the mean of the ages of `SightingAges.counted`, float32 [envs]; 0 without any."""
    count = counted[:, -1]
    total = (count.unsqueeze(-1) - counted).sum(-1)  # ages above 0, above 1, ...
    return (total.double() / count.clamp(min=1)).float()


def number_events(seen: Tensor, ended: Tensor) -> Tensor:
    """Returns looks at cells and ends of burning in the order of cells and steps, each once.

    Args:
        seen, ended: integers, cell * steps + step: indices of cells in the flat maps of all
            environments, and of steps.
    """
    return torch.cat((2 * seen, 2 * ended + 1)).unique()


def whole_steps(times: Tensor, horizon: int) -> Tensor:
    """Returns the first whole steps at or after times; `horizon + 1` for later ones and NaN."""
    never = horizon + 1
    return times.nan_to_num(nan=never).clamp(0, never).ceil().to(step_type(horizon))


class Measures(nn.Module):
    """Measures the ages of sightings, and what reaches the base station.

    Args:
        world: the world and the team.
        envs: number of environments.
        area: cells of a padded map (`Sensor.area`).
    """

    base_seen: Tensor
    """int64 [envs]: number of cells with a sighting in flames at the base"""

    def __init__(self, world: WildfireConfig, envs: int, area: int):
        super().__init__()
        self._world, self._area = world, area
        self.knowledge = self.base_ages = self.ages = self.reports = None
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
            self.channel = Channel(world, envs, base=True)
            if world.radio.packets:
                sizes = torch.full((area,), cell_bytes(world.horizon))
                self.reports = Exchange(world.radio, sizes, (envs, world.num_uavs + 1))

    def start_episodes(self, mask: Tensor, fire: CoverageMap) -> None:
        """Starts new episodes in the environments of a mask, bool [envs]."""
        burning, _ = fire.count(torch.zeros_like(mask, dtype=torch.int64))
        for part in (self.ages, self.base_ages):
            if part is not None:
                ignition = whole_steps(fire.times[0], self._world.horizon)
                part.start_episodes(mask, ignition, burning)
        if self.knowledge is not None:
            self.knowledge.start_episodes(mask)
            if self.reports is not None:
                self.reports.start_episodes(mask)
            self.base_seen.masked_fill_(mask, 0)

    def update(
        self,
        fire: CoverageMap,
        look: Look,
        position: Tensor,
        rng_key: Tensor,
        step: Tensor,
        alive: Tensor,
    ) -> tuple[Tensor | None, dict[Any, Tensor]]:
        """Adds successive steps.

        Args:
            look: the sightings of the steps.
            position: float [steps, envs, uavs, 3], cells.
            rng_key: int64 [envs], `keys.RNG_KEY`.
            step: int64 [steps, envs], steps since the episode began.
            alive: bool [steps, envs, uavs].

        Returns:
            The burnt cells new to the base at each step, for UAVs whose messages arrived there,
            else 0, int64 [steps, envs, uavs], or None without a base; and by key the measures of
            each step, [steps, envs, ...].
        """
        ignited = look.burnt - fire.count(step - 1)[1]
        row, cell = look.ended
        steps, envs = step.shape
        cell = row % envs * self._area + cell
        if self.ages is not None:
            at = torch.arange(steps, device=step.device).view(-1, 1, 1, 1)
            seen = (look.view.cells * steps + at)[look.view.burning]
            events = number_events(seen, cell * steps + row // envs)
            self.ages.add(step, ignited, events)
        if self.knowledge is None:
            return None, {}
        told, known, said = [], [], []
        every = zip(*self.channel(position.double(), rng_key, step, alive), strict=True)
        for number, (now, links) in enumerate(zip(step, every, strict=True)):
            view = View(*(part[number] for part in look.view))
            gone = cell[row // envs == number]
            new, sent = self._report(view, now, links, ignited[number], gone, fire.times)
            told.append(new)
            known.append(self.base_seen.clone())
            said += [] if sent is None else [sent[:, :-1]]
        measured: dict[Any, Tensor] = {keys.BASE_SEEN: torch.stack(known)}
        if self._world.reports:
            measured[keys.REPORT_BYTES] = torch.stack(said) * alive
        return torch.stack(told) * alive, measured

    def _report(
        self,
        view: View,
        step: Tensor,
        links: tuple[Tensor, Tensor],
        ignited: Tensor,
        ended: Tensor,
        times: tuple[Tensor, Tensor | None],
    ) -> tuple[Tensor, Tensor | None]:
        """Adds a step to the base's knowledge; returns the burnt cells told, and bytes if sent."""
        knowledge, ages = self.knowledge, self.base_ages
        assert knowledge is not None
        assert ages is not None
        assert knowledge.seen_fire is not None
        before = knowledge.last_seen[:, -1].clone()
        near, hears = links
        left = budget(self._world, near)
        sent = share(knowledge, self.reports, view, step, hears, left)
        after, now = knowledge.last_seen[:, -1].clone(), step.unsqueeze(-1)
        arrival, burn_out = times
        newer = (after > before) & (after > ages.since) & (arrival <= now)
        if burn_out is not None:
            newer &= now < burn_out
        events = number_events(newer.view(-1).nonzero().squeeze(-1), ended)
        ages.add(step[None], ignited[None], events, after)
        seen = knowledge.seen_fire[:, -1].sum(-1)
        told = (seen - self.base_seen).unsqueeze(-1) * knowledge.reach[:, -1, :-1]
        self.base_seen.copy_(seen)
        return told, sent

    def values(self, step: Tensor) -> dict[str, Tensor]:
        """Returns the measures of the episode up to a step, int64 [envs], by key, [envs] each."""
        values: dict[str, Tensor] = {}
        if self.ages is not None:
            counted = self.ages.counted(step)
            values[keys.FRONT_AGE] = mean_age(counted)
            values[keys.FRONT_AGE_P95] = self.ages.percentile(counted, 0.95)
        if self.knowledge is not None and self.base_ages is not None:
            values[keys.BASE_SEEN] = self.base_seen.clone()
            values[keys.BASE_AGE] = mean_age(self.base_ages.counted(step))
        return values
