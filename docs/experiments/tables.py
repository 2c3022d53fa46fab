"""Writes the tables between markers on the pages, and figures, from docs/data.

    python docs/experiments/tables.py                          # make tables
    python docs/experiments/tables.py pack NAME [LABEL=]RUNS…  # adds runs to the files of a study

`<!-- table: NAME -->` names a table of tables.yaml. A cell is an expression, its row in the place
of `{}` in its column or the other way round: function, runs, measure and number of digits, such as
`iqm front/maps coverage 1`.
"""

import io
import json
import re
import sys
from collections.abc import Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from matplotlib import rc_context
from matplotlib.figure import Figure

from emberlink.envs import metrics
from emberlink.trainers.comparison import bootstrap, drawing, rankings
from emberlink.trainers.comparison.communication import gain_and_value

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
TEXTS = Path(__file__).with_suffix(".yaml")
TABLE = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- /table -->)", re.DOTALL)
POINTS = 40  # most of a learning curve: means of equal parts of a training


def written(text: str) -> str:
    """Returns the text of a page with its tables as the data have them."""
    known = yaml.safe_load(TEXTS.read_text())
    return TABLE.sub(lambda found: f"{found[1]}{table(**known[found[2]])}{found[3]}", text)


def table(
    columns: dict[str, str], rows: dict[str, Any], first: str = "", holm: str | None = None
) -> str:
    """Returns a table; `first` is the head of the names of rows, and a list holds texts.

    The p-values of the column `holm` are corrected; those without data are 1. Rows without data are
    left out.
    """
    lines = [[first, *columns], ["---"] * (len(columns) + first.count("|") + 1)]
    for name, row in rows.items():
        cells = row if isinstance(row, list) else [cell(row, c) for c in columns.values()]
        lines.append([name.rstrip(), *cells])
    if holm:
        place, tested = 1 + [*columns].index(holm), lines[2:]
        corrected = bootstrap.holm([float(line[place] or 1) for line in tested])
        for line, p in zip(tested, corrected, strict=True):
            line[place] = line[place] and f"{p:.4f}"
    lines = [line for line in lines if any(line[1:])]
    return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


def computed(expression: str) -> Any:
    """Returns the value of an expression and the ends of its interval, None without its runs."""
    function, *runs, measure, _ = expression.split()
    samples = [sample(*run.split("/"), measure) for run in runs]
    return FUNCTIONS[function](samples, measure) if all(map(len, samples[:3])) else None


def cell(row: str, column: str) -> str:
    """Returns the text of an expression; empty if its runs do not exist.

    * marks what was computed of fewer than 5 seeds.
    """
    expression = row.replace("{}", column) if "{}" in row else column.replace("{}", row)
    function, *runs, measure, digits = expression.split()
    value, ends = computed(expression) or (None, None)
    if value is None or np.isnan(value):
        return "" if value is None else "undetermined"
    numbers = [round(x, int(digits)) + 0.0 for x in (value, *(ends or ()))]
    texts = [f"{x:,.{digits}f}".replace("-", "\N{MINUS SIGN}") for x in numbers]
    if not ends or ends[0] == ends[1]:
        return texts[0]
    few = function in ("gain", "ratio", "value") and any(
        1 < len(sample(*run.split("/"), measure)) < bootstrap.FEW for run in runs
    )
    return f"{texts[0]} [{texts[1]}, {texts[2]}]{'*' * few}"


@cache
def frame(name: str) -> dict[Any, Any]:
    if not (file := DATA / f"{name}.csv.xz").exists():
        return {}
    data = pd.read_csv(file).rename(columns={"episode": "fire"})
    return dict(iter(data.fillna({"seed": -1}).groupby(["run", "measure"])))


def sample(study: str, run: str, measure: str) -> Any:
    """Returns the values of a run, [seeds, fires], or [seeds, points] of its learning curve."""
    rows = frame(study).get((run, measure))
    return (
        [] if rows is None else rows.pivot(index="seed", columns="fire", values="value").to_numpy()
    )


