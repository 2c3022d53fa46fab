"""Measures the sightings of the team and of the base at each step."""

from typing import Any

import torch
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.world.coverage_map import CoverageMap, Look, View
from emberlink.envs.world.exchange import Exchange, cell_bytes, share
from emberlink.envs.world.knowledge import Knowledge, step_type
from emberlink.envs.world.radio import Channel, budget


class SightingAges(nn.Module):
    """Sums the ages of burning cells over the steps of an episode.

    The age of a burning cell is the number of steps since its last look, or since its ignition.
    Only cells that change are touched.
    """

    since: Tensor
    """integers [envs, area]: the step of the last look at a burning cell, or of its ignition"""
    since_sum: Tensor
    """int64 [envs]: sum of `since` over the burning cells"""
    age_sum: Tensor
    age_count: Tensor
    """int64 [envs]: sum and number of all ages so far"""

    def __init__(self, envs: int, area: int, horizon: int):
        super().__init__()
        self.register_buffer("since", torch.zeros(envs, area, dtype=step_type(horizon)))
        for name in ("since_sum", "age_sum", "age_count"):
            self.register_buffer(name, torch.zeros(envs, dtype=torch.int64))

    def start_episodes(self, mask: Tensor, ignition: Tensor) -> None:
        """Begins with new fires in the environments of a mask, bool [envs].

        Args:
            ignition: integers [envs, area], see `whole_steps`.
        """
        self.since.copy_(torch.where(mask[:, None], ignition, self.since))
        for total in (self.since_sum, self.age_sum, self.age_count):
            total.masked_fill_(mask, 0)

    def add(
        self, step: Tensor, counts: Tensor, events: Tensor, looks: Tensor | None = None
    ) -> None:
        """Adds the ages of successive steps.

        Args:
            step: int64 [steps, envs], from 1 on.
            counts: int64 [2, steps, envs], number of cells that burn, and that burn since a step.
            events: int64 [k], from `number_events`: looks at burning cells and ends of burning.
            looks: integers [envs, area], the steps of the looks; the step of the event if None.
        """
        steps, envs = step.shape
        place, ends = events >> 1, (events & 1).bool()
        cell = place // steps
        row = place % steps * envs + cell // self.since.shape[1]
        look = step.flatten()[row] if looks is None else looks.view(-1)[cell].long()
        # The look before a look or an end, among these steps or earlier ones.
        before = self.since.view(-1)[cell].long()
        again = cell[1:] == cell[:-1]
        before[1:] = torch.where(again, look[:-1], before[1:])
        latest = look[~ends].to(self.since.dtype)
        self.since.view(-1).scatter_reduce_(0, cell[~ends], latest, "amax")
        burning, ignited = counts
        change = (ignited * step).flatten().index_add_(0, row, look.masked_fill(ends, 0) - before)
        since_sum = self.since_sum + change.view_as(step).cumsum(0)
        self.since_sum.copy_(since_sum[-1])
        self.age_sum += (burning * step - since_sum).sum(0)
        self.age_count += burning.sum(0)

    def mean(self) -> Tensor:
        """Returns the mean of the ages so far, float32 [envs]; 0 without any."""
        return (self.age_sum.double() / self.age_count.clamp(min=1)).float()


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
        for part in (self.ages, self.base_ages):
            if part is not None:
                ignition = whole_steps(fire.times[0], self._world.horizon)
                part.start_episodes(mask, ignition)
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
        counts = torch.stack((look.burning, look.burnt - fire.count(step - 1)[1]))
        row, cell = look.ended
        steps, envs = step.shape
        cell = row % envs * self._area + cell
        if self.ages is not None:
            at = torch.arange(steps, device=step.device).view(-1, 1, 1, 1)
            seen = (look.view.cells * steps + at)[look.view.burning]
            events = number_events(seen, cell * steps + row // envs)
            self.ages.add(step, counts, events)
        if self.knowledge is None:
            return None, {}
        told, known, said = [], [], []
        every = zip(*self.channel(position.double(), rng_key, step, alive), strict=True)
        for number, (now, links) in enumerate(zip(step, every, strict=True)):
            view = View(*(part[number] for part in look.view))
            gone = cell[row // envs == number]
            new, sent = self._report(view, now, links, counts[:, number], gone, fire.times)
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
        counts: Tensor,
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
        ages.add(step[None], counts[:, None], events, after)
        seen = knowledge.seen_fire[:, -1].sum(-1)
        told = (seen - self.base_seen).unsqueeze(-1) * knowledge.reach[:, -1, :-1]
        self.base_seen.copy_(seen)
        return told, sent

    def values(self) -> dict[str, Tensor]:
        """Returns the measures of the episode so far by key, [envs] each."""
        values: dict[str, Tensor] = {}
        if self.ages is not None:
            values[keys.FRONT_AGE] = self.ages.mean()
        if self.knowledge is not None and self.base_ages is not None:
            values[keys.BASE_SEEN] = self.base_seen.clone()
            values[keys.BASE_AGE] = self.base_ages.mean()
        return values
