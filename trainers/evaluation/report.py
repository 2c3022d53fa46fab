"""Evaluates a run's frozen policy and leaves table, eval.json, figures and an animation."""

import platform
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.table import Table
from tensordict.nn import TensorDictModule

from emberlink.envs import metrics
from emberlink.envs.rendering.frame import write_gif
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.build import build_env, build_networks
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.checkpoints import ACTOR, load_weights
from emberlink.trainers.runs.run_folder import RunFolder

from . import evaluate, plots

_PACKAGES = ("emberlink", "torch", "torchrl", "tensordict", "numpy")


def load_actor(config: RunConfig, checkpoint: Path) -> TensorDictModule:
    """The frozen policy of a run.

    Raises:
        ValueError: the checkpoint can't be read or is of another shape.
    """
    env = build_env(
        config,
        num_envs=1,
        fire=torch.full(config.env.grid, torch.inf),
        seed=0,
        device=config.device,
    )
    actor, _ = build_networks(config, env)
    network: Any = actor.module
    expected = {ACTOR + name: value for name, value in network.state_dict().items()}
    weights = load_weights(checkpoint, expected, config)
    network.load_state_dict({name.removeprefix(ACTOR): v for name, v in weights.items()})
    return actor.requires_grad_(False)


def evaluate_run(
    run: RunFolder,
    config: RunConfig,
    actor: evaluate.Policy,
    *,
    checkpoint: Path,
    fires: int,
    report: Callable[[str], None],
    label: str = "",
) -> evaluate.Results:
    """Evaluates a frozen policy and writes eval.json, the figures and one animation.

    Args:
        run: where everything is written.
        config: of the run.
        actor: the frozen policy.
        checkpoint: where it is from.
        fires: episodes, each on a held-out fire of its own.
        report: told what is being done.
        label: ends the names of the files, to keep them apart from those of the newest checkpoint.
    """

    def say(fire: str, policy: str) -> None:
        report(f"{policy} on {fires} fires of {fire}")

    try:
        run.figures()  # refused before the episodes are played, not after
        results = evaluate.evaluate(config, actor, fires=fires, report=say)
        _draw(run, config, actor, results, report, label)
    except OSError as error:
        raise UserError(
            f"{run.path / 'figures'}: cannot be written: {error.strerror or error}"
        ) from None
    # Last: with it, an evaluation is whole.
    run.write(f"eval{label}.json", record(config, results, checkpoint=checkpoint.name, fires=fires))
    return results


def _draw(
    run: RunFolder,
    config: RunConfig,
    actor: evaluate.Policy,
    results: evaluate.Results,
    report: Callable[[str], None],
    label: str,
) -> None:
    with run.figure(f"coverage{label}.png") as path:
        plots.coverage_bars(path, results)
    lines = run.lines()
    if lines:
        title = f"{config.method}, setup {config.setup}, fire {config.fire.name}"
        with run.figure("training.png") as path:
            plots.training_curves(path, lines, title)
    report("one episode for the animation")
    name, arrival = evaluate.shown_fire(config)
    pictures, steps = evaluate.film(config, actor, fire=arrival)
    with run.figure(f"episode_{name}{label}.gif") as path:
        write_gif(path, pictures)
    with run.figure(f"timelapse_{name}{label}.png") as path:
        plots.timelapse(path, pictures, steps)


def record(config: RunConfig, results: evaluate.Results, **about: Any) -> dict[str, Any]:
    """What eval.json holds: enough to redo any statistics without running anything."""
    configs = evaluate.evaluation_scenarios(config)
    count = len(next(iter(results.values()))[evaluate.LEARNED]["coverage"])
    return {
        "method": config.method,
        "setup": config.setup,
        "seed": config.seed,
        "start_seed": evaluate.START_SEED,
        **about,
        "start_seeds": list(range(evaluate.START_SEED, evaluate.START_SEED + count)),
        "held_out": {name: fires_of(configs[name]).about(count) for name in results},
        "environment": asdict(config.env),
        "communication": {
            evaluate.LEARNED: config.comm,
            **{name: evaluate.scripted_config(config, name).comm for name in SCRIPTED},
        },
        "device": config.device,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
        },
        "results": results,
    }


def print_table(console: Console, results: evaluate.Results, config: RunConfig) -> None:
    """The means over episodes: a table per fire, a row per policy, a column per measure."""
    for fire, by_policy in results.items():
        episodes = len(next(iter(by_policy.values()))["coverage"])
        table = Table(
            title=f"held-out fires: {fire} ({episodes} episodes, mean; setup {config.setup})",
            box=box.SIMPLE_HEAD,
            padding=0,
            show_edge=False,
        )
        # One word below the other: names and all measures fit a terminal of 80 columns.
        table.add_column(min_width=13)
        for name in metrics.NAMES:
            table.add_column(name.replace("_", "\n"), justify="right", no_wrap=True)
        for policy, measured in by_policy.items():
            learned = policy == evaluate.LEARNED
            means = evaluate.means(measured)
            table.add_row(
                config.method if learned else policy.replace("_", " "),
                *(_short(name, means[name]) for name in metrics.NAMES),
                style="bold" if learned else None,
            )
        console.print(table)


def _short(measure: str, value: float) -> str:
    """One decimal; of a score, which may be a small reward, as many as make four digits."""
    digits = max(1, 4 - len(str(int(abs(value))))) if measure == "mean_reward" else 1
    return f"{value:.{digits}f}"
