"""Writes the report of a comparison: one HTML page, compare.json, and other files if asked for."""

import json
import os
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
from matplotlib.figure import Figure

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison import plots
from emberlink.trainers.comparison.page import Chapter, Picture, html, ranking_table
from emberlink.trainers.comparison.rankings import trained_on
from emberlink.trainers.comparison.results import Comparison
from emberlink.trainers.comparison.tables import Frame
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.episodes import Panel
from emberlink.trainers.evaluation.plots import timelapse
from emberlink.trainers.evaluation.policy import load_actor
from emberlink.trainers.evaluation.results import CURVES, LEARNED
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Episode
from emberlink.trainers.runs.run_folder import RunFolder


def free_folder(output: Path | None) -> Path:
    """Returns a folder for a report: `output`, or the first free of `compare`, `compare_2`, ...

    Raises:
        UserError: `output` is not a new or empty folder.
    """
    if output is None:
        tried = (Path("compare" if i == 1 else f"compare_{i}") for i in range(1, 10_000))
        return next(path for path in tried if not os.path.lexists(path))
    try:
        taken = os.path.lexists(output) and (not output.is_dir() or any(output.iterdir()))
    except OSError as error:
        raise UserError(f"output {output}: cannot be written: {error.strerror}") from None
    if taken:
        raise UserError(f"output {output}: exists and is not an empty folder; name a new one")
    return output


