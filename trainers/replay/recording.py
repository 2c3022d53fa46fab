"""Records an episode, so that it can be drawn: fire, tracks, fields of view, links, measures."""

import dataclasses
import math
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from emberlink.comm.base import CommModule
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.world.exchange import Exchange
from emberlink.envs.world.measures import whole_steps
from emberlink.envs.world.radio import Channel
from emberlink.envs.world.sensor import Sensor

COUNTS = {"seen": keys.SEEN, "burning": keys.BURNING, "burnt": keys.BURNT}
OF_BASE = {"base_seen": keys.BASE_SEEN, "base_age": keys.BASE_AGE}
ADVICE = {"follows": keys.FOLLOWS, "target": keys.TARGET}
"""advice of a communication module to the UAVs"""
ROLES = ("discoverer", "seeker", "wanderer")
"""the roles of UAVs in a consensus network (paper, section IV.F)"""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One episode: T steps, n UAVs, r radios (the UAVs, and the base last if there is one)."""

    title: str = ""
    """the title that it is shown with"""
    world: WildfireConfig
    listens: bool
    """whether the policy or a base station receives messages"""
    ignition: NDArray[Any]
    """[X, Y]: the first step at which each cell burns, T + 1 for never"""
    end: NDArray[Any]
    """[X, Y]: the first step at which each cell no longer burns, T + 1 for never"""
    steps: dict[str, NDArray[Any]]
    """name -> numbers after each step, [T + 1, ...]:

    - position: float32 [n, 3], cells; alive: bool [n]; reward: float32 [n], 0 at step 0
    - view: int [n, 4], the first and last cell in view along x, then along y; (1, 0, 1, 0) for none
    - hears: bool [r, r], whether a radio (row) heard another one (column); lost: bool [r, r],
      whether it was in range but the message was lost; both at the step of sending
    - waits: int64 [n], bytes that did not fit into the step; only with `env.radio.bandwidth`
    - missed: bool [n, W, W], the cells of the view, from its first along x and y, that the UAV did
      not recognise; only with `env.sensor`
    - `COUNTS`, `OF_BASE` with a base, `ADVICE` if the policy follows it
    """

    @property
    def horizon(self) -> int:
        """The number of steps, T."""
        return len(self.steps["position"]) - 1

    @cached_property
    def first_seen(self) -> NDArray[Any]:
        """The first step at which a UAV saw each cell while it burned, T + 1 for never, [X, Y]."""
        first = np.full_like(self.ignition, self.horizon + 1)
        for step in range(self.horizon, 0, -1):
            first[self._seen(step)] = step
        return first

    def front_age(self) -> NDArray[Any]:
        """Returns the measure `front_age` up to each step, float32 [T + 1]."""
        since, total, count = self.ignition.copy(), 0, 0
        means = np.zeros(self.horizon + 1, np.float32)
        for step in range(1, self.horizon + 1):
            since[self._seen(step)] = step
            ages = step - since[self._burns(step)]
            total, count = total + ages.sum(dtype=np.int64), count + ages.size
            means[step] = total / max(count, 1)
        return means

    def _burns(self, step: int) -> NDArray[np.bool_]:
        return (self.ignition <= step) & (step < self.end)

    def _seen(self, step: int) -> NDArray[np.bool_]:
        """Returns the burning cells that a UAV recognised at a step, bool [X, Y]."""
        seen = np.zeros(self.ignition.shape, bool)
        for uav, (left, right, low, high) in enumerate(self.steps["view"][step].tolist()):
            part = seen[left : right + 1, low : high + 1]
            if "missed" in self.steps:
                part |= ~self.steps["missed"][step, uav, : part.shape[0], : part.shape[1]]
            else:
                part[:] = True
        return seen & self._burns(step)

    def fire_map(self, step: int) -> NDArray[np.uint8]:
        """Returns `WildfireEnv.fire_map` at a step, uint8 [X, Y]."""
        fire = (self.ignition <= step).astype(np.uint8) * (2 - (self.first_seen <= step))
        return (fire + 2 * (self.end <= step)).astype(np.uint8)

    def coverage(self, step: int) -> float:
        """Returns cells seen / cells burnt up to a step, in %; 100 where nothing has burnt."""
        seen, burnt = (int(self.steps[name][step]) for name in ("seen", "burnt"))
        return 100 * seen / burnt if burnt else 100.0


class Recorder:
    """Records the episode of the environment with index `member`; `add` is called at each step.

    It computes views and links again, which the environment does not show.
    """

    def __init__(self, member: int = 0):
        self.member = member
        self._steps: dict[str, list[NDArray[Any]]] = {}

    def add(self, env: TransformedEnv, td: TensorDictBase, policy: Any = None) -> None:
        """Adds one step, at which the environments returned `td`: of a reset, or its "next".

        `policy` may exchange messages by itself. The advice of the communication is recorded if the
        policy reads it, or is None.
        """
        now: Any = td[self.member : self.member + 1].cpu()
        if not self._steps:
            self._start(env, policy)
        wanted = {"position": keys.POSITION, "alive": keys.ALIVE, **COUNTS, **OF_BASE}
        if self._advised:
            self._hears |= now.get(keys.HEARS, None) is not None
            wanted |= ADVICE
        values = {name: now.get(key, None) for name, key in wanted.items()}
        reward = now.get(keys.REWARD, None)
        values["reward"] = torch.zeros(values["alive"].shape) if reward is None else reward[..., 0]
        for name, value in (values | self._look(now)).items():
            if value is not None:
                self._steps.setdefault(name, []).append(value[0].numpy().copy())

    def recording(self, title: str = "") -> Recording:
        """Returns the recorded episode."""
        steps = {name: np.stack(values) for name, values in self._steps.items()}
        listens = self._hears or self._world.base is not None
        ignition, end = (times.numpy() for times in self._whole)
        return Recording(
            title=title, world=self._world, listens=listens, ignition=ignition, end=end, steps=steps
        )

    def _start(self, env: TransformedEnv, policy: Any) -> None:
        """Takes the fire of the environment, and finds the radios."""
        world: Any = env.base_env
        parts = [*nn.ModuleList([env] if policy is None else [env, policy]).modules()]
        self._exchanges = [part for part in parts if isinstance(part, Exchange)]
        comm = next(part for part in parts if isinstance(part, CommModule))
        self._advised = policy is None or any(key in comm.out_keys for key in policy.in_keys)
        self._hears = getattr(policy, "hears", False)
        self._world, self._sensor = world.config, Sensor(world.config)
        arrival, burn_out = world.arrival_time[self.member].cpu(), world.burn_out
        end = torch.full_like(arrival, torch.inf) if burn_out is None else burn_out[self.member]
        self._whole = [whole_steps(times.cpu(), world.config.horizon) for times in (arrival, end)]
        self._channel = Channel(world.config, 1, base=world.config.base is not None)

    def _look(self, now: TensorDictBase) -> dict[str, Tensor]:
        """Returns the views and links of a time step of batch size [1]."""
        position, alive = now.get(keys.POSITION).double(), now.get(keys.ALIVE)
        key, step = now.get(keys.RNG_KEY), now.get(keys.STEP)
        near, hears = self._channel(position, key, step, alive)
        looks = alive & (step > 0)  # nobody looks at the reset
        view = self._view(position, looks)
        found = {"view": view}
        if self._world.radio.packets:  # a radio may say nothing, as it has no news or does not fit
            says = now.get(keys.BYTES_SENT, alive).unsqueeze(1) > 0
            says = nn.functional.pad(says, (0, near.shape[1] - says.shape[2]), value=True)
            near, hears = near & says, hears & says
        if self._world.radio.bandwidth is not None:
            uavs, none = alive.shape[1], torch.zeros_like(alive, dtype=torch.int64)
            waits = (one.waits[self.member, :uavs].cpu() for one in self._exchanges)
            found["waits"] = sum(waits, none)
        found |= {"hears": hears, "lost": near & ~hears}
        if self._world.sensor != (1.0, 1.0):
            found["missed"] = self._missed(position, looks, key, step, view)
        return found

    def _view(self, position: Tensor, looks: Tensor) -> Tensor:
        """Returns the first and last cells in view along x and y, int16 [1, n, 4]."""
        reach = position[..., 2:] * math.tan(math.radians(self._world.view_angle))
        bounds, found = [], looks
        for axis, side in enumerate(self._world.grid):
            near = (torch.arange(side) - position[..., axis, None]).abs() <= reach
            found = found & near.any(-1)
            last = side - 1 - near.flip(-1).int().argmax(-1)
            bounds += [near.int().argmax(-1), last]
        none = torch.tensor([1, 0, 1, 0])
        return torch.where(found[..., None], torch.stack(bounds, -1), none).short()

    def _missed(
        self, position: Tensor, looks: Tensor, key: Tensor, step: Tensor, view: Tensor
    ) -> Tensor:
        """Returns the cells in view that were not recognised, bool [1, n, W, W]."""
        side, start = self._sensor.side, torch.zeros(1, 1, dtype=torch.int64)
        centre, _, whole = self._sensor.look(position, start)
        missed = whole & ~self._sensor.look(position, start, key, step)[2] & looks[..., None]
        # From the first cell of the window to the first of the view, which is within the grid.
        shifts = centre.long() - side // 2 - view[..., ::2]
        windows = zip(missed[0].unflatten(-1, (side, side)), shifts[0].tolist(), strict=True)
        return torch.stack([window.roll(shift, (0, 1)) for window, shift in windows])[None]
