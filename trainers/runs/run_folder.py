"""A run on disk: config.yaml, metrics.jsonl, checkpoints, evaluation, figures."""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from torch import Tensor

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import flat, from_values, to_values
from emberlink.trainers.config.schema import RunConfig, comm_settings

from . import checkpoint_file as files
from . import compact_json
from .safe_read import LONGEST_JSON, parse_json, read_text, read_yaml

_NOT_FROM_THE_START = ("comm.agree", "comm.follow", "comm.wander", "comm.loss")
"""settings that runs of the first release were made without; their defaults change nothing"""
_NUMBERED = re.compile(r"(state|step)_\d{9,18}\.safetensors")


ACTOR = "actor_network_params.module."
"""begins the names of the actors' weights in a checkpoint"""


class RunFolder:
    """One training run's files.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)

    @classmethod
    def create(cls, config: RunConfig) -> "RunFolder":
        """A new folder under `config.output`, in which `write_config` comes next.

        Raises:
            ValueError: the folder can't be made.
        """
        stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        name = f"{stamp}_{config.method}_{config.setup}_s{config.seed}"
        try:
            path = _new_folder(Path(config.output) / name)
            (path / "checkpoints").mkdir()
            (path / "figures").mkdir()
        except OSError as error:
            raise UserError(f"output={config.output}: {error.strerror or error}") from None
        return cls(path)

    def write_config(self, config: RunConfig) -> None:
        """Writes the resolved configuration whole, or leaves what was there."""
        values = to_values(config)
        text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
        self._replace("config.yaml", text)

    def has_config(self) -> bool:
        """Whether there is a configuration: it is written last when a folder is made."""
        return (self.path / "config.yaml").exists()

    def config(self, **changes: Any) -> RunConfig:
        """The run's configuration.

        Args:
            changes: values in place of those in the file, such as `device="cpu"`.

        Raises:
            ValueError: there is no such folder, no config.yaml, or a value in it is wrong.
        """
        file = self.path / "config.yaml"
        if not self.path.is_dir():
            raise UserError(f"{self.path}: there is no such run folder")
        try:
            values = read_yaml(file)
        except FileNotFoundError:
            raise UserError(f"{self.path}: not a run folder, config.yaml is missing") from None
        if not isinstance(values, dict):
            raise UserError(f"{file}: expected keys and values, found {type(values).__name__}")
        try:
            config = from_values({**values, **changes})
            _check_whole(values, config)
        except ValueError as error:
            raise UserError(f"{file}: {error}") from None
        return replace(config, fire=fires_of(config.fire).opened(self.path))

    def append(self, file: str, line: Mapping[str, Any]) -> None:
        """Adds a line of JSON and hands it to the system at once, whole or not at all.

        Raises:
            ValueError: it cannot be written, such as to a full disk.
        """
        path = self.path / file
        try:
            with atomic_io.changed(path, create=True) as handle:
                before = os.fstat(handle).st_size
                left = (json.dumps(line) + "\n").encode()
                try:
                    while left:
                        left = left[os.write(handle, left) :]
                except OSError:
                    os.ftruncate(handle, before)
                    raise
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None

    def size(self, file: str) -> int:
        """Bytes in a file, all of them flushed to the disk; 0 where there is none."""
        try:
            with atomic_io.open_regular(self.path / file, LONGEST_JSON) as content:
                os.fsync(content.fileno())
                return os.fstat(content.fileno()).st_size
        except FileNotFoundError:
            return 0
        except OSError as error:
            raise ValueError(
                f"{self.path / file}: cannot be read: {error.strerror or error}"
            ) from None

    def check_lines(self, file: str, size: int, lines: int) -> None:
        """Checks that a .jsonl file still begins as it was when a checkpoint was made.

        Args:
            file: its name; a link is refused, for lines are going to be added to it.
            size: bytes that it had.
            lines: that these hold.

        Raises:
            ValueError: it is a link or no regular file, or holds less or other lines.
        """
        path = self.path / file
        try:
            kept = atomic_io.read_bytes(path, LONGEST_JSON, follow=False)[:size]
        except FileNotFoundError:
            kept = b""
        except OSError as error:
            raise UserError(f"{path}: cannot be read: {error.strerror}") from None
        found = kept.count(b"\n") if kept.endswith(b"\n") else -1
        if len(kept) < size or found != (lines if lines else -1):
            raise UserError(
                f"{path}: the checkpoint was made when it had {lines} lines in {size} bytes; its "
                f"first {len(kept)} bytes are not those"
            )

    def cut(self, file: str, size: int) -> None:
        """Cuts a file back to so many bytes, where it has more."""
        path = self.path / file
        try:
            with atomic_io.changed(path) as handle:
                if os.fstat(handle).st_size > size:
                    os.ftruncate(handle, size)
        except FileNotFoundError:
            return
        except OSError as error:
            raise UserError(f"{path}: cannot be cut: {error.strerror}") from None

    def write(self, file: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file whole, or leaves what was there."""
        self._replace(file, compact_json.dumps(content) + "\n")

    def write_text(self, file: str, text: str) -> None:
        """Writes a text file whole, or leaves what was there."""
        self._replace(file, text)

    def _replace(self, file: str, text: str) -> None:
        path = self.path / file
        try:
            atomic_io.write_bytes(path, text.encode())
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None

    def lines(self, file: str = "metrics.jsonl") -> list[dict[str, Any]]:
        """The lines of a .jsonl file; none where there is no such file."""
        path = self.path / file
        text = read_text(path, LONGEST_JSON) if path.exists() else ""
        # What a killed run had not finished writing is no line yet.
        whole = text[: text.rfind("\n") + 1].splitlines()
        try:
            found = [parse_json(line) for line in whole]
            for line in found:
                if not isinstance(line, dict) or "episode" not in line:
                    raise UserError("a line is not of the form {episode: ..., ...}")
                if not all(isinstance(value, int | float) for value in line.values()):
                    raise UserError("a line holds what is no number")
            return found
        except ValueError as error:
            raise UserError(f"{path}: not a file of JSON lines: {error}") from None

    def figures(self) -> Path:
        """Returns the folder of the figures, made if it is not there.

        Raises:
            OSError: it is a link or no folder, or cannot be made.
        """
        return atomic_io.inner_folder(self.path, "figures")

    @contextmanager
    def figure(self, file: str) -> Iterator[Path]:
        """Yields the path to draw a figure to, which gets its name once it is whole.

        Raises:
            OSError: it cannot be written, or the folder is a link.
        """
        with atomic_io.replaced(self.figures() / file) as partial:
            yield partial

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints."""
        return self.path / "checkpoints"

    def own_checkpoints(self) -> Path:
        """Returns the folder of the checkpoints to write to, made if it is not there.

        Raises:
            ValueError: it is a link or no folder, or cannot be made.
        """
        try:
            return atomic_io.inner_folder(self.path, "checkpoints")
        except OSError as error:
            raise ValueError(f"{self.checkpoints}: cannot be written: {error.strerror}") from None

    def save(self, weights: Mapping[str, Tensor], config: RunConfig, step: int) -> Path:
        """Writes networks to a name of their own, whole or not at all."""
        path = self.own_checkpoints() / f"step_{step:09d}.safetensors"
        files.write(path, weights, _network_header(config, step))
        return path

    def save_best(self, weights: Mapping[str, Tensor], config: RunConfig, step: int) -> None:
        """Writes networks to best.safetensors, in place of those that were there."""
        path = self.own_checkpoints() / "best.safetensors"
        files.write(path, weights, _network_header(config, step))

    def state(self, step: int) -> Path:
        """Returns where everything else that a resumed run needs is written."""
        return self.own_checkpoints() / f"state_{step:09d}.safetensors"

    def states(self) -> list[Path]:
        """What a run can be resumed from, oldest first."""
        return self._numbered("state")

    def networks(self) -> list[Path]:
        """The checkpoints' networks, oldest first."""
        return self._numbered("step")

    def _numbered(self, name: str) -> list[Path]:
        """The files that are called so with a step; what a user has put beside them is not ours."""
        found = self.checkpoints.glob(f"{name}_*.safetensors")
        return sorted((path for path in found if _is_ours(path)), key=step_of)

    def checkpoint(self) -> Path:
        """The newest checkpoint's networks.

        Raises:
            ValueError: there is none.
        """
        found = self.networks()
        if not found:
            raise UserError(f"{self.path}: holds no checkpoint (checkpoints/*.safetensors)")
        return found[-1]

    def rotate(self, keep: int, states: int) -> None:
        """Takes all but the newest `keep` networks and `states` states away."""
        self.own_checkpoints()
        for path in self.networks()[:-keep] + self.states()[:-states]:
            atomic_io.remove(path)

    def evaluated(self) -> bool:
        """Whether eval.json is there, and of the newest checkpoint."""
        try:
            about = parse_json(read_text(self.path / "eval.json", LONGEST_JSON))
            return about["checkpoint"] == self.checkpoint().name
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def take_away_after(self, step: int) -> None:
        """Takes away what a resumed run makes again, and what a killed one had begun to write."""
        names = ("config.yaml", "*.json", "*.jsonl", "fires.npz")
        begun = [self.path.glob(f"{name}.[0-9]*.part") for name in names]
        # safetensors' own names begin with .tmp
        written = ("*.safetensors.[0-9]*.part", ".tmp*")
        begun += [self.own_checkpoints().glob(name) for name in written]
        later = [path for path in self.networks() + self.states() if step_of(path) > step]
        try:
            begun += [self.figures().glob(f"*.{end}.[0-9]*.part") for end in ("png", "gif")]
            for path in chain(later, *begun):
                if path.is_file() or path.is_symlink():  # what is none is not ours
                    atomic_io.remove(path)
            for path in self.path.glob("divergence_step_*.part"):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
        except OSError as error:
            raise UserError(f"{error.filename}: cannot be taken away: {error.strerror}") from None


