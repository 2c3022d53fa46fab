"""Consensus communication: method 4 of the paper (section IV.F, algorithm 3)."""

from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from emberlink.comm.base import CommModule, successive
from emberlink.envs import keys
from emberlink.envs.config import Number, WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.utils.validation import STRICT
from emberlink.envs.world import motion
from emberlink.envs.world.radio import Late, pairwise_distance, reachable
from emberlink.envs.world.reward import left_box

RECORD_BYTES = 16
"""position and rank of a discoverer, four float32 numbers"""
LATE_BYTES = 4
"""more of a record where messages are late or limited: the discoverer and the step"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class HeadingConfig:
    """Stores the settings of the bonus for flying to the target; the defaults are the paper's."""

    form: Literal["folded_linear", "folded_exponential", "approach"] = "folded_linear"
    """the formula, see `heading_reward`"""
    weight: Number = 1.0
    """factor of the term"""
    circle: Number = 0.0
    """factor of `circling`, which replaces the term of a UAV that sees old fire only; 0 for none"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ConsensusConfig:
    """Stores the settings of method 4; the defaults are the paper's text."""

    discoverer: Literal["new_fire", "any_fire"] = "new_fire"
    """condition for being a discoverer: seeing new fire, or any fire"""
    jitter: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    """standard deviation of the noise on x and y of a target closer than 1, cells"""
    target: Literal["absolute", "relative"] = "absolute"
    """whether the UAV observes the target's coordinates or the vector to it"""
    agree: bool = True
    """whether sub-networks reach consensus; if not, a UAV knows only discoverers that it hears"""
    follow: Literal["best", "nearest"] = "best"
    """whether a UAV follows the known discoverer of highest rank or the nearest"""
    wander: bool = True
    """whether wanderers get random targets; if not, a wanderer's target is its own position"""
    redraw: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """steps after which random targets are drawn again, even if not reached; None for never"""
    heading: HeadingConfig = HeadingConfig()
    """the bonus for flying towards the target"""


