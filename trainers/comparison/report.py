"""Shows a comparison: tables of text, figures, one HTML page, compare.json, and other files."""

import base64
import json
import os
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure
from rich import table as rich_table
from rich.text import Text

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.comparison import drawing
from emberlink.trainers.comparison.bootstrap import FEW
from emberlink.trainers.comparison.comparison import Comparison, about
from emberlink.trainers.comparison.rankings import differing, trained_on
from emberlink.trainers.comparison.tables import Frame
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.episodes import Panel
from emberlink.trainers.evaluation.figures import timelapse
from emberlink.trainers.evaluation.policy import load_actor
from emberlink.trainers.evaluation.scores import CURVES, LEARNED
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Episode
from emberlink.trainers.runs.run_folder import RunFolder

NONE = "-"
DIGITS = {"mean_reward": 3, "boundary_exits": 2, "fire_losses": 2}
"""digits after the decimal point; 1 for other measures"""
ENDS = "95 % interval"
BETTER = "P(better than the next)"
NUMBERS = {
    "seeds",
    "IQM",
    ENDS,
    BETTER,
    "radio off",
    "with radio",
    "no limits",
    "gain",
    "value",
    "ratio",
}
"""columns that are aligned to the right"""
GROUP = "group"


class Table(NamedTuple):
    """A table of text; `rows` has the heading of each row's group as its index."""

    title: str
    caption: str
    rows: Frame

    @property
    def groups(self) -> Iterator[tuple[str, Frame]]:
        """The heading and the rows of each group."""
        return iter(self.rows.groupby(level=0, sort=False))


class Picture(NamedTuple):
    """A PNG file and its caption."""

    path: Path
    caption: str

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.path.read_bytes()).decode()


def tables(comparison: Comparison, section: str) -> list[Table]:
    """Returns the tables of a section: rankings, the value of communication, claims."""
    ranking, gains, claims = (
        table[table["section"] == section]
        for table in (comparison.ranking, comparison.communication, comparison.claims)
    )
    few = f" *: fewer than {FEW} seeds are too few for an interval to be trusted."
    caption = (
        "IQM: interquartile mean over seeds; interval: bootstrap over seeds; ↑ more is better, "
        "↓ less is better. A scripted policy has no seeds: its number is the mean over the fires."
    ) + (few if ranking["seeds"].map(len).between(1, FEW - 1).any() else "")
    found = [
        _table(f"on {fires}", caption, part, _ranked)
        for fires, part in ranking.groupby("fires", sort=False)
    ]
    if len(gains):
        title = (
            "the gain of messages and the value of communication, by " + gains["measure"].iloc[0]
        )
        caption = (
            "Gain: with the world's radio less with the radio off. Value: gain / (without limits "
            "less off), 0 where the radio adds nothing and 1 where it adds as much as one without "
            "limits. 95 % intervals: over the fires for the same networks, over seeds and fires "
            "for retrained ones."
        )
        found.append(_table(title, caption, gains, _gained))
    if len(claims):
        caption = (
            "Ratio: interquartile mean against that of the best other method, above 1 where the "
            "method is better, with its 95 % interval. A claim holds if the whole interval is at "
            "or above the factor claimed, does not hold if all of it is below, and is undecided "
            "otherwise."
        )
        claims = claims.sort_values("label", kind="stable")
        found.append(_table("the paper's claims", caption, claims, _claimed))
    return found


def _table(
    title: str, caption: str, table: Frame, cells: Callable[[Mapping[str, Any]], dict[str, str]]
) -> Table:
    rows = pd.DataFrame([cells(row) for row in table.to_dict("records")])
    return Table(title, caption, rows.set_index(GROUP))


