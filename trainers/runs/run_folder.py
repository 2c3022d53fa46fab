"""Reads and writes run folders: configuration, metrics, checkpoints, evaluation, figures."""

import json
import os
import re
import stat
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.errors import UserError, naming
from emberlink.trainers.config.compose import from_values, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs import checkpoint, compact_json

NEWEST = "checkpoint.safetensors"
"""file of the newest networks and the training state"""
BEST = "best.safetensors"
"""file of the networks with the best headline measure"""
METRICS = "metrics.jsonl"
"""file with a line for each episode"""
_LINE = TypeAdapter(dict[str, int | float])
MAX_YAML = 100_000
"""maximum bytes of a config.yaml; a typical one has 2,000"""
MAX_JSON = 100_000_000
"""maximum bytes of eval.json and metrics.jsonl"""


class RunFolder:
    """The files of one training run.

    A folder from somebody else may hold links, pipes or devices, through which a later command
    would read or write elsewhere. It is refused here, where every command opens it.
    """

    def __init__(self, path: Path | str):
        self.path = atomic_io.user_path(path)
        for place, folders, files in os.walk(self.path):
            for entry in (Path(place, name) for name in (*folders, *files)):
                # wandb makes links in its folder; the tracker removes them before wandb writes.
                of_wandb = entry.is_symlink() and self.path / "wandb" in entry.parents
                with suppress(FileNotFoundError):  # a training has just removed it
                    if not (of_wandb or _is_ordinary(entry)):
                        raise UserError(
                            f"{entry}: a link, a pipe or a device; a run folder holds only folders "
                            "and files"
                        )

    @classmethod
    def create(cls, config: RunConfig, name: str = "", *, label: str = "") -> "RunFolder":
        """Creates a new run folder in `config.output`, with config.yaml and the fires of files.

        Its name is `name`, or else made of the time, `label` or the method, and the settings.
        """
        about = f"{label or config.method}_{config.setup}_{config.world}_s{config.seed}"
        name = name or f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{about}"
        with naming(f"output={config.output}"):
            path = _new_folder(atomic_io.user_path(config.output) / name)
        run = cls(path)
        fires_of(config.fire).save_copy(path, config.env.grid, config.env.horizon)
        run.write_config(config)
        return run

    def write_config(self, config: RunConfig) -> None:
        """Writes config.yaml completely, or leaves the earlier one."""
        form: Any = {"sort_keys": False, "default_flow_style": None, "width": 100}
        self.write_text("config.yaml", yaml.safe_dump(to_values(config), **form))

    def values(self) -> dict[str, Any]:
        """Returns the configuration of config.yaml as plain values, without checking them."""
        file = self.path / "config.yaml"
        if not file.exists():
            raise UserError(f"{self.path}: no such run folder, config.yaml is missing")
        with naming(file, yaml.YAMLError):
            values = yaml.load(read_text(file, MAX_YAML), _WithoutAliases)
            if not isinstance(values, dict):
                raise UserError(f"expected keys and values, found {type(values).__name__}")
        return values

    def config(self, file: Path | None = None, **changes: Any) -> RunConfig:
        """Returns the configuration that a checkpoint was trained with, with changed values.

        Without `file`, the newest checkpoint is read or, before there is one, config.yaml.
        """
        file = self.newest if file is None and self.newest.exists() else file
        given = checkpoint.read_header(file).config if file else self.values()
        with naming(file or self.path / "config.yaml"):
            values = {**given, "output": str(self.path.parent), **changes}
            return self.with_fires(from_values(values))

    def with_fires(self, config: RunConfig) -> RunConfig:
        """Returns a configuration that reads the fires of files from the run's copy."""
        return replace(config, fire=fires_of(config.fire).load_copy(self.path))

    @property
    def newest(self) -> Path:
        """The path of the newest checkpoint, which may not exist yet."""
        return self.path / NEWEST

    def metrics(self) -> list[dict[str, Any]]:
        """Returns the lines of metrics.jsonl; an empty list if there is no such file.

        An incomplete last line, which a killed process left, is ignored.
        """
        path = self.path / METRICS
        *lines, _ = read_text(path, MAX_JSON).split("\n") if path.exists() else [""]
        with naming(path):
            return [_LINE.validate_json(line) for line in lines]

    def append(self, line: Mapping[str, Any]) -> None:
        """Appends a line to metrics.jsonl."""
        path = self.path / METRICS
        with naming(path), path.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def sync_metrics(self) -> None:
        """Flushes metrics.jsonl to the disk; a checkpoint must not be newer than its lines."""
        with suppress(FileNotFoundError):
            atomic_io.sync(self.path / METRICS)

    def return_to(self, episode: int) -> None:
        """Removes the lines of later episodes and the incomplete files of a killed process."""
        lines = [line for line in self.metrics() if line.get("episode", 0) <= episode]
        if [line.get("episode") for line in lines] != list(range(1, episode + 1)):
            lacks = f"lacks some of the {episode} episodes of the checkpoint"
            raise UserError(f"{self.path / METRICS}: {lacks}")
        self.write_text(METRICS, "".join(f"{json.dumps(line)}\n" for line in lines))
        # safetensors writes to .tmp*
        for pattern in ("*.[0-9]*.part", ".tmp*", "figures/*.[0-9]*.part"):
            for path in self.path.glob(pattern):
                path.unlink(missing_ok=True)

    def evaluated(self) -> bool:
        """Returns whether eval.json is an evaluation of the newest checkpoint."""
        with suppress(ValueError, TypeError, KeyError, RecursionError):  # missing or damaged
            return json.loads(read_text(self.path / "eval.json", MAX_JSON))["step"] == self.step()
        return False

    def step(self) -> int:
        """Returns the step of the newest checkpoint."""
        return checkpoint.read_header(self.newest).step

    def write(self, file: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file completely, or leaves the earlier one."""
        self.write_text(file, compact_json.dumps(content) + "\n")

    def write_text(self, file: str, text: str) -> None:
        """Writes a text file completely, or leaves the earlier one."""
        with naming(self.path / file):
            atomic_io.write_bytes(self.path / file, text.encode())

    def figures(self) -> Path:
        """Creates the folder of the figures if it is missing, and returns it."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder

    def figure(self, file: str) -> AbstractContextManager[Path]:
        """Yields a path for a figure, which is renamed to figures/FILE at the end."""
        return atomic_io.replaced(self.figures() / file)


class _WithoutAliases(yaml.SafeLoader):
    """Refuses aliases, by which a small file can expand to any size."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise UserError("aliases (*name) are not allowed")
        return super().compose_node(parent, index)


def read_text(path: Path, max_bytes: int) -> str:
    """Returns the text of a regular file of bounded size."""
    with naming(path):
        return atomic_io.read_bytes(path, max_bytes).decode()


def without_time_and_seed(path: str) -> str:
    """Returns the path of a run without what tells seeds apart in names of trainings and sweeps."""
    time, digest = r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_", "[0-9a-f]{8}"
    made = re.fullmatch(rf"{time}(.+)_s\d+(_\d+)?|(.+)_s\d+_{digest}", Path(path).name)
    return str(Path(path).with_name(made[1] or made[3])) if made else path


def _is_ordinary(path: Path) -> bool:
    """Returns whether a path is a folder or a regular file; the lock has no second name."""
    about = path.lstat()
    linked = path.name == "lock" and about.st_nlink > 1
    return stat.S_ISDIR(about.st_mode) or (stat.S_ISREG(about.st_mode) and not linked)


def _new_folder(path: Path) -> Path:
    """Creates `path`, or `path_2` and so on if it exists, and returns the new folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        free = atomic_io.free_name(path.parent, path.name, [""])
        with suppress(FileExistsError):  # another process was faster
            free.mkdir()
            return free
