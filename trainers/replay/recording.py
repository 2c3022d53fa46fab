"""Records an episode, so that it can be drawn: fire, tracks, fields of view, links, measures."""

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.measures import Measures, whole_steps
from emberlink.envs.world.radio import Channel
from emberlink.envs.world.sensor import Sensor

COUNTS = {"seen": keys.SEEN, "burning": keys.BURNING, "burnt": keys.BURNT}
AGES = {"front_age": keys.FRONT_AGE, "front_age_p95": keys.FRONT_AGE_P95}
OF_BASE = {"base_seen": keys.BASE_SEEN, "base_age": keys.BASE_AGE}
ADVICE = {"follows": keys.FOLLOWS, "target": keys.TARGET}
"""advice of a communication module to the UAVs"""
ROLES = ("discoverer", "seeker", "wanderer")
"""the roles of UAVs in a consensus network (paper, section IV.F)"""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One episode: T steps, n UAVs, r radios (the UAVs, and the base last if there is one)."""

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
      whether it was in range but the message was lost
    - missed: bool [n, W, W], the cells of the view, from its first along x and y, that the UAV did
      not recognise; only with `env.sensor`
    - `COUNTS` and `AGES`, `OF_BASE` with a base, `ADVICE` if the policy follows it
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
            for uav, (left, right, low, high) in enumerate(self.steps["view"][step].tolist()):
                seen = np.s_[left : right + 1, low : high + 1]
                burns = (self.ignition[seen] <= step) & (step < self.end[seen])
                if "missed" in self.steps:
                    missed = self.steps["missed"][step, uav]
                    burns &= ~missed[: burns.shape[0], : burns.shape[1]]
                first[seen][burns] = step
        return first

    def fire_map(self, step: int) -> NDArray[np.uint8]:
        """Returns `WildfireEnv.fire_map` at a step, uint8 [X, Y]."""
        fire = (self.ignition <= step).astype(np.uint8) * (2 - (self.first_seen <= step))
        return (fire + 2 * (self.end <= step)).astype(np.uint8)

    def coverage(self, step: int) -> float:
        """Returns cells seen / cells burnt up to a step, in %; 100 where nothing has burnt."""
        seen, burnt = (int(self.steps[name][step]) for name in ("seen", "burnt"))
        return 100 * seen / burnt if burnt else 100.0

    def roles(self, step: int) -> list[int | None]:
        """Returns the role of each UAV at a step, an index in `ROLES`; None without roles."""
        if "follows" not in self.steps:
            return [None] * self.world.num_uavs
        followed = enumerate(self.steps["follows"][step].tolist())
        return [2 if other < 0 else int(other != uav) for uav, other in followed]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episode:
    """An episode and the title that it is shown with."""

    title: str
    recording: Recording


class Recorder:
    """Records the episode of one environment; `add` is called at each step.

    It repeats what the environment computes and does not show: views, links and, in every world,
    the ages. `member` is the index of the environment; `advised` tells whether the policy reads
    what the communication tells it, and `hears` whether it receives messages of its own.
    """

    def __init__(self, *, member: int = 0, advised: bool = True, hears: bool = False):
        self._member, self._advised, self._hears = member, advised, hears
        self._steps: dict[str, list[NDArray[Any]]] = {}

    def add(self, world: WildfireEnv, td: TensorDictBase) -> None:
        """Adds one step, at which the environments returned `td`: of a reset, or its "next"."""
        now: Any = td[self._member : self._member + 1].cpu()
        if not self._steps:
            self._start(world)
        wanted = {"position": keys.POSITION, "alive": keys.ALIVE, **COUNTS}
        values = {name: now.get(key) for name, key in wanted.items()}
        reward = now.get(keys.REWARD, None)
        values["reward"] = torch.zeros(values["alive"].shape) if reward is None else reward[..., 0]
        if self._advised:
            self._hears |= now.get(keys.HEARS, None) is not None
            advice = {name: now.get(key, None) for name, key in ADVICE.items()}
            values |= {name: value for name, value in advice.items() if value is not None}
        for name, value in (values | self._look(now)).items():
            self._steps.setdefault(name, []).append(value[0].numpy().copy())

    def recording(self) -> Recording:
        """Returns the recorded episode."""
        ignition, end = (self._sensor.crop(steps)[0].numpy() for steps in self._whole)
        steps = {name: np.stack(values) for name, values in self._steps.items()}
        listens = self._hears or self._config.base is not None
        return Recording(
            world=self._config, listens=listens, ignition=ignition, end=end, steps=steps
        )

    def _start(self, world: WildfireEnv) -> None:
        """Takes the fire of the environment."""
        self._config, self._sensor = world.config, Sensor.of(world.config)
        measured = dataclasses.replace(world.config, measures="all")
        self._measures = Measures(measured, 1, self._sensor.area)
        member, burn_out = [self._member], world.burn_out
        arrival = self._sensor.pad(world.arrival_time[member].cpu(), torch.nan)
        end = None if burn_out is None else self._sensor.pad(burn_out[member].cpu(), torch.nan)
        self._times, never = (arrival, end), torch.full_like(arrival, torch.inf)
        self._whole = [
            whole_steps(times, world.config.horizon)
            for times in (arrival, never if end is None else end)
        ]
        counts = self._burning(torch.zeros(1)).sum(-1), (self._whole[0] == 0).sum(-1)
        self._measures.start_episodes(torch.ones(1, dtype=torch.bool), arrival, *counts)
        self._channel = Channel(world.config, 1, base=world.config.base is not None)

    def _look(self, now: TensorDictBase) -> dict[str, Tensor]:
        """Returns the views, links and ages of a time step of batch size [1]."""
        position, alive = now.get(keys.POSITION).double(), now.get(keys.ALIVE)
        key, step = now.get(keys.RNG_KEY), now.get(keys.STEP)
        start = torch.zeros(1, 1, dtype=torch.int64)
        whole = self._sensor.look(position, start)[2] & alive.unsqueeze(-1)
        view = self._view(position, alive, key, step)
        if step > 0:  # nobody looks at the reset
            ignition, end = self._whole
            burnt, (row, cell) = (ignition <= step).sum(-1), (end == step).nonzero().unbind(1)
            seen = View(*(part.unsqueeze(0) for part in view))
            at = position[None], key, step[None], alive[None], burnt[None]
            self._measures.update(seen, (row, cell), self._times, *at)
        else:
            whole.zero_()
        hears = self._channel(position, key, step, alive)
        near = self._channel.in_range(position, alive)
        measured = self._measures.values(step)
        ages = {name: measured[key] for name, key in (AGES | OF_BASE).items() if key in measured}
        bounds = self._bounds(view._replace(in_view=whole))
        looks = {"view": bounds}
        if self._config.sensor != (1.0, 1.0):
            looks["missed"] = self._missed(view._replace(in_view=whole & ~view.in_view), bounds)
        return {**looks, "hears": hears, "lost": near & ~hears, **ages}

    def _view(self, position: Tensor, alive: Tensor, key: Tensor, step: Tensor) -> View:
        start = torch.zeros(1, 1, dtype=torch.int64)
        _, cells, in_view = self._sensor.look(position, start, key, step)
        in_view &= alive.unsqueeze(-1)
        return View(cells, in_view, in_view & self._burning(step)[0].take(cells))

    def _burning(self, step: Tensor) -> Tensor:
        ignition, end = self._whole
        return (ignition <= step) & (step < end)

    def _on_map(self, view: View) -> Tensor:
        """Returns the cells in view on the map, bool [n, X, Y]."""
        seen = torch.zeros(view.cells.shape[1], self._sensor.area, dtype=torch.bool)
        return self._sensor.crop(seen.scatter_(1, view.cells[0], view.in_view[0]))

    def _missed(self, missed: View, bounds: Tensor) -> Tensor:
        """Returns missed cells from the corner of each view on, bool [1, n, W, W]."""
        side = self._sensor.side
        on_map = torch.nn.functional.pad(self._on_map(missed), (0, side, 0, side))
        corners = zip(on_map, bounds[0, :, ::2].tolist(), strict=True)
        return torch.stack([m[x : x + side, y : y + side] for m, (x, y) in corners]).unsqueeze(0)

    def _bounds(self, view: View) -> Tensor:
        """Returns the first and last cells in view along x and y, int16 [1, n, 4]."""
        inside = self._on_map(view)
        bounds = []
        for axis in (2, 1):
            line = inside.any(axis).int()
            bounds += [line.argmax(-1), line.shape[-1] - 1 - line.flip(-1).argmax(-1)]
        found, none = torch.stack(bounds, -1), torch.tensor([1, 0, 1, 0])
        return torch.where(inside.any(2).any(1)[:, None], found, none).short().unsqueeze(0)
