"""Evaluates a run's frozen policy and leaves table, eval.json, figures and an animation."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict.nn import TensorDictModule

from emberlink.envs import metrics
from emberlink.envs.render import write_gif

from . import evaluate, figures
from .build import build_env, build_networks
from .config import RunConfig
from .run_folder import RunFolder, load_weights

_ACTOR = "actor_network_params.module."
"""what the actor's weights are called in a checkpoint, before the name within the network"""


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
    expected = {_ACTOR + name: value for name, value in network.state_dict().items()}
    weights = load_weights(checkpoint, expected)
    network.load_state_dict({name.removeprefix(_ACTOR): v for name, v in weights.items()})
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

    results = evaluate.evaluate(config, actor, fires=fires, report=say)
    content = evaluate.record(config, results, checkpoint=checkpoint.name, fires=fires)
    run.write(f"eval{label}.json", content)
    figures.coverage_bars(run.figure(f"coverage{label}.png"), results)
    lines = run.lines()
    if lines:
        title = f"{config.method}, setup {config.setup}, fire {config.fire.name}"
        figures.training_curves(run.figure("training.png"), lines, title)
    report("one episode for the animation")
    name, arrival = next(iter(evaluate.evaluation_fires(config, fires).items()))
    pictures, steps = evaluate.film(config, actor, fire=arrival[0])
    write_gif(run.figure(f"episode_{name}{label}.gif"), pictures)
    figures.timelapse(run.figure(f"timelapse_{name}{label}.png"), pictures, steps)
    return results


def print_table(console: Console, results: evaluate.Results, config: RunConfig) -> None:
    """The means over episodes: a table per fire, a column per policy."""
    for fire, by_policy in results.items():
        episodes = len(next(iter(by_policy.values()))["coverage"])
        table = Table(title=f"held-out fires: {fire} ({episodes} episodes, mean)")
        table.add_column("measure")
        for policy in by_policy:
            name = f"{config.method} ({config.setup})" if policy == evaluate.LEARNED else policy
            table.add_column(name.replace("_", " "), justify="right")
        columns = [evaluate.means(measured) for measured in by_policy.values()]
        for name in metrics.NAMES:
            digits = 3 if name == "score" else 1
            table.add_row(name, *(f"{column[name]:.{digits}f}" for column in columns))
        console.print(table)
