"""The TensorDict keys of the environment, and the layout of one UAV's observation.

Everything a UAV has stands under "agents", with batch size [num_envs, num_uavs]; everything an
environment has stands at the root, with batch size [num_envs].
"""

from typing import Final

from torchrl.data import Composite

AGENTS: Final = "agents"

OBSERVATION: Final = (AGENTS, "observation")
"""float32 [..., features]: the vector that the UAV's networks read."""
WINDOW: Final = (AGENTS, "window")
"""bool [..., 3, W, W]: the cells of the window around the UAV that are new fire, old fire and no
fire in view, by x and y offset from the cell nearest to the UAV, which is in the middle; False
outside of the grid and of the field of view. W is odd and fits the view from the highest altitude.
Only with `observation: window`."""
ACTION: Final = (AGENTS, "action")
"""float32 [..., 3] in [-1, 1]: a displacement in x, y and z."""
REWARD: Final = (AGENTS, "reward")
"""float32 [..., 1]."""
POSITION: Final = (AGENTS, "position")
"""float32 [..., 3]: x, y and z in cells."""
NEW_FIRE: Final = (AGENTS, "new_fire")
"""int64 [...]: cells in view that burn and that nobody had seen before."""
OLD_FIRE: Final = (AGENTS, "old_fire")
"""int64 [...]: cells in view that burn and that some UAV had seen before."""
NO_FIRE: Final = (AGENTS, "no_fire")
"""int64 [...]: cells in view that do not burn."""
NEW_CENTRE: Final = (AGENTS, "new_centre")
"""float32 [..., 2]: mean x and y of the new fire in view, 0 where there is none."""
OLD_CENTRE: Final = (AGENTS, "old_centre")
"""float32 [..., 2]: mean x and y of the old fire in view, 0 where there is none."""
HEARS: Final = (AGENTS, "hears")
"""bool [..., n]: the UAVs whose messages the UAV received at this step, False for itself. Written
by communication."""
TARGET: Final = (AGENTS, "target")
"""float32 [..., 3]: the point that the UAV is told to fly to, cells. Written by communication."""
FOLLOWS: Final = (AGENTS, "follows")
"""int64 [...]: the discoverer that the UAV follows, itself for a discoverer, -1 for nobody. Written
by communication."""
HIT_BOUNDARY: Final = (AGENTS, "hit_boundary")
"""bool [..., 3]: the axes along which the last move would have left the box."""

RNG_KEY: Final = "rng_key"
"""int64 [num_envs]: the key of this episode's random numbers (`envs.utils.counter_rng`)."""
STEP: Final = "step"
"""int64 [num_envs]: steps since the episode began."""
SEEN: Final = "seen"
"""int64 [num_envs]: burning cells that some UAV has seen this episode."""
BURNING: Final = "burning"
"""int64 [num_envs]: cells that burn now."""

FEATURES: Final = ("x", "y", "z", "new_fire", "old_fire", "timestep")
"""What each number of a UAV's own observation is, in order (paper, section IV.C)."""


def observation_keys(spec: Composite) -> list[tuple[str, str]]:
    """Returns the keys of the tensors per UAV that networks read, in a fixed order.

    Args:
        spec: an environment's observation spec.
    """
    present = spec.keys(True, True)
    return [key for key in (OBSERVATION, WINDOW) if key in present]
