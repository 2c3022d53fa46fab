"""Keeps the results of scripted policies in files, so that each is computed once.

They depend on the constants of a run only, so runs with the same constants share a file.
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
    """The file of one policy's results on the fires of one evaluation.

    Its name is a hash of everything that the numbers depend on: environment, communication,
    fires, start seeds, the version of torch, the kind of device, and the source files, those of a
    policy or a communication module from another package included. If a source file has changed
    since it was imported, nothing is read and nothing is written.

    Args:
        policy: name of the policy.
        config: configuration of the environment that it is played in.
        arrival: arrival times of the fires, float32 [count, X, Y].
        protocol: other values that the numbers depend on, as plain values.
    """

    def __init__(
        self, policy: str, config: RunConfig, arrival: Tensor, protocol: Mapping[str, Any]
    ):
        used = SCRIPTED[policy], registry.find(config.comm["name"])
        self._episodes, source = len(arrival), source_digest(*used)
        parts = {
            "policy": policy,
            "env": asdict(config.env),
            "comm": config.comm,
            "fires": hashlib.sha256(arrival.cpu().contiguous().numpy().tobytes()).hexdigest(),
            "protocol": dict(protocol),
            "torch": torch.__version__,
            "device": torch.device(config.device).type,
            "source": source,
        }
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]
        self.file = cache_folder() / f"scripted-{key}.json" if source else None

    def read(self) -> Measured | None:
        """Returns the results, or None if there is no such file or it is damaged."""
        if self.file is None:
            return None
        content = read_sealed(self.file, MAX_JSON)
        if content is None:
            return None
        try:
            stored = parse_json(content.decode())
        except ValueError:
            return None
        return stored if _whole(stored, self._episodes) else None

    def write(self, measured: Measured) -> None:
        """Writes the file; warns if the folder cannot be written to."""
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
        used: classes of the policy and the communication, which may be of other packages.
    """
    folders = [Path(str(module.__file__)).parent for module in _SOURCES]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    here = Path(__file__)
    files += [here.with_name("evaluate.py"), here.parents[1] / "build.py"]
    return list(dict.fromkeys([*files, *(Path(inspect.getfile(one)) for one in used)]))


def source_digest(*used: type) -> str | None:
    """Returns a hash of `sources`, or None if one has changed since it was imported."""
    files = sources(*used)
    if max(file.stat().st_mtime_ns for file in files) > _IMPORTED:
        return None
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        digest.update(f"{file.parent.name}/{file.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _whole(stored: Any, episodes: int) -> bool:
    """Returns whether these are all measures of so many episodes."""
    return (
        isinstance(stored, dict)
        and list(stored) == list(metrics.NAMES)
        and all(isinstance(column, list) and len(column) == episodes for column in stored.values())
        and all(
            isinstance(x, float) and math.isfinite(x) for column in stored.values() for x in column
        )
    )
