"""Keeps a belief map per UAV, exchanged by radio and observed as pictures."""

from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field, Strict
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from emberlink.comm._crops import LARGEST_SCALE, Crops
from emberlink.comm._messages import (
    CellMessages,
    cell_bytes,
    offers,
    pass_on_places,
    place_bytes,
    place_gain,
    said_within,
)
from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.validation import STRICT
from emberlink.envs.world import motion, radio
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.sensor import Sensor

_DIAGONAL = 2**0.5  # greatest distance over the ground that a unit of action leads


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MapsConfig:
    """Stores the settings under `comm`."""

    pixels: Annotated[int, Field(ge=8, le=64)] = 24
    """pixels along the side of a picture"""
    scales: Annotated[
        tuple[Annotated[int, Field(ge=1, le=LARGEST_SCALE)], ...],
        Field(min_length=1, max_length=4),
        Strict(False),
    ] = (1, 5)
    """cells along the side of a pixel, in each picture"""
    spread: Annotated[int, Field(ge=0, le=16)] = 2
    """cells around known fire that may burn by now, along x and y; 0 for none"""
    position: bool = False
    """whether a UAV also observes its own x and y"""
    home: bool = True
    """whether UAVs fly to a chain of radios to the base in time, whatever the policy does; without
    a base, and without a radio that reaches it, they do not"""


