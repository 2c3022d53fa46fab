"""Scenarios, made by the generator or read from files, behind one interface."""

import dataclasses
import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Discriminator, Tag
from torch import Tensor

from emberlink.envs import fire_files
from emberlink.envs.config import WildfireConfig
from emberlink.envs.fire.cache import fire_bank
from emberlink.envs.fire.generator import (
    FireConfig,
    GeneratedConfig,
    Split,
    fire_seeds,
    load_scenario,
    make_fires,
)
from emberlink.envs.fire.reaction import ReactionConfig
from emberlink.envs.fire_files.config import COPY_FILE, FileFireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import TAG
from emberlink.envs.world.coverage_map import split_times, with_burn_time

Grid = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class FireSource(ABC):
    """The fires of a scenario, in three sets: "train", "validation" and "test".

    The validation fires choose among the checkpoints of a training, the test fires measure its
    result. Generated fires of different sets never have a seed in common. A scenario without files
    is its own copy.
    """

    config: Any

    @abstractmethod
    def fires(self, split: Split, count: int | None, grid: Grid, horizon: int) -> Tensor:
        """Returns the times in steps of the first `count` fires of a set; fewer are repeated.

        All training fires for None. See `world.coverage_map.split_times`.
        """

    def test_fire(self, index: int, grid: Grid, horizon: int) -> Tensor:
        """Returns the times of the test fire of that index, with a first dimension of 1."""
        return self.fires("test", index + 1, grid, horizon)[index:]

    @abstractmethod
    def describe(self, count: int) -> dict[str, Any]:
        """Returns plain values that identify the first `count` test fires."""

    def with_checksum(self) -> "ScenarioConfig":
        """Returns the scenario with the checksums of its files."""
        return self.config

    def summary(self, grid: Grid, horizon: int) -> str:
        """Returns the findings about the files; empty for generated fires."""
        del grid, horizon
        return ""

    def save_copy(self, folder: Path, grid: Grid, horizon: int) -> None:
        """Copies the fires of files into a run folder, for `load_copy`."""
        del folder, grid, horizon

    def load_copy(self, folder: Path) -> "ScenarioConfig":
        """Returns the scenario that reads its fires from the copy in a run folder."""
        return self.config


class Generated(FireSource):
    """Fires from seeds."""

    config: GeneratedConfig

    def fires(self, split: Split, count: int | None, grid: Grid, horizon: int) -> Tensor:
        count = self.config.num_train_fires if count is None else count
        times = fire_bank(self.config, split, count, grid, horizon)
        return with_burn_time(times, self.config.burn_time)

    def test_fire(self, index: int, grid: Grid, horizon: int) -> Tensor:
        seeds = fire_seeds("test", index + 1, self.config.test_seed)[index:]
        times = make_fires(self.config, seeds, grid, horizon)
        return with_burn_time(times, self.config.burn_time)

    def describe(self, count: int) -> dict[str, Any]:
        """Returns their seeds, and the fields of the scenario that differ from their defaults."""
        defaults = {field.name: field.default for field in dataclasses.fields(self.config)}
        values = vars(self.config)
        changed = {key: values[key] for key in defaults if values[key] != defaults[key]}
        seeds = fire_seeds("test", count, self.config.test_seed)
        return {"fire_seeds": seeds.tolist(), "scenario": changed}


class FromFile(FireSource):
    """Fires of files."""

    config: FileFireConfig

    def fires(self, split: Split, count: int | None, grid: Grid, horizon: int) -> Tensor:
        every = getattr(fire_files.fire_sets(self.config, grid, horizon), split)
        chosen = every if count is None else every[torch.arange(count) % len(every)]
        return with_burn_time(chosen, self.config.burn_time)

    def describe(self, count: int) -> dict[str, Any]:
        """Returns how many they are, and the scenario with the checksum of its file."""
        values = dataclasses.asdict(self.config)
        del values["saved_copy"]
        if math.isinf(values["burn_time"]):
            del values["burn_time"]  # not a number of JSON
        return {"fires": count, "scenario": values}

    def with_checksum(self) -> "ScenarioConfig":
        return fire_files.with_checksum(self.config)

    def summary(self, grid: Grid, horizon: int) -> str:
        return fire_files.fire_sets(self.config, grid, horizon).about

    def save_copy(self, folder: Path, grid: Grid, horizon: int) -> None:
        fire_files.save_copy(self.config, folder, grid, horizon)

    def load_copy(self, folder: Path) -> "ScenarioConfig":
        return dataclasses.replace(self.config, saved_copy=str(folder / COPY_FILE))


