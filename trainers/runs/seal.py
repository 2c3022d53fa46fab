"""Compares config.yaml with the configuration in the header of a checkpoint.

The SHA-256 of the checkpoint covers its header, but not config.yaml.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import flat, from_values, to_values
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.runs import checkpoint_file

MAY_CHANGE = ("episodes", *NOT_LEARNT_WITH)
"""keys that may be changed when a run is resumed, besides those of `evaluation`"""
_FREE = (*MAY_CHANGE, "output", "evaluation")


def check_trained_with(path: Path, config: RunConfig) -> None:
    """Checks that a checkpoint was trained with the configuration of its run folder.

    Keys that do not affect training, such as `device`, may differ.

    Args:
        path: path of the checkpoint.
        config: configuration from config.yaml.

    Raises:
        UserError: the checkpoint holds no configuration or another one; the message names the first
            key that differs and both values.
    """
    header = checkpoint_file.read_header(path)
    if "config" not in header:
        raise UserError(f"{path}: does not hold the configuration that it was trained with")
    check_same(path, header["config"], config)


def check_same(path: Path, sealed: Mapping[str, Any], config: RunConfig) -> None:
    """Checks that the configuration in a checkpoint's header is that of the run.

    Args:
        path: path of the checkpoint, for the message.
        sealed: configuration in its header, as plain values.
        config: configuration of the run.

    Raises:
        UserError: they differ; see `check_trained_with`.
    """
    free = {key: getattr(config, key) for key in _FREE}
    trained = unsealed(path, sealed, config)
    for key, (before, now) in differences(replace(trained, **free), config).items():
        hint = ""
        if key.startswith(("env.", "comm.")):
            hint = f"; to evaluate with another value: emberlink eval RUN {key}=VALUE"
        raise UserError(
            f"{path}: made with {key}={shown(before)}; the run has {key}={shown(now)}: "
            f"put {shown(before)} back into config.yaml{hint}"
        )


def unsealed(path: Path, sealed: Mapping[str, Any], config: RunConfig) -> RunConfig:
    """Returns the configuration in a checkpoint's header; what an old one lacks is the default.

    Args:
        path: path of the checkpoint, for the message.
        sealed: configuration in its header, as plain values.
        config: configuration whose device and output it gets.

    Raises:
        UserError: it cannot be read.
    """
    here = {"device": config.device, "output": config.output}
    try:
        return from_values({**sealed, **here})
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: its configuration cannot be read: {error}") from None


def changed_evaluation(path: Path, config: RunConfig) -> list[str]:
    """Returns a text for each setting of evaluations that differs from the checkpoint's header.

    They may be changed when a run is resumed, and do not affect training. In another world than
    that of the training, the one text is that world.

    Args:
        path: path of the checkpoint.
        config: configuration of the run.
    """
    header = checkpoint_file.read_header(path)
    trained = header.get("config", {})
    if trained.get("world") != config.world:
        return [f"world is {config.world} here, {shown(str(trained.get('world')))} in training"]
    before = trained.get("evaluation", {})
    now = to_values(config)["evaluation"]
    return [
        f"evaluation.{key} is {shown(value)} here, {shown(before.get(key))} in {path.name}"
        for key, value in now.items()
        if value != before.get(key)
    ]


def to_header(config: RunConfig) -> dict[str, Any]:
    """Returns the configuration for the header of a checkpoint.

    It does not contain `output`, so that a checkpoint does not depend on the path of its folder.
    """
    return {key: value for key, value in to_values(config).items() if key != "output"}


def differences(one: RunConfig, other: RunConfig) -> dict[str, tuple[Any, Any]]:
    """Returns the dotted keys in which two configurations differ, with both values."""
    first, second = flat(to_values(one)), flat(to_values(other))
    return {
        key: (first.get(key), second.get(key))
        for key in [*first, *(key for key in second if key not in first)]
        if first.get(key) != second.get(key)
    }