def _ranked(row: Mapping[str, Any]) -> dict[str, str]:
    measure, seeds = row["measure"], len(row["seeds"])
    digits = DIGITS.get(measure, 1)
    arrow = "↑" if measure in metrics.HIGHER_IS_BETTER else "↓"
    return {
        GROUP: f"{measure} " + (f"(not ranked: {why})" if (why := row["not_ranked"]) else arrow),
        "policy": row["label"],
        "seeds": f"{seeds}{'*' if seeds < FEW else ''}" if seeds else NONE,
        "IQM": _number(row["iqm"], digits),
        ENDS: _ends(row, "", digits) or NONE,
        BETTER: _with_ends(row, "probability", 2),
    }


def _gained(row: Mapping[str, Any]) -> dict[str, str]:
    digits = DIGITS.get(row["measure"], 1)
    return {
        GROUP: row["fires"],
        "policy": row["label"],
        "radios": row["radios"],
        "radio off": _number(row["none"], digits),
        "with radio": _number(row["with_radio"], digits),
        "no limits": _number(row["full"], digits),
        "gain": _with_ends(row, "gain", digits + 1),
        "value": _with_ends(row, "value", 2),
    }


def _claimed(row: Mapping[str, Any]) -> dict[str, str]:
    count = row["fewest_seeds"]
    few = "" if count >= FEW else f" (only {count} seed{'s' if count > 1 else ''})"
    return {
        GROUP: row["label"],
        "claim": f"{row['claim']} ({row['measure']})",
        "verdict": row["verdict"] + few,
        "ratio": f"{_number(row['ratio'], 2)} {_ends(row, '', 2)}".rstrip(),
        "best other": row["best_other"],
        "fires": row["fires"],
    }


def _number(value: float | None, digits: int) -> str:
    if value is None or pd.isna(value):
        return NONE
    return "∞" if value == float("inf") else f"{value:.{digits}f}"


def _ends(row: Mapping[str, Any], name: str, digits: int) -> str:
    ends = [_number(row[f"{name}{end}"], digits) for end in ("low", "high")]
    return "" if NONE in ends else f"[{', '.join(ends)}]"


def _with_ends(row: Mapping[str, Any], name: str, digits: int) -> str:
    return f"{_number(row[name], digits)} {_ends(row, f'{name}_', digits)}".rstrip()


def printed(table: Table, section: str) -> rich_table.Table:
    """Returns a table for the console."""
    result = rich_table.Table(title=Text(f"{section}: {table.title}"), caption=table.caption)
    for column in table.rows:
        result.add_column(column, justify="right" if column in NUMBERS else "left")
    for heading, rows in table.groups:
        result.add_section()
        result.add_row(Text(heading, style="bold"))
        for row in rows.itertuples(index=False):
            result.add_row(*map(Text, row))
    return result


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
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = files("emberlink.trainers.comparison").joinpath("page.html").read_text("utf-8")
    with tempfile.TemporaryDirectory() as work:
        chapters = [
            _chapter(Path(work, f"{place}_"), comparison, section, folder, say, extras)
            for place, section in enumerate(comparison.sections, 1)
        ]
        page = environment.from_string(source).render(
            comparison=comparison, chapters=chapters, settings=about(), numbers=NUMBERS
        )
        contents = {
            file.name: file.read_bytes()
            for file in sorted(Path(work).iterdir())
            if file.suffix[1:] in {*extras, "html"}
        }
    texts = {"compare.html": page, "compare.json": comparison.to_json()}
    if "csv" in extras:
        texts["compare.csv"] = comparison.table.to_csv(index=False)
    if "latex" in extras:
        texts["compare.tex"] = _latex(comparison)
    if "marl-eval" in extras:
        texts["marl_eval.json"] = _marl_eval(comparison)
    # Names of folders may hold bytes that are no characters.
    contents |= {name: text.encode(errors="backslashreplace") for name, text in texts.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).write_bytes(content)
    except OSError as error:
        raise UserError(f"output {folder}: cannot be written: {error.strerror or error}") from None
    return comparison


