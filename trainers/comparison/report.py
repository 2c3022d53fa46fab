"""Shows a comparison: tables of text, figures, one HTML page, compare.json, and other files."""

import base64
import json
import os
from collections.abc import Callable, Collection, Mapping
from functools import partial
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure
from rich.table import Table as RichTable
from rich.text import Text

from emberlink.envs import metrics
from emberlink.envs.utils.atomic_io import free_name
from emberlink.envs.utils.errors import UserError, naming
from emberlink.trainers.comparison import drawing
from emberlink.trainers.comparison.bootstrap import FEW
from emberlink.trainers.comparison.comparison import Comparison, about
from emberlink.trainers.comparison.rankings import differing, trained_on
from emberlink.trainers.comparison.tables import Frame
from emberlink.trainers.evaluation.scores import DIGITS, LEARNED
from emberlink.trainers.terminal.console import plain_table

NONE = "-"
ENDS = "95 % interval"
BETTER = "P(better than the next)"
NUMBERS = {
    *("seeds", "IQM", ENDS, BETTER, "ratio"),
    *("radio off", "with radio", "no limits", "gain", "value"),
}
"""columns that are aligned to the right"""
RANKED = (
    "IQM: interquartile mean over seeds; interval: over seeds and fires; ↑ more is better, "
    "↓ less is better. A scripted policy has no seeds: its number is the mean over the fires."
)
GAINED = (
    "Gain: with the world's radio less with the radio off. Value: gain / (without limits less "
    "off), 0 where the radio adds nothing and 1 where it adds as much as one without limits; "
    "undetermined where the interval of the divisor is not above 0. 95 % intervals: over the fires "
    "for the same networks, over seeds and fires for retrained ones."
)
CLAIMED = (
    "Ratio: interquartile mean against that of the best other method, above 1 where the method is "
    "better, with its 95 % interval. A claim holds if the whole interval is at or above the factor "
    "claimed, does not hold if all of it is below, and is undecided otherwise."
)
"""captions of the tables"""


class Table(NamedTuple):
    """A table of text."""

    title: str
    caption: str
    rows: Frame


def tables(comparison: Comparison, section: str) -> list[Table]:
    """Returns the tables of a section: rankings, the value of communication, claims."""
    ranking, gains, claims = (
        table[table["section"] == section]
        for table in (comparison.ranking, comparison.communication, comparison.claims)
    )
    few = f" *: fewer than {FEW} seeds are too few for an interval to be trusted."
    few *= any(0 < len(seeds) < FEW for seeds in ranking["seeds"])
    found = [
        _table(f"on {fires}", RANKED + few, part, _ranked)
        for fires, part in ranking.groupby("fires", sort=False)
    ]
    if len(gains):
        title = "the gain of messages and the value of communication, by "
        found.append(_table(title + gains["measure"].iloc[0], GAINED, gains, _gained))
    if len(claims):
        claims = claims.sort_values("label", kind="stable")
        found.append(_table("the paper's claims", CLAIMED, claims, _claimed))
    return found


def _table(title: str, caption: str, rows: Frame, text: Callable[..., dict[str, str]]) -> Table:
    return Table(title, caption, pd.DataFrame(map(text, rows.to_dict("records"))))


def _ranked(row: Mapping[str, Any]) -> dict[str, str]:
    measure, seeds = row["measure"], len(row["seeds"])
    digits = DIGITS.get(measure, 1)
    arrow = "↑" if measure in metrics.HIGHER_IS_BETTER else "↓"
    not_ranked = row["not_ranked"] and f"(not ranked: {row['not_ranked']})"
    return {
        "measure": f"{measure} {not_ranked or arrow}",
        "policy": row["label"],
        "seeds": f"{seeds}{'*' if seeds < FEW else ''}" if seeds else NONE,
        "IQM": _number(row["iqm"], digits),
        ENDS: _ends(row, "", digits) or NONE,
        BETTER: _with_ends(row, "probability", 2),
    }


def _gained(row: Mapping[str, Any]) -> dict[str, str]:
    digits = DIGITS.get(row["measure"], 1)
    undetermined = "undetermined" if pd.notna(row["full"]) else NONE
    return {
        **{"fires": row["fires"], "policy": row["label"], "radios": row["radios"]},
        "radio off": _number(row["none"], digits),
        "with radio": _number(row["with_radio"], digits),
        "no limits": _number(row["full"], digits),
        "gain": _with_ends(row, "gain", digits + 1),
        "value": undetermined if pd.isna(row["value"]) else _with_ends(row, "value", 2),
    }


