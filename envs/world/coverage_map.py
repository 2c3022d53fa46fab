"""Stores the fires of all environments, which cells burn, and when each was first seen."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from emberlink.envs.world.sensor import Sensor

_NEVER = torch.iinfo(torch.int32).max
_CHUNK = 2**22  # cells sorted at a time


def split_times(fires: Tensor) -> tuple[Tensor, Tensor | None]:
    """Splits fires into arrival and burn-out times, float32 [fires, X, Y] each.

    A cell burns at a step if `arrival <= step < burn_out`.

    Args:
        fires: steps, [fires, X, Y] of arrival alone, or [fires, 2, X, Y] of arrival and burn-out.

    Returns:
        The arrival times, and the burn-out times or None if cells burn for ever.
    """
    return (fires, None) if fires.ndim == 3 else (fires[:, 0], fires[:, 1])


def with_burn_time(arrival: Tensor, burn_time: float) -> Tensor:
    """Returns fires, [fires, X, Y], with burn-out times after `burn_time` steps.

    Returns:
        Arrival and burn-out times, float32 [fires, 2, X, Y]; `arrival` itself if `burn_time` is
        inf.
    """
    if math.isinf(burn_time):
        return arrival
    return torch.stack((arrival, arrival + burn_time), 1)


class PassedCells(nn.Module):
    """Finds the cells of a fire whose time has passed, or passes at a step.

    Args:
        times: arrival or burn-out times in steps, float32 [fires, cells]; inf for never, NaN for
            cells outside of the grid.
        horizon: steps of an episode; later steps count as the horizon.
        listed: whether the cells themselves are stored, for `passing`.
    """

    _count: Tensor
    """int32 [fires, horizon + 2]: number of cells whose time has passed at a step"""
    _order: Tensor
    """int32 [fires, cells]: the cells in the order of their times"""

    def __init__(self, times: Tensor, horizon: int, *, listed: bool = False):
        super().__init__()
        self._horizon, counts, orders = horizon, [], []
        for part in times.split(max(1, _CHUNK // times.shape[1])):
            step = part.nan_to_num(nan=math.inf).ceil().clamp(0, horizon + 1).long()
            count = step.new_zeros(len(part), horizon + 2, dtype=torch.int32)
            count.scatter_add_(1, step, torch.ones_like(step, dtype=torch.int32))
            counts.append(count.cumsum_(1))
            orders += [step.argsort(1).int()] if listed else []
        self.register_buffer("_count", torch.cat(counts), persistent=False)
        self.register_buffer("_order", torch.cat(orders) if listed else None, persistent=False)

    def at(self, fire: Tensor, step: Tensor) -> Tensor:
        """Returns the number of cells of fires with `time <= step`, int64 [...].

        Args:
            fire, step: int64, broadcast against [...].
        """
        return self._count[fire, step.clamp(max=self._horizon)].long()

    def passing(self, fire: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the cells whose time passes at a step: index into `fire` and cell, int64 [k].

        Args:
            fire, step: int64 [rows], see `at`; steps from 1 on.
        """
        first = self.at(fire, step - 1)
        count = self.at(fire, step) - first
        row = torch.arange(len(fire), device=fire.device).repeat_interleave(count)
        place = torch.arange(len(row), device=fire.device) + (first - count.cumsum(0) + count)[row]
        return row, self._order[fire[row], place].long()


class Sighting(NamedTuple):
    """The cells in view by class: new fire, old fire and no fire."""

    counts: Tensor
    """float64 [..., 3]: number of cells"""
    centres: Tensor
    """float32 [..., 3, 2]: mean (i, j) of the cells; 0 if there are none"""
    classes: Tensor
    """bool [..., 3, W * W]: mask of the cells in the UAV's window"""
    burnt_out: Tensor | None = None
    """bool [..., W * W]: mask of the burnt-out cells in view; None if cells never burn out"""

    @classmethod
    def nothing(cls, position: Tensor, cells: int) -> "Sighting":
        """Returns what UAVs with windows of so many cells have seen before they first look."""
        none = torch.zeros_like(position)
        classes = none.new_zeros((*none.shape, cells), dtype=torch.bool)
        return cls(none.double(), none.new_zeros((*none.shape, 2)), classes)

    def shown(self) -> Tensor:
        """Returns the camera's view of the window, uint8 [..., W * W]; see `keys.SIGHT`."""
        new, old, none = self.classes.to(torch.uint8).unbind(-2)
        shown = none + 2 * (new + old)
        return shown if self.burnt_out is None else shown.add(self.burnt_out, alpha=2)


class View(NamedTuple):
    """The cells of every UAV's window."""

    cells: Tensor
    """int64 [..., envs, uavs, W * W]: indices in the flat padded maps of all environments"""
    in_view: Tensor
    """bool [..., envs, uavs, W * W]: whether the cell is in view, padding included"""
    burning: Tensor
    """bool [..., envs, uavs, W * W]: whether the UAV sees the cell and it burns"""