def _chapter(
    prefix: Path,
    comparison: Comparison,
    section: str,
    folder: Path,
    say: Callable[[str], None],
    extras: Collection[str],
) -> dict[str, Any]:
    """Draws the figures of a section, and returns what the page shows of it."""
    say(f"figures of {section}")
    runs, ranking, curves = (
        table[table["section"] == section]
        for table in (comparison.runs, comparison.ranking, comparison.curves)
    )

    def saved(figure: Figure, name: str, caption: str) -> Picture:
        path = Path(f"{prefix}{name}.png")
        for kind, changing in (("png", "Software"), ("pdf", "CreationDate"), ("svg", "Date")):
            if kind == "png" or kind in extras:
                figure.savefig(path.with_suffix(f".{kind}"), dpi=120, metadata={changing: None})
        return Picture(path, caption)

    labels = list(runs[runs["as_trained"]]["label"].unique())
    frozen = [
        saved(drawing.frozen(part, labels), f"frozen_{i}", f"{fires}: {drawing.FROZEN_CAPTION}")
        for i, (fires, part) in enumerate(ranking.groupby("fires", sort=False), 1)
    ]
    scripted = ranking[(ranking["fires"] == trained_on(runs)) & (ranking["policy"] != LEARNED)]
    training = [
        saved(
            drawing.training(curves, scripted, measures),
            f"figure_{number}",
            f"The paper's figure {number}. {content} {drawing.CURVES_CAPTION}",
        )
        for number, (measures, content) in drawing.FIGURES.items()
    ]
    return {
        "title": section,
        "runs": runs,
        "frozen": frozen,
        "tables": tables(comparison, section),
        "training": training,
        "timelapses": _timelapses(prefix, comparison, runs, say, extras),
        "details": _details(runs, folder),
    }


def _timelapses(
    prefix: Path,
    comparison: Comparison,
    runs: Frame,
    say: Callable[[str], None],
    extras: Collection[str],
) -> list[Picture]:
    """Plays an episode of the first seed of each label, and draws its timelapse."""
    pictures: list[Picture] = []
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
        path = Path(f"{prefix}timelapse_{number}.png")
        timelapse(path, episode.recording, label)
        caption = (
            f"{title}: the frozen policy on the first held-out fire of {fire}. Fire white, field "
            "of view yellow, UAVs blue."
        )
        pictures.append(Picture(path, caption))
    if "replay" in extras:
        for number, (fire, shown) in enumerate(episodes.items(), 1):
            Replay(shown, f"{fire}:0").save(Path(f"{prefix}replay_{number}.html"))
    return pictures


def _details(runs: Frame, folder: Path) -> list[Table]:
    """Returns the settings in which the labels of a section differ, and its runs."""
    settings = differing(runs).rename_axis("policy").reset_index()
    trained = runs[runs["as_trained"]]
    rows = trained[["label", "seed", "radio"]].rename(columns={"label": "policy"})
    rows["episodes of training"] = [run.settings["episodes"] for run in trained["object"]]
    rows["folder"] = trained["run"]
    rows["replay"] = [_replay(Path(run), folder) for run in trained["run"]]
    return [
        Table(title, "", part.astype(str).set_axis([""] * len(part)))
        for title, part in (("Settings that differ", settings), ("Runs", rows))
    ]


def _replay(run: Path, folder: Path) -> str:
    """Returns the address of a run's replay page, relative to the folder of the report."""
    page = run / "figures" / "replay.html"
    address = os.path.relpath(page.resolve(), folder.resolve()) if page.is_file() else ""
    return quote(os.fsencode(address))


def _latex(comparison: Comparison) -> str:
    """Returns a LaTeX table for each section and set of fires: the headline measure by rank."""
    texts: list[str] = []
    for (section, fires), part in comparison.ranking.groupby(["section", "fires"], sort=False):
        measure = part["measure"].iloc[0]
        rows = _table("", "", part[part["measure"] == measure], _ranked).rows
        caption = f"{section}, on {fires}: {measure}".replace("_", r"\_")
        texts.append(rows.to_latex(index=False, escape=True, caption=caption))
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
