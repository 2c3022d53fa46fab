"""Reads and writes run folders: config.yaml, metrics.jsonl, checkpoints, evaluation, figures."""

import errno
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Any

import yaml

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import flat, from_values, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs import compact_json
from emberlink.trainers.runs.checkpoints import Checkpoints
from emberlink.trainers.runs.json_lines import JsonLines
from emberlink.trainers.runs.safe_read import MAX_JSON, parse_json, read_text, read_yaml

_PARTIAL = ("config.yaml", "metrics.csv", "*.json", "*.jsonl", "fires.npz")
_PARTIAL_FIGURES = tuple(f"*.{kind}.[0-9]*.part" for kind in ("png", "gif", "html"))
_PARTIAL_DUMPS = "divergence_step_*.part"


class RunFolder(JsonLines, Checkpoints):
    """The files of one training run.

    Args:
        path: the folder.
    """

    @classmethod
    def create(cls, config: RunConfig, name: str = "") -> "RunFolder":
        """Creates a new run folder in `config.output`, without config.yaml.

        Args:
            config: configuration of the run.
            name: name of the folder; made of the date and the configuration if empty.

        Raises:
            UserError: the folder cannot be created.
        """
        stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        name = name or f"{stamp}_{config.method}_{config.setup}_{config.world}_s{config.seed}"
        try:
            path = _new_folder(Path(config.output) / name)
            (path / "checkpoints").mkdir()
            (path / "figures").mkdir()
        except OSError as error:
            raise UserError(f"output={config.output}: {error.strerror or error}") from None
        return cls(path)

    def write_config(self, config: RunConfig) -> None:
        """Writes config.yaml completely, or leaves the earlier one.

        Raises:
            UserError: it cannot be written.
        """
        values = to_values(config)
        text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
        self.write_text("config.yaml", text)

    def has_config(self) -> bool:
        """Returns whether config.yaml exists; it is the last file of a new folder to be written."""
        return (self.path / "config.yaml").exists()

    def config(self, **changes: Any) -> RunConfig:
        """Reads the run's configuration.

        Args:
            changes: keys and values to change, such as `device="cpu"`.

        Raises:
            UserError: the folder or its config.yaml does not exist, or a key or value in it is
                missing or wrong.
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
            _check_complete(values, config)
        except ValueError as error:
            raise UserError(f"{file}: {error}") from None
        return replace(config, fire=fires_of(config.fire).load_copy(self.path))

    def write(self, file: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file completely, or leaves the earlier one.

        Raises:
            UserError: it cannot be written.
        """
        self.write_text(file, compact_json.dumps(content) + "\n")

    def write_text(self, file: str, text: str) -> None:
        """Writes a text file completely, or leaves the earlier one.

        Raises:
            UserError: it cannot be written.
        """
        path = self.path / file
        try:
            atomic_io.write_bytes(path, text.encode())
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None

    def figures(self) -> Path:
        """Creates the folder of the figures if it is missing, and returns it.

        Raises:
            OSError: it is a link or not a folder, or cannot be created.
        """
        return atomic_io.inner_folder(self.path, "figures")

    @contextmanager
    def figure(self, file: str) -> Iterator[Path]:
        """Yields a path for a figure, which is renamed to figures/FILE at the end.

        Raises:
            OSError: it cannot be written, or the folder is a link.
        """
        with atomic_io.replaced(self.figures() / file) as partial:
            yield partial

    def evaluated(self) -> bool:
        """Returns whether eval.json is an evaluation of the newest checkpoint."""
        try:
            evaluation = parse_json(read_text(self.path / "eval.json", MAX_JSON))
            return evaluation["checkpoint"] == self.checkpoint().name
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def take_away_after(self, step: int) -> None:
        """Removes the checkpoints after a step and all incomplete files.

        Raises:
            UserError: a file cannot be removed.
        """
        partial = [self.path.glob(f"{name}.[0-9]*.part") for name in _PARTIAL]
        try:
            partial += [self.figures().glob(pattern) for pattern in _PARTIAL_FIGURES]
            for path in chain(self.checkpoints_after(step), self.partial_checkpoints(), *partial):
                if path.is_file() or path.is_symlink():  # a folder with such a name is not ours
                    atomic_io.remove(path)
            for path in self.path.glob(_PARTIAL_DUMPS):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
        except OSError as error:
            raise UserError(f"{error.filename}: cannot be removed: {error.strerror}") from None


def _check_complete(values: Mapping[str, Any], config: RunConfig) -> None:
    """Checks that all settings of the environment, fire and communication are in the file.

    A missing setting would get a default, which may not be the value of the run.

    Raises:
        UserError: a key is missing.
    """
    written, complete = flat(values), to_values(config)
    world = {key: complete[key] for key in ("env", "fire", "comm")}
    for key in flat(world):
        if key not in written:
            raise UserError(f"key {key!r} is missing")


def without_time_and_seed(path: str) -> str:
    """Returns the path of a run without the time and the seed in a name that `create` has made."""
    made = re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_(.+)_s\d+(_\d+)?", Path(path).name)
    return str(Path(path).with_name(made[1])) if made else path


def _new_folder(path: Path) -> Path:
    """Creates `path`, or `path_2` and so on if it exists, and returns the new folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for attempt in range(1, 1000):
        candidate = path if attempt == 1 else path.with_name(f"{path.name}_{attempt}")
        try:
            candidate.mkdir()
        except FileExistsError:
            continue
        return candidate
    raise FileExistsError(errno.EEXIST, f"{path} and 998 more exist already")
