"""Runs `emberlink render`: draws episodes of runs side by side as GIF, MP4 or a replay."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.console import Console
from torch import Tensor

from emberlink.envs.rendering.frame import write_gif
from emberlink.envs.rendering.panels import Episode, Screen
from emberlink.envs.rendering.video import write_mp4
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name, new_file, published
from emberlink.trainers.evaluation.evaluate import BLOCK
from emberlink.trainers.evaluation.panels import (
    Panel,
    check_comparable,
    find_fire,
    follows_advice,
    learned,
    replay,
    scripted,
)
from emberlink.trainers.evaluation.record_episode import record_episode
from emberlink.trainers.runs.pretrained import open_run
from emberlink.trainers.runs.run_folder import RunFolder

_ALONE, _BESIDE = (480, 800), (360, 600)  # minimum and maximum pixels of a map's longer side
_CELL = 8  # pixels of a cell, within those limits

REPLAY = ".html"
"""suffix of a replay"""

Write = Callable[[Path, Screen, int], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choices:
    """The options of the command, with the defaults of the command line."""

    fire: str | None = None
    """NAME, INDEX or NAME:INDEX of a held-out fire; see `find_fire`"""
    policies: Sequence[str] = ()
    """names of scripted policies to draw, too"""
    checkpoints: Sequence[Path] = ()
    """a checkpoint for each run; the newest of each run if empty"""
    output: Path | None = None
    """a file or a folder; the figures of the first run if None"""
    frames: int = 126
    fps: int = 12
    size: int | None = None
    """pixels of a map's longer side"""
    step: int | None = None
    """step of a single picture; the last if None"""
    seen: bool = False
    """whether seen fire is grey"""


def render(runs: Sequence[str], console: Console, choices: Choices) -> int:
    """Plays an episode of each run on the same fire and writes the files.

    Args:
        runs: run folders; settings such as `env.radio.range=0` change the run before them.
        console: prints the progress and the paths.
        choices: options of the command.

    Returns:
        The exit status 0.

    Raises:
        UserError: a run, fire or output is wrong.
    """
    panels = [*learned(runs, choices.checkpoints)]
    panels += scripted(panels[0].config, choices.policies)
    check_comparable(panels)
    if choices.output is not None and choices.output.suffix == REPLAY:
        return _write_replay(panels, console, choices, choices.output)
    fire, scenario, index = find_fire(choices.fire, panels[0].config)
    config = panels[0].config.env
    shown = "episode" if len(panels) == 1 else "side_by_side"
    stem = "_".join([shown, fire, str(index), *(p.stem for p in choices.checkpoints)])
    suffixes = _suffixes(choices.output)
    steps = _steps(choices, config.horizon, suffixes)
    arrival = fires_of(scenario).test_fire(index, config.grid, config.horizon)
    paths = _free_paths(choices.output, runs[0], stem, suffixes)
    episodes = [_play(panel, arrival, index, steps, console) for panel in panels]
    least, most = _ALONE if len(panels) == 1 else _BESIDE
    size = min(max(_CELL * max(config.grid), least), most)
    screen = Screen(episodes, size=choices.size or size, grey_seen=choices.seen)
    for path in paths:
        with published(path) as partial:
            _WRITERS[path.suffix](partial, screen, len(steps), choices.fps)
        console.print(str(path), soft_wrap=True, highlight=False)
    return 0


def _write_replay(panels: Sequence[Panel], console: Console, choices: Choices, output: Path) -> int:
    """Writes a page of HTML and returns the exit status 0."""
    if choices.step is not None:
        raise UserError(f"step={choices.step}: a replay opens at a step with {output.name}#t=STEP")
    path = new_file(output, (REPLAY,))
    page = replay(panels, choices.fire, lambda text: console.print(text, style="dim"))
    with published(path) as partial:
        page.save(partial)
    console.print(str(path), soft_wrap=True, highlight=False)
    return 0


def _steps(choices: Choices, horizon: int, suffixes: Sequence[str]) -> list[int]:
    """Returns the steps to draw."""
    if suffixes != [".png"]:
        if choices.step is not None:
            raise UserError(f"step={choices.step}: needs a picture as output, --output FILE.png")
        frames = min(choices.frames, horizon + 1)
        return np.linspace(0, horizon, frames).round().astype(int).tolist()
    step = horizon if choices.step is None else choices.step
    if step > horizon:
        raise UserError(f"step={step}: the episode has the steps 0 to {horizon}")
    return [step]


def _play(
    panel: Panel, arrival: Tensor, index: int, steps: Sequence[int], console: Console
) -> Episode:
    """Plays episode `index` of the evaluation and returns its frames."""
    config, env = panel.config, panel.env(arrival, index)
    world: Any = env.base_env
    policy = panel.policy(world)
    advised = follows_advice(config, policy)
    frames = record_episode(env, policy, steps=set(steps), advised=advised, member=index % BLOCK)
    console.print(f"  {panel.title}: coverage {frames[-1].coverage:.1f} %", style="dim")
    return Episode(title=panel.title, view_angle=config.env.view_angle, frames=frames)


def _gif(path: Path, screen: Screen, count: int, fps: int) -> None:
    write_gif(path, map(screen.picture, range(count)), fps=fps)


def _mp4(path: Path, screen: Screen, count: int, fps: int) -> None:
    write_mp4(path, map(screen.picture, range(count)), fps=fps)


def _png(path: Path, screen: Screen, count: int, fps: int) -> None:
    Image.fromarray(screen.picture(0)).quantize(256).save(path, "PNG", optimize=True)


_WRITERS = {".gif": _gif, ".mp4": _mp4, ".png": _png}


def _suffixes(output: Path | None) -> list[str]:
    """Returns the endings of the files to write.

    Raises:
        UserError: the output is neither a folder nor a file of a known kind.
    """
    if output is None or output.is_dir():
        return [".gif", ".mp4"]
    if output.suffix not in _WRITERS:
        known = ", ".join([*_WRITERS, REPLAY])
        raise UserError(f"{output}: there is no such folder, and a file ends in {known}")
    return [output.suffix]


def _free_paths(output: Path | None, name: str, stem: str, suffixes: Sequence[str]) -> list[Path]:
    """Returns the paths of the new files, in the folder of the run with a name if `output` is None.

    Raises:
        UserError: the named file exists, or its folder does not.
    """
    if output is not None and not output.is_dir():
        return [new_file(output, list(_WRITERS))]
    folder = _figures(open_run(name)) if output is None else output
    path = free_name(folder, stem, suffixes)
    return [path.with_name(f"{path.name}{suffix}") for suffix in suffixes]


def _figures(run: RunFolder) -> Path:
    """Returns the folder of a run's figures."""
    try:
        return run.figures()
    except OSError as error:
        raise UserError(f"{run.path}: {error.strerror or error}") from None
