"""Evaluates the frozen policy of a run and writes eval.json, figures, a GIF and a replay page."""

import argparse
import hashlib
import re
from collections.abc import Callable
from dataclasses import asdict
from functools import partial

from rich.console import Console

from emberlink.envs.rendering.film import write_gif
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError, naming
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import evaluate, figures
from emberlink.trainers.evaluation.foreign import FOREIGN, foreign_name, is_reference, new_run
from emberlink.trainers.evaluation.policy import TrainedPolicy, adopted, load_policy
from emberlink.trainers.evaluation.scores import LEARNED, Results, print_results, reporter
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Recorder, Recording
from emberlink.trainers.replay.screen import Screen, even_steps
from emberlink.trainers.runs.checkpoint import read_header, versions
from emberlink.trainers.runs.pretrained import open_run, read_run
from emberlink.trainers.runs.run_folder import RunFolder

_MAX_LABEL = 150
"""characters; a name of a file can have 255"""


def run_command(options: argparse.Namespace, console: Console) -> int:
    """Runs `emberlink eval`: evaluates a run, prints the table and returns 0."""
    changes, file = options.overrides, options.checkpoint
    if is_reference(options.folder) or options.name:
        (policy, run), changes = _new_run(options), []
    else:
        folder, device = read_run(options.folder), options.device
        policy = load_policy(folder, changes, checkpoint=file, device=device)
        run = open_run(options.folder)  # copies a trained policy of the package once all is checked
    parts = [file.stem] if file else []
    parts += [re.sub(r"[^\w.=+-]", "-", text) for text in changes]
    label = "".join(f"_{part}" for part in parts)
    if len(label) > _MAX_LABEL:
        label = f"{label[: _MAX_LABEL - 9]}_{hashlib.sha256(label.encode()).hexdigest()[:8]}"
    results = evaluate_run(run, policy, options.fires, report=reporter(console), label=label)
    print_results(console, results, policy.config, foreign_name(run))
    console.print(str(run.path), soft_wrap=True)
    return 0


def _new_run(options: argparse.Namespace) -> tuple[TrainedPolicy, RunFolder]:
    """Returns a policy that is evaluated with a method and a name, and its new run folder."""
    method, *settings = options.overrides or [""]
    if not method or "=" in method or not options.name or options.checkpoint:
        raise UserError(
            f"{options.folder}: expected emberlink eval {options.folder} METHOD [key=value ...] "
            "--name NAME; METHOD says which observations it reads"
        )
    settings += [f"device={options.device}"] if options.device else []
    policy, reference = adopted(options.folder, method, settings, name=options.name)
    return policy, new_run(reference, options.name, policy.config)


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
    play, failed = partial(evaluate.evaluate, config, fires=fires, report=report), ""
    try:
        results = play(policy.actor, watch=recorder.add)
    except UserError as error:
        if checkpoint.name != FOREIGN or not config.evaluation.scripted:
            raise
        results, failed = play(None), str(error)
    else:
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
        "failed": failed,
    }
    run.write(f"eval{label}.json", content)  # last: an evaluation with this file is complete
    if failed:
        raise UserError(f"{failed}; results of the others: {run.path / f'eval{label}.json'}")
    return results


def _draw(run: RunFolder, config: RunConfig, episode: Recording, label: str) -> None:
    if lines := run.metrics():
        title = f"{config.method}, setup {config.setup}, fire {config.fire.name}"
        with run.figure("training.png") as path:
            figures.training_curves(path, lines, title)
    name = evaluate.shown_scenario(config)
    with run.figure(f"episode_{name}{label}.gif") as path:
        screen = Screen([episode], size=480)
        write_gif(path, map(screen.picture, even_steps(config.env.horizon, 100)))
    with run.figure(f"timelapse_{name}{label}.png") as path:
        figures.timelapse(path, episode)
    with run.figure(f"replay{label}.html") as path:
        Replay([episode], f"{name}:0").save(path)
