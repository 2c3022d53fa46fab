"""A run on disk: config.yaml, metrics.jsonl, checkpoints, evaluation, figures."""

import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from .config import RunConfig, from_values, to_values


class RunFolder:
    """One training run's files.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)

    @classmethod
    def create(cls, config: RunConfig) -> "RunFolder":
        """A new folder under `config.output` with the resolved configuration in it.

        Raises:
            ValueError: the folder can't be made.
        """
        stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        name = f"{stamp}_{config.method}_{config.setup}_s{config.seed}"
        try:
            path = _new_folder(Path(config.output) / name)
            (path / "checkpoints").mkdir()
            (path / "figures").mkdir()
            (path / "config.yaml").write_text(yaml.safe_dump(to_values(config), sort_keys=False))
        except OSError as error:
            raise ValueError(f"output={config.output}: {error.strerror or error}") from None
        return cls(path)

    def config(self, **changes: Any) -> RunConfig:
        """The run's configuration.

        Args:
            changes: values in place of those in the file, such as `device="cpu"`.

        Raises:
            ValueError: there is no such folder, no config.yaml, or a value in it is wrong.
        """
        file = self.path / "config.yaml"
        if not self.path.is_dir():
            raise ValueError(f"{self.path}: there is no such run folder")
        try:
            values = yaml.safe_load(file.read_text())
        except FileNotFoundError:
            raise ValueError(f"{self.path}: not a run folder, config.yaml is missing") from None
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ValueError(f"{file}: cannot be read: {' '.join(str(error).split())}") from None
        if not isinstance(values, dict):
            raise ValueError(f"{file}: expected keys and values, found {type(values).__name__}")
        try:
            return from_values({**values, **changes})
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None

    def append(self, file: str, line: Mapping[str, Any]) -> None:
        """Adds a line of JSON and hands it to the system at once."""
        with (self.path / file).open("a") as out:
            out.write(json.dumps(line) + "\n")

    def write(self, file: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file whole, or leaves what was there."""
        partial = self.path / (file + ".part")
        partial.write_text(json.dumps(content, indent=1) + "\n")
        partial.replace(self.path / file)

    def lines(self, file: str = "metrics.jsonl") -> list[dict[str, Any]]:
        """The lines of a .jsonl file; none where there is no such file."""
        path = self.path / file
        text = path.read_text() if path.exists() else ""
        # What a killed run had not finished writing is no line yet.
        whole = text[: text.rfind("\n") + 1].splitlines()
        try:
            return [json.loads(line) for line in whole]
        except ValueError as error:
            raise ValueError(f"{path}: not a file of JSON lines: {error}") from None

    def figure(self, file: str) -> Path:
        """Where a figure goes; its folder is made if it is not there."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder / file

    def save(self, step: int, weights: Mapping[str, Tensor]) -> Path:
        """Writes a checkpoint to a name of its own, whole or not at all."""
        path = self.path / "checkpoints" / f"step_{step:09d}.safetensors"
        partial = path.with_suffix(".part")
        save_file({name: value.cpu().contiguous() for name, value in weights.items()}, partial)
        partial.replace(path)
        return path

    def checkpoint(self) -> Path:
        """The newest checkpoint.

        Raises:
            ValueError: there is none.
        """
        found = sorted((self.path / "checkpoints").glob("step_*.safetensors"))
        if not found:
            raise ValueError(f"{self.path}: holds no checkpoint (checkpoints/*.safetensors)")
        return found[-1]


def load_weights(path: Path, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights of a checkpoint, float32, by name.

    Args:
        path: a safetensors file.
        expected: tensors of the names and shapes that must be there.

    Raises:
        ValueError: the file can't be read, or a tensor is missing or of another shape.
    """
    try:
        weights = load_file(path)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: not a readable checkpoint: {error}") from None
    for name, tensor in expected.items():
        if name not in weights:
            raise ValueError(f"{path}: holds no {name}")
        if weights[name].shape != tensor.shape:
            raise ValueError(
                f"{path}: {name} has shape {list(weights[name].shape)}; "
                f"this configuration needs {list(tensor.shape)}"
            )
    return {name: weights[name] for name in expected}


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
