"""Defines the schema of a run's configuration."""

import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    SerializeAsAny,
    Strict,
    field_validator,
    model_validator,
)
from pydantic.dataclasses import dataclass

from emberlink.comm.base import MODULES, CommModule
from emberlink.envs import metrics
from emberlink.envs.config import WildfireConfig
from emberlink.envs.scenarios import Scenario
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Plugins
from emberlink.envs.utils.validation import STRICT, CountOrZero, Name, from_plain, shown
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners.base import LEARNERS, Count, LearnerConfig

MAX_FIRES = 65_536
"""maximum number of held-out fires of an evaluation"""
Many = Annotated[int, Field(ge=1, le=MAX_FIRES)]
NOT_LEARNT_WITH = ("device", "logger", "checkpoint_interval", "checkpoint_steps")
"""keys that do not affect learning: configurations that differ only in them are of the same run"""


def _settings(key: str, values: Any, plugins: Plugins) -> Any:
    """Returns name and settings as an instance of the `config_type` of the named class."""
    if is_dataclass(values):
        return values
    if not isinstance(values, Mapping) or not isinstance(name := values.get("name"), str):
        raise UserError(f"{key}={shown(values)}: expected a name and settings")
    config_type = plugins.find(name).config_type
    # A type may have the name among its fields.
    named = any(field.name == "name" for field in fields(config_type))
    given = values if named else {k: v for k, v in values.items() if k != "name"}
    return from_plain(config_type, given, key)


def _known(plugins: Plugins) -> AfterValidator:
    return AfterValidator(lambda name: plugins.find(name) and name)


LearnerChoice = Annotated[
    SerializeAsAny[LearnerConfig],
    PlainValidator(lambda values: _settings("learner", values, LEARNERS)),
]
"""settings of the learner `learner.name`"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class EvaluationConfig:
    """Stores the settings of evaluations of frozen policies on held-out fires."""

    episodes: Many
    """episodes of the evaluation after training, each on another test fire"""
    interval: CountOrZero
    """episodes between evaluations during training; 0 for none"""
    interval_episodes: Many
    """episodes of an evaluation during training, each on another validation fire"""
    huygens: bool
    """whether to evaluate on fires of `huygens` besides the training's scenario"""
    scripted: Annotated[tuple[Annotated[str, _known(SCRIPTED)], ...], Strict(False)]
    """scripted policies to evaluate"""
    headline: str
    """the measure that chooses the networks of best.safetensors on validation fires"""
    message_fault: Literal["none", "zero", "shuffle"] = "none"
    """what happens to learned messages when a frozen policy is evaluated (`Messages.fault`)"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RunConfig:
    """All settings of a run."""

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
    comm: dict[str, Any]
    """name and settings of the communication module"""
    fire: Scenario
    """training fires"""
    learner: LearnerChoice
    """settings of the learning algorithm"""
    evaluation: EvaluationConfig
    """settings of the evaluations"""
    device: Annotated[str, Field(min_length=1)]
    """device of the environment, the replay buffer and the networks"""

    @model_validator(mode="after")
    def _check_headline(self) -> "RunConfig":
        headline, known = self.evaluation.headline, metrics.names(self.env)
        if headline not in known:
            where = "is not measured in this world (env.measures, env.base)"
            raise UserError(f"evaluation.headline={headline} {where}; known: {', '.join(known)}")
        return self

    @field_validator("comm")
    @classmethod
    def _complete_comm(cls, value: dict[str, Any]) -> dict[str, Any]:
        # A run folder keeps them if a later version of the module has other defaults.
        settings = _settings("comm", value, MODULES)
        return {"name": value["name"], **asdict(settings)}


def build_comm(config: RunConfig, num_envs: int) -> CommModule:
    """Returns a new communication module; warns if it does not heed delay and bandwidth."""
    kind, radio = MODULES.find(config.comm["name"]), config.env.radio
    if radio.packets and kind.hears and not kind.heeds_packets:
        name = config.comm["name"]
        said = f"env.radio.delay or bandwidth: the messages of comm.name={name} heed neither"
        warnings.warn(said, stacklevel=2)
    module = kind(config.env, _settings("comm", config.comm, MODULES), num_envs)
    module.hold = config.policy.hold
    return module