def _kind(value: Any) -> str:
    """Returns the tag of a scenario; one without a `kind` is of the level set."""
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    kind = "file" if kind == "masks" else kind
    return f"{TAG}{kind}" if kind in ("file", "reaction") else f"{TAG}spread"


ScenarioConfig = GeneratedConfig | FileFireConfig
Scenario = Annotated[
    Annotated[FireConfig, Tag(f"{TAG}spread")]
    | Annotated[ReactionConfig, Tag(f"{TAG}reaction")]
    | Annotated[FileFireConfig, Tag(f"{TAG}file")],
    Discriminator(_kind),
]
"""A scenario as a field of a configuration."""


def fires_of(scenario: ScenarioConfig) -> FireSource:
    """Returns the fires of a scenario."""
    of_file = isinstance(scenario, FileFireConfig)
    return FromFile(scenario) if of_file else Generated(scenario)


def same_tests(one: ScenarioConfig, other: ScenarioConfig) -> bool:
    """Returns whether two scenarios have the same test fires; ignores the training fires."""
    if not (isinstance(one, GeneratedConfig) and isinstance(other, GeneratedConfig)):
        return one == other
    return dataclasses.replace(one, num_train_fires=other.num_train_fires) == other


def grid_of(fire: Any) -> tuple[int, int] | None:
    """Returns the grid of arrival times, a tensor or an array; None for a scenario."""
    shape: list[int] = list(getattr(fire, "shape", ()))
    return (shape[-2], shape[-1]) if len(shape) in (2, 3, 4) else None


def default_config(fire: Any) -> WildfireConfig:
    """Returns the default config, on the grid of the fire if that is a tensor or an array."""
    grid = grid_of(fire)
    return WildfireConfig() if grid is None else WildfireConfig(grid=grid)


def load_fires(
    fire: str | ScenarioConfig | Tensor, config: WildfireConfig, num_envs: int
) -> tuple[Tensor, bool]:
    """Returns the fires of a `WildfireEnv`.

    Returns:
        Arrival times, float32 [fires, X, Y], or arrival and burn-out times, [fires, 2, X, Y]; and
        whether they are fixed: environment i always has fire i, or the only one.

    Raises:
        UserError: an unknown scenario, a file that cannot be read, or arrival times whose shape or
            values do not fit.
    """
    if isinstance(fire, str):
        fire = load_scenario(fire)
    if isinstance(fire, ScenarioConfig):
        return fires_of(fire).fires("train", None, config.grid, config.horizon), False
    # A copy, because the caller may change theirs later.
    bank = torch.as_tensor(fire, dtype=torch.float32).clone(memory_format=torch.contiguous_format)
    shape = list(bank.shape)
    bank = bank.unsqueeze(0) if bank.ndim == 2 else bank
    times = (2,) if bank.ndim == 4 else ()
    if bank.shape not in ((1, *times, *config.grid), (num_envs, *times, *config.grid)):
        raise UserError(
            f"fire: arrival times of shape {shape}; expected {list(config.grid)} or "
            f"{[num_envs, *config.grid]} (the grid of the config, num_envs={num_envs}), or arrival "
            f"and burn-out times of shape {[num_envs, 2, *config.grid]}"
        )
    if bank.isnan().any():
        raise UserError("fire: arrival times hold NaN; a cell that never burns is inf")
    arrival, burn_out = split_times(bank)
    if burn_out is not None and (burn_out < arrival).any():
        raise UserError("fire: a cell burns out before the fire arrives")
    return bank, True
