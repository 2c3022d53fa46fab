"""Defines the settings of learners from whole episodes."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.trainers.learners.anchor import WarmStartConfig
from emberlink.trainers.learners.base import STRICT, Count, NotNegative, Positive


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OnPolicyConfig(WarmStartConfig):
    """Stores the settings of learners from whole episodes."""

    share_parameters: bool = True
    """whether all UAVs of a seed use the same weights; if not, each UAV has its own"""
    gamma: Annotated[float, Field(ge=0, lt=1)]
    """discount per decision"""
    gae_lambda: Annotated[float, Field(ge=0, le=1)]
    """factor of generalised advantage estimation (Schulman et al. 2016), per decision"""
    clip: Annotated[float, Field(gt=0, lt=1)]
    """clip range of the probability ratio, [1 - clip, 1 + clip] (Schulman et al. 2017)"""
    epochs: Count
    """passes over the episodes of an iteration"""
    minibatches: Count
    """updates of a pass; each uses whole episodes of some of the environments"""
    lr: Positive
    """learning rate of Adam at the beginning; it falls linearly to 0 at the end of the run"""
    gradient_norm: Positive
    """largest Euclidean norm of the gradient of a network"""
    entropy: NotNegative
    """weight of the entropy of the actions in the actors' loss"""
    log_std: Annotated[float, Field(ge=-10, le=2)] = -0.5
    """logarithm of the standard deviation of the actions at the beginning, also of a warm start"""

    @property
    def replays(self) -> bool:
        return False
