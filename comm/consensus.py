"""A network that agrees whom to follow: method 4 of the paper (section IV.F, algorithm 3)."""

from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world import motion
from emberlink.envs.world.reward import left_box

from ._heading import HeadingConfig, circling, heading_reward
from .base import CommModule

TARGET = (keys.AGENTS, "target")
"""float32 [..., 3]: where the UAV is to go, cells."""
WAYPOINT = (keys.AGENTS, "waypoint")
"""float32 [..., 3]: the random point that the UAV flies to as a wanderer, cells."""
FOLLOWS = (keys.AGENTS, "follows")
"""int64 [...]: the discoverer that a seeker follows, itself for a discoverer, -1 for a wanderer."""
STREAK = (keys.AGENTS, "streak")
"""int64 [...]: consecutive steps as a discoverer."""
FIRE_SCORE = (keys.AGENTS, "fire_score")
"""int64 [...]: fire points discovered over the streak."""
ALTITUDE_SUM = (keys.AGENTS, "altitude_sum")
"""float64 [...]: the altitudes of the streak added up; divided by the streak it is Avg_Alt."""


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class ConsensusConfig:
    """The settings of method 4; the defaults are the paper's text."""

    range: Annotated[float, Field(ge=0)] = 10.0
    """UAVs nearer than this hear each other, cells; .inf for no limit"""
    discoverer: Literal["new_fire", "any_fire"] = "new_fire"
    """what a discoverer sees: new fire, or new or old fire"""
    jitter: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """standard deviation of what is added to x and y of a target closer than 1, cells"""
    target: Literal["absolute", "relative"] = "absolute"
    """whether the UAV is told the target's coordinates or the way to it"""
    agree: bool = True
    """whether sub-networks agree; if not, a UAV knows of the discoverers it hears itself alone"""
    follow: Literal["best", "nearest"] = "best"
    """which of the discoverers that it knows of a UAV follows: of highest rank, or nearest to it"""
    wander: bool = True
    """whether who has nobody to follow is given random targets; if not, it has no target"""
    loss: Annotated[float, Field(ge=0, le=1)] = 0.0
    """probability that nothing gets from one UAV to another in a step, each way for itself"""
    heading: HeadingConfig = HeadingConfig()
    """the bonus for flying towards the target"""


