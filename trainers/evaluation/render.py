"""Runs `emberlink render`: draws episodes side by side as GIF, MP4, picture or page."""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from PIL import Image
from rich.console import Console

from emberlink.envs.rendering.film import write_gif, write_mp4
from emberlink.envs.utils.atomic_io import created, free_name, new_file
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.evaluation import episodes
from emberlink.trainers.evaluation.episodes import Panel
from emberlink.trainers.evaluation.policy import load_policy
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.screen import Screen, even_steps
from emberlink.trainers.runs.pretrained import open_run, read_run

_ALONE, _BESIDE = (480, 800), (360, 600)  # minimum and maximum pixels of a map's longer side
_CELL = 8  # pixels of a cell, within those limits
_SUFFIXES = (".gif", ".mp4", ".png", ".html")


def render(options: argparse.Namespace, console: Console) -> int:
    """Plays an episode of each run on the same fire, writes the files and returns 0."""
    panels = [*learned(options.runs, options.checkpoint)]
    panels += episodes.scripted(panels[0].config, options.policy)
    fire, index, arrival = episodes.find_fire(options.fire, panels[0].config)
    shown = "episode" if len(panels) == 1 else "side_by_side"
    stem = "_".join([shown, fire, str(index), *(path.stem for path in options.checkpoint)])
    paths = _free_paths(options.output, options.runs[0], stem)
    steps = _steps(options, panels[0].config.env.horizon, paths[0])
    report = partial(console.print, style="dim", highlight=False)
    played = episodes.play_side_by_side(panels, arrival, index, report)
    least, most = _ALONE if len(panels) == 1 else _BESIDE
    size = options.size or min(max(_CELL * max(panels[0].config.env.grid), least), most)
    screen = Screen(played, size=size, grey_seen=options.seen)
    for path in paths:
        with created(path) as new:
            if path.suffix == ".html":
                Replay(played, f"{fire}:{index}").save(new)
            elif path.suffix == ".png":
                Image.fromarray(screen.picture(steps[0])).save(new, "PNG", optimize=True)
            else:
                write = write_gif if path.suffix == ".gif" else write_mp4
                write(new, map(screen.picture, steps), fps=options.fps)
        console.print(str(path), soft_wrap=True, highlight=False)
    return 0


def learned(arguments: Sequence[str], checkpoints: Sequence[Path] = ()) -> Iterator[Panel]:
    """Yields a panel for each run; an argument `key=value` changes the run before it.

    `checkpoints` has one for each run, or none for the newest ones.
    """
    runs: list[tuple[str, list[str]]] = []
    for text in arguments:
        if "=" not in text or Path(text).exists():
            runs.append((text, []))
        elif runs:
            runs[-1][1].append(text)
        else:
            raise UserError(f"{text!r}: a setting stands after the run that it changes")
    if checkpoints and len(checkpoints) != len(runs):
        raise UserError(f"{len(checkpoints)} checkpoints for {len(runs)} runs: one each")
    titles: set[str] = set()
    for (name, changes), file in zip(runs, checkpoints or [None] * len(runs), strict=True):
        run = read_run(name)
        panel = load_policy(run, changes, checkpoint=file, device="cpu").panel()
        if panel.title in titles:  # runs that were trained with other settings
            panel = replace(panel, title=f"{panel.title}, {run.path.name}")
        titles.add(panel.title)
        yield panel


def _steps(options: argparse.Namespace, horizon: int, path: Path) -> list[int]:
    """Returns the steps to draw."""
    step = options.step
    if path.suffix != ".png":
        if step is None:
            return even_steps(horizon, options.frames)
        raise UserError(
            f"step={step}: needs a picture, --output FILE.png; a page opens at FILE.html#t={step}"
        )
    if step is not None and step > horizon:
        raise UserError(f"step={step}: the episode has the steps 0 to {horizon}")
    return [horizon if step is None else step]


def _free_paths(output: Path | None, run: str, stem: str) -> list[Path]:
    """Returns the paths of the new files: a GIF and an MP4, or the file that the user named."""
    if output is not None and not output.is_dir():
        return [new_file(output, _SUFFIXES)]
    folder = output or open_run(run).figures()
    path = free_name(folder, stem, [".gif", ".mp4"])
    return [path.with_name(f"{path.name}{suffix}") for suffix in (".gif", ".mp4")]
