"""The schema of a run's configuration."""

from dataclasses import asdict
from typing import Annotated, Any, Literal

import torch
from pydantic import ConfigDict, Field, PlainValidator, SerializeAsAny, Strict, field_validator
from pydantic.dataclasses import dataclass

from emberlink.comm import registry
from emberlink.comm.base import CommModule
from emberlink.envs.config import WildfireConfig
from emberlink.envs.scenarios import Scenario
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import Name, shown
from emberlink.trainers.learners.base import LearnerConfig
from emberlink.trainers.learners.registry import parse_config as parse_learner

from . import choice

_STRICT = ConfigDict(extra="forbid", strict=True)


NOT_LEARNT_WITH = (
    *("device", "logger", "on_nan"),
    *("checkpoint_interval", "checkpoint_steps", "keep_checkpoints"),
)
"""keys that change nothing of what is learnt, so that runs that differ in them are the same"""


Count = Annotated[int, Field(ge=1, le=1_000_000_000)]


Side = Annotated[int, Field(ge=1, le=65_536)]


MaybeCount = Annotated[int, Field(ge=0)]


Seed = Annotated[int, Field(ge=0, lt=2**31)]


LearnerChoice = Annotated[SerializeAsAny[LearnerConfig], PlainValidator(parse_learner)]
"""the configuration of the learner that `learner.name` says"""


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class EvaluationConfig:
    """Frozen policies on held-out fires."""

    episodes: Side
    """held-out fires, one episode each, of the evaluation at the end"""
    interval: MaybeCount
    """episodes between evaluations during training; 0 for none"""
    interval_episodes: Side
    """held-out fires of the evaluations during training"""


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
    learner: LearnerChoice
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
