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
from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.measures import Measures
from emberlink.envs.world.sensor import Sensor

COUNTS = {"seen": keys.SEEN, "burning": keys.BURNING, "burnt": keys.BURNT}
AGES = {"front_age": keys.FRONT_AGE, "front_age_p95": keys.FRONT_AGE_P95}
OF_BASE = {"base_seen": keys.BASE_SEEN, "base_age": keys.BASE_AGE}
ADVICE = {"follows": keys.FOLLOWS, "target": keys.TARGET}
"""what a communication module tells the UAVs"""
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
            for left, right, low, high in self.steps["view"][step].tolist():
                seen = np.s_[left : right + 1, low : high + 1]
                burns = (self.ignition[seen] <= step) & (step < self.end[seen])
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

    The ages are measured in every world, with the environment's own rules.

    Args:
        member: index of the environment.
        advised: whether the policy reads what the communication tells it.
        hears: whether the policy receives messages of its own.
    """

    def __init__(self, *, member: int = 0, advised: bool = True, hears: bool = False):
        self._member, self._advised, self._hears = member, advised, hears
        self._steps: dict[str, list[NDArray[Any]]] = {}
        self._observer: _Observer | None = None

    def add(self, world: WildfireEnv, td: TensorDictBase) -> None:
        """Adds one step.

        Args:
            world: the environments, at this step.
            td: what they returned: the result of a reset, or the "next" of a step.
        """
        now = td[self._member : self._member + 1].cpu()
        if self._observer is None:
            self._observer = _Observer(world, self._member)
        for name, value in {**self._observer.look(now), **self._told(now)}.items():
            self._steps.setdefault(name, []).append(value[0].numpy().copy())

    def _told(self, now: TensorDictBase) -> dict[str, Tensor]:
        """Returns what the environment and the communication wrote."""
        wanted = {"position": keys.POSITION, "alive": keys.ALIVE, **COUNTS}
        told = {name: now.get(key) for name, key in wanted.items()}
        reward = now.get(keys.REWARD, None)
        told["reward"] = torch.zeros(1, len(told["alive"][0])) if reward is None else reward[..., 0]
        if self._advised:
            self._hears |= now.get(keys.HEARS, None) is not None
            advice = {name: now.get(key, None) for name, key in ADVICE.items()}
            told |= {name: value for name, value in advice.items() if value is not None}
        return told

    def recording(self) -> Recording:
        """Returns what was recorded."""
        assert self._observer is not None, "no step was recorded"
        ignition, end = self._observer.fire
        steps = {name: np.stack(values) for name, values in self._steps.items()}
        world = self._observer.config
        listens = self._hears or world.base is not None
        return Recording(world=world, listens=listens, ignition=ignition, end=end, steps=steps)


class _Observer:
    """Repeats what one environment computes and does not show: views, links and ages.

    Args:
        world: the environments, after their reset.
        member: index of the environment.
    """

    def __init__(self, world: WildfireEnv, member: int):
        self.config = world.config
        self._sensor = Sensor.of(self.config)
        measured = dataclasses.replace(self.config, measures="all")
        self._measures = Measures(measured, 1, self._sensor.area)
        arrival, burn_out = world.arrival_time[[member]].cpu(), world.burn_out
        self._measures.start_episodes(
            torch.ones(1, dtype=torch.bool),
            self._sensor.pad(arrival, torch.nan),
            None if burn_out is None else self._sensor.pad(burn_out[[member]].cpu(), torch.nan),
        )
        base = self.config.base
        self._base = torch.zeros(1, 0, 3) if base is None else torch.tensor([[[*base, 0.0]]])

    @property
    def fire(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """The first step of each cell's fire and the first after it, [X, Y]."""
        times = self._measures.times
        crop = self._sensor.crop
        return crop(times.ignition)[0].numpy(), crop(times.end)[0].numpy()

    def look(self, now: TensorDictBase) -> dict[str, Tensor]:
        """Returns the views, links and ages of a time step of batch size [1]."""
        position, alive = now.get(keys.POSITION).double(), now.get(keys.ALIVE)
        key, step = now.get(keys.RNG_KEY), now.get(keys.STEP)
        view = self._view(position, alive, step)
        if step > 0:  # nobody looks at the reset
            self._measures.update(view, position, key, step, alive)
        seen = {"view": self._bounds(view) if step > 0 else _no_view(alive)}
        given = key, step, alive
        if self.config.base is None:
            hears = radio.links(self.config.radio, position, *given[:2], alive=alive)
        else:
            hears = self._measures.hears(position, *given)
        lives = torch.nn.functional.pad(alive, (0, self._base.shape[1]), value=True)
        places = torch.cat((position, self._base.double()), 1)
        near = radio.neighbours(places, self.config.radio.range)
        near &= lives.unsqueeze(-1) & lives.unsqueeze(-2)
        values = self._measures.values()
        ages = {name: values[key] for name, key in {**AGES, **OF_BASE}.items() if key in values}
        return {**seen, "hears": hears, "lost": near & ~hears, **ages}

    def _view(self, position: Tensor, alive: Tensor, step: Tensor) -> View:
        _, cells, in_view = self._sensor.look(position, torch.zeros(1, 1, dtype=torch.int64))
        in_view &= alive.unsqueeze(-1)
        return View(cells, in_view, in_view & self._measures.times.burning(step)[0].take(cells))

    def _bounds(self, view: View) -> Tensor:
        """Returns the first and last cells in view along x and y, int16 [1, n, 4]."""
        seen = torch.zeros(view.cells.shape[1], self._sensor.area, dtype=torch.bool)
        inside = self._sensor.crop(seen.scatter_(1, view.cells[0], view.in_view[0]))
        none = torch.tensor([1, 0, 1, 0])
        bounds = []
        for axis in (2, 1):
            line = inside.any(axis).int()
            bounds += [line.argmax(-1), line.shape[-1] - 1 - line.flip(-1).argmax(-1)]
        found = torch.stack(bounds, -1)
        return torch.where(inside.any(2).any(1)[:, None], found, none).short().unsqueeze(0)


def _no_view(alive: Tensor) -> Tensor:
    return torch.tensor([1, 0, 1, 0], dtype=torch.int16).expand(*alive.shape, 4)