def write_report(
    comparison: Comparison,
    folder: Path,
    say: Callable[[str], None] = lambda _: None,
    extras: Collection[str] = (),
) -> Comparison:
    """Writes compare.html, compare.json and the extras into a new or empty folder.

    Args:
        comparison: result of `compare_runs`; a note is added for each label without a timelapse.
        folder: result of `free_folder`.
        say: called with a line of text before each figure.
        extras: csv, latex, marl-eval, replay, and png, pdf or svg for the figures.

    Raises:
        UserError: the folder cannot be written.
    """
    with tempfile.TemporaryDirectory() as work:
        chapters = [
            _chapter(Path(work), place, comparison, section, say, extras)
            for place, section in enumerate(comparison.sections, 1)
        ]
        files = {"compare.html": html(comparison, chapters, _replays(comparison, folder))}
        kinds = {*extras, "html"}
        drawn = [file for file in sorted(Path(work).iterdir()) if file.suffix[1:] in kinds]
        figures = {file.name: file.read_bytes() for file in drawn}
    files["compare.json"] = comparison.to_json()
    others = {"csv": ("compare.csv", _csv), "latex": ("compare.tex", _latex)}
    others["marl-eval"] = ("marl_eval.json", _marl_eval)
    files |= {name: made(comparison) for kind, (name, made) in others.items() if kind in extras}
    # Names of folders may hold bytes that are no characters.
    texts = {name: text.encode(errors="backslashreplace") for name, text in files.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in {**figures, **texts}.items():
            (folder / name).write_bytes(content)
    except OSError as error:
        raise UserError(f"output {folder}: cannot be written: {error.strerror or error}") from None
    return comparison


def _replays(comparison: Comparison, folder: Path) -> dict[str, str]:
    """Returns the address of each run's replay page, relative to the folder of the report."""
    pages = {run: Path(run) / "figures" / "replay.html" for run in comparison.runs["run"]}
    return {
        run: quote(os.fsencode(os.path.relpath(page.resolve(), folder.resolve())))
        for run, page in pages.items()
        if page.is_file()
    }


def _chapter(
    folder: Path,
    place: int,
    comparison: Comparison,
    section: str,
    say: Callable[[str], None],
    extras: Collection[str],
) -> Chapter:
    """Draws the figures of a section into a folder."""
    say(f"figures of {section}")
    runs, ranking, curves = (
        table[table["section"] == section]
        for table in (comparison.runs, comparison.ranking, comparison.curves)
    )

    def saved(figure: Figure, name: str, caption: str) -> Picture:
        path = folder / f"{place}_{name}.png"
        for kind, about in (("png", "Software"), ("pdf", "CreationDate"), ("svg", "Date")):
            if kind == "png" or kind in extras:
                figure.savefig(path.with_suffix(f".{kind}"), dpi=120, metadata={about: None})
        return Picture(path, caption)

    labels = list(runs[runs["as_trained"]]["label"].unique())
    frozen = [
        saved(plots.frozen(part, labels), f"frozen_{number}", f"{fires}: {plots.FROZEN_CAPTION}")
        for number, (fires, part) in enumerate(ranking.groupby("fires", sort=False), 1)
    ]
    scripted = ranking[(ranking["fires"] == trained_on(runs)) & (ranking["policy"] != LEARNED)]
    training = [
        saved(
            plots.training(curves, scripted, measures),
            f"figure_{number}",
            f"The paper's figure {number}. {content} {plots.CURVES_CAPTION}",
        )
        for number, (measures, content) in plots.FIGURES.items()
    ]
    films = _films(folder, place, comparison, runs, say, extras)
    return Chapter(section, runs, frozen, training, films)


def _films(
    work: Path,
    place: int,
    comparison: Comparison,
    runs: Frame,
    say: Callable[[str], None],
    extras: Collection[str],
) -> list[Picture]:
    """Plays an episode of the first seed of each label, and draws its timelapse."""
    films: list[Picture] = []
    episodes: dict[str, list[Episode]] = {}
    trained = runs[runs["as_trained"]].drop_duplicates("label")
    for number, (label, run) in enumerate(zip(trained["label"], trained["object"], strict=True), 1):
        folder, title = RunFolder(run.path), f"{label}, seed {run.settings['seed']}"
        try:
            config = folder.config(folder.checkpoint(), device="cpu")
            actor = load_actor(config, folder.newest)
        except (UserError, OSError) as error:
            comparison.notes.append(f"{label}: no timelapse; {error}")
            continue
        say(f"timelapse of {label}")
        fire, arrival = evaluate.shown_fire(config)
        episode = Panel(title, config, lambda _, actor=actor: actor).play(arrival)
        episodes.setdefault(fire, []).append(episode)
        path = work / f"{place}_timelapse_{number}.png"
        timelapse(path, episode.recording, label)
        caption = (
            f"{title}: the frozen policy on the first held-out fire of {fire}. Fire white, field "
            "of view yellow, UAVs blue."
        )
        films.append(Picture(path, caption))
    if "replay" in extras:
        for number, (fire, shown) in enumerate(episodes.items(), 1):
            Replay(shown, f"{fire}:0").save(work / f"{place}_replay_{number}.html")
    return films


def _csv(comparison: Comparison) -> str:
    """Returns one row per run, fire and measure."""
    return comparison.table.to_csv(index=False)


def _latex(comparison: Comparison) -> str:
    """Returns a LaTeX table for each section and set of fires: the headline measure by rank."""
    texts: list[str] = []
    for (section, _), part in comparison.ranking.groupby(["section", "fires"], sort=False):
        table = ranking_table(part)
        heading, rows = table.groups[0]
        cells = pd.DataFrame([cells for cells, _ in rows], columns=list(table.columns))
        caption = f"{section}, {table.title}: {heading.split()[0]}".replace("_", r"\_")
        texts.append(cells.to_latex(index=False, escape=True, caption=caption))
    return "\n".join(texts)


def _marl_eval(comparison: Comparison) -> str:
    """Returns environment, section, label, run, step and measures as JSON that MARL-eval reads."""
    tasks: dict[str, Any] = {}
    for row in comparison.runs[comparison.runs["as_trained"]].itertuples():
        run: Any = row.object
        a_line = run.settings["env.horizon"] * run.settings["num_envs"]
        steps: dict[str, Any] = {
            f"step_{line['episode']}": {"step_count": line["episode"] * a_line}
            | {name: [line[name]] for name in CURVES}
            for line in run.lines
        }
        steps["absolute_metrics"] = [*run.evaluation.results.values()][-1][LEARNED]
        of_section = tasks.setdefault(str(row.section), {})
        of_section.setdefault(str(row.label), {})[f"run_{row.seed}"] = steps
    return json.dumps({"emberlink": tasks}) + "\n"