class Consensus(CommModule):
    """Gives every UAV a target and appends its x, y, z to the UAV's observation.

    A discoverer's target is the mean of the fire in its view. A seeker's is the position of the
    discoverer that it follows. A wanderer, which has no discoverer to follow, gets a random point.
    """

    config_type: ClassVar[type] = ConsensusConfig
    hears: ClassVar[bool] = True
    heeds_packets: ClassVar[bool] = True
    units: ClassVar[tuple[str, ...]] = ("target",)
    out_keys = (keys.OBSERVATION, keys.TARGET, keys.FOLLOWS)
    low: Tensor
    high: Tensor
    waypoint: Tensor
    """float32 [num_envs, n, 3]: random targets of wanderers, cells"""
    fire_score: Tensor
    """int64 [num_envs, n]: new fire cells counted over consecutive steps as a discoverer"""
    altitude_sum: Tensor
    """float64 [num_envs, n]: sum of the altitudes over these steps, the paper's Avg_Alt * Streak"""
    position: Tensor
    """float32 [num_envs, n, 3]: positions at the previous time step, cells"""
    target: Tensor
    """float32 [num_envs, n, 3]: targets at the previous time step, cells"""
    leaderless: Tensor
    """bool [num_envs, n]: whether a UAV was a wanderer at the previous time step"""
    old_fire_only: Tensor
    """bool [num_envs, n]: whether a UAV was a discoverer without new fire at that step"""
    newest: Tensor
    """float64 [num_envs, n, n]: step of the newest record that a UAV has had of another one, or
    -1"""
    received: Tensor
    """float64 [num_envs, n, n, 5]: newer records of UAVs that a UAV received at the last step: step
    (-1 for none), position and rank"""
    said: Tensor
    """int64 [num_envs, n]: the bytes that each UAV said at the last step"""

    def __init__(self, world: WildfireConfig, config: ConsensusConfig, num_envs: int = 1):
        super().__init__(world, config, num_envs)
        low, high = motion.corners(world.low, world.high)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        agents = num_envs, world.num_uavs
        for name in ("waypoint", "position", "target"):
            self.register_buffer(name, torch.zeros(*agents, 3, dtype=torch.float32))
        self.register_buffer("fire_score", torch.zeros(agents, dtype=torch.int64))
        for name in ("leaderless", "old_fire_only"):
            self.register_buffer(name, torch.zeros(agents, dtype=torch.bool))
        self.register_buffer("altitude_sum", torch.zeros(agents, dtype=torch.float64))
        if world.radio.packets:
            pairs, delay = (num_envs, world.num_uavs, world.num_uavs), world.radio.delay
            nothing = torch.tensor(-1.0, dtype=torch.float64)
            self.links = Late(delay, torch.tensor(False), *pairs)
            self.records = Late(delay, nothing, *pairs, 5)
            self.register_buffer("newest", nothing.repeat(pairs))
            self.register_buffer("received", nothing.repeat(*pairs, 5))

    def specs(self, observation: Composite) -> Composite:
        shape, device = observation[keys.AGENTS].shape, observation.device
        features = observation[keys.OBSERVATION].shape[-1] + 3
        vector = Unbounded(torch.Size((*shape, features)), device=device, dtype=torch.float32)
        points = torch.Size((*shape, 3))
        low, high = (
            side.to(device, torch.float32).expand(points) for side in (self.low, self.high)
        )
        observation[keys.OBSERVATION] = vector
        observation[keys.TARGET] = Bounded(low, high, points, device=device, dtype=torch.float32)
        observation[keys.FOLLOWS] = Unbounded(shape, device=device, dtype=torch.int64)
        return observation

    def reset(self, tensordict: TensorDictBase, mask: Tensor) -> None:
        """Empties the track records and draws a random point for each UAV."""
        at = tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP)
        key = counter_rng.step_key(*at, Use.WAYPOINT)
        points = motion.random_points(key, self.world.num_uavs, self.low, self.high)
        self.waypoint.copy_(torch.where(mask[:, None, None], points, self.waypoint))
        for record in (self.fire_score, self.altitude_sum):
            record.masked_fill_(mask[:, None], 0)
        if self.world.radio.packets:
            self.links.start_episodes(mask)
            for record in (self.newest, self.received):
                record[mask] = -1.0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._rewrite(tensordict.unsqueeze(0), tensordict)
        return tensordict

    def take_part(
        self, steps: TensorDictBase, last: TensorDictBase
    ) -> tuple[TensorDictBase, Tensor | None, Tensor | None]:
        if self.maps is not None:
            for step in successive(steps, last):
                self.maps.look(step)
        bonus, sent = self._rewrite(steps, last)
        return self.show(last), bonus, sent if self.counts else None

    def _rewrite(self, steps: TensorDictBase, last: TensorDictBase) -> tuple[Tensor | None, Tensor]:
        """Rewrites the last time step; what depends on the step before is computed in turn."""
        position = steps.get(keys.POSITION)
        new, old = steps.get(keys.NEW_FIRE), steps.get(keys.OLD_FIRE)
        discovers = (new + old if self.config.discoverer == "any_fire" else new) > 0
        rank = self._update_track_record(steps, discovers)
        best = self.config.follow == "best"
        if self.world.radio.packets:
            known, records, sent = self._converse(steps, discovers, rank)
            places = records[..., 1:4].float()
            cost = -records[..., 4] if best else motion.distance(position.unsqueeze(-2), places)
        else:
            known, sent = self._agree(steps.get(keys.HEARS), discovers)
            places = position.unsqueeze(-3).expand(*known.shape, 3)
            cost = -rank.unsqueeze(-2) if best else pairwise_distance(position)
        self.said = sent[-1]
        follows = choose_leader(known, cost, discovers)
        target = self._targets(steps, discovers, follows, places)
        bonus = self._bonus(steps, discovers, follows, target)
        relative = self.config.target == "relative"
        shown = self._scaled(target[-1] - position[-1] if relative else target[-1])
        last.set(keys.OBSERVATION, torch.cat((last.get(keys.OBSERVATION), shown), -1))
        last.set(keys.FOLLOWS, follows[-1]).set(keys.TARGET, target[-1])
        return bonus, sent

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor:
        return self.said

    def _agree(self, hears: Tensor, discovers: Tensor) -> tuple[Tensor, Tensor]:
        """Passes on records of discoverers along any path within a step.

        A non-discoverer hears the discoverers among its neighbours. Non-discoverers in the same
        connected sub-network of non-discoverers then share the discoverers that any of them hears,
        if they `agree`. A discoverer sends its own record alone.

        Args:
            hears: bool [..., n, n], whether a UAV (row) hears another one (column).
            discovers: bool [..., n], whether a UAV is a discoverer.

        Returns:
            The discoverers that each UAV knows, bool [..., n, n]; and the bytes of each UAV, int64
            [..., n].
        """
        agree = self.config.agree
        knows = reachable(hears & ~discovers.unsqueeze(-1)) if agree else hears
        known = knows & discovers.unsqueeze(-2)
        return known, RECORD_BYTES * torch.where(discovers, 1, known.sum(-1) * agree)

    def _converse(
        self, steps: TensorDictBase, discovers: Tensor, rank: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Passes on records of discoverers, one link a step.

        A discoverer says its own record. Other UAVs pass on the newer records that they received
        at the step before, by falling rank.

        Returns:
            The discoverers of whom each UAV receives a newer record, bool [steps, num_envs, n, n];
            these records, see `received`; and the bytes of each UAV, int64 [steps, num_envs, n].
        """
        uavs, size = discovers.shape[-1], RECORD_BYTES + LATE_BYTES
        own, finds = torch.eye(uavs, dtype=torch.bool, device=rank.device), discovers.unsqueeze(-1)
        stamp = steps.get(keys.STEP)[..., None, None].expand(*discovers.shape, 1).double()
        mine = torch.cat((stamp, steps.get(keys.POSITION), rank.unsqueeze(-1)), -1).unsqueeze(-3)
        passes, finds = ~finds & self.config.agree, finds & own
        links, budget = self.links(steps.get(keys.HEARS)), steps.get(keys.BUDGET, None)
        most = None if budget is None else (budget // size).unsqueeze(-1)
        received, known, records, sent = self.received, [], [], []
        for number, arrives in enumerate(links.unsqueeze(-1)):
            says = finds[number] | passes[number] & (received[..., 0] >= 0)
            record = torch.where(own.unsqueeze(-1), mine[number], received)
            if most is not None:
                order = record[..., 4].masked_fill(~says, -torch.inf).argsort(-1, descending=True)
                says &= order.argsort(-1) < most[number]
            heard = self.records(torch.where(says.unsqueeze(-1), record, -1.0))
            # [num_envs, hearers, speakers, discoverers]
            told, speaker = torch.where(arrives, heard[..., 0].unsqueeze(1), -1.0).max(2)
            new = (told > self.newest) & ~own
            self.newest.copy_(torch.maximum(self.newest, told))
            found = heard.gather(1, speaker.unsqueeze(-1).expand(*speaker.shape, 5))
            received = torch.where(new.unsqueeze(-1), found, -1.0)
            known.append(new)
            records.append(received)
            sent.append(says)
        self.received.copy_(received)
        return torch.stack(known), torch.stack(records), size * torch.stack(sent).sum(-1)

    def _update_track_record(self, steps: TensorDictBase, discovers: Tensor) -> Tensor:
        """Adds the steps to the track records; returns ranks, float64 [steps, num_envs, n]."""
        discovered, altitude = steps.get(keys.NEW_FIRE), steps.get(keys.POSITION)[..., 2].double()
        records = []
        for new, height, counts in zip(discovered, altitude, discovers, strict=True):
            self.fire_score.add_(new).mul_(counts)
            self.altitude_sum.add_(height).mul_(counts)
            records.append(self.fire_score / self.altitude_sum.clamp(min=1e-9))
        return torch.stack(records) * (discovered / altitude)

    def _targets(
        self, steps: TensorDictBase, discovers: Tensor, follows: Tensor, places: Tensor
    ) -> Tensor:
        """Returns the targets, float32 [steps, num_envs, n, 3].

        Args:
            places: float32 [steps, num_envs, n, n, 3], of UAVs as each UAV (row) has heard of them.
        """
        position = steps.get(keys.POSITION)
        wanders = (follows < 0).unsqueeze(-1)
        alone = self._wander(steps, wanders) if self.config.wander else position
        new = (steps.get(keys.NEW_FIRE) > 0).unsqueeze(-1)
        centre = torch.where(new, steps.get(keys.NEW_CENTRE), steps.get(keys.OLD_CENTRE))
        leader = follows.clamp(min=0)[..., None, None].expand(*follows.shape, 1, 3)
        target = torch.where(wanders, alone, places.gather(-2, leader).squeeze(-2))
        over_fire = torch.cat((centre, position[..., 2:]), -1)
        target = torch.where(discovers.unsqueeze(-1), over_fire, target)
        return self._jittered(steps, target) if self.config.jitter else target

    def _wander(self, steps: TensorDictBase, wanders: Tensor) -> Tensor:
        """Returns the waypoints at each step, drawn again where they are reached or due."""
        position, step, every = steps.get(keys.POSITION), steps.get(keys.STEP), self.config.redraw
        # At step 0, `reset` has used the first key.
        use = Use.WAYPOINT + (step == 0) * (Use.FIRST_WAYPOINT_REDRAW - Use.WAYPOINT)
        key = counter_rng.step_key(steps.get(keys.RNG_KEY), step, use)
        points = motion.random_points(key, position.shape[-2], self.low, self.high)
        due = (step % every == 0)[..., None, None] & wanders if every else wanders & False
        waypoint, waypoints = self.waypoint, []
        for here, point, wander, draws in zip(position, points, wanders, due, strict=True):
            reached = motion.distance(here, waypoint).unsqueeze(-1) < 1
            waypoint = torch.where(reached & wander | draws, point, waypoint)
            waypoints.append(waypoint)
        self.waypoint.copy_(waypoint)
        return torch.stack(waypoints)

    def _bonus(
        self, steps: TensorDictBase, discovers: Tensor, follows: Tensor, target: Tensor
    ) -> Tensor | None:
        """Returns the heading term, float32 [steps, num_envs, n]; 0 for a UAV that left the box.

        It depends on the positions, targets and roles of the step before, which are stored.
        """
        heading, after = self.config.heading, steps.get(keys.POSITION)
        if not heading.weight and not heading.circle:
            return None
        before = self._before(self.position, after), after, self._before(self.target, target)
        term = heading_reward(*before, heading)
        if heading.circle:
            old_fire_only = discovers & (steps.get(keys.NEW_FIRE) == 0)
            circles = self._before(self.old_fire_only, old_fire_only)
            term = torch.where(circles, heading.circle * circling(*before), term)
        if not self.config.wander:
            term = term.masked_fill(self._before(self.leaderless, follows < 0), 0.0)
        left = left_box(steps.get(keys.HIT_BOUNDARY), self.world.reward.exit_axes)
        return term.masked_fill(left, 0.0)

    @staticmethod
    def _before(kept: Tensor, now: Tensor) -> Tensor:
        """Returns the values before each step, and keeps the last ones for the next step."""
        before = torch.cat((kept.unsqueeze(0), now[:-1]))
        kept.copy_(now[-1])
        return before

    def _jittered(self, steps: TensorDictBase, target: Tensor) -> Tensor:
        """Adds clipped noise to x and y of targets closer than 1, within the box."""
        key = counter_rng.step_key(steps.get(keys.RNG_KEY), steps.get(keys.STEP), Use.TARGET_JITTER)
        noise = counter_rng.normal(key, 2 * target.shape[-2]).unflatten(-1, (-1, 2))
        noise = (self.config.jitter * noise).clamp(-1, 1)
        near = motion.distance(steps.get(keys.POSITION), target) < 1
        moved = target + torch.nn.functional.pad(noise, (0, 1)) * near[..., None]
        return moved.clamp(self.low.float(), self.high.float())

    def _scaled(self, shown: Tensor) -> Tensor:
        """Returns targets, or vectors to targets, in the scale of the observation."""
        if self.world.observation_scale == "raw":
            return shown
        if self.config.target == "relative":
            return shown / ((self.high - self.low) / 2).clamp(min=1e-6).float()
        return motion.scale_to_box(shown, self.low, self.high)


def choose_leader(known: Tensor, cost: Tensor, discovers: Tensor) -> Tensor:
    """Returns the index of the discoverer that each UAV follows, int64 [..., n].

    A discoverer follows itself. The index is -1 for a UAV that knows no discoverer.

    Args:
        known: bool [..., n, n], the discoverers that a UAV (row) knows of.
        cost: [..., n or 1, n], of following a UAV (column). Each UAV chooses the discoverer of
            lowest cost, and of equal costs the lower index.
        discovers: bool [..., n], whether a UAV is a discoverer.
    """
    uavs = discovers.shape[-1]
    # Ranks have no ties, so the minimum is the same on every device.
    order = torch.sort(cost, dim=-1, stable=True).indices.argsort(-1)
    best, leader = order.masked_fill(~known, uavs).min(-1)
    leader = torch.where(best < uavs, leader, -1)
    return torch.where(discovers, torch.arange(uavs, device=leader.device), leader)


def _degrees(vector: Tensor) -> Tensor:
    """Returns the angles of vectors [..., 2 or 3] in the x-y plane, [...], in (-180, 180]."""
    return torch.rad2deg(torch.atan2(vector[..., 1], vector[..., 0]))


def heading_reward(before: Tensor, after: Tensor, target: Tensor, config: HeadingConfig) -> Tensor:
    """Computes the heading term, float32 [...].

    With `approach`, it is the cells by which the 3-D distance to the target has decreased. The
    other forms are of the paper and its code, whose angles ignore left and right. Angles are
    measured in the x-y plane, in degrees, from the position before the move. They are computed in
    float64: a move of 0.1 cells is a difference of nearly equal float32 numbers.

    Args:
        before, after: float32 [..., 3], positions before and after the move, cells.
        target: float32 [..., 3], the target that the UAV had before the move, cells.
    """
    before = before.double()
    way, moved = target.double() - before, after.double() - before
    if config.form == "approach":
        left = torch.linalg.vector_norm(way - moved, dim=-1)
        return (config.weight * (torch.linalg.vector_norm(way, dim=-1) - left)).float()
    apart = (_degrees(way).abs() - _degrees(moved).abs()).abs()
    term = (180 - apart) / 10 if config.form == "folded_linear" else 20 * 0.94**apart
    return (config.weight * term).float()


def circling(before: Tensor, after: Tensor, target: Tensor) -> Tensor:
    """Computes the cells flown around the target counterclockwise, float32 [...].

    The term is the component of the move perpendicular to the vector to the target, times
    2 d / (1 + d^2), where d is the horizontal distance to the target in cells. This factor is 1 at
    a distance of 1 and smaller both nearer to the target and further away.

    Args:
        before, after, target: as of `heading_reward`.
    """
    offset, moved = (end[..., :2].double() - before[..., :2].double() for end in (target, after))
    arm = 2 * offset / (1 + offset.square().sum(-1, keepdim=True))
    return (moved[..., 0] * arm[..., 1] - moved[..., 1] * arm[..., 0]).float()
