"""Compares runs and writes the report; prints nothing."""

import os
import re
import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.plots import timelapse

from . import plots
from .page import Chapter, Picture, Report, html, record
from .rankings import Numbers, numbers
from .runs import Run, checkpoint, evaluated_otherwise, find, gather, read

FRAMES = 5
"""of a timelapse"""


@dataclass(frozen=True)
class Comparison:
    """The numbers of a comparison."""

    paths: tuple[Path, ...]
    """what was compared, as given"""
    sections: tuple[Numbers, ...]
    """rankings, claims and training curves of each setup and fire trained on"""
    notes: tuple[str, ...]
    """differences between runs that were compared"""
    left_out: tuple[tuple[str, str], ...]
    """runs that were not compared, and the reason of each"""


def compare_runs(paths: Sequence[Path]) -> Comparison:
    """Returns the comparison of runs by setup, fire trained on and method.

    Args:
        paths: run folders, folders that hold some, or names such as `pretrained:tuned`.

    Raises:
        UserError: there is nothing to compare, the runs can't be compared, or a file is damaged.
    """
    runs: list[Run] = []
    left_out: list[tuple[str, str]] = []
    for path in find(paths):
        found = read(path)
        if isinstance(found, Run):
            others, why = evaluated_otherwise(found)
            runs += [found, *others]
            left_out += why
        else:
            left_out.append((str(path), found))
    if not runs:
        reasons = "".join(f"; {path}: {why}" for path, why in left_out[:1])
        raise UserError(f"no finished run among {len(left_out)}: nothing to compare{reasons}")
    sections, notes = gather(runs)
    every = [numbers(section) for section in sections]
    notes += [note for one in every for note in one.notes]
    return Comparison(tuple(paths), tuple(every), tuple(notes), tuple(left_out))


def free_folder(output: Path | None) -> Path:
    """Returns a folder for a report: `output`, else `compare`, `compare_2`, ...

    Raises:
        UserError: `output` is a file, or holds something.
    """
    if output is None:
        tried = (Path("compare" if i == 1 else f"compare_{i}") for i in range(1, 10_000))
        return next(path for path in tried if not os.path.lexists(path))
    if output.is_symlink() and not output.exists():
        raise UserError(f"--output {output}: a link to what is not there; name a new folder")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise UserError(f"--output {output}: is there and not an empty folder; name a new one")
    return output


def write_report(
    comparison: Comparison, folder: Path, say: Callable[[str], None] = lambda _: None
) -> Comparison:
    """Writes compare.html, compare.json and the figures into a new or empty folder.

    Args:
        comparison: of `compare_runs`.
        folder: of `free_folder`.
        say: called with a line before each picture.

    Returns:
        The comparison, with the notes that drawing added.

    Raises:
        UserError: the folder can't be written.
    """
    try:
        return _write(comparison, folder, say)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written: {error.strerror or error}") from None


def _write(comparison: Comparison, folder: Path, say: Callable[[str], None]) -> Comparison:
    notes = list(comparison.notes)
    command = shlex.join(["emberlink", "compare", *sorted(map(str, comparison.paths))])
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".compare-") as partial:
        report = Path(partial) / "report"
        report.mkdir()
        chapters = [
            _chapter(report, place, one, notes, say)
            for place, one in enumerate(comparison.sections, 1)
        ]
        whole = Report(command, chapters, comparison.left_out, notes)
        (report / "compare.html").write_text(html(whole), encoding="utf-8")
        (report / "compare.json").write_text(record(whole), encoding="utf-8")
        report.replace(folder)
    return replace(comparison, notes=tuple(notes))


def _chapter(
    folder: Path, place: int, one: Numbers, notes: list[str], say: Callable[[str], None]
) -> Chapter:
    """Draws the pictures of a section into a folder."""
    name = _for_a_file(one.section.runs[0].config.setup)
    say(f"figures of {one.section.label}")
    pictures: list[Picture] = []
    frozen: list[Picture] = []
    for number, fire in enumerate(one.fires, 1):
        path = folder / f"{place}_{name}_frozen_{number}_{_for_a_file(fire)}.png"
        plots.frozen(path, one, fire)
        frozen.append(Picture(path, _frozen_caption(one, fire)))
    for number, (measures, caption) in plots.FIGURES.items():
        path = folder / f"{place}_{name}_figure_{number}.png"
        plots.figure(path, one, measures)
        pictures.append(Picture(path, _caption(one, number, caption)))
    films = list(_timelapses(folder, f"{place}_{name}", one, notes, say))
    return Chapter(one, frozen, pictures, films)


def _for_a_file(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", name)[:40]


def _frozen_caption(one: Numbers, fire: str) -> str:
    count = one.section.runs[0].evaluation.fires
    return (
        f"Frozen policies on {count} held-out fires of {fire}. Small dots: a run's mean over its "
        "episodes, one a seed. Large dot: interquartile mean over seeds; line: 95 % bootstrap "
        "interval over seeds, none with one seed. Dashed: scripted policies; in a method's row "
        "alone where the number is that method's. The first UAV's step and exits on a logarithmic "
        "scale, linear near 0."
    )


def _caption(one: Numbers, number: int, what: str) -> str:
    seeds = ", ".join(f"{group.label} {len(group.runs)}" for group in one.section.as_trained)
    text = (
        f"The paper's figure {number}. {what} The exploring policy in each episode of training, "
        "mean over the environments side by side. Line: interquartile mean over seeds; band: 95 % "
        f"bootstrap interval over seeds, none with one seed (seeds: {seeds})."
    )
    if one.on_trained:
        text += (
            " Dashed: scripted policies, mean over the frozen evaluation's "
            f"{one.section.runs[0].evaluation.fires} episodes on {one.section.trained_on}, the "
            "fire trained on; in a method's colour where the number is that method's alone."
        )
    return text


def _timelapses(
    folder: Path, name: str, one: Numbers, notes: list[str], say: Callable[[str], None]
) -> Iterator[Picture]:
    """Draws one episode of the first seed of each method, as a row of frames."""
    for place, group in enumerate(one.section.as_trained, 1):
        run = group.runs[0]
        newest = checkpoint(run.path)
        if newest is None:
            notes.append(f"{run.path}: holds no checkpoint, so there is no timelapse of it")
            continue
        say(f"timelapse of {group.label}")
        actor = load_actor(run.config, newest)
        fire, arrival = evaluate.shown_fire(run.config)
        pictures, steps = evaluate.film(run.config, actor, fire=arrival, frames=FRAMES)
        path = folder / f"{name}_timelapse_{place}.png"
        timelapse(path, pictures, steps, group.label)
        yield Picture(
            path,
            f"{group.label}, seed {run.config.seed}: the frozen policy of {newest.name} on the "
            f"first held-out fire of {fire}, from the same start positions as every other method. "
            "Fire white, field of view yellow, UAVs blue.",
        )
