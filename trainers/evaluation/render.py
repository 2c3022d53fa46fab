"""Runs `emberlink render`: draws episodes side by side as GIF, MP4, picture or page."""

import argparse
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from PIL import Image
from rich.console import Console

from emberlink.envs.rendering.film import write_gif, write_mp4
from emberlink.envs.utils.atomic_io import created, free_name, new_file
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.evaluation import episodes
from emberlink.trainers.evaluation.episodes import Panel
from emberlink.trainers.evaluation.policy import load
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.screen import Screen, even_steps
from emberlink.trainers.runs.pretrained import open_run

_SUFFIXES = (".gif", ".mp4", ".png", ".html")


def render(options: argparse.Namespace, console: Console) -> int:
    """Plays an episode of each run on the same fire, writes the files and returns 0."""
    panels = [*learned(options.runs, options.checkpoint)]
    panels += episodes.scripted(panels[0].config, options.policy)
    fire, index, arrival = episodes.find_fire(options.fire, panels[0].config)
    shown = "episode" if len(panels) == 1 else "side_by_side"
    stem = "_".join([shown, fire, str(index), *(path.stem for path in options.checkpoint)])
    paths = _free_paths(options.output, options.runs[0], stem)
    horizon = panels[0].config.env.horizon
    step = horizon if options.step is None else options.step
    if step > horizon:
        raise UserError(f"step={step}: the episode has the steps 0 to {horizon}")
    report = partial(console.print, style="dim", highlight=False)
    played = episodes.play_side_by_side(panels, arrival, index, report)
    size = options.size or (480 if len(panels) == 1 else 360)
    screen = Screen(played, size=size, grey_seen=options.seen)
    for path in paths:
        with created(path) as new:
            if path.suffix == ".html":
                Replay(played, f"{fire}:{index}").save(new)
            elif path.suffix == ".png":
                Image.fromarray(screen.picture(step)).save(new, "PNG", optimize=True)
            else:
                write = write_gif if path.suffix == ".gif" else write_mp4
                steps = even_steps(horizon, options.frames)
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
        panel = load(name, changes, checkpoint=file, device="cpu").panel()
        if panel.title in titles:  # runs that were trained with other settings
            panel = panel._replace(title=f"{panel.title}, {Path(name).name}")
        titles.add(panel.title)
        yield panel


def _free_paths(output: Path | None, run: str, stem: str) -> list[Path]:
    """Returns the paths of the new files: a GIF and an MP4, or the file that the user named."""
    if output is not None and not output.is_dir():
        return [new_file(output, _SUFFIXES)]
    folder = output or open_run(run).figures()
    path = free_name(folder, stem, [".gif", ".mp4"])
    return [path.with_name(f"{path.name}{suffix}") for suffix in (".gif", ".mp4")]
