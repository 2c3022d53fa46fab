"""Exchanges the belief maps of UAVs by radio, and brings UAVs home."""

from typing import ClassVar

import torch
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.comm._belief import BeliefMaps
from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT
from emberlink.envs.world import motion, radio
from emberlink.envs.world.exchange import Exchange, cell_bytes, step_bytes

_DIAGONAL = 2**0.5  # greatest distance over the ground that a unit of action leads


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MapsConfig:
    """Stores the settings under `comm`."""

    home: bool = False
    """whether UAVs fly to a chain of radios to the base in time, whatever the policy does; without
    a base, and without a radio that reaches it, they do not"""


class Maps(CommModule):
    """Passes on the entries of the UAVs' belief maps.

    At each step, a UAV sends the cells and the positions of UAVs that are new to a UAV in range, as
    far as it has heard, and acknowledges messages; what it receives, it passes on at the next step
    (`Exchange`).

    With `home` and a base, a UAV leaves for its place in a chain of radios from the base to the
    fire that it knows when it would otherwise come too late (`steer`).

    Raises:
        UserError: the UAVs have no maps.
    """

    config_type: ClassVar[type] = MapsConfig
    hears: ClassVar[bool] = True
    heeds_packets: ClassVar[bool] = True
    maps: BeliefMaps  # pyright: ignore[reportIncompatibleVariableOverride]
    home: Tensor
    """float32 [num_envs, n, 3]: each UAV's place in a chain to the base and its reach, cells"""
    _base: Tensor

    def __init__(self, world: WildfireConfig, config: MapsConfig, num_envs: int = 1):
        super().__init__(world, config, num_envs)
        if world.observation != "map":
            raise UserError(
                f"env.observation={world.observation}: comm.name=maps exchanges the UAVs' maps, "
                "which they have with env.observation=map"
            )
        agents, area = (num_envs, world.num_uavs), self.maps.sensor.area
        sizes = torch.full((area + world.num_uavs,), cell_bytes(world.horizon))
        sizes[area:] = 2 + step_bytes(world.horizon) + 12  # UAV, step, three float32 numbers
        self.messages = Exchange(world.radio, sizes, agents, unit=4)
        pairs = num_envs, world.num_uavs, world.num_uavs
        self.places = radio.Late(world.radio.delay, torch.tensor(0.0), *pairs, 3)
        self.register_buffer("home", torch.zeros(*agents, 3, dtype=torch.float32))
        base = torch.tensor(world.base or (0.0, 0.0), dtype=torch.float32)
        self.register_buffer("_base", base, persistent=False)
        reached = world.base is not None and world.radio.range > world.altitude[1]
        self._brings_home = config.home and reached

    def reset(self, tensordict: TensorDictBase, mask: Tensor) -> None:
        """Forgets who was in range."""
        self.messages.start_episodes(mask)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        maps, step, left = self.maps, tensordict.get(keys.STEP), tensordict.get(keys.BUDGET, None)
        self.messages.saw(maps.view)
        hears = tensordict.get(keys.HEARS)
        self._said, _, new = self.messages(maps.known, hears, step, left)
        places, area = self.places(maps.place.clone()), maps.sensor.area
        env, hearer, speaker, entry = new[:, new[3] >= area]
        uav = entry - area
        maps.place[env, hearer, uav] = places[env, speaker, uav]
        due = (step % self.hold == 0).nonzero().squeeze(-1)
        if self._brings_home and len(due):
            self.home[due] = self._find_home(tensordict, due)
        return tensordict

    @property
    def steers(self) -> bool:
        return self._brings_home

    def steer(self, tensordict: TensorDictBase) -> Tensor | None:
        if not self.steers:
            return None
        action, maps = tensordict.get(keys.ACTION), self.maps
        position, step = maps.place.diagonal(dim1=1, dim2=2).mT, maps.stamp.diagonal(dim1=1, dim2=2)
        return steer_home(self.world, action, self.home, position, step)

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the bytes that each UAV said at the last step, int64 [num_envs, n]."""
        return self._said

    def _find_home(self, tensordict: TensorDictBase, env: Tensor) -> Tensor:
        """Returns the place and reach of UAVs in a chain to the fire, float32 [len(env), n, 3]."""
        burning = self.maps.sensor.crop(self.maps.looks[env]) & 3 == 1
        step, heard = tensordict.get(keys.STEP)[env], self.maps.stamp[env].clamp(min=0)
        place, reach = radio.chain_to_fire(self.world, self._base, burning, step, heard)
        return torch.cat((place, reach.unsqueeze(-1)), -1)


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
