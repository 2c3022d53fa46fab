"""Keeps the belief maps of the UAVs for scripted policies."""

from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.config import RadioConfig
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.exchange import Exchange, cell_bytes, share, step_bytes
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.radio import Channel, budget
from emberlink.envs.world.sensor import Sensor

TARGET_BYTES = 8
"""two float32 numbers"""


class TeamMaps(nn.Module):
    """Stores the last step at which each UAV knows each cell to have been seen.

    The maps are made from the positions of the UAVs alone. The state of the fire is read only for
    cells and steps that a UAV has seen.

    Args:
        env: the environment that the policy acts in.
        radio: over which UAVs exchange maps; if None, the world's, which the base has as well.
    """

    reach: Tensor
    """bool [envs, radios, radios]: whose targets each radio knows at this step"""
    sent: Tensor | None = None
    """int64 [envs, radios]: bytes said at this step; None if whole maps are"""
    _start: Tensor
    _own: Tensor

    def __init__(self, env: WildfireEnv, radio: RadioConfig | None):
        super().__init__()
        world, envs = replace(env.config, radio=radio or env.config.radio), env.num_envs
        self._env, self._world, self._sensor = (env,), world, Sensor(world)
        listens, settings = world.base is not None and radio is None, world.radio
        area = self._sensor.area + world.num_uavs
        self.known = Knowledge(
            envs=envs,
            uavs=world.num_uavs,
            area=area,
            horizon=world.horizon,
            listeners=int(listens),
            fires=settings.packets,
        )
        self.channel, self.exchange = Channel(world, envs, base=listens), None
        radios = world.num_uavs + listens
        if settings.packets:
            sizes = torch.full((area,), cell_bytes(world.horizon))
            sizes[self._sensor.area :] = 2 + step_bytes(world.horizon)  # of a UAV, and the step
            # A target is said at once, or not at all: late, all have chosen already.
            header = 2 + TARGET_BYTES * (settings.delay == 0)
            self.exchange = Exchange(settings, sizes, (envs, radios), header=header)
        self.register_buffer("reach", torch.zeros(envs, radios, radios, dtype=torch.bool))
        first = torch.arange(envs).unsqueeze(-1) * area
        self.register_buffer("_start", first, persistent=False)
        own = self._sensor.area + torch.arange(world.num_uavs) + first
        self.register_buffer("_own", own.unsqueeze(-1), persistent=False)

    @property
    def sends(self) -> bool:
        """Whether the UAVs send their maps."""
        return self._world.radio.range > 0

    def update(self, tensordict: TensorDictBase) -> None:
        """Adds the sightings and messages of a time step; forgets all where an episode begins."""
        step = tensordict.get(keys.STEP)
        begins = step == 0
        self.known.start_episodes(begins)
        if self.exchange is not None:
            self.exchange.start_episodes(begins)
        position = tensordict.get(keys.POSITION).double()
        alive = tensordict.get(keys.ALIVE)
        given = tensordict.get(keys.RNG_KEY), step
        _, cells, in_view = self._sensor.look(position, self._start, *given)
        # A UAV's own position is an entry behind the cells.
        cells = torch.cat((cells, self._own), -1)
        in_view = torch.nn.functional.pad(in_view, (0, 1), value=True)
        in_view &= (alive & ~begins.unsqueeze(-1)).unsqueeze(-1)
        near, hears = self.channel(position, *given, alive)
        view, left = View(cells, in_view, in_view), budget(self._world, near)
        self.sent = share(self.known, self.exchange, view, step, hears, left)
        self.reach.copy_(self.known.reach)
        if self._world.radio.delay:
            self.reach.zero_()

    @property
    def heard(self) -> Tensor:
        """The step of the latest news that each UAV (row) has of another one, [envs, n, n]."""
        uavs = self._world.num_uavs
        return self.known.last_seen[:, :uavs, -uavs:].clamp(min=0)

    def last_seen(self) -> Tensor:
        """Returns the last step at which each UAV knows each cell seen, float [envs, n, X, Y]."""
        seen = self.known.last_seen[:, : self._world.num_uavs, : self._sensor.area]
        return self._sensor.crop(seen).float()

    def was_fire(self, last_seen: Tensor) -> tuple[Tensor, Tensor]:
        """Returns whether cells had ignited and burnt out at `last_seen`, bool like `last_seen`."""
        (env,) = self._env
        seen = last_seen >= 0
        ignited = seen & (last_seen >= env.arrival_time.unsqueeze(1))
        if env.burn_out is None:
            return ignited, torch.zeros_like(ignited)
        return ignited, seen & (last_seen >= env.burn_out.unsqueeze(1))
