"""Evaluates the frozen policy of a run and writes eval.json, figures, a GIF and a replay page."""

import argparse
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console

from emberlink.envs.rendering.film import write_gif
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import naming
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.foreign import FOREIGN, foreign_name
from emberlink.trainers.evaluation.policy import TrainedPolicy, to_evaluate
from emberlink.trainers.evaluation.scores import CURVES, LEARNED, Results, print_results, reporter
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Recorder, Recording
from emberlink.trainers.replay.screen import Screen, draw_step, even_steps
from emberlink.trainers.runs.checkpoint import read_header, versions
from emberlink.trainers.runs.pretrained import open_run
from emberlink.trainers.runs.run_folder import RunFolder


def run_command(options: argparse.Namespace, console: Console) -> int:
    """Runs `emberlink eval`: evaluates a run, prints the table and returns 0."""
    changes, file, name, method = options.overrides, options.checkpoint, options.name, None
    if name and changes and "=" not in changes[0]:
        method, *changes = changes
    about = {"name": name or "", "checkpoint": file, "device": options.device}
    policy, run = to_evaluate(options.folder, method, changes, **about)
    label = ""
    if run is None:
        run = open_run(options.folder)  # copies a trained policy of the package once all is checked
        parts = [file.stem] if file else []
        parts += [re.sub(r"[^\w.=+-]", "-", text) for text in changes]
        label = "".join(f"_{part}" for part in parts)
        if len(label) > 150:  # the name of a file can have 255 characters
            label = f"{label[:141]}_{hashlib.sha256(label.encode()).hexdigest()[:8]}"
    results = evaluate_run(run, policy, options.fires, report=reporter(console), label=label)
    print_results(console, results, policy.config, foreign_name(run))
    console.print(str(run.path), soft_wrap=True)
    return 0


def evaluate_run(
    run: RunFolder,
    policy: TrainedPolicy,
    fires: int | None = None,
    *,
    report: Callable[[str, str], None] = lambda *_: None,
    label: str = "",
) -> Results:
    """Evaluates a frozen policy and writes eval.json, the figures, a GIF and a replay page.

    Arguments as for `evaluate.evaluate`; `fires` is `evaluation.episodes` if None, `label` the
    suffix of the file names.
    """
    with naming(run.path / "figures"):
        run.figures()  # an unusable folder is an error before the episodes, not after
    config, checkpoint = policy.config, policy.checkpoint
    fires = fires or config.evaluation.episodes
    recorder = Recorder()
    results = evaluate.evaluate(
        config, policy.actor, fires=fires, report=report, watch=recorder.add
    )
    _draw(run, config, recorder.recording(policy.title), label)
    scenarios = evaluate.evaluation_scenarios(config)
    policies = next(iter(results.values()))
    content = {
        "method": config.method,
        "setup": config.setup,
        "world": config.world,
        "seed": config.seed,
        "start_seed": evaluate.START_SEED,
        "checkpoint": checkpoint.name,
        "step": 0 if checkpoint.name == FOREIGN else read_header(checkpoint).step,
        "fires": fires,
        "held_out": {name: fires_of(scenarios[name]).describe(fires) for name in results},
        "environment": asdict(config.env),
        "communication": {
            name: config.comm if name == LEARNED else evaluate.scripted_config(config, name).comm
            for name in policies
        },
        "message_fault": config.evaluation.message_fault,
        "device": config.device,
        "versions": versions(),
        "results": results,
    }
    run.write(f"eval{label}.json", content)  # last: an evaluation with this file is complete
    return results


def _draw(run: RunFolder, config: RunConfig, episode: Recording, label: str) -> None:
    if lines := run.metrics():
        title = f"{config.method}, setup {config.setup}, fire {config.fire.name}"
        with run.figure("training.png") as path:
            training_curves(path, lines, title)
    name = evaluate.shown_scenario(config)
    with run.figure(f"episode_{name}{label}.gif") as path:
        screen = Screen([episode], size=480)
        write_gif(path, map(screen.picture, even_steps(config.env.horizon, 100)))
    with run.figure(f"timelapse_{name}{label}.png") as path:
        timelapse(path, episode)
    with run.figure(f"replay{label}.html") as path:
        Replay([episode], f"{name}:0").save(path)


def training_curves(path: Path, lines: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draws the paper's figures 5 to 9 for one run as PNG.

    Keys of `lines`, as in metrics.jsonl, are measures of the exploring policy, and "fire/measure"
    for the frozen policy on validation fires.
    """
    figure = Figure(figsize=(11, 6), layout="constrained")
    figure.suptitle(title)
    table = pd.DataFrame(lines).set_index("episode")
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, CURVES.items(), strict=True):
        axes.plot(table[name], color="0.6", label="with noise")
        for key, values in table.filter(regex=f"/{name}$").items():
            shown = f"without noise, {str(key).partition('/')[0]}"
            axes.plot(values.dropna(), marker="o", ms=3, label=shown)
        axes.set(xlabel="episode", ylabel=label)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    for text in figure.axes[0].legend(fontsize="small").get_texts():
        text.set_parse_math(False)
    figure.savefig(path, format="png", dpi=120)


def timelapse(path: Path, episode: Recording) -> None:
    """Draws a row of up to five steps of an episode as PNG, as in the paper's figure 3."""
    steps = even_steps(episode.horizon, 5)
    figure = Figure(figsize=(2.4 * len(steps), 2.7), layout="constrained")
    for axes, step in zip(figure.subplots(1, len(steps), squeeze=False)[0], steps, strict=True):
        draw_step(axes, episode, step)
        axes.set_title(f"step {step}", fontsize="medium")
    figure.savefig(path, format="png", dpi=120)