class Consensus(CommModule):
    """Tells every UAV a target: 9 numbers, the UAV's own 6 and x, y, z of the target."""

    config_type: ClassVar[type] = ConsensusConfig
    memory_keys = (WAYPOINT, STREAK, FIRE_SCORE, ALTITUDE_SUM)
    low: Tensor
    high: Tensor

    def __init__(self, world: WildfireConfig, config: ConsensusConfig):
        super().__init__(world, config)
        memory: list[Any] = list(self.memory_keys)
        seen: list[Any] = [keys.NEW_FIRE, keys.OLD_FIRE, keys.NEW_CENTRE, keys.OLD_CENTRE]
        moment: list[Any] = [keys.OBSERVATION, keys.POSITION, keys.RNG_KEY, keys.STEP]
        told: list[Any] = [keys.OBSERVATION, TARGET, FOLLOWS]
        self.in_keys, self.out_keys = moment + seen + memory, told + memory
        low, high = motion.corners(world.low, world.high)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)

    def specs(self, observation: Composite) -> Composite:
        agents = observation[keys.AGENTS]
        device, shape = observation.device, agents.shape
        points, features = torch.Size((*shape, 3)), agents[keys.OBSERVATION[1]].shape[-1]
        agents[keys.OBSERVATION[1]] = Unbounded(torch.Size((*shape, features + 3)), device=device)
        for key in (TARGET, WAYPOINT):
            low, high = (
                side.to(device, torch.float32).expand(points) for side in (self.low, self.high)
            )
            agents[key[1]] = Bounded(low, high, points, device=device, dtype=torch.float32)
        for key in (FOLLOWS, STREAK, FIRE_SCORE):
            agents[key[1]] = Unbounded(shape, device=device, dtype=torch.int64)
        agents[ALTITUDE_SUM[1]] = Unbounded(shape, device=device, dtype=torch.float64)
        return observation

    def start(self, tensordict: TensorDictBase) -> TensorDictBase:
        """No streak, and a random point for everyone."""
        position = tensordict.get(keys.POSITION)
        nothing = torch.zeros_like(tensordict.get(keys.NEW_FIRE))
        points = motion.random_points(
            self._step_key(tensordict, Use.WAYPOINT), position.shape[-2], self.low, self.high
        )
        tensordict.set(WAYPOINT, points)
        tensordict.set(STREAK, nothing)
        tensordict.set(FIRE_SCORE, nothing.clone())
        return tensordict.set(ALTITUDE_SUM, torch.zeros_like(position[..., 2].double()))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict.get(keys.POSITION)
        discovers = self._discovers(tensordict)
        rank = self._track_record(tensordict, discovers)
        known = known_discoverers(self._hears(tensordict), discovers, agree=self.config.agree)
        worse = -rank.unsqueeze(-2) if self.config.follow == "best" else apart(position)
        follows = first_choice(known, worse, discovers)
        target = self._targets(tensordict, discovers, follows)
        tensordict.set(FOLLOWS, follows)
        tensordict.set(TARGET, target)
        told = target - position if self.config.target == "relative" else target
        own = tensordict.get(keys.OBSERVATION)
        return tensordict.set(keys.OBSERVATION, torch.cat((own, self._scaled(told)), -1))

    def shaping(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """The heading term, unless the UAV left the box."""
        heading = self.config.heading
        flight = before.get(keys.POSITION), after.get(keys.POSITION), before.get(TARGET)
        term = heading_reward(*flight, heading)
        if heading.circle:
            old_alone = self._discovers(before) & (before.get(keys.NEW_FIRE) == 0)
            term = torch.where(old_alone, heading.circle * circling(*flight), term)
        if not self.config.wander:
            term = term.masked_fill(before.get(FOLLOWS) < 0, 0.0)
        left = left_box(after.get(keys.HIT_BOUNDARY), self.world.reward.exit_axes)
        return term.masked_fill(left, 0.0)

    def _hears(self, tensordict: TensorDictBase) -> Tensor:
        """Who hears whom at this moment, bool [..., n, n]."""
        heard = neighbours(tensordict.get(keys.POSITION), self.config.range)
        if self.config.loss:
            uavs = heard.shape[-1]
            unit = counter_rng.uniform(self._step_key(tensordict, Use.MESSAGE_LOSS), uavs * uavs)
            heard = heard & (unit.unflatten(-1, (uavs, uavs)) >= self.config.loss)
        return heard

    def _discovers(self, tensordict: TensorDictBase) -> Tensor:
        fire = tensordict.get(keys.NEW_FIRE)
        if self.config.discoverer == "any_fire":
            fire = fire + tensordict.get(keys.OLD_FIRE)
        return fire > 0

    def _track_record(self, tensordict: TensorDictBase, discovers: Tensor) -> Tensor:
        """Writes the streaks of this moment and returns the ranks, float64 [..., n]."""
        discovered = tensordict.get(keys.NEW_FIRE)
        altitude = tensordict.get(keys.POSITION)[..., 2].double()
        streak = (tensordict.get(STREAK) + 1) * discovers
        fire_score = (tensordict.get(FIRE_SCORE) + discovered) * discovers
        altitude_sum = (tensordict.get(ALTITUDE_SUM) + altitude) * discovers
        tensordict.set(STREAK, streak)
        tensordict.set(FIRE_SCORE, fire_score)
        tensordict.set(ALTITUDE_SUM, altitude_sum)
        # Avg_Alt * Streak of the paper's equation is the sum of the altitudes of the streak.
        return fire_score / altitude_sum.clamp(min=1e-9) * (discovered / altitude)

    def _targets(self, tensordict: TensorDictBase, discovers: Tensor, follows: Tensor) -> Tensor:
        """Where each UAV is to go, float32 [..., n, 3]; renews the wanderers' waypoints."""
        position = tensordict.get(keys.POSITION)
        waypoint, wanders = tensordict.get(WAYPOINT), follows < 0
        key = self._step_key(tensordict, Use.WAYPOINT)
        other = motion.next_waypoint(waypoint, position, key, self.low, self.high)
        waypoint = torch.where(wanders[..., None], other, waypoint)
        tensordict.set(WAYPOINT, waypoint)
        new = (tensordict.get(keys.NEW_FIRE) > 0).unsqueeze(-1)
        centre = torch.where(new, tensordict.get(keys.NEW_CENTRE), tensordict.get(keys.OLD_CENTRE))
        leader = follows.clamp(min=0).unsqueeze(-1).expand_as(position)
        alone = waypoint if self.config.wander else position
        target = torch.where(wanders[..., None], alone, position.gather(-2, leader))
        over_fire = torch.cat((centre, position[..., 2:]), -1)
        target = torch.where(discovers[..., None], over_fire, target)
        return self._jittered(tensordict, target) if self.config.jitter else target

    def _jittered(self, tensordict: TensorDictBase, target: Tensor) -> Tensor:
        """Moves the x and y of targets closer than 1 by clipped noise, within the box."""
        key = self._step_key(tensordict, Use.TARGET_JITTER)
        noise = counter_rng.normal(key, 2 * target.shape[-2]).unflatten(-1, (-1, 2))
        noise = (self.config.jitter * noise).clamp(-1, 1)
        near = motion.distance(tensordict.get(keys.POSITION), target) < 1
        moved = target + torch.nn.functional.pad(noise, (0, 1)) * near[..., None]
        return moved.clamp(self.low.float(), self.high.float())

    def _step_key(self, tensordict: TensorDictBase, use: int) -> Tensor:
        return counter_rng.step_key(tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP), use)

    def _scaled(self, told: Tensor) -> Tensor:
        if self.world.observation_scale == "raw":
            return told
        if self.config.target == "relative":
            return told / ((self.high - self.low) / 2).clamp(min=1e-6).float()
        return motion.scale_to_box(told, self.low, self.high)


