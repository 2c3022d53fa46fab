"""Models the radio: which messages arrive, when, how many bytes fit, and places for a chain."""

import torch
from torch import Tensor, nn

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world import motion

PASSING = 15  # steps that a chain needs to pass on all sightings: one link per step, with losses
_NEARER = 0.97  # of the range, so that rounding and small errors of position break no link
_AT_PLACE = 0.01  # of the range over the ground; distance at which a relay is at its place
_SILENT = 150  # steps; a UAV not heard of for so long counts as lost where UAVs fail
_HALF = 0.65  # of the range: where `fade` loses half of the messages; at the range it loses 90 %
_STEEP = 5  # 1.7 (path loss exponent 2.79) 10 / (standard deviation of 4.05 dB · ln 10)


class Channel(nn.Module):
    """Decides for each pair of radios whether the message of a step is lost.

    The radios are the UAVs and, last, the base if there is one. A message is lost independently
    with probability `loss`, or in bad spells (Gilbert 1960, Elliott 1963), and with `fade` the more
    often, the farther it goes. Random numbers are functions of the episode's key, the step and the
    pair; between UAVs, they do not depend on the base. So methods are paired, and the links of a
    step may be asked for several times.

    Args:
        world: the environment's constants.
        envs: number of environments.
        base: whether the base has a radio.
    """

    bad: Tensor
    """bool [envs, radios, radios]: whether the link from a radio (column) is in a bad spell"""
    base: Tensor

    def __init__(self, world: WildfireConfig, envs: int, *, base: bool = False):
        super().__init__()
        self.config, radios = world.radio, world.num_uavs + base
        place = [[*world.base, 0.0]] if base and world.base is not None else []
        at = torch.tensor(place, dtype=torch.float64).view(-1, 3)
        self.register_buffer("base", at, persistent=False)
        self.register_buffer("bad", torch.zeros(envs, radios, radios, dtype=torch.bool))

    def forward(
        self, position: Tensor, rng_key: Tensor, step: Tensor, alive: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Returns the links of a step without and with losses, bool [..., r, r] each.

        Row i marks the radios in range of radio i, and the radios that it hears. A message arrives
        `delay` steps later.

        Args:
            position: float [..., n, 3], of the UAVs, cells.
            rng_key: int64 [...], `keys.RNG_KEY`.
            step: int64 [...], steps since the episode began; [steps, envs] are successive steps.
            alive: bool [..., n]; a UAV that is not neither hears nor is heard. All are if None.
        """
        config, places = self.config, self.places(position)
        near = neighbours(places, config.range)
        if alive is not None:
            alive = nn.functional.pad(alive, (0, len(self.base)), value=True)
            near &= alive.unsqueeze(-1) & alive.unsqueeze(-2)
        hears = near
        uses = [(Use.MESSAGE_LOSS, Use.REPORT_LOSS)] * (config.loss > 0)
        uses += [(Use.MESSAGE_FADE, Use.REPORT_FADE)] * config.fade
        units = self._draw(rng_key, step, uses) if uses else []
        if config.loss:
            unit = units[0]
            lost = self._spells(unit, step) if config.burst > 1 else unit < config.loss
            hears = hears & ~lost
        if config.fade:
            hears = hears & (units[-1] >= fade(pairwise_distance(places) / config.range))
        return near, hears

    def places(self, position: Tensor) -> Tensor:
        """Returns the places of all radios, float [..., r, 3]."""
        base = self.base.to(position.dtype).expand(*position.shape[:-2], -1, -1)
        return torch.cat((position, base), -2)

    def _draw(self, rng_key: Tensor, step: Tensor, uses: list[tuple[Use, Use]]) -> list[Tensor]:
        """Returns a number from 0 to 1 for each pair and use, float32 [..., r, r] each.

        The first of two uses is for pairs of UAVs, the second one for pairs with the base.
        """
        radios = self.bad.shape[-1]
        uavs, pairs = radios - len(self.base), len(uses)
        use = torch.tensor(uses, device=step.device).T.flatten()[: pairs * (1 + len(self.base))]
        key = counter_rng.step_key(rng_key.unsqueeze(-1), step.unsqueeze(-1), use)
        unit = counter_rng.uniform(key, radios * radios)
        of_uavs = unit[..., :pairs, : uavs * uavs].unflatten(-1, (uavs, uavs))
        if uavs == radios:
            return list(of_uavs.unbind(-3))
        unit = unit[..., pairs:, :].unflatten(-1, (radios, radios))
        unit[..., :uavs, :uavs] = of_uavs
        return list(unit.unbind(-3))

    def _spells(self, unit: Tensor, step: Tensor) -> Tensor:
        """Returns which links are in a bad spell, bool like `unit`; see `RadioConfig.burst`.

        The same number moves both states of a link: below `begins` it gets bad, above `lasts` good.
        """
        loss = self.config.loss
        ends = min(1 / self.config.burst, 1 - loss)
        begins, lasts = loss * ends / (1 - loss) if loss < 1 else 1.0, 1 - ends
        units = unit if step.ndim > 1 else unit.unsqueeze(0)
        first = (step == 0)[..., None, None]
        gets, stays = units < torch.where(first, loss, begins), ~first & (units < lasts)
        # The last change of a link decides: even numbers for good, odd ones for bad.
        number = 2 * torch.arange(1, len(units) + 1, device=unit.device)[:, None, None, None]
        change = torch.where(gets, number + 1, torch.where(stays, self.bad, number))
        bad = change.cummax(0).values % 2 == 1
        self.bad.copy_(bad[-1])
        return bad.view_as(unit)


class Late(nn.Module):
    """Keeps the messages of the last `delay` steps until they arrive.

    Args:
        delay: steps from sending to receiving.
        blank: the message [] that arrives before step `delay`.
        shape: of the messages of a step: environments first.
    """

    sent: Tensor
    """[envs, delay, ...], the oldest first"""

    def __init__(self, delay: int, blank: Tensor, *shape: int):
        super().__init__()
        self.delay, self.blank = delay, blank.item()
        self.register_buffer("sent", blank.repeat(shape[0], delay, *shape[1:]))

    def start_episodes(self, mask: Tensor) -> None:
        """Forgets the messages in the environments of a mask, bool [envs]."""
        self.sent[mask] = self.blank

    def forward(self, now: Tensor) -> Tensor:
        """Returns what arrives when `now`, [(steps,) envs, ...], is sent at one or more steps."""
        if not self.delay:
            return now
        steps = now if now.ndim == self.sent.ndim else now.unsqueeze(0)
        series = torch.cat((self.sent.transpose(0, 1), steps))
        self.sent.copy_(series[-self.delay :].transpose(0, 1))
        return series[: len(steps)].view_as(now)


def fade(far: Tensor) -> Tensor:
    """Returns the probability that `env.radio.fade` loses a message; `far` is in ranges.

    The logistic curve, in decibels, of log-normal shadowing between a UAV and open or suburban
    ground: exponents 2.54 to 3.04, deviations 2.79 to 5.3 dB (Khawaja et al., in table 2.2 of
    Imran et al., Autonomous Airborne Wireless Networks, 2021).
    """
    return torch.sigmoid(_STEEP * (far / _HALF).log())


def budget(world: WildfireConfig, near: Tensor) -> Tensor | None:
    """Returns the bytes that each radio can say in a step, int64 [..., r]; None for no limit.

    In a world with a base, half of them are for messages, and half for reports to the base.

    Args:
        near: bool [..., r, r], the links if no message is lost.
    """
    config = world.radio
    if config.bandwidth is None:
        return None
    sharing = 1 + near.sum(-1) if config.shared else near.new_ones(near.shape[:-1]).long()
    return config.bandwidth // (sharing * (1 + (world.base is not None)))


def reachable(hears: Tensor) -> Tensor:
    """Returns whose messages arrive at each radio, directly or passed on, bool [..., n, n].

    Args:
        hears: bool [..., n, n], whether a radio (row) hears another one (column).

    Returns:
        The reflexive and transitive closure of `hears`.
    """
    radios = hears.shape[-1]
    reach = hears | torch.eye(radios, dtype=torch.bool, device=hears.device)
    for via in range(radios):  # after it, paths over the radios up to this one are known
        reach |= reach[..., via : via + 1] & reach[..., via : via + 1, :]
    return reach


def pairwise_distance(position: Tensor) -> Tensor:
    """Returns the distances between points [..., n, 3], float64 [..., n, n], cells."""
    return motion.distance(position.unsqueeze(-2), position.unsqueeze(-3))


def neighbours(position: Tensor, limit: float) -> Tensor:
    """Returns whether each other point of [..., n, 3] is nearer than `limit`, bool [..., n, n]."""
    near = pairwise_distance(position) < limit
    return near & ~torch.eye(near.shape[-1], dtype=torch.bool, device=near.device)


def chain(
    world: WildfireConfig, base: Tensor, centre: Tensor, rank: Tensor, count: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns the place of each UAV in a chain of radios from the base towards a fire.

    UAVs hold places at distances of one radio range from the base to the middle of the fire, as
    many as needed; at least one UAV is left over. The others have to be in range of the last place.
    All fly at the maximum altitude, which the range has to exceed for the base to hear anything.

    Args:
        base: float32 [2], cells.
        centre: float32 [envs, n, 2], the middle of the fire, cells.
        rank: int64 [envs, n], place of each UAV in the chain, 0 next to the base.
        count: int64, broadcast against [envs, n], UAVs in the team.

    Returns:
        Place, float32 [envs, n, 2], cells, and reach, float32 [envs, n]: the greatest distance from
        it, cells.
    """
    height = world.altitude[1]
    far = 10.0 * (sum(world.grid) + height)  # as good as any longer range, and finite
    heard = min(world.radio.range, far)
    hop = _NEARER * heard
    over_ground = max(heard**2 - height**2, 0.0) ** 0.5  # the base's range at that altitude
    first = _NEARER * over_ground
    way = centre - base
    distance = torch.linalg.vector_norm(way, dim=-1)
    needed = ((distance - first) / max(hop, 1e-6)).ceil()
    relays = torch.minimum(needed, (count - 1).float()).clamp(min=0)
    link = torch.minimum(rank.float(), relays - 1).clamp(min=0)
    along = torch.where(relays > 0, (first + hop * link).minimum(distance), 0.0)
    place = base + way * (along / distance.clamp(min=1e-6)).unsqueeze(-1)
    reach = torch.where(relays > 0, hop, first).to(place.dtype)
    return place, torch.where(rank < relays, _AT_PLACE * over_ground, reach)


def middle(cells: Tensor) -> Tensor:
    """Returns the mean place of a mask's cells, bool [..., X, Y]: float32 [..., 2], 0 if none."""
    count = cells.sum((-2, -1)).clamp(min=1)
    sides = (torch.arange(side, device=cells.device) for side in cells.shape[-2:])
    sums = ((cells.sum(axis) * side).sum(-1) for axis, side in zip((-1, -2), sides, strict=True))
    return torch.stack([total.float() / count.float() for total in sums], -1)


def chain_to_fire(
    world: WildfireConfig, base: Tensor, burning: Tensor, step: Tensor, heard: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns the place of each UAV in a `chain` to the middle of the fire that it knows.

    UAVs take their places in the order of their numbers. Without known fire, all are at the base.

    Args:
        base: float32 [2], cells.
        burning: bool [envs, n, X, Y], the cells that each UAV knows to burn.
        step, heard: see `believed_to_fly`; UAVs that do not fly have no place.

    Returns:
        Place, float32 [envs, n, 2], cells, and reach, float32 [envs, n]: the greatest distance from
        it, cells.
    """
    flies = believed_to_fly(world, step, heard)
    known = burning.flatten(2).any(-1, keepdim=True)
    centre = torch.where(known, middle(burning), base)
    rank = flies.tril(-1).sum(-1)
    return chain(world, base, centre, rank, flies.sum(-1))


def believed_to_fly(world: WildfireConfig, step: Tensor, heard: Tensor) -> Tensor:
    """Returns whether each UAV (row) believes that another one flies, bool [envs, n, n].

    In a world in which UAVs fail, 150 steps without news of a UAV count as its loss.

    Args:
        step: int64 [envs].
        heard: [envs, n, n], step of the latest news that a UAV (row) has of another one (column).
    """
    if not world.failures:
        return torch.ones_like(heard, dtype=torch.bool)
    return step.view(-1, 1, 1) - heard < _SILENT
