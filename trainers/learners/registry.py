"""Finds learners by name, in this folder and among entry points, and builds them."""

from emberlink.envs.utils.plugins import Registry
from emberlink.trainers.learners.base import Learner, LearnerConfig, LearnerContext

_REGISTRY = Registry(
    Learner,
    "emberlink.trainers.learners",
    "learner.name",
    other_files=("base", "ppo", "registry", "replay", "tensors"),
    group="emberlink.learners",
    shared={"ippo": "ppo", "mappo": "ppo"},
)
known, find = _REGISTRY.known, _REGISTRY.find


def build(config: LearnerConfig, context: LearnerContext) -> Learner:
    """Returns a new learner of a configuration."""
    return find(config.name)(config, context)
