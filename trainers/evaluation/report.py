"""Evaluates the frozen policy of a run and writes eval.json, figures, a GIF and a replay."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from emberlink.envs.rendering.film import write_gif
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import evaluate, plots
from emberlink.trainers.evaluation.episodes import recorder_of, title_of
from emberlink.trainers.evaluation.results import LEARNED, Results
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.recording import Episode
from emberlink.trainers.replay.screen import Screen, even_steps
from emberlink.trainers.runs.checkpoint import read_header
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.versions import versions
from emberlink.trainers.terminal.console import OutputError


def evaluate_run(
    run: RunFolder,
    config: RunConfig,
    actor: evaluate.Policy,
    *,
    checkpoint: Path,
    fires: int,
    report: Callable[[str], None],
    label: str = "",
    about: Sequence[str] = (),
) -> Results:
    """Evaluates a frozen policy and writes eval.json, the figures, a GIF and a replay.

    Args:
        run: folder of the files.
        config: configuration of the run.
        actor: the frozen policy.
        checkpoint: file of the policy.
        fires: number of test fires, one episode each.
        report: called with a line of text before each part of the work.
        label: suffix of the file names.
        about: texts that the title of the replay names, such as changed settings.

    Raises:
        UserError: a file cannot be written.
    """
    try:
        run.figures()  # an unusable folder is an error before the episodes, not after
        recorder = recorder_of(config, actor)
        results = evaluate.evaluate(
            config,
            actor,
            fires=fires,
            report=lambda fire, policy: report(f"{policy} on {_fires(fires)} of {fire}"),
            watch=recorder.add,
        )
        shown = Episode(title=title_of(config, *about), recording=recorder.recording())
        _draw(run, config, results, shown, label)
    except OutputError:
        raise
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"{run.path / 'figures'}: cannot be written: {why}") from None
    # Written last: an evaluation with this file is complete.
    step = read_header(checkpoint).step
    content = record(config, results, checkpoint=checkpoint.name, step=step, fires=fires)
    run.write(f"eval{label}.json", content)
    return results


def _fires(count: int) -> str:
    return f"{count} fire{'s' * (count > 1)}"


def _draw(
    run: RunFolder, config: RunConfig, results: Results, episode: Episode, label: str
) -> None:
    with run.figure(f"coverage{label}.png") as path:
        plots.coverage_bars(path, results)
    lines = run.metrics()
    if lines:
        title = f"{config.method}, setup {config.setup}, fire {config.fire.name}"
        with run.figure("training.png") as path:
            plots.training_curves(path, lines, title)
    name = evaluate.shown_scenario(config)
    with run.figure(f"episode_{name}{label}.gif") as path:
        screen = Screen([episode], size=480)
        write_gif(path, map(screen.picture, even_steps(config.env.horizon, 100)))
    with run.figure(f"timelapse_{name}{label}.png") as path:
        plots.timelapse(path, episode.recording)
    with run.figure(f"replay{label}.html") as path:
        Replay([episode], f"{name}:0").save(path)


def record(config: RunConfig, results: Results, **about: Any) -> dict[str, Any]:
    """Returns the content of eval.json: the measures of all episodes and the settings.

    Args:
        config: configuration of the run.
        results: of `evaluate.evaluate`.
        about: other entries.
    """
    configs = evaluate.evaluation_scenarios(config)
    count = len(next(iter(results.values()))[LEARNED]["coverage"])
    return {
        "method": config.method,
        "setup": config.setup,
        "world": config.world,
        "seed": config.seed,
        "start_seed": evaluate.START_SEED,
        **about,
        "start_seeds": list(range(evaluate.START_SEED, evaluate.START_SEED + count)),
        "held_out": {name: fires_of(configs[name]).describe(count) for name in results},
        "environment": asdict(config.env),
        "communication": {
            name: config.comm if name == LEARNED else evaluate.scripted_config(config, name).comm
            for name in next(iter(results.values()))
        },
        "device": config.device,
        "versions": versions(),
        "results": results,
    }