def apart(position: Tensor) -> Tensor:
    """Distances between UAVs, float64 [..., n, n], cells; of positions [..., n, 3]."""
    return motion.distance(position.unsqueeze(-2), position.unsqueeze(-3))


def neighbours(position: Tensor, limit: float) -> Tensor:
    """Who hears whom: another UAV at a distance below `limit`, bool [..., n, n].

    Args:
        position: float32 [..., n, 3], cells.
        limit: communication range, cells.
    """
    near = apart(position) < limit
    return near & ~torch.eye(near.shape[-1], dtype=torch.bool, device=near.device)


def known_discoverers(heard: Tensor, discovers: Tensor, *, agree: bool = True) -> Tensor:
    """Which discoverers each UAV knows of once its sub-network has agreed, bool [..., n, n].

    A non-discoverer hears the discoverers among its neighbours; non-discoverers that are connected
    through non-discoverers then know of all that any of them hears.

    Args:
        heard: bool [..., n, n], who (row) hears whom (column).
        discovers: bool [..., n].
        agree: whether they tell each other.
    """
    uavs = discovers.shape[-1]
    known = heard & discovers.unsqueeze(-2)
    if not agree:
        return known
    # Exchanging with neighbours once per round reaches, after k doublings, all within 2**k hops.
    silent = ~discovers
    itself = torch.eye(uavs, dtype=torch.bool, device=heard.device)
    within = ((heard & silent.unsqueeze(-1) & silent.unsqueeze(-2)) | itself).float()
    for _ in range((uavs - 1).bit_length()):
        within = (within @ within).clamp_(max=1)
    return (within @ known.float()) > 0


def first_choice(known: Tensor, worse: Tensor, discovers: Tensor) -> Tensor:
    """Whom each UAV follows, int64 [..., n]: itself if a discoverer, -1 if it knows of none.

    Args:
        known: bool [..., n, n], the discoverers that a UAV (row) knows of.
        worse: [..., n or 1, n], what is better the lower it is; among equals the lower index.
        discovers: bool [..., n].
    """
    uavs = discovers.shape[-1]
    # Places differ, so that the least of them is one UAV on every device.
    place = torch.sort(worse, dim=-1, stable=True).indices.argsort(-1)
    best, chosen = place.masked_fill(~known, uavs).min(-1)
    chosen = torch.where(best < uavs, chosen, -1)
    return torch.where(discovers, torch.arange(uavs, device=chosen.device), chosen)
