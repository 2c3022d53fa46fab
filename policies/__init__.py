"""The policies of the UAVs: networks, exploration noise, scripted baselines, trained weights."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.policies.exploration import ExplorationConfig, OrnsteinUhlenbeck
    from emberlink.policies.gaussian import GaussianExplorer, MemoryActor
    from emberlink.policies.hold import Held
    from emberlink.policies.settings import PolicyConfig

__all__ = [
    "ExplorationConfig",
    "GaussianExplorer",
    "Held",
    "MemoryActor",
    "OrnsteinUhlenbeck",
    "PolicyConfig",
]

__getattr__ = lazy(
    __name__,
    {
        "ExplorationConfig": "exploration",
        "GaussianExplorer": "gaussian",
        "Held": "hold",
        "MemoryActor": "gaussian",
        "OrnsteinUhlenbeck": "exploration",
        "PolicyConfig": "settings",
    },
)
