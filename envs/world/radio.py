"""Models the radio: computes which UAVs hear each other in a step, and places for a chain."""

import torch
from torch import Tensor

from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world import motion

PASSING = 15  # steps that a chain needs to pass on all sightings: one link per step, with losses
_NEARER = 0.97  # of the range, so that rounding and small errors of position break no link
_AT_PLACE = 0.01  # of the range over the ground; distance at which a relay is at its place
_SILENT = 150  # steps; a UAV not heard of for so long counts as lost where UAVs fail


def links(
    config: RadioConfig,
    position: Tensor,
    rng_key: Tensor,
    step: Tensor,
    *,
    alive: Tensor | None = None,
    use: Use = Use.MESSAGE_LOSS,
) -> Tensor:
    """Returns the links of a step, bool [..., n, n]: row i marks the radios that radio i hears.

    The lost messages are a function of the episode's random key and the step.

    Args:
        position, alive: see `in_range`.
        rng_key: int64 [...], `keys.RNG_KEY`.
        step: int64 [...], steps since the episode began.
    """
    linked = in_range(config, position, alive)
    if config.loss:
        radios = linked.shape[-1]
        key = counter_rng.step_key(rng_key, step, use)
        unit = counter_rng.uniform(key, radios * radios).unflatten(-1, (radios, radios))
        linked &= unit >= config.loss
    return linked


def in_range(config: RadioConfig, position: Tensor, alive: Tensor | None = None) -> Tensor:
    """Returns the links of a step if no message is lost, bool [..., n, n].

    Args:
        position: float [..., n, 3], cells.
        alive: bool [..., n]; a radio that is not neither hears nor is heard. All are alive if None.
    """
    linked = neighbours(position, config.range)
    if alive is not None:
        linked &= alive.unsqueeze(-1) & alive.unsqueeze(-2)
    return linked


def links_with_base(
    config: RadioConfig,
    position: Tensor,
    base: Tensor,
    rng_key: Tensor,
    step: Tensor,
    alive: Tensor | None = None,
) -> Tensor:
    """Returns the links of the UAVs and the base, which is last, bool [envs, n + 1, n + 1].

    The links between UAVs equal `links` without a base.

    Args:
        config, position, rng_key, step, alive: see `links`.
        base: float [envs, 1, 3], cells; the base never fails.
    """
    places = torch.cat((position, base), 1)
    lives = None if alive is None else torch.nn.functional.pad(alive, (0, 1), value=True)
    every = links(config, places, rng_key, step, alive=lives, use=Use.REPORT_LOSS)
    every[:, :-1, :-1] = links(config, position, rng_key, step, alive=alive)
    return every


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
