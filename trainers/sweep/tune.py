"""Runs `emberlink tune`: chooses settings by validation fires, with Optuna."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from emberlink.envs import metrics
from emberlink.envs.utils import config_files
from emberlink.envs.utils.atomic_io import read_bytes, user_path
from emberlink.envs.utils.errors import UserError, naming, require
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.scores import validated
from emberlink.trainers.runs.run_folder import MAX_YAML
from emberlink.trainers.terminal.signals import Interruption
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Progress, Trainer


def tune(
    method: str, overrides: Sequence[str], console: Console, *, space: Path | None, trials: int
) -> int:
    """Trains a method with settings that Optuna chooses, and prints the best ones.

    A trial is a run, whose value is the headline measure of its last validation. A trial that is
    below the median of the earlier ones at a validation is stopped. Test fires are not played. The
    same command continues, in `output/tune_METHOD_SETUP_WORLD`.

    Args:
        space: a file with the settings to try; the learner's file of configs/space if None.
        trials: number of trials, with the trials of earlier commands.
    """
    require("optuna", "tune", "tune")
    import optuna
    from optuna.storages.journal import JournalFileBackend

    config = resolve(method, overrides)
    if not config.evaluation.interval:
        raise UserError("evaluation.interval=0: tune chooses by validations, and there are none")
    given = {text.partition("=")[0] for text in overrides}
    ranges = {key: of for key, of in _space(config, space).items() if key not in given}
    headline = config.evaluation.headline
    folder = user_path(config.output) / f"tune_{method}_{config.setup}_{config.world}"
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    states, journal = optuna.trial.TrialState, JournalFileBackend(str(folder / "optuna.log"))
    study = optuna.create_study(
        storage=optuna.storages.JournalStorage(journal),
        study_name="emberlink",
        direction="maximize" if headline in metrics.HIGHER_IS_BETTER else "minimize",
        load_if_exists=True,
    )
    # Of a seed alone, the sampler would repeat the first draws of the earlier command.
    study.sampler = optuna.samplers.TPESampler(seed=config.seed + len(study.trials))
    for old in study.get_trials(states=(states.RUNNING,)):
        study.tell(old.number, state=states.FAIL)
        study.enqueue_trial(old.params, user_attrs=old.user_attrs)
    while len(done := study.get_trials(states=(states.COMPLETE, states.PRUNED))) < trials:
        trial = study.ask(ranges)
        chosen = [f"{key}={value}" for key, value in trial.params.items()]
        trainer = _trainer(trial, method, [*overrides, *chosen, f"output={folder}"])
        pruned = False

        def report(state: Progress, trial: Any = trial, trainer: Trainer = trainer) -> None:
            nonlocal pruned
            value = validated(state.line, headline)
            if value is not None and not state.step % config.env.horizon:
                trial.report(value, state.episode)
                if pruned := bool(trial.should_prune()):
                    trainer.stop()

        interruption = Interruption(trainer.stop)
        try:
            with interruption:
                trainer.train(report)
        finally:
            trainer.close()
        if interruption.received:
            console.print("stopped; the same command continues", soft_wrap=True)
            return interruption.status
        value = validated(trainer.run.metrics()[-1], headline)
        study.tell(trial, None if pruned else value, states.PRUNED if pruned else None)
        text = f"trial {len(done) + 1} of {trials}: {' '.join(chosen)}: {headline} {value:.1f}"
        console.print(text + ", stopped early" * pruned, soft_wrap=True, highlight=False)
    best = study.best_trial
    settings = " ".join([*overrides, *(f"{key}={value}" for key, value in best.params.items())])
    line = f"best: {headline} {best.value:.1f}: emberlink train {method} {settings}"
    console.print(line, soft_wrap=True, highlight=False)
    return 0


def _space(config: RunConfig, file: Path | None) -> dict[str, Any]:
    """Returns the settings to try: key -> distribution."""
    file = file or config_files.find("space", config.learner.name)
    with naming(file, yaml.YAMLError, AttributeError):
        ranges = yaml.safe_load(read_bytes(file, MAX_YAML))
        return {key: _distribution(key, values) for key, values in ranges.items()}


def _distribution(key: str, values: Any) -> Any:
    """Returns Optuna's distribution of a list, or of low, high and log."""
    from optuna import distributions as of

    if isinstance(values, list):
        return of.CategoricalDistribution(values)
    if not isinstance(values, Mapping) or not {"low", "high"} <= values.keys():
        raise UserError(f"{key}: {shown(values)}: expected a list, or low and high")
    low, high = values["low"], values["high"]
    whole = isinstance(low, int) and isinstance(high, int)
    kind = of.IntDistribution if whole else of.FloatDistribution
    return kind(low, high, log=bool(values.get("log")))


def _trainer(trial: Any, method: str, overrides: Sequence[str]) -> Trainer:
    """Returns the training of a trial, new or resumed in the run folder that the trial names."""
    if run := trial.user_attrs.get("run"):
        return resume(run)
    trainer = Trainer(resolve(method, overrides))
    trial.set_user_attr("run", str(trainer.start().path))
    return trainer
