"""The TensorDict keys of the environment, and the layout of one UAV's observation.

Tensors per UAV stand under "agents", with batch size [num_envs, num_uavs]; tensors per environment
stand at the root, with batch size [num_envs].
"""

from collections.abc import Sequence
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
SIGHT: Final = (AGENTS, "sight")
"""uint8 [..., W, W]: the camera's view of the same cells: 0 not in view, 1 no fire, 2 fire, 3 burnt
out; without other UAVs' sightings. Only with `observation: map`."""
CROPS: Final = (AGENTS, "crops")
"""uint8 [..., scales, channels, S, S]: pictures of the UAV's belief map around it. Only with
`observation: map`; written with the communication."""
ACTION: Final = (AGENTS, "action")
"""float32 [..., 3] in [-1, 1]: a displacement in x, y and z."""
REWARD: Final = (AGENTS, "reward")
"""float32 [..., 1]."""
POSITION: Final = (AGENTS, "position")
"""float32 [..., 3]: x, y and z in cells."""
NEW_FIRE: Final = (AGENTS, "new_fire")
"""int64 [...]: cells in view that burn and that no UAV had seen before; with `knowledge: own`, that
the UAV itself had not seen."""
OLD_FIRE: Final = (AGENTS, "old_fire")
"""int64 [...]: the other cells in view that burn."""
NO_FIRE: Final = (AGENTS, "no_fire")
"""int64 [...]: cells in view that do not burn."""
NEW_CENTRE: Final = (AGENTS, "new_centre")
"""float32 [..., 2]: mean x and y of the new fire in view, 0 without any."""
OLD_CENTRE: Final = (AGENTS, "old_centre")
"""float32 [..., 2]: mean x and y of the old fire in view, 0 without any."""
HEARS: Final = (AGENTS, "hears")
"""bool [..., n]: the UAVs whose messages the UAV received at this step, False for itself. Written
by communication."""
BUDGET: Final = (AGENTS, "budget")
"""int64 [...]: the bytes that the UAV can say at this step besides its learned message, negative if
this does not fit. Written by communication with `radio.bandwidth`."""
TARGET: Final = (AGENTS, "target")
"""float32 [..., 3]: the point that the UAV is told to fly to, cells. Written by communication."""
FOLLOWS: Final = (AGENTS, "follows")
"""int64 [...]: the discoverer that the UAV follows, itself for a discoverer, -1 for nobody. Written
by communication."""
HIT_BOUNDARY: Final = (AGENTS, "hit_boundary")
"""bool [..., 3]: the axes along which the last move would have left the box."""
ALIVE: Final = (AGENTS, "alive")
"""bool [...]: whether the UAV flies; one that has failed sees, says and hears nothing, does not
move and gets no reward."""
BYTES_SENT: Final = (AGENTS, "bytes_sent")
"""int64 [...]: bytes that the UAV sent at this step. Written by communication."""
REPORT_BYTES: Final = (AGENTS, "report_bytes")
"""int64 [...]: the part of them for the base. Only with a base, `measures: all` and a radio that is
late or limited; `BYTES_SENT` contains them."""

RNG_KEY: Final = "rng_key"
"""int64 [num_envs]: the key of this episode's random numbers (`envs.utils.counter_rng`)."""
STEP: Final = "step"
"""int64 [num_envs]: steps since the episode began."""
SEEN: Final = "seen"
"""int64 [num_envs]: cells that any UAV has seen while they burned, in this episode."""
BURNING: Final = "burning"
"""int64 [num_envs]: cells that burn now."""
BURNT: Final = "burnt"
"""int64 [num_envs]: cells that burn now or have burnt out, in this episode."""
FRONT_AGE: Final = "front_age"
"""float32 [num_envs]: mean steps since a burning cell was last seen by any UAV, from its ignition
if it was not seen since; over all burning cells and steps so far. Only with `measures: all`."""
BASE_SEEN: Final = "base_seen"
"""int64 [num_envs]: cells with a sighting in flames known to the base. Only with a base."""
BASE_AGE: Final = "base_age"
"""float32 [num_envs]: as `FRONT_AGE`, with the last sighting that the base has. Only with a
base."""
TRUE_MAP: Final = "true_map"
"""uint8 [num_envs, X, Y]: `WildfireEnv.fire_map`. Only with `true_map=True`; no UAV knows it."""

STEPS: Final = "steps"
"""The steps of a held action, batch size [num_envs, hold]: the entries that the measures read of
each step (`metrics.counted`), under the same keys. Only after a step with `hold` above 1."""

TEACHER: Final = (AGENTS, "teacher")
"""float32 [..., 3]: the action of a teacher with the UAV's own belief map; 0 at steps without a
decision. Only in trainings with `learner=imitation`."""

FEATURES: Final = ("x", "y", "z", "new_fire", "old_fire", "timestep")
"""the numbers of a UAV's own observation, in order (paper, section IV.C)"""


NETWORKS_READ: Final = (OBSERVATION, WINDOW, CROPS)
"""the tensors per UAV that networks read, in order"""


def observation_keys(spec: Composite) -> list[tuple[str, str]]:
    """Returns the keys of `NETWORKS_READ` that an environment's observation spec has."""
    present = spec.keys(True, True)
    return [key for key in NETWORKS_READ if key in present]


def observation_shapes(spec: Composite) -> list[Sequence[int]]:
    """Returns the shapes of the tensors of `observation_keys`, per UAV."""
    batch = spec.ndim + 1
    return [spec[key].shape[batch:] for key in observation_keys(spec)]
