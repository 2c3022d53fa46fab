"""Reads and writes checkpoints: safetensors files whose header holds JSON."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from emberlink.envs.utils.atomic_io import open_regular, replaced
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, CountOrZero, from_plain, shown
from emberlink.trainers.config.compose import from_values, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import flat
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs.versions import versions

FORMAT = 2
"""version of the file format; files of another version are refused"""
WEIGHTS = "weights/"
"""prefix of the names of the networks' tensors; the others are training state"""

_KEY = "emberlink"
_MAX_HEADER = 4_000_000
"""bytes; the header of a checkpoint with 2,000 tensors has a tenth of it"""
_MAX_FILE = 2**35
"""bytes; the largest checkpoint measured has 333 MB"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Header:
    """The part of a checkpoint that is not tensors."""

    step: CountOrZero
    """steps of the batch of environments so far"""
    config: dict[str, Any]
    """configuration of the run as plain values, without `output`"""
    versions: dict[str, str]
    """package -> version that wrote the checkpoint"""
    best: Annotated[float, Field(allow_inf_nan=False)] | None = None
    """best headline measure so far"""
    resumable: bool = False
    """whether the checkpoint holds the training state, besides the networks"""


def header_of(config: RunConfig, step: int, **more: Any) -> Header:
    """Returns the header of a new checkpoint."""
    values = {key: value for key, value in to_values(config).items() if key != "output"}
    return Header(step=step, config=values, versions=versions(), **more)


def write(path: Path, header: Header, tensors: Mapping[str, Tensor]) -> None:
    """Writes a checkpoint by temporary file, flush to the disk and rename.

    Raises:
        UserError: the file cannot be written, such as to a full disk; the earlier file stays.
    """
    content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps({"format": FORMAT, **asdict(header)})
    try:
        with replaced(path) as partial:
            save_file(content, partial, metadata={_KEY: text})
            partial.chmod(path.parent.stat().st_mode & 0o666)  # safetensors makes it private
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: cannot be written: {_reason(error)}") from None


def read_header(path: Path) -> Header:
    """Returns a checkpoint's header.

    Raises:
        UserError: there is no such file, or it is not a checkpoint of this format.
    """
    try:
        with open_regular(path, _MAX_FILE) as file:
            length = int.from_bytes(file.read(8), "little")
            head = json.loads(file.read(length)) if length <= _MAX_HEADER else {}
        values = json.loads(head["__metadata__"][_KEY])
        version = values.pop("format")
    except OSError as error:
        raise UserError(f"{path}: not a readable checkpoint: {_reason(error)}") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError):
        raise UserError(
            f"{path}: not a readable checkpoint: damaged, or of another program"
        ) from None
    if version != FORMAT:
        raise UserError(
            f"{path}: a checkpoint of format {shown(version)}; this version reads {FORMAT}"
        )
    try:
        return from_plain(Header, values)
    except UserError as error:
        raise UserError(f"{path}: not a readable checkpoint: {error}") from None


def read_tensors(path: Path, prefix: str = "") -> dict[str, Tensor]:
    """Returns the tensors whose names begin with `prefix`, on the CPU, without the prefix.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        with safe_open(path, "pt") as file:
            names = file.offset_keys()
            chosen = [name for name in names if name.startswith(prefix)]
            return {name.removeprefix(prefix): file.get_tensor(name) for name in chosen}
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: not a readable checkpoint: {_reason(error)}") from None


def read_config(path: Path, **changes: Any) -> RunConfig:
    """Returns the configuration that a checkpoint was trained with.

    Args:
        changes: keys and values to change, such as `device="cpu"`.

    Raises:
        UserError: the file cannot be read, or a key or value is not known here.
    """
    try:
        return from_values({**read_header(path).config, "output": "runs", **changes})
    except UserError as error:
        text = str(error)
        raise UserError(text if str(path) in text else f"{path}: {text}") from None


def load_weights(
    path: Path, expected: Mapping[str, Tensor], config: RunConfig
) -> dict[str, Tensor]:
    """Returns the weights of a checkpoint.

    Args:
        expected: the actors' tensors, with the expected names, shapes and types.
        config: configuration of the networks that get the weights, for messages.

    Raises:
        UserError: the file cannot be read, a weight is missing, has another shape or type or is not
            finite, or the actors have more weights.
    """
    header, weights = read_header(path), read_tensors(path, WEIGHTS)
    if reason := _misfit(weights, expected):
        before, now = flat(header.config), flat(to_values(config))
        changed = [
            f"{key}={shown(now[key])} (in training {shown(before[key])})"
            for key in now
            if before.get(key, now[key]) != now[key] and key.startswith(("env.", "comm.", "policy"))
        ]
        raise UserError(f"{path}: does not fit {', '.join(changed) or 'the run'}: {reason}")
    chosen = {name: weights[name] for name in expected}
    if name := first_non_finite(chosen):
        raise UserError(f"{path}: {name} holds NaN or infinite numbers")
    return chosen


def first_non_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Returns the name of the first tensor that holds NaN or Inf, or None."""
    for name, value in tensors.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            return name
    return None


def _misfit(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> str:
    """Returns how weights differ from the expected ones; "" if they fit."""
    for name, tensor in expected.items():
        if name not in weights:
            return f"holds no {name}"
        weight = weights[name]
        if weight.shape != tensor.shape or weight.dtype != tensor.dtype:
            return (
                f"{name} has shape {list(weight.shape)}, {weight.dtype}; expected "
                f"{list(tensor.shape)}, {tensor.dtype}"
            )
    more = [name for name in weights if name.startswith(ACTOR) and name not in expected]
    return f"holds {more[0]}, which is not expected" if more else ""


def _reason(error: Exception) -> str:
    """Returns the message of an error on one line."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split()).removeprefix("Error while serializing: I/O error: ")
