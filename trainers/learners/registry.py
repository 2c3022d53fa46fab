"""Finds learners by name, emberlink's own and entry points, and builds them."""

from emberlink.envs.utils.plugins import Registry
from emberlink.trainers.learners.base import Learner, LearnerConfig, LearnerContext

_OWN = {
    "ddpg": "trainers.learners.ddpg:DDPG",
    "imitation": "trainers.learners.imitation:Imitation",
    "ippo": "trainers.learners.ppo:IPPO",
    "mappo": "trainers.learners.ppo:MAPPO",
    "td3": "trainers.learners.td3:TD3",
}
_REGISTRY = Registry(Learner, "emberlink.learners", "learner.name", _OWN)
known, find = _REGISTRY.known, _REGISTRY.find


def build(config: LearnerConfig, context: LearnerContext) -> Learner:
    """Returns a new learner of a configuration."""
    return find(config.name)(config, context)
