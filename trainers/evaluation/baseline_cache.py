"""Caches the results of scripted policies in files.

They do not depend on training, so all runs with the same environment share them.
"""

import hashlib
import inspect
import json
import math
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import emberlink.comm.base
import emberlink.envs.wildfire
import emberlink.policies
from emberlink.comm import registry
from emberlink.envs import metrics
from emberlink.envs.fire.cache import cache_folder
from emberlink.envs.utils.atomic_io import read_sealed, write_sealed
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import Measured
from emberlink.trainers.runs.safe_read import MAX_JSON, parse_json

_SOURCES = (emberlink.envs.wildfire, emberlink.comm.base, emberlink.policies)
_IMPORTED = time.time_ns()


class ScriptedResults:
    """Reads and writes the file of one policy's results on the fires of one evaluation.

    The name of the file is a hash of everything that the results depend on: environment,
    communication, fires, start seeds, the version of torch, the type of the device, and the source
    files, including those of policies and communication modules of other packages. If a source file
    has changed since it was imported, the cache is not used.

    Args:
        policy: name of the policy.
        config: configuration of the environment.
        arrival: times of the fires in steps, float32 [count, X, Y] or [count, 2, X, Y].
        protocol: other plain values that the results depend on.
    """

    def __init__(
        self, policy: str, config: RunConfig, arrival: Tensor, protocol: Mapping[str, Any]
    ):
        used = SCRIPTED[policy], registry.find(config.comm["name"])
        self._episodes, source = len(arrival), source_digest(*used)
        self._measures = list(metrics.names(config.env))
        parts = {
            "policy": policy,
            "env": asdict(config.env),
            "comm": config.comm,
            "hold": config.policy.hold,
            "fires": hashlib.sha256(arrival.cpu().contiguous().numpy().tobytes()).hexdigest(),
            "protocol": dict(protocol),
            "torch": torch.__version__,
            "device": torch.device(config.device).type,
            "source": source,
        }
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]
        self.file = cache_folder() / f"scripted-{key}.json" if source else None

    def read(self) -> Measured | None:
        """Returns the results, or None if the file does not exist or is damaged."""
        if self.file is None:
            return None
        content = read_sealed(self.file, MAX_JSON)
        if content is None:
            return None
        try:
            stored = parse_json(content.decode())
        except ValueError:
            return None
        return stored if _whole(stored, self._measures, self._episodes) else None

    def write(self, measured: Measured) -> None:
        """Writes the results, or warns if the folder is not writable."""
        if self.file is None:
            return
        try:
            write_sealed(self.file, json.dumps(measured).encode())
        except OSError as error:
            message = f"scripted results are not cached: cannot write {self.file}: {error}"
            warnings.warn(message, stacklevel=2)


def sources(*used: type) -> list[Path]:
    """Returns the source files that the results depend on.

    Args:
        used: classes of the policy and the communication module.
    """
    folders = [Path(str(module.__file__)).parent for module in _SOURCES]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    here = Path(__file__)
    files += [here.with_name("evaluate.py"), here.parents[1] / "build.py"]
    return list(dict.fromkeys([*files, *(Path(inspect.getfile(cls)) for cls in used)]))


def source_digest(*used: type) -> str | None:
    """Returns a hash of `sources`, or None if a file has changed since it was imported."""
    files = sources(*used)
    if max(file.stat().st_mtime_ns for file in files) > _IMPORTED:
        return None
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        digest.update(f"{file.parent.name}/{file.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _whole(stored: Any, measures: list[str], episodes: int) -> bool:
    """Returns whether a stored value has all measures of the given number of episodes."""
    return (
        isinstance(stored, dict)
        and list(stored) == measures
        and all(isinstance(column, list) and len(column) == episodes for column in stored.values())
        and all(
            isinstance(x, float) and math.isfinite(x) for column in stored.values() for x in column
        )
    )
