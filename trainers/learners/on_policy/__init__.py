"""The base of learners from whole episodes (IPPO, MAPPO), and its parts."""

from emberlink.trainers.learners.on_policy.config import OnPolicyConfig
from emberlink.trainers.learners.on_policy.learner import OnPolicyLearner

__all__ = ["OnPolicyConfig", "OnPolicyLearner"]
