"""Evaluates a run's frozen policy and leaves table, eval.json, figures and an animation."""

import platform
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from emberlink.envs.rendering.frame import write_gif
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

from . import evaluate, plots

_PACKAGES = ("emberlink", "torch", "torchrl", "tensordict", "numpy")


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

    results = evaluate.evaluate(config, actor, fires=fires, report=say)
    try:
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
    plots.coverage_bars(run.figure(f"coverage{label}.png"), results)
    lines = run.lines()
    if lines:
        title = f"{config.method}, setup {config.setup}, fire {config.fire.name}"
        plots.training_curves(run.figure("training.png"), lines, title)
    report("one episode for the animation")
    name, arrival = evaluate.shown_fire(config)
    pictures, steps = evaluate.film(config, actor, fire=arrival)
    write_gif(run.figure(f"episode_{name}{label}.gif"), pictures)
    plots.timelapse(run.figure(f"timelapse_{name}{label}.png"), pictures, steps)


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