class Maps(CommModule):
    """Keeps a belief map per UAV and shows it to the UAV as pictures.

    At each step, a UAV sends the cells and the positions of UAVs that are new to a UAV in range;
    received messages are passed on at the next step. With a limit of bytes, the highest gain is
    sent first. A UAV observes its altitude, the time and pictures of its map (`Crops`). With a
    limit, a sender chooses by the maps of all UAVs in range, so what one of them receives may
    depend on the maps of the others.

    With `home` and a base, a UAV leaves for its place in a chain of radios from the base to the
    fire that it knows when it would otherwise come too late (`steer`).
    """

    config_type: ClassVar[type] = MapsConfig
    hears: ClassVar[bool] = True
    heeds_bandwidth: ClassVar[bool] = True
    units: ClassVar[tuple[str, ...]] = "scales", "spread"
    stamp: Tensor
    """int64 [num_envs, n, n]: steps at which UAVs know positions of UAVs, -1 for never"""
    place: Tensor
    """float32 [num_envs, n, n, 3]: these positions, cells"""
    crops: Tensor
    """uint8 [num_envs, n, ...]: the pictures last drawn"""
    said: Tensor
    """int64 [num_envs, n]: the bytes said at the last step"""
    home: Tensor
    """float32 [num_envs, n, 3]: each UAV's place in a chain to the base and its reach, cells"""
    low: Tensor
    high: Tensor
    _start: Tensor
    _base: Tensor
    _base_place: Tensor

    def __init__(self, world: WildfireConfig, config: MapsConfig, num_envs: int = 1):
        super().__init__(world, config, num_envs)
        inputs: list[Any] = [keys.SIGHT, keys.POSITION, keys.HEARS, keys.ALIVE, keys.STEP]
        outputs: list[Any] = [keys.OBSERVATION, keys.CROPS]
        self.in_keys, self.out_keys = inputs, outputs
        low, high = motion.corners(world.low, world.high)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.sensor = Sensor.of(world)
        uavs, area = world.num_uavs, self.sensor.area
        # Stored: 4 * step + state of the cell.
        last = 4 * world.horizon + 3
        self.known = Knowledge(envs=num_envs, uavs=uavs, area=area, horizon=last, fires=True)
        size = cell_bytes(world.horizon)
        self.messages = CellMessages(num_envs, uavs, area, size)
        self.pictures = Crops(
            world.grid,
            pixels=config.pixels,
            scales=config.scales,
            spread=config.spread,
            horizon=world.horizon,
        )
        agents = num_envs, uavs
        self.register_buffer("stamp", torch.full((*agents, uavs), -1))
        self.register_buffer("place", torch.zeros(*agents, uavs, 3, dtype=torch.float32))
        drawn = torch.zeros(*agents, *self.pictures.shape, dtype=torch.uint8)
        self.register_buffer("crops", drawn)
        self.register_buffer("home", torch.zeros(*agents, 3, dtype=torch.float32))
        self.register_buffer("said", torch.zeros(agents, dtype=torch.int64))
        first = torch.arange(num_envs).unsqueeze(-1) * area
        self.register_buffer("_start", first, persistent=False)
        base = torch.tensor([] if world.base is None else [world.base]).view(-1, 2)
        self.register_buffer("_base", _nearest(base), persistent=False)
        self.register_buffer("_base_place", base.float(), persistent=False)
        self._brings_home = config.home and hears_home(world)

    def specs(self, observation: Composite) -> Composite:
        shape, device = observation[keys.AGENTS].shape, observation.device
        features = 2 + 2 * self.config.position
        vector = Unbounded(torch.Size((*shape, features)), device=device, dtype=torch.float32)
        pictures = torch.Size((*shape, *self.pictures.shape))
        observation[keys.OBSERVATION] = vector
        observation[keys.CROPS] = Unbounded(pictures, device=device, dtype=torch.uint8)
        return observation

    def reset(self, tensordict: TensorDictBase, mask: Tensor) -> None:
        """Forgets everything."""
        self.known.start_episodes(mask)
        self.messages.start_episodes(mask)
        self.stamp.masked_fill_(mask[:, None, None], -1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._look(tensordict)
        self._talk(tensordict)
        self._draw(tensordict)
        tensordict.set(keys.CROPS, self.crops.clone())
        return tensordict.set(keys.OBSERVATION, self._vector(tensordict))

    def steer(self, tensordict: TensorDictBase) -> Tensor | None:
        if not self._brings_home:
            return None
        action = tensordict.get(keys.ACTION)
        position, step = self.place.diagonal(dim1=1, dim2=2).mT, self.stamp.diagonal(dim1=1, dim2=2)
        return steer_home(self.world, action, self.home, position, step)

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the bytes that each UAV said at the last step, int64 [num_envs, n]."""
        return self.said.clone()

    def sightings(self) -> tuple[Tensor, Tensor]:
        """Returns the last look of each UAV at each cell, as it knows it.

        Returns:
            The step, int64 [num_envs, n, X, Y], -1 for never, and the cell's state then: 0 no fire,
            1 fire, 2 burnt out; 3 for never.
        """
        known = self.sensor.crop(self.known.last_seen).long()
        return known >> 2, known & 3

    def _look(self, tensordict: TensorDictBase) -> None:
        """Adds each UAV's view and position to its maps."""
        position, step = tensordict.get(keys.POSITION), tensordict.get(keys.STEP)
        sight = tensordict.get(keys.SIGHT).flatten(-2)
        cells = self.sensor.look(position.double(), self._start)[1]
        view = View(cells, sight > 0, sight == 2)
        # Beyond the horizon, a step that does not fit into the map counts as the last that does.
        latest = torch.iinfo(self.known.last_seen.dtype).max >> 2
        self.known.see(view, 4 * step.clamp(max=latest).view(-1, 1, 1) + sight - 1)
        self.messages.saw(view)
        alive = tensordict.get(keys.ALIVE)
        own = self.stamp.diagonal(dim1=1, dim2=2)
        own.copy_(torch.where(alive, step.unsqueeze(-1), own))
        self.place.diagonal(dim1=1, dim2=2).copy_(position.mT)

    def _talk(self, tensordict: TensorDictBase) -> None:
        """Exchanges messages between UAVs in range, and counts the bytes."""
        near = hears = tensordict.get(keys.HEARS)
        settings, limit = self.world.radio, self.world.radio.bandwidth
        if settings.loss:
            place, alive = tensordict.get(keys.POSITION), tensordict.get(keys.ALIVE)
            near = radio.in_range(settings, place, alive)
        news = self.messages.compare(self.known, near)
        said_cells = said_places = None
        sizes = self.messages.size, place_bytes(self.world.horizon)
        if limit is not None:
            cells = offers(self.known, news, limit // sizes[0])
            places = place_gain(self.stamp, near)
            area = self.sensor.area
            said_cells, said_places = said_within(limit, cells, places, area, sizes)
        spoken = self.messages.pass_on(self.known, near, hears, news, said_cells)
        spoken += pass_on_places(self.stamp, self.place, near, hears, said_places, sizes[1])
        self.said.copy_(spoken)

    def _draw(self, tensordict: TensorDictBase) -> None:
        """Draws the pictures of the environments in which they are due, and looks for home."""
        step = tensordict.get(keys.STEP)
        env = (step % self.hold == 0).nonzero().squeeze(-1)
        if not len(env):
            return
        self.crops[env] = self._pictures(tensordict, env)
        if self._brings_home:
            self.home[env] = self._find_home(tensordict, env)

    def _pictures(self, tensordict: TensorDictBase, env: Tensor) -> Tensor:
        """Returns the pictures of some environments, uint8 [len(env), n, ...]."""
        uavs, seen = self.world.num_uavs, self.known.seen_fire
        assert seen is not None
        own = torch.eye(uavs, dtype=torch.bool, device=env.device)
        heard = self.stamp[env].masked_fill(own, -1)
        others = _nearest(self.place[env][..., :2])
        centre = _nearest(tensordict.get(keys.POSITION)[env][..., :2])
        base = self._base.expand(len(env), uavs, *self._base.shape)
        step = tensordict.get(keys.STEP)[env].unsqueeze(-1).expand(-1, uavs)
        drawn = self.pictures.draw(
            self.sensor.crop(self.known.last_seen[env]).flatten(0, 1),
            self.sensor.crop(seen[env]).flatten(0, 1),
            step.flatten(),
            centre.flatten(0, 1),
            tuple(x.flatten(0, 1) for x in (others, heard, base)),
        )
        return drawn.unflatten(0, (len(env), uavs))

    def _find_home(self, tensordict: TensorDictBase, env: Tensor) -> Tensor:
        """Returns the place and reach of UAVs in a chain to the fire, float32 [len(env), n, 3]."""
        known = self.sensor.crop(self.known.last_seen[env])
        burning = (known >= 0) & (known & 3 == 1)
        step, heard = tensordict.get(keys.STEP)[env], self.stamp[env].clamp(min=0)
        base = self._base_place[0]
        place, reach = radio.chain_to_fire(self.world, base, burning, step, heard)
        return torch.cat((place, reach.unsqueeze(-1)), -1)

    def _vector(self, tensordict: TensorDictBase) -> Tensor:
        """Returns scaled altitude, time and, if wanted, x and y, float32 [num_envs, n, k]."""
        scaled = motion.scale_to_box(tensordict.get(keys.POSITION), self.low, self.high)
        clock = tensordict.get(keys.STEP).float().view(-1, 1, 1) / self.world.horizon
        parts = [scaled[..., 2:], clock.expand(-1, scaled.shape[1], 1)]
        if self.config.position:
            parts.append(scaled[..., :2])
        return torch.cat(parts, -1)


def _nearest(place: Tensor) -> Tensor:
    """Returns the nearest cells, int64; halves are rounded up, wherever they are in the grid."""
    return (place + 0.5).floor().long()


def hears_home(world: WildfireConfig) -> bool:
    """Returns whether there is a base that hears UAVs at the ceiling."""
    return world.base is not None and world.radio.range > world.altitude[1]


def steer_home(
    world: WildfireConfig, action: Tensor, home: Tensor, position: Tensor, step: Tensor
) -> Tensor:
    """Returns the actions of a step: home, if a UAV that flies on would come too late.

    A UAV has to be home, and at the ceiling, 15 steps before the end and from then on. The action
    over the ground and the action along z are decided independently.

    Args:
        action: float32 [envs, n, 3], the actions of the policy.
        home: float32 [envs, n, 3], each UAV's place along x and y, and the greatest distance from
            it, cells.
        position: float32 [envs, n, 3], cells.
        step: int64 [envs, n], steps since the episode began.
    """
    speed = world.displacement
    way, up = home[..., :2] - position[..., :2], world.altitude[1] - position[..., 2:]
    # If it flies on, it may be farther away after this step, and has the steps that are left then.
    apart = torch.linalg.vector_norm(way, dim=-1) - home[..., 2] + _DIAGONAL * speed
    left = world.horizon - radio.PASSING - (step + 1)
    leaves = (apart > 0) & (apart / speed > left)
    climbs = (up.squeeze(-1) + speed) / speed > left
    needed = torch.cat((motion.towards(way, speed), motion.towards(up, speed)), -1)
    return torch.where(torch.stack((leaves, leaves, climbs), -1), needed, action)
