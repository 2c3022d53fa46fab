"""Compares a run's config.yaml with the configuration that its networks were trained with.

Every checkpoint holds that configuration in its header, under a checksum.
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
"""keys that a resumed run may be given anew, beside those of `evaluation`"""
_FREE = (*MAY_CHANGE, "output", "evaluation")


def check_trained_with(path: Path, config: RunConfig) -> None:
    """Checks that networks were trained with a configuration, but for what may change.

    Args:
        path: of the checkpoint.
        config: of the run folder, as its config.yaml says.

    Raises:
        ValueError: one line: the checkpoint holds no configuration, or another one; the message
            names the first key that differs and both values.
    """
    header = checkpoint_file.read_header(path)
    if header is None or "config" not in header:
        raise UserError(
            f"{path}: does not hold the configuration that it was trained with: it was written by "
            "an earlier version, or by another program"
        )
    check_same(path, header["config"], config)


def check_same(path: Path, sealed: Mapping[str, Any], config: RunConfig) -> None:
    """Checks that the configuration in a checkpoint's header is the run's.

    Args:
        path: of the checkpoint, for the message.
        sealed: plain values of its header.
        config: of the run.

    Raises:
        ValueError: one line that names the first key that differs, and both values.
    """
    free = {key: getattr(config, key) for key in _FREE}
    try:
        made = from_values({**sealed, "device": config.device})
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: made with a configuration that is none: {error}") from None
    for key, (found, wanted) in differences(replace(made, **free), config).items():
        other = ""
        if key.startswith(("env.", "comm.")):
            other = f"; another world is played with: emberlink eval RUN {key}=VALUE"
        raise UserError(
            f"{path}: made with {key}={shown(str(found))}; the run has {key}={shown(str(wanted))}: "
            f"put {shown(str(found))} back into config.yaml{other}"
        )


def differences(one: RunConfig, other: RunConfig) -> dict[str, tuple[Any, Any]]:
    """Returns the dotted keys in which two configurations differ, and both values."""
    first, second = flat(to_values(one)), flat(to_values(other))
    return {
        key: (first.get(key), second.get(key))
        for key in [*first, *(key for key in second if key not in first)]
        if first.get(key) != second.get(key)
    }
