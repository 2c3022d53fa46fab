"""The schema of a run's configuration."""

from dataclasses import asdict
from typing import Annotated, Any, Literal

import torch
from pydantic import ConfigDict, Field, Strict, field_validator, model_validator
from pydantic.dataclasses import dataclass

from emberlink.comm import registry
from emberlink.comm.base import CommModule
from emberlink.envs.config import WildfireConfig
from emberlink.envs.scenarios import Scenario
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import Name, shown

from . import choice

_STRICT = ConfigDict(extra="forbid", strict=True)


NOT_LEARNT_WITH = (
    *("device", "logger", "on_nan"),
    *("checkpoint_interval", "checkpoint_steps", "keep_checkpoints"),
)
"""keys that change nothing of what is learnt, so that runs that differ in them are the same"""


Positive = Annotated[float, Field(gt=0, le=1e30)]


NotNegative = Annotated[float, Field(ge=0, le=1e30)]


Count = Annotated[int, Field(ge=1, le=1_000_000_000)]


Units = Annotated[int, Field(ge=1, le=8192)]


Side = Annotated[int, Field(ge=1, le=65_536)]


MaybeCount = Annotated[int, Field(ge=0)]


Seed = Annotated[int, Field(ge=0, lt=2**31)]


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class LearnerConfig:
    """DDPG for every UAV (paper, section III.C)."""

    hidden: Annotated[tuple[Units, Units], Strict(False)]
    """units of the two hidden layers"""
    gamma: Annotated[float, Field(ge=0, lt=1)]
    """discount per step"""
    actor_lr: Positive
    """Adam's learning rate of the actors"""
    critic_lr: Positive
    """Adam's learning rate of the critics"""
    critic_weight_decay: NotNegative
    """L2 penalty in the critics' Adam"""
    tau: Annotated[float, Field(gt=0, le=0.5)]
    """share of the networks in their targets per update"""
    updates_per_step: Count
    """updates of every UAV's networks per step of all environments side by side"""
    batch_size: Annotated[int, Field(ge=1, le=1_000_000)]
    """transitions per UAV and update"""
    buffer_size: Count
    """transitions that a replay memory holds"""

    @model_validator(mode="after")
    def _a_batch_fits(self) -> "LearnerConfig":
        if self.batch_size > self.buffer_size:
            raise UserError(
                f"batch_size={self.batch_size} is more than buffer_size={self.buffer_size} holds"
            )
        return self


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class ExplorationConfig:
    """Ornstein-Uhlenbeck noise: x += theta * (0 - x) * dt + sigma * sqrt(dt) * N(0, 1)."""

    theta: NotNegative
    """pull towards 0"""
    sigma: NotNegative
    """strength of the noise"""
    dt: Positive
    """length of a step"""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class EvaluationConfig:
    """Evaluations of the frozen policies."""

    episodes: Side
    """number of test fires, one episode each, of the evaluation at the end"""
    interval: MaybeCount
    """episodes between evaluations during training; 0 for none"""
    interval_episodes: Side
    """number of validation fires, one episode each, of an evaluation during training"""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RunConfig:
    """Everything that a run depends on."""

    method: Name
    """the recipe: a file in configs/method"""
    setup: Name
    """the constants: a file in configs/setup"""
    replay: Literal["per_agent", "shared"]
    """one replay memory per UAV, or one for all"""
    comm: dict[str, Any]
    """the communication module's name and its settings"""
    env: WildfireConfig
    fire: Scenario
    learner: LearnerConfig
    exploration: ExplorationConfig
    evaluation: EvaluationConfig
    episodes: Count
    """episodes of training, counted per environment: all run theirs side by side"""
    num_envs: Side
    """environments that collect side by side, for each seed"""
    seeds: Annotated[tuple[Seed, ...], Strict(False)] = ()
    """several seeds, trained side by side as one stack, a run folder each; `seed` is then this
    run's; none for `seed` alone"""
    seed: Seed
    """of everything random in the run"""
    device: str
    """where environment, memory and networks live"""
    logger: Literal["wandb", "tensorboard", "csv", "none"]
    """the tracker beside metrics.jsonl"""
    output: Annotated[str, Field(min_length=1)]
    """the folder in which the run folder is made"""
    checkpoint_interval: Count
    """episodes between checkpoints"""
    checkpoint_steps: MaybeCount = 0
    """steps between further checkpoints, counted through the whole run; 0 for none"""
    keep_checkpoints: Count = 5
    """checkpoints of which the networks stay; the two newest hold what a resumed run needs too"""
    on_nan: Literal["stop", "rollback"] = "stop"
    """what is done where a number is not finite: the run ends, or goes back to its last checkpoint
    with smaller learning rates"""

    @field_validator("device")
    @classmethod
    def _device_is_there(cls, value: str) -> str:
        return check_device(value)

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(value)) < len(value):
            raise UserError(f"seeds={list(value)}: each seed at most once")
        return value

    @field_validator("comm")
    @classmethod
    def _comm_is_known(cls, value: dict[str, Any]) -> dict[str, Any]:
        choice.check("comm", value, registry)
        return value


def build_comm(config: RunConfig) -> CommModule:
    """Returns a new communication module of a configuration."""
    settings = {key: value for key, value in config.comm.items() if key != "name"}
    return registry.build(config.comm["name"], config.env, settings)


def comm_settings(config: RunConfig) -> dict[str, Any]:
    """Returns all settings of a configuration's communication module, defaults included."""
    return asdict(choice.settings("comm", config.comm, registry))


def check_device(name: str) -> str:
    """Returns the name of a device, after checking that this machine has it.

    Raises:
        UserError: there is no such device; the message lists those that there are.
    """
    present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    found = device is not None and (
        str(device) == "cpu" or (device.type == "cuda" and (device.index or 0) < len(present) - 1)
    )
    if not found:
        raise UserError(f"device={shown(name)} is not there; known: {', '.join(present)}")
    return name