def own_maps(envs: int, radios: int, area: int) -> Tensor:
    """Returns what leads from a cell of a `View` to maps of each radio, int64 [envs, radios, 1].

    A view's cell of environment e is at e * area; the map of its radio r begins at
    (e * radios + r) * area.
    """
    env = torch.arange(envs).view(-1, 1, 1)
    return (env * (radios - 1) + torch.arange(radios).view(-1, 1)) * area


def mark(maps: Tensor, cells: Tensor, flags: Tensor) -> None:
    """Sets the cells of bool maps, given by their flat indices, where bool `flags` are true."""
    flat = maps.view(-1).view(torch.uint8)
    flat.scatter_reduce_(0, cells.flatten(), flags.flatten().view(torch.uint8), "amax")


class Look(NamedTuple):
    """The sightings of the UAVs at successive steps; batch shape [steps, envs, uavs]."""

    counts: Tensor
    """float64 [steps, envs, uavs, 3]: cells in view by class, new fire as new to the team"""
    shown: Sighting
    """the sightings shown to the UAVs; with `own`, new fire is fire new to the UAV"""
    view: View
    """the indices of the cells"""
    burning: Tensor
    """int64 [steps, envs]: cells that burn"""
    burnt: Tensor
    """int64 [steps, envs]: cells that burn or have burnt out"""
    seen: Tensor
    """int64 [steps, envs]: cells that a UAV has seen while they burned"""
    unseen: Tensor
    """int64 [steps, envs]: burning cells that no UAV has seen while they burned"""
    ended: tuple[Tensor, Tensor]
    """the cells that burned until a step: rows of the flat [steps, envs] and cells, int64 [k]"""