def iqm(samples: Any, _: str, run: int = 0, last: int = 0, seeds: int | None = None) -> Any:
    """Returns the interquartile mean over seeds of a run, at its last points, and its interval."""
    values = samples[run][:seeds, -last:]
    if last:  # points of a learning curve, not fires
        values = values.mean(1, keepdims=True)
    return bootstrap.iqm(values.mean(1)), bootstrap.crossed_interval(bootstrap.iqm, values)


def gain(samples: Any, measure: str, key: str = "gain", retrained: bool = True) -> Any:
    """Returns a number of `gain_and_value` and its interval, NaN if it is undetermined."""
    now = gain_and_value(measure, samples[:2][::-1] + samples[2:], retrained=retrained)
    ends = now.get(f"{key}_low"), now.get(f"{key}_high")
    return now.get(key, np.nan), None if None in ends else ends


def rise(samples: Any, _: str) -> Any:
    """Returns by how much the last eighth of a learning curve exceeds the one before."""
    curve = samples[0].mean(0)
    last = curve[-max(2, len(curve) // 4) :]
    return last[len(last) // 2 :].mean() - last[: len(last) // 2].mean(), None


def ratio(samples: Any, measure: str) -> Any:
    """Returns how many times better a method is than the best other one, with its interval."""
    samples = [values for values in samples if len(values)]
    return bootstrap.ratio_to_best(*samples, higher=measure in metrics.HIGHER_IS_BETTER)


FUNCTIONS: dict[str, Any] = {
    **{"iqm": iqm, "gain": gain, "ratio": ratio, "last10": partial(iqm, last=2)},
    **{"same": partial(gain, retrained=False), "value": partial(gain, key="value")},
    **{f"run{i}": lambda samples, _, i=i: (iqm(samples, _, i)[0], None) for i in range(3)},
    **{"rise": rise, "seed0": partial(iqm, seeds=1)},
    "p": lambda samples, _: (bootstrap.crossed_p(bootstrap.iqm_difference, *samples), None),
    "seeds": lambda samples, _: (len(samples[0]), None),
}


def figures() -> dict[str, Figure]:
    """Returns the figures of the pages by their names in docs/images."""
    known = yaml.safe_load(TEXTS.read_text())
    panels = [name for measures, _ in drawing.FIGURES.values() for name in measures]
    methods = ["consensus", "independent", "positional", "shared_memory"]
    arms = [run for run in known["study_front"]["rows"].values() if "@" not in run]
    of_maps, of_vectors = ([a for a in arms if a.startswith(kind)] for kind in ("map", "vector"))
    return {
        "gains": gains(**known["gains"]),
        "learning": curves("study_front", of_maps, ["front/coverage"]),
        "learning_vector": curves("study_front", of_vectors, ["front/coverage"]),
        "learning_paper": curves("study_paper", of_vectors, ["huygens/coverage"]),
        "learning_relay": curves(
            "study_relay", of_maps, ["front/base_coverage_auc", "front/coverage"]
        ),
        "tuned_first": curves("tuned", methods, panels[:3]),
        "tuned_last": curves("tuned", methods, panels[3:]),
    }


def gains(columns: dict[str, str], rows: dict[str, str], **_: str) -> Figure:
    """Returns the last column of a table as dots with their intervals."""
    expressions = {name: [*columns.values()][-1].replace("{}", row) for name, row in rows.items()}
    found = {name: value for name, text in expressions.items() if (value := computed(text))}
    figure = Figure(figsize=(6, 0.8 + 0.3 * len(found)), layout="constrained")
    axes = figure.subplots()
    for y, (value, ends) in enumerate(found.values()):
        axes.plot(ends or [value] * 2, [y, y], "|-", lw=2, ms=9, mew=1.5, color=drawing.COLOURS[0])
        axes.plot([value], [y], "o", ms=7, color=drawing.COLOURS[0])
    axes.set_yticks(range(len(found)), [re.sub("`", "", x).replace(" | ", ", ") for x in found])
    unit = [*columns][-1].split(", ")[1]
    figure.supxlabel(f"gain of teams trained with messages, {unit}", fontsize="medium")
    axes.axvline(0, color="0.3", lw=1.3)
    axes.invert_yaxis()
    axes.grid(alpha=0.3, axis="x")
    return figure


def curves(study: str, labels: Sequence[str], measures: Sequence[str]) -> Figure:
    """Returns the learning curves of the runs that there are."""
    rows, every = [], frame(f"{study}.curves")
    known = yaml.safe_load(TEXTS.read_text())[study]["rows"]
    titles = {run: title.replace("`", "") for title, run in known.items() if run in labels}
    for (run, title), measure in product(titles.items(), measures):
        if (run, measure) in every:
            points = every[run, measure].pivot(index="seed", columns="fire", values="value")
            about = {"label": title, "measure": measure.rpartition("/")[2]}
            rows.append(rankings.band(points.to_numpy(), points.columns, **about))
    none = pd.DataFrame(columns=["label", "measure", "iqm"])
    shown = [measure.rpartition("/")[2] for measure in measures]
    figure = drawing.training(pd.concat(rows), none, shown, [*titles.values()])
    figure.set_size_inches(3 + 2.6 * len(measures), 3.4)
    return figure


def svg(figure: Figure) -> str:
    """Returns a figure as text, the same each time."""
    memory = io.StringIO()
    with rc_context({"svg.hashsalt": "emberlink", "svg.fonttype": "none"}):
        figure.savefig(memory, format="svg", metadata={"Date": None, "Creator": None})
    return memory.getvalue()


def pack(name: str, *folders: str) -> None:
    """Adds evaluations, learning curves and configurations of runs to docs/data.

    The label of a folder without one is its name, that of a .json of `world check` the world. Rows
    that are there already are replaced.
    """
    rows, curves, configs = [], [], {}
    for label, _, folder in (text.rpartition("=") for text in folders):
        label = label or Path(folder).name
        for file in sorted(Path(folder).rglob("eval*.json")):
            found = json.loads(file.read_text())
            changed = file.stem.removeprefix("eval").replace("_", "@", 1)
            for fires, policies in found["results"].items():
                on = changed + (f":{fires}" if len(found["results"]) > 1 else "")
                for policy, measured in policies.items():
                    run, seed = (label, found["seed"]) if policy == "learned" else (policy, None)
                    for measure, values in measured.items():
                        rows += [(run + on, seed, measure, *one) for one in enumerate(values)]
        if folder.endswith(".json"):  # of `emberlink world check`
            for policy, measured in json.loads(Path(folder).read_text())[label]["means"].items():
                rows += [(policy, None, name, 0, mean) for name, mean in measured.items()]
        for file in sorted(Path(folder).rglob("eval.json")):
            config = yaml.safe_load(file.with_name("config.yaml").read_text())
            learner = config["learner"]
            learner["warm_start"] = Path(learner.get("warm_start", "")).name
            configs.setdefault(label, {**config, "output": "runs"})
            lines = pd.read_json(file.with_name("metrics.jsonl"), lines=True).set_index("episode")
            size = -(-len(lines) // POINTS)
            means = lines.groupby((np.arange(len(lines)) // size + 1) * size).mean()
            part = means.rename_axis("episode").melt(var_name="measure", ignore_index=False)
            curves.append(part.dropna().reset_index().assign(run=label, seed=config["seed"]))
    columns = ["run", "seed", "measure", "fire", "value"]
    add(DATA / f"{name}.csv.xz", pd.DataFrame(rows, columns=columns))
    if curves:
        add(DATA / f"{name}.curves.csv.xz", pd.concat(curves))
        file = DATA / f"{name}.yaml"
        before = yaml.safe_load(file.read_text()) if file.exists() else {}
        file.write_text(yaml.safe_dump({**before, **configs}))


def add(file: Path, table: Any) -> None:
    """Adds rows to a file."""
    if file.exists():
        table = pd.concat([pd.read_csv(file), table])
    rows = table.drop_duplicates([*table.columns.drop("value")], keep="last")
    rows.astype({"seed": "Int64"}).to_csv(file, index=False, float_format="%.6g")


def write() -> None:
    """Writes the figures and the tables of all pages."""
    for name, figure in figures().items():
        (ROOT / "docs" / "images" / f"{name}.svg").write_text(svg(figure))
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md")):
        page.write_text(written(page.read_text()))


if __name__ == "__main__":
    pack(*sys.argv[2:]) if sys.argv[1:] else write()