def _claimed(row: Mapping[str, Any]) -> dict[str, str]:
    count = row["fewest_seeds"]
    few = "" if count >= FEW else f" (only {count} seed{'s' if count > 1 else ''})"
    return {
        "policy": row["label"],
        "claim": f"{row['claim']} ({row['measure']})",
        "verdict": row["verdict"] + few,
        "ratio": f"{_number(row['ratio'], 2)} {_ends(row, '', 2)}".rstrip(),
        **{"best other": row["best_other"], "fires": row["fires"]},
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


def printed(table: Table, section: str) -> RichTable:
    """Returns a table for the console; a line is between the values of its first column."""
    result = plain_table(title=Text(f"{section}: {table.title}"), caption=table.caption)
    for column in table.rows:
        result.add_column(column, justify="right" if column in NUMBERS else "left")
    for _, rows in table.rows.groupby(table.rows.columns[0], sort=False):
        result.add_section()
        for row in rows.itertuples(index=False):
            result.add_row(*map(Text, row))
    return result


def free_folder(output: Path | None) -> Path:
    """Returns a folder for a report: `output`, or the first free of `compare`, `compare_2`, ..."""
    if output is None:
        return free_name(Path(), "compare", [""])
    with naming(f"output {output}"):
        if os.path.lexists(output) and (not output.is_dir() or any(output.iterdir())):
            raise UserError("exists and is not an empty folder; name a new one")
    return output


def write_report(
    comparison: Comparison,
    folder: Path,
    say: Callable[[str], None] = lambda _: None,
    extras: Collection[str] = (),
) -> Comparison:
    """Writes compare.html, compare.json and the extras into a new or empty folder.

    `say` is called with a line of text before the figures of each section; `extras` are
    "marl-eval", and "pdf" and "svg" for the figures.
    """
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = files("emberlink.trainers.comparison").joinpath("page.html").read_text("utf-8")
    with naming(f"output {folder}"):
        folder.mkdir(parents=True, exist_ok=True)

    def saved(chapter: int, figure: Figure, name: str, caption: str) -> dict[str, str]:
        for kind in {"pdf", "svg"} & {*extras}:
            figure.savefig(folder / f"{chapter}_{name}.{kind}")
        png = BytesIO()
        figure.savefig(png, format="png", dpi=120)
        data = base64.b64encode(png.getvalue()).decode()
        return {"uri": f"data:image/png;base64,{data}", "caption": caption}

    chapters = []
    for place, section in enumerate(comparison.sections, 1):
        say(f"figures of {section}")
        chapters.append(_chapter(comparison, section, folder, partial(saved, place)))
    page = environment.from_string(source).render(
        comparison=comparison, chapters=chapters, settings=about(), numbers=NUMBERS
    )
    texts = {"compare.html": page, "compare.json": comparison.to_json()}
    if "marl-eval" in extras:
        texts["marl_eval.json"] = _marl_eval(comparison)
    for name, text in texts.items():
        # Names of folders may hold bytes that are no characters.
        (folder / name).write_text(text, "utf-8", "backslashreplace")
    return comparison


def _chapter(
    comparison: Comparison,
    section: str,
    folder: Path,
    saved: Callable[[Figure, str, str], dict[str, str]],
) -> dict[str, Any]:
    """Draws the figures of a section, and returns its part of the page."""
    runs, ranking, curves = (
        table[table["section"] == section]
        for table in (comparison.runs, comparison.ranking, comparison.curves)
    )
    trained = runs[runs["as_trained"]]
    labels = list(trained["label"].unique())
    scripted = ranking[(ranking["fires"] == trained_on(runs)) & (ranking["policy"] != LEARNED)]
    frozen = [
        saved(drawing.frozen(part, labels), f"frozen_{i}", f"{fires}: {drawing.FROZEN_CAPTION}")
        for i, (fires, part) in enumerate(ranking.groupby("fires", sort=False), 1)
    ]
    training = []
    for number, (measures, content) in drawing.FIGURES.items() if len(curves) else ():
        caption = f"The paper's figure {number}. {content} {drawing.CURVES_CAPTION}"
        figure = drawing.training(curves, scripted, measures, labels)
        training.append(saved(figure, f"figure_{number}", caption))
    return {
        "title": section,
        "runs": runs,
        "frozen": frozen,
        "tables": tables(comparison, section),
        "training": training,
        "details": _details(runs, folder),
    }


def _marl_eval(comparison: Comparison) -> str:
    """Returns JSON that MARL-eval reads: the same measures at each step, no comma in a label."""
    tasks: dict[str, Any] = {}
    for row in comparison.runs[comparison.runs["as_trained"]].itertuples():
        run: Any = row.object
        tested = [*run.evaluation.results.values()][-1][LEARNED]
        both = [name for name in tested if all(name in line for line in run.lines)]
        a_line = run.settings["env.horizon"] * run.settings["num_envs"]
        steps: dict[str, Any] = {
            f"step_{line['episode']}": {"step_count": line["episode"] * a_line}
            | {name: [line[name]] for name in both}
            for line in run.lines
        }
        steps["absolute_metrics"] = {name: tested[name] for name in both}
        runs = tasks.setdefault(str(row.section), {}).setdefault(row.label.replace(",", ""), {})
        runs[f"run_{row.seed}"] = steps
    return json.dumps({"emberlink": tasks}) + "\n"


def _details(runs: Frame, folder: Path) -> list[Table]:
    """Returns the settings in which the labels of a section differ, and its runs."""
    settings = differing(runs).rename_axis("policy").reset_index()
    trained = runs[runs["as_trained"]]
    rows = trained[["label", "seed", "radio"]].rename(columns={"label": "policy"})
    rows["episodes of training"] = [len(run.lines) for run in trained["object"]]
    rows["folder"] = trained["run"]
    pages = [Path(run) / "figures" / "replay.html" for run in trained["run"]]
    start = folder.resolve()
    rows["replay"] = [
        quote(os.fsencode(os.path.relpath(page.resolve(), start))) if page.is_file() else ""
        for page in pages
    ]
    return [
        Table("Settings that differ", "", settings.astype(str)),
        Table("Runs", "", rows.astype(str)),
    ]
