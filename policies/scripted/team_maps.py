"""Keeps the belief maps of the UAVs for scripted policies."""

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.sensor import Sensor

Messages = Literal["none", "in range", "everyone"]


class TeamMaps(nn.Module):
    """Stores the last step at which each UAV knows each cell to have been seen.

    The maps are made from the positions of the UAVs alone. The state of the fire is read only for
    cells and steps that a UAV has seen.

    Args:
        env: the environment that the policy acts in.
        messages: whose maps a UAV takes over at each step: nobody's, the UAVs' and the base's whose
            messages arrive, or all UAVs'.
    """

    reach: Tensor
    """bool [envs, radios, radios]: whose messages arrive at each radio at this step"""
    heard: Tensor
    """float32 [envs, n, n]: step of the latest news that each UAV (row) has of another one"""
    _start: Tensor
    _base: Tensor

    def __init__(self, env: WildfireEnv, messages: Messages):
        super().__init__()
        self._env, self._world, self._messages = (env,), env.config, messages
        world, envs = env.config, env.num_envs
        self._sensor = Sensor.of(world)
        listens = world.base is not None and messages == "in range"
        self.known = Knowledge(
            envs=envs,
            uavs=world.num_uavs,
            area=self._sensor.area,
            horizon=world.horizon,
            listeners=int(listens),
        )
        radios = world.num_uavs + listens
        self.register_buffer("reach", torch.zeros(envs, radios, radios, dtype=torch.bool))
        self.register_buffer("heard", torch.zeros(envs, world.num_uavs, world.num_uavs))
        first = torch.arange(envs).unsqueeze(-1) * self._sensor.area
        self.register_buffer("_start", first, persistent=False)
        base = torch.tensor([[*(world.base or (0.0, 0.0)), 0.0]], dtype=torch.float64)
        base = base.repeat(envs if listens else 0, 1, 1)
        self.register_buffer("_base", base, persistent=False)

    @property
    def sends(self) -> bool | Tensor:
        """Whether the UAVs send their maps; a tensor is bool [envs, 1]."""
        in_range = self._messages == "in range" and self._world.radio.range > 0
        return in_range or self._messages == "everyone"

    def update(self, tensordict: TensorDictBase) -> None:
        """Adds the sightings and messages of a time step; forgets all where an episode begins."""
        step = tensordict.get(keys.STEP)
        begins = step == 0
        self.known.start_episodes(begins)
        position = tensordict.get(keys.POSITION).double()
        alive = tensordict.get(keys.ALIVE)
        given = tensordict.get(keys.RNG_KEY), step
        _, cells, in_view = self._sensor.look(position, self._start, *given)
        in_view &= (alive & ~begins.unsqueeze(-1)).unsqueeze(-1)
        hears = self._hears(tensordict, position, alive)
        self.known.update(View(cells, in_view, in_view), step, hears)
        self.reach.copy_(radio.reachable(hears))
        self._update_heard(step, alive)

    def _update_heard(self, step: Tensor, alive: Tensor) -> None:
        """Stores the steps of the latest news, direct or passed on."""
        now, uavs = step.view(-1, 1, 1).float(), self._world.num_uavs
        reach = self.reach[:, :uavs, :uavs]
        self.heard.masked_fill_(now == 0, 0.0)
        own = torch.eye(uavs, dtype=torch.bool, device=alive.device) & alive.unsqueeze(-1)
        known = torch.where(own, now, self.heard)
        told = torch.where(reach.unsqueeze(-1), known.unsqueeze(1), 0.0).amax(2)
        self.heard.copy_(torch.maximum(self.heard, told))

    def _hears(self, tensordict: TensorDictBase, position: Tensor, alive: Tensor) -> Tensor:
        """Returns the links of a step, bool [envs, radios, radios]."""
        if self._messages == "none":
            return torch.zeros_like(self.reach)
        if self._messages == "everyone":
            return alive.unsqueeze(-1) & alive.unsqueeze(-2)
        given = tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP)
        config = self._world.radio
        if len(self._base):
            return radio.links_with_base(config, position, self._base, *given, alive)
        return radio.links(config, position, *given, alive=alive)

    def last_seen(self) -> Tensor:
        """Returns the last step at which each UAV knows each cell seen, float [envs, n, X, Y]."""
        seen = self._sensor.crop(self.known.last_seen[:, : self._world.num_uavs])
        return seen.float()

    def was_fire(self, last_seen: Tensor) -> tuple[Tensor, Tensor]:
        """Returns whether cells had ignited and burnt out at `last_seen`, bool like `last_seen`."""
        (env,) = self._env
        seen = last_seen >= 0
        ignited = seen & (last_seen >= env.arrival_time.unsqueeze(1))
        if env.burn_out is None:
            return ignited, torch.zeros_like(ignited)
        return ignited, seen & (last_seen >= env.burn_out.unsqueeze(1))
