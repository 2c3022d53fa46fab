"""Keeps a belief map per UAV and shows it to the UAV as pictures (`env.observation: map`)."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded

from emberlink.comm._crops import Crops
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import motion
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.sensor import Sensor


class BeliefMaps(nn.Module):
    """Keeps what each UAV knows of the fire and of the places of UAVs.

    A UAV enters the view of its camera and its position; the communication method enters the
    messages of others. It observes its altitude, the time and pictures of its map (`Crops`).

    Args:
        world: the environment's constants.
        envs: number of environments.
    """

    known: Knowledge
    """the last looks at cells, and after them at the positions of UAVs; stored are 4 times the step
    plus the cell's state then"""
    view: View
    """the cells that the UAVs see at this step"""
    place: Tensor
    """float32 [envs, n, n, 3]: positions of UAVs as UAVs (row) know them, cells"""
    crops: Tensor
    """uint8 [envs, n, ...]: the pictures last drawn"""
    low: Tensor
    high: Tensor
    _start: Tensor
    _own: Tensor
    _base: Tensor

    def __init__(self, world: WildfireConfig, envs: int):
        super().__init__()
        self.world, self.sensor = world, Sensor(world)
        uavs, settings = world.num_uavs, world.map
        entries, last = self.sensor.area + uavs, 4 * world.horizon + 3
        self.known = Knowledge(envs=envs, uavs=uavs, area=entries, horizon=last, fires=True)
        self.pictures = Crops(
            world.grid,
            pixels=settings.pixels,
            scales=settings.scales,
            spread=settings.spread,
            horizon=world.horizon,
        )
        low, high = motion.corners(world.low, world.high)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.register_buffer("place", torch.zeros(envs, uavs, uavs, 3, dtype=torch.float32))
        drawn = torch.zeros(envs, uavs, *self.pictures.shape, dtype=torch.uint8)
        self.register_buffer("crops", drawn)
        first = torch.arange(envs).unsqueeze(-1) * entries
        self.register_buffer("_start", first, persistent=False)
        own = self.sensor.area + torch.arange(uavs).unsqueeze(-1)
        self.register_buffer("_own", own, persistent=False)
        base = torch.tensor([] if world.base is None else [world.base]).view(-1, 2)
        self.register_buffer("_base", _nearest(base), persistent=False)

    def specs(self, observation: Composite) -> Composite:
        """Returns the environment's observation spec with the vector and the pictures."""
        shape, device = observation[keys.AGENTS].shape, observation.device
        features = 2 + 2 * self.world.map.position
        vector = Unbounded(torch.Size((*shape, features)), device=device, dtype=torch.float32)
        pictures = torch.Size((*shape, *self.pictures.shape))
        observation[keys.OBSERVATION] = vector
        observation[keys.CROPS] = Unbounded(pictures, device=device, dtype=torch.uint8)
        return observation

    @property
    def looks(self) -> Tensor:
        """The entries of cells in `known`, integers [envs, n, area]."""
        return self.known.last_seen[..., : self.sensor.area]

    @property
    def stamp(self) -> Tensor:
        """The steps at which UAVs know positions of UAVs, -1 for never, int64 [envs, n, n]."""
        return self._stamps().long() >> 2

    def _stamps(self) -> Tensor:
        return self.known.last_seen[..., self.sensor.area :]

    def look(self, tensordict: TensorDictBase) -> None:
        """Adds each UAV's view and position to its map, and writes the vector that it observes."""
        position, step = tensordict.get(keys.POSITION), tensordict.get(keys.STEP)
        # A UAV's own position is an entry behind the cells.
        alive = tensordict.get(keys.ALIVE).unsqueeze(-1).byte()
        sight = torch.cat((tensordict.get(keys.SIGHT).flatten(-2), alive), -1)
        cells = self.sensor.look(position.double(), self._start)[1]
        cells = torch.cat((cells, self._own.expand(len(step), -1, -1) + self._start[..., None]), -1)
        self.view = View(cells, sight > 0, sight == 2)
        self.known.see(self.view, self._first_of(step) + sight - 1)
        self.place.diagonal(dim1=1, dim2=2).copy_(position.mT)
        tensordict.set(keys.OBSERVATION, self._vector(position, step))

    def hear_positions(self, hears: Tensor, step: Tensor, place: Tensor) -> None:
        """Enters positions that UAVs have heard.

        Args:
            hears: bool [envs, n, n], the UAVs (column) that a UAV hears.
            step: int64 [envs], when they said where they were.
            place: float32 [envs, n, 3], cells.
        """
        stamps = self._stamps()
        stamps.copy_(torch.where(hears, self._first_of(step), stamps))
        self.place.copy_(torch.where(hears.unsqueeze(-1), place.unsqueeze(1), self.place))

    def _first_of(self, step: Tensor) -> Tensor:
        """Returns the lowest number in a map of each step, int64 [envs, 1, 1]."""
        # Beyond the horizon, a step that does not fit into the map counts as the last that does.
        latest = torch.iinfo(self.known.last_seen.dtype).max >> 2
        return 4 * step.clamp(max=latest).view(-1, 1, 1)

    def show(self, tensordict: TensorDictBase, due: Tensor) -> None:
        """Writes the pictures; redraws the environments of a mask, bool [envs]."""
        each = due.unsqueeze(-1).expand(-1, self.world.num_uavs).nonzero()
        if len(each):
            for rows in each.split(self.pictures.rows):
                env, uav = rows.unbind(-1)
                self.crops[env, uav] = self._draw(tensordict, env, uav)
        tensordict.set(keys.CROPS, self.crops.clone())

    def sightings(self) -> tuple[Tensor, Tensor]:
        """Returns the last look of each UAV at each cell, as it knows it.

        Returns:
            The step, integers [envs, n, X, Y], -1 for never, and the cell's state then: 0 no fire,
            1 fire, 2 burnt out; 3 for never.
        """
        known = self.sensor.crop(self.looks)
        return known >> 2, known & 3

    def _draw(self, tensordict: TensorDictBase, env: Tensor, uav: Tensor) -> Tensor:
        """Returns the pictures of some UAVs, int64 [rows] each, uint8 [rows, ...]."""
        seen, area = self.known.seen_fire, self.sensor.area
        assert seen is not None
        own = uav.unsqueeze(-1) == torch.arange(self.world.num_uavs, device=uav.device)
        return self.pictures.draw(
            self.sensor.crop(self.looks[env, uav]),
            self.sensor.crop(seen[env, uav, :area]),
            tensordict.get(keys.STEP)[env],
            _nearest(tensordict.get(keys.POSITION)[env, uav, :2]),
            _nearest(self.place[env, uav, :, :2]),
            self.stamp[env, uav].masked_fill(own, -1),
            self._base.expand(len(uav), *self._base.shape),
        )

    def _vector(self, position: Tensor, step: Tensor) -> Tensor:
        """Returns scaled altitude, time and, if wanted, x and y, float32 [envs, n, k]."""
        scaled = motion.scale_to_box(position, self.low, self.high)
        clock = step.float().view(-1, 1, 1) / self.world.horizon
        parts = [scaled[..., 2:], clock.expand(-1, scaled.shape[1], 1)]
        if self.world.map.position:
            parts.append(scaled[..., :2])
        return torch.cat(parts, -1)


def _nearest(place: Tensor) -> Tensor:
    """Returns the nearest cells, int64; halves are rounded up, wherever they are in the grid."""
    return (place + 0.5).floor().long()
