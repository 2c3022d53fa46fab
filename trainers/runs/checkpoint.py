"""Reads and writes checkpoints: safetensors files whose header holds JSON."""

import json
import platform
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from pydantic.dataclasses import dataclass
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from emberlink.envs.utils.atomic_io import replaced
from emberlink.envs.utils.errors import UserError, naming
from emberlink.envs.utils.validation import STRICT, CountOrZero, from_plain, shown
from emberlink.trainers.config.compose import differences, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.learners.tensors import check_like

FORMAT = 2
"""version of the file format; files of another version are refused"""
WEIGHTS = "weights/"
"""prefix of the names of the networks' tensors; the others are training state"""

_KEY = "emberlink"


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


@cache
def versions() -> dict[str, str]:
    """Returns the version of Python and of each package that a training's numbers depend on."""
    names = ("emberlink", "torch", "torchrl", "tensordict", "numpy")
    return {name: version(name) for name in names} | {"python": platform.python_version()}


def header_of(config: RunConfig, step: int, **more: Any) -> Header:
    """Returns the header of a new checkpoint."""
    values = {key: value for key, value in to_values(config).items() if key != "output"}
    return Header(step=step, config=values, versions=versions(), **more)


def write(path: Path, header: Header, tensors: Mapping[str, Tensor]) -> None:
    """Writes a checkpoint by temporary file, flush to the disk and rename."""
    content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps({"format": FORMAT, **asdict(header)})
    with naming(path, SafetensorError), replaced(path) as partial:
        save_file(content, partial, metadata={_KEY: text})
        partial.chmod(path.parent.stat().st_mode & 0o666)  # safetensors makes it private


def read_header(path: Path) -> Header:
    """Returns a checkpoint's header."""
    with naming(path, SafetensorError):
        with safe_open(path, "pt") as file:
            about = file.metadata() or {}
        values = json.loads(about.get(_KEY, "{}"))
        if not isinstance(values, dict) or values.pop("format", None) != FORMAT:
            raise UserError(f"not a checkpoint of format {FORMAT}, which this version reads")
        return from_plain(Header, values)


def read_tensors(path: Path, prefix: str = "") -> dict[str, Tensor]:
    """Returns the tensors whose names begin with `prefix`, on the CPU, without the prefix."""
    with naming(path, SafetensorError), safe_open(path, "pt") as file:
        chosen = [name for name in file.offset_keys() if name.startswith(prefix)]
        return {name.removeprefix(prefix): file.get_tensor(name) for name in chosen}


def load_weights(path: Path, network: Any, config: RunConfig) -> dict[str, Tensor]:
    """Returns the weights of a checkpoint, which fit the actors `network` of a configuration."""
    expected = {ACTOR + name: value for name, value in network.state_dict().items()}
    header, every = read_header(path), read_tensors(path, WEIGHTS)
    weights = {name: value for name, value in every.items() if name.startswith(ACTOR)}
    try:
        check_like(expected, weights)
    except ValueError as reason:
        changed = [
            f"{key}={shown(now)} (in training {shown(before)})"
            for key, (now, before) in differences(config, header.config).items()
            if key.startswith(("env.", "comm.", "policy"))
        ]
        fits = ", ".join(changed) or "the run"
        raise UserError(f"{path}: does not fit {fits}: {reason}") from None
    if name := first_non_finite(weights):
        raise UserError(f"{path}: {name} holds NaN or infinite numbers")
    return weights


def first_non_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Returns the name of the first tensor that holds NaN or Inf, or None."""
    return next((name for name, value in tensors.items() if not value.isfinite().all()), None)
