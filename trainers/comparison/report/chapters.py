"""Draws the figures of a section of the report and writes its replay."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from emberlink.trainers.comparison.rankings import Numbers
from emberlink.trainers.comparison.report import plots
from emberlink.trainers.comparison.report.page import Chapter, Picture, ReplayFile
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.episodes import Panel
from emberlink.trainers.evaluation.plots import timelapse
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Episode
from emberlink.trainers.runs.run_folder import RunFolder


@dataclass(frozen=True)
class _Film:
    """An episode, its timelapse, and the name of its fire."""

    timelapse: Picture
    fire: str
    episode: Episode


def draw(
    folder: Path, place: int, numbers: Numbers, notes: list[str], say: Callable[[str], None]
) -> Chapter:
    """Draws the figures and timelapses of a section, and writes its replays.

    Args:
        folder: folder of the report.
        place: number of the section; prefix of the file names.
        numbers: numbers of the section.
        notes: a note is appended for each method without a timelapse.
        say: called with a line of text before each figure.
    """
    stem = f"{place}_{_as_file_name(numbers.section.runs[0].config.setup)}"
    say(f"figures of {numbers.section.label}")
    frozen: list[Picture] = []
    for number, fire in enumerate(numbers.fires, 1):
        path = folder / f"{stem}_frozen_{number}_{_as_file_name(fire)}.png"
        plots.frozen(path, numbers, fire)
        frozen.append(Picture(path, _frozen_caption(numbers, fire)))
    pictures: list[Picture] = []
    for number, (measures, caption) in plots.FIGURES.items():
        path = folder / f"{stem}_figure_{number}.png"
        plots.figure(path, numbers, measures)
        pictures.append(Picture(path, _caption(numbers, number, caption)))
    films = list(_films(folder, stem, numbers, notes, say))
    replays = list(_replays(folder, stem, films))
    return Chapter(numbers, frozen, pictures, [film.timelapse for film in films], replays)


def _as_file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", name)[:40]


def _frozen_caption(numbers: Numbers, fire: str) -> str:
    count = numbers.section.runs[0].evaluation.fires
    return (
        f"Frozen policies on {count} held-out fires of {fire}. Small dots: a run's mean over its "
        "episodes, one a seed. Large dot: interquartile mean over seeds; line: 95 % bootstrap "
        "interval over seeds, none with one seed. Dashed: scripted policies, in the rows of the "
        "methods whose number it is. The first UAV's step and exits on a logarithmic scale, linear "
        "near 0."
    )


def _caption(numbers: Numbers, number: int, content: str) -> str:
    section = numbers.section
    seeds = ", ".join(f"{group.label} {len(group.runs)}" for group in section.as_trained)
    text = (
        f"The paper's figure {number}. {content} The exploring policy in each episode of training, "
        "mean over the environments side by side. Line: interquartile mean over seeds; band: 95 % "
        f"bootstrap interval over seeds, none with one seed (seeds: {seeds})."
    )
    if numbers.on_trained:
        text += (
            " Dashed: scripted policies, mean over the frozen evaluation's "
            f"{section.runs[0].evaluation.fires} episodes on {section.trained_on}, the fire "
            "trained on; in a method's colour where the number is that method's alone."
        )
    return text


def _films(
    folder: Path, stem: str, numbers: Numbers, notes: list[str], say: Callable[[str], None]
) -> Iterator[_Film]:
    """Plays an episode of the first seed of each method and draws its timelapse."""
    without: list[str] = []
    for place, group in enumerate(numbers.section.as_trained, 1):
        run = group.runs[0]
        newest = RunFolder(run.path).newest
        if not newest.exists():
            without.append(str(run.path))
            continue
        say(f"timelapse of {group.label}")
        title, actor = f"{group.label}, seed {run.config.seed}", load_actor(run.config, newest)
        fire, arrival = evaluate.shown_fire(run.config)
        episode = Panel(title, run.config, lambda _, actor=actor: actor).play(arrival)
        path = folder / f"{stem}_timelapse_{place}.png"
        timelapse(path, episode.recording, group.label)
        caption = (
            f"{title}: the frozen policy of {newest.name} on the first held-out fire of {fire}. "
            "Teams of the same size and altitudes have the same start positions. Fire white, field "
            "of view yellow, UAVs blue."
        )
        yield _Film(Picture(path, caption), fire, episode)
    if without:
        notes.append(
            f"no timelapse or replay, because there is no checkpoint: {', '.join(without)}"
        )


def _replays(folder: Path, stem: str, films: Sequence[_Film]) -> Iterator[ReplayFile]:
    """Writes a page for each fire that plays the methods side by side."""
    for place, fire in enumerate(dict.fromkeys(one.fire for one in films)):
        shown = [one.episode for one in films if one.fire == fire]
        path = folder / f"{stem}_replay{f'_{place + 1}' if place else ''}.html"
        Replay(shown, f"{fire}:0").save(path)
        yield ReplayFile(path, fire, len(shown))
