"""The base of learners from a replay buffer with target networks (DDPG, TD3), and its parts."""

from emberlink.trainers.learners.off_policy.config import OffPolicyConfig
from emberlink.trainers.learners.off_policy.learner import OffPolicyLearner

__all__ = ["OffPolicyConfig", "OffPolicyLearner"]
