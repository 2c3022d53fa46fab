"""Stores the fires of all environments and when and by which UAV each cell was first seen."""

from typing import NamedTuple

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers
from emberlink.envs.world.burning import BurningCounts
from emberlink.envs.world.sensor import Sensor

_NEVER = torch.iinfo(torch.int32).max


class Sighting(NamedTuple):
    """The cells in view by class: new fire, old fire and no fire."""

    counts: Tensor
    """float64 [..., 3]: number of cells"""
    centres: Tensor
    """float32 [..., 3, 2]: mean (i, j) of the cells; 0 if there are none"""
    classes: Tensor
    """bool [..., 3, W * W]: mask of the cells in the UAV's window"""


class CoverageMap(Buffers):
    """Stores the fire of every environment and the cells that its UAVs have seen.

    The UAVs count the cells in their view one after another, UAV 0 first. So a burning cell is new
    fire for one UAV at one step only, and old fire for the other UAVs and at later steps. A
    sighting is stored as the number step * uavs + uav; the minimum over all sightings of a cell
    gives the first one without a loop over UAVs.

    Args:
        sensor: the UAVs' camera.
        fires: arrival times in steps, float32 [fires, X, Y]; inf for cells that never burn.
        horizon: steps of an episode.
        envs: number of environments.
        uavs: UAVs per environment.
    """

    _fires: Tensor
    _start: Tensor
    _uav: Tensor
    _never: Tensor
    _arrival_time: Tensor
    _fire_index: Tensor
    _first_seen: Tensor
    _stamp: Tensor

    def __init__(self, sensor: Sensor, fires: Tensor, *, horizon: int, envs: int, uavs: int):
        super().__init__()
        self._sensor, self._uavs = sensor, uavs
        self._burning = BurningCounts(fires, horizon)
        # Padding is NaN: all comparisons with it are false, so it belongs to no class.
        self.register_buffer("_fires", sensor.pad(fires, torch.nan), persistent=False)
        self.register_buffer(
            "_start", torch.arange(envs).unsqueeze(-1) * sensor.area, persistent=False
        )
        self.register_buffer(
            "_uav", torch.arange(uavs, dtype=torch.int32).unsqueeze(-1), persistent=False
        )
        self.register_buffer("_never", torch.tensor(_NEVER, dtype=torch.int32), persistent=False)
        self.register_buffer("_arrival_time", self._fires[:1].repeat(envs, 1))
        self.register_buffer("_fire_index", torch.zeros(envs, dtype=torch.int64))
        first_seen = torch.full((envs, sensor.area), _NEVER, dtype=torch.int32)
        self.register_buffer("_first_seen", first_seen)
        self.register_buffer("_stamp", self._uav.repeat(envs, 1, 1))

    def __len__(self) -> int:
        """Returns the number of fires."""
        return len(self._fires)

    @property
    def arrival_time(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [envs, X, Y]."""
        return self._sensor.crop(self._arrival_time)

    @property
    def seen(self) -> Tensor:
        """Whether each cell burned when a UAV saw it, bool [envs, X, Y]."""
        return self._sensor.crop(self._first_seen < _NEVER)

    def start_episodes(self, mask: Tensor, fire: Tensor) -> None:
        """Starts new episodes in the environments of a mask.

        Args:
            mask: bool [envs].
            fire: int64 [envs], the index of each environment's fire.
        """
        self._arrival_time.copy_(torch.where(mask[:, None], self._fires[fire], self._arrival_time))
        self._fire_index.copy_(torch.where(mask, fire, self._fire_index))
        self._first_seen.masked_fill_(mask[:, None], _NEVER)
        self._stamp.copy_(torch.where(mask[:, None, None], self._uav, self._stamp))

    def count_burning(self, step: Tensor) -> Tensor:
        """Returns the number of cells that burn at steps, int64 [envs]; int64 [envs]."""
        return self._burning.at(self._fire_index, step)

    def look(self, position: Tensor, step: Tensor) -> Sighting:
        """Classifies the cells in view of all UAVs and marks the burning ones as seen.

        It must be called exactly once per step.

        Args:
            position: float64 [envs, uavs, 3], cells.
            step: float32 [envs], steps since the episode began.

        Returns:
            The cells in view of each UAV, batch shape [envs, uavs].
        """
        centre, cells, in_view = self._sensor.look(position, self._start)
        stamp, first_seen, time = self._stamp, self._first_seen, step.view(-1, 1, 1)
        stamp.add_(self._uavs)
        arrival_time = self._arrival_time.take(cells)
        burning = in_view & (arrival_time <= time)
        claims = torch.where(burning, stamp, self._never)
        first_seen.view(-1).scatter_reduce_(0, cells.view(-1), claims.view(-1), "amin")
        new = first_seen.take(cells) == stamp
        classes = torch.stack((new, burning ^ new, in_view & (arrival_time > time)), -2)
        return Sighting(*self._sensor.count_classes(classes, centre), classes)
