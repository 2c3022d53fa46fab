"""Models the radio: computes which UAVs hear each other in a step."""

import torch
from torch import Tensor

from emberlink.envs.config import RadioConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world import motion


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
        config: range and probability of loss.
        position: float [..., n, 3], cells.
        rng_key: int64 [...], `keys.RNG_KEY`.
        step: int64 [...], steps since the episode began.
        alive: bool [..., n]; a radio that is not neither hears nor is heard. All are alive if None.
        use: purpose of the random numbers.
    """
    linked = neighbours(position, config.range)
    if alive is not None:
        linked &= alive.unsqueeze(-1) & alive.unsqueeze(-2)
    if config.loss:
        radios = linked.shape[-1]
        key = counter_rng.step_key(rng_key, step, use)
        unit = counter_rng.uniform(key, radios * radios).unflatten(-1, (radios, radios))
        linked &= unit >= config.loss
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

    The links between UAVs are those of `links` without a base.

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
    reach = (hears | torch.eye(radios, dtype=torch.bool, device=hears.device)).float()
    # Each squaring doubles the number of hops; a path has at most n - 1 hops.
    for _ in range((radios - 1).bit_length()):
        reach = (reach @ reach).clamp_(max=1)
    return reach > 0


def pairwise_distance(position: Tensor) -> Tensor:
    """Returns the distances between points [..., n, 3], float64 [..., n, n], cells."""
    return motion.distance(position.unsqueeze(-2), position.unsqueeze(-3))


def neighbours(position: Tensor, limit: float) -> Tensor:
    """Returns whether each other point of [..., n, 3] is nearer than `limit`, bool [..., n, n]."""
    near = pairwise_distance(position) < limit
    return near & ~torch.eye(near.shape[-1], dtype=torch.bool, device=near.device)