class CoverageMap(nn.Module):
    """Stores the fire of every environment and the cells that its UAVs have seen.

    The UAVs count the cells in their view one after another, UAV 0 first. So a burning cell is new
    fire for one UAV at one step only, and old fire for the other UAVs and at later steps. A
    sighting is stored as the number step * uavs + uav; the minimum over all sightings of a cell
    gives the first one without a loop over UAVs.

    Args:
        sensor: the UAVs' camera.
        fires: arrival times in steps, float32 [fires, X, Y], inf for cells that never burn; or
            arrival and burn-out times, float32 [fires, 2, X, Y].
        horizon: steps of an episode.
        envs: number of environments.
        uavs: UAVs per environment.
        own: whether old fire, as shown to a UAV, is fire that it has seen itself, not that any has.
    """

    _fires: Tensor
    _fires_end: Tensor | None
    _start: Tensor
    _uav: Tensor
    _arrival_time: Tensor
    _burn_out: Tensor | None
    _fire_index: Tensor
    _first_seen: Tensor
    _own_first_seen: Tensor | None
    _own_first: Tensor
    seen_count: Tensor
    """int64 [envs]: cells that a UAV has seen while they burned"""
    seen_gone: Tensor
    """int64 [envs]: number of seen cells that have burnt out"""

    def __init__(
        self,
        sensor: Sensor,
        fires: Tensor,
        *,
        horizon: int,
        envs: int,
        uavs: int,
        own: bool = False,
    ):
        super().__init__()
        self._sensor, self._uavs = sensor, uavs
        arrival, burn_out = split_times(fires)
        # Padding is NaN: all comparisons with it are false, so it belongs to no class.
        self.register_buffer("_fires", sensor.pad(arrival, torch.nan), persistent=False)
        ends = None if burn_out is None else sensor.pad(burn_out, torch.nan)
        self.register_buffer("_fires_end", ends, persistent=False)
        self._ignited = PassedCells(self._fires, horizon)
        self._burnt_out = None if ends is None else PassedCells(ends, horizon, listed=True)
        self.register_buffer(
            "_start", torch.arange(envs).unsqueeze(-1) * sensor.area, persistent=False
        )
        self.register_buffer(
            "_uav", torch.arange(uavs, dtype=torch.int32).unsqueeze(-1), persistent=False
        )
        self.register_buffer("_arrival_time", self._fires[:1].repeat(envs, 1))
        self.register_buffer("_burn_out", None if ends is None else ends[:1].repeat(envs, 1))
        self.register_buffer("_fire_index", torch.zeros(envs, dtype=torch.int64))
        first_seen = torch.full((envs, sensor.area), _NEVER, dtype=torch.int32)
        self.register_buffer("_first_seen", first_seen)
        each = first_seen.unsqueeze(1).repeat(1, uavs, 1) if own else None
        self.register_buffer("_own_first_seen", each)
        self.register_buffer("_own_first", own_maps(envs, uavs, sensor.area), persistent=False)
        for name in ("seen_count", "seen_gone"):
            self.register_buffer(name, torch.zeros(envs, dtype=torch.int64))

    def __len__(self) -> int:
        """Returns the number of fires."""
        return len(self._fires)

    @property
    def arrival_time(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [envs, X, Y]."""
        return self._sensor.crop(self._arrival_time)

    @property
    def burn_out(self) -> Tensor | None:
        """The burn-out times in steps, float32 [envs, X, Y]; None if cells burn for ever."""
        return None if self._burn_out is None else self._sensor.crop(self._burn_out)

    @property
    def times(self) -> tuple[Tensor, Tensor | None]:
        """The arrival and burn-out times on the padded maps, float32 [envs, area], or None."""
        return self._arrival_time, self._burn_out

    @property
    def seen(self) -> Tensor:
        """Whether each cell burned when a UAV saw it, bool [envs, X, Y]."""
        return self._sensor.crop(self._first_seen < _NEVER)

    def start_episodes(self, mask: Tensor, fire: Tensor) -> None:
        """Starts episodes where a mask, bool [envs], is true, with fires of index int64 [envs]."""
        began = mask[:, None]
        self._arrival_time.copy_(torch.where(began, self._fires[fire], self._arrival_time))
        if self._burn_out is not None and self._fires_end is not None:
            self._burn_out.copy_(torch.where(began, self._fires_end[fire], self._burn_out))
        self._fire_index.copy_(torch.where(mask, fire, self._fire_index))
        self._first_seen.masked_fill_(began, _NEVER)
        if self._own_first_seen is not None:
            self._own_first_seen.masked_fill_(mask[:, None, None], _NEVER)
        self.seen_count.masked_fill_(mask, 0)
        self.seen_gone.masked_fill_(mask, 0)

    def count(self, step: Tensor) -> tuple[Tensor, Tensor]:
        """Counts burning, and burning or burnt, cells at steps [..., envs]: int64 of that shape."""
        burnt = self._ignited.at(self._fire_index, step)
        if self._burnt_out is None:
            return burnt, burnt.clone()
        return burnt - self._burnt_out.at(self._fire_index, step), burnt

    def look(self, position: Tensor, rng_key: Tensor, step: Tensor, alive: Tensor) -> Look:
        """Classifies the cells in view at successive steps and marks the burning ones as seen.

        Every step has to be looked at once, and in order.

        Args:
            position: float64 [steps, envs, uavs, 3], cells.
            rng_key: int64 [envs], `keys.RNG_KEY`.
            step: int64 [steps, envs], steps since the episode began.
            alive: bool [steps, envs, uavs]; the others see nothing.
        """
        centre, cells, in_view = self._sensor.look(position, self._start, rng_key, step)
        in_view &= alive.unsqueeze(-1)
        time = step[..., None, None].float()
        stamp = step[..., None, None].int() * self._uavs + self._uav
        arrival_time, burnt_out = self._arrival_time.take(cells), None
        burns = in_view & (arrival_time <= time)
        no_fire = in_view & (arrival_time > time)
        if self._burn_out is not None:
            burnt_out = burns & (self._burn_out.take(cells) <= time)
            burns, no_fire = burns ^ burnt_out, no_fire | burnt_out
        claims = torch.where(burns, stamp, _NEVER)

        def new(first_seen: Tensor, at: Tensor) -> Tensor:
            first_seen.view(-1).scatter_reduce_(0, at.view(-1), claims.view(-1), "amin")
            return first_seen.take(at) == stamp

        new_fire = shown_as_new = new(self._first_seen, cells)
        if self._own_first_seen is not None:
            shown_as_new = new(self._own_first_seen, cells + self._own_first)
        classes = torch.stack((shown_as_new, burns ^ shown_as_new, no_fire), -2)
        counts, centres = self._sensor.count_classes(classes, centre)
        shown = Sighting(counts, centres, classes, burnt_out)
        if self._own_first_seen is not None:
            new_count = new_fire.sum(-1, dtype=counts.dtype)
            old_count = counts[..., :2].sum(-1) - new_count
            counts = torch.stack((new_count, old_count, counts[..., 2]), -1)
        burning, burnt = self.count(step)
        seen = self.seen_count + counts[..., 0].sum(-1).long().cumsum(0)
        unseen, ended = burning - seen, (self._fire_index[:0], self._fire_index[:0])
        if self._burnt_out is not None:
            fire = self._fire_index.expand_as(step).flatten()
            ended = row, cell = self._burnt_out.passing(fire, step.flatten())
            was_seen = self._first_seen[row % step.shape[1], cell] < _NEVER
            gone = torch.zeros_like(fire).index_add_(0, row, was_seen.long()).view_as(step)
            gone = self.seen_gone + gone.cumsum(0)
            unseen = unseen + gone
            self.seen_gone.copy_(gone[-1])
        self.seen_count.copy_(seen[-1])
        view = View(cells, in_view, burns)
        return Look(counts, shown, view, burning, burnt, seen, unseen, ended)
