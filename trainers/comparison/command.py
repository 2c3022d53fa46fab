"""`emberlink compare`: several runs in one report."""

import os
import re
import shlex
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.plots import timelapse
from emberlink.trainers.evaluation.report import load_actor

from . import plots
from .bootstrap import FEW
from .page import FLAG, Chapter, Picture, Report, counts, decision, html, lines, ratio, record
from .rankings import Numbers, numbers
from .runs import Run, checkpoint, evaluated_otherwise, find, gather, read

FRAMES = 5
"""of a timelapse"""


def compare(paths: Sequence[Path], console: Console, output: Path | None = None) -> int:
    """Gathers runs by setup and method and leaves a folder with the report.

    Args:
        paths: run folders, or folders that hold some.
        console: gets the tables.
        output: a new or empty folder; `compare`, or `compare_2`, ... if left out.

    Raises:
        ValueError: there is nothing to compare, the runs can't be compared, a file is damaged, or
            the folder holds something.
    """
    try:
        return _compare(paths, console, _free(output))
    except OSError as error:
        place = "" if output is None else f"--output {output}: "
        raise UserError(f"{place}cannot be written: {error.strerror or error}") from None


def _compare(paths: Sequence[Path], console: Console, folder: Path) -> int:
    runs, left_out = _read_all(paths)
    for path, why in left_out:
        console.print(Text(f"note: {path} is left out: {why}", style="yellow"))
    if not runs:
        raise UserError(f"no finished run among {len(left_out)}: nothing to compare")
    sections, notes = gather(runs)
    everything = [numbers(section) for section in sections]
    notes += [note for one in everything for note in one.notes]
    command = shlex.join(["emberlink", "compare", *sorted(map(str, paths))])
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".compare-") as partial:
        report = Path(partial) / "report"
        report.mkdir()
        chapters = [
            _chapter(report, place, one, notes, console) for place, one in enumerate(everything, 1)
        ]
        whole = Report(command, chapters, left_out, notes)
        (report / "compare.html").write_text(html(whole), encoding="utf-8")
        (report / "compare.json").write_text(record(whole), encoding="utf-8")
        report.replace(folder)
    for note in notes:
        console.print(Text(f"note: {note}", style="yellow"))
    for one in everything:
        _print(console, one)
    console.print(Text(str(folder / "compare.html")), soft_wrap=True)
    return 0


def _free(output: Path | None) -> Path:
    """A folder that holds nothing, or is not there yet."""
    if output is None:
        tried = (Path("compare" if i == 1 else f"compare_{i}") for i in range(1, 10_000))
        return next(path for path in tried if not os.path.lexists(path))
    if output.is_symlink() and not output.exists():
        raise UserError(f"--output {output}: a link to what is not there; name a new folder")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise UserError(f"--output {output}: is there and not an empty folder; name a new one")
    return output


def _read_all(paths: Sequence[Path]) -> tuple[list[Run], list[tuple[str, str]]]:
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
    return runs, left_out


def _chapter(folder: Path, place: int, one: Numbers, notes: list[str], console: Console) -> Chapter:
    """Draws a section's pictures into the folder."""
    name = _for_a_file(one.section.runs[0].config.setup)
    console.print(Text(f"  figures of {one.section.label}", style="dim"))
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
    films = list(_timelapses(folder, f"{place}_{name}", one, notes, console))
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
    folder: Path, name: str, one: Numbers, notes: list[str], console: Console
) -> Iterator[Picture]:
    """One episode of the first seed of each method, as a row of frames."""
    for place, group in enumerate(one.section.as_trained, 1):
        run = group.runs[0]
        newest = checkpoint(run.path)
        if newest is None:
            notes.append(f"{run.path}: holds no checkpoint, so there is no timelapse of it")
            continue
        console.print(Text(f"  timelapse of {group.label}", style="dim"))
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


def _print(console: Console, one: Numbers) -> None:
    for fire, rankings in one.fires.items():
        trained = ", the fire trained on" if fire == one.section.trained_on else ""
        title = f"{one.section.label}: on {fire}{trained}"
        caption = "↑ more is better, ↓ less is better"
        if min(counts(one)) < FEW:
            caption += f"; {FLAG} fewer than {FEW} seeds are too few for an interval"
        table = Table(title=Text(title), caption=caption)
        for column in ("policy", "seeds", "IQM", "95 % interval", "P(better than the next)"):
            table.add_column(column, justify="left" if column == "policy" else "right")
        for ranking in rankings:
            table.add_section()
            arrow = "↑" if ranking.higher_is_better else "↓"
            table.add_row(Text(f"{ranking.measure} {arrow}", style="bold"))
            for line in lines(ranking):
                cells = (line.name, line.seeds, line.mean, line.interval, line.improvement)
                table.add_row(*map(Text, cells), style="dim" if line.scripted else "")
        console.print(table)
    if one.verdicts:
        table = Table(title=Text(f"{one.section.label}: the paper's claims"))
        for column in ("on", "claim", "best other", "ratio", "95 % interval", "verdict"):
            table.add_column(column)
        for verdict in one.verdicts:
            about = f"{verdict.method}: {verdict.claim}"
            cells = (verdict.fire, about, verdict.best_other, *ratio(verdict), decision(verdict))
            table.add_row(*map(Text, cells))
        console.print(table)
