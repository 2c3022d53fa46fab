"""The settings of a run that are checked before torch is imported, which takes seconds."""

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.validation import STRICT, CountOrZero, Name
from emberlink.policies.settings import PolicyConfig

MAX_FIRES = 65_536
"""maximum number of held-out fires of an evaluation"""
Many = Annotated[int, Field(ge=1, le=MAX_FIRES)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Basics:
    """The settings of a run apart from fires, communication, learner, evaluations and device."""

    method: Name
    """name of the method, a file in configs/method"""
    setup: Name
    """name of the setup, a file in configs/setup"""
    world: Name
    """name of the world, a file in configs/world"""
    edition: Count = 1
    """edition of the world: another one has other rules or fires, so numbers do not compare"""
    replay: Literal["per_agent", "shared"]
    """whether each UAV has its own replay buffer, or all share one"""
    env: WildfireConfig
    """settings of the environment"""
    policy: PolicyConfig = PolicyConfig()
    """memory of the policies, and time between their decisions"""
    episodes: Count
    """training episodes of each environment"""
    num_envs: Many
    """environments, stepped in one batch"""
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    """seed of all random numbers"""
    logger: Literal["wandb", "tensorboard", "csv", "none"]
    """experiment tracker, in addition to metrics.jsonl"""
    output: Annotated[str, Field(min_length=1)]
    """folder in which run folders are created"""
    checkpoint_interval: Count
    """episodes between checkpoints"""
    checkpoint_steps: CountOrZero = 0
    """steps between additional checkpoints; 0 for none"""