def _is_ours(path: Path) -> bool:
    return _NUMBERED.fullmatch(path.name) is not None and path.is_file()


def _check_whole(values: Mapping[str, Any], config: RunConfig) -> None:
    """That nothing of the world has been left to a default, which may be another setup's.

    Raises:
        ValueError: a key of `env` or `comm` is missing that every run folder has.
    """
    written, whole = flat(values), {"env": to_values(config)["env"], "comm": comm_settings(config)}
    for key in flat(whole):
        if key not in written and key not in _NOT_FROM_THE_START:
            raise UserError(f"key {key!r} is missing")


def step_of(checkpoint: Path) -> int:
    """The step that a checkpoint's name tells; -1 where it tells none."""
    with suppress(ValueError):
        return int(checkpoint.stem.rpartition("_")[2])
    return -1


def _network_header(config: RunConfig, step: int) -> dict[str, Any]:
    return {
        "kind": "networks",
        "step": step,
        "method": config.method,
        "uavs": config.env.num_uavs,
        "seed": config.seed,
        "config": to_values(config),
    }


def load_weights(
    path: Path, expected: Mapping[str, Tensor], config: RunConfig | None = None
) -> dict[str, Tensor]:
    """The weights of a checkpoint, float32, by name.

    Args:
        path: a safetensors file.
        expected: tensors of the names and shapes that must be there.
        config: whose method and number of UAVs the checkpoint must have; any if None.

    Raises:
        ValueError: the file can't be read or is damaged, a tensor is missing or of another shape
            or type, or a number is NaN or infinite.
    """
    header, weights = files.read(path)
    if header is not None and config is not None:
        wanted = _network_header(config, 0)
        for name in ("method", "uavs"):
            if header.get(name, wanted[name]) != wanted[name]:
                raise UserError(
                    f"{path}: a checkpoint of {name}={header[name]}; "
                    f"this configuration has {name}={wanted[name]}"
                )
    for name, tensor in expected.items():
        if name not in weights:
            raise UserError(f"{path}: holds no {name}")
        found = weights[name]
        if found.shape != tensor.shape or found.dtype != tensor.dtype:
            raise UserError(
                f"{path}: {name} has shape {list(found.shape)}, {found.dtype}; this configuration "
                f"needs {list(tensor.shape)}, {tensor.dtype}"
            )
    chosen = {name: weights[name] for name in expected}
    files.check_finite(path, chosen)
    return chosen


def _new_folder(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    for attempt in range(1, 1000):
        candidate = path if attempt == 1 else path.with_name(f"{path.name}_{attempt}")
        try:
            candidate.mkdir()
        except FileExistsError:
            continue
        return candidate
    raise FileExistsError(17, f"{path} and 998 more are there already")
