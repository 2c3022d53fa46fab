"""Reports the first NaN or Inf in training and writes a dump that reproduces it."""

import math
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name
from emberlink.trainers.learners.nan_guard import ROLLOUT
from emberlink.trainers.learners.tensors import flatten, group, prefixed, unflatten
from emberlink.trainers.rollout.finite_actions import NonFiniteActionError
from emberlink.trainers.rollout.products import fast_products
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.versions import versions
from emberlink.trainers.training.setup import TrainingSetup

_TENSORS = "tensors.safetensors"


FIRE_TIMES = ("_arrival_time", "_burn_out")
"""ends of the names of tensors that are inf where nothing burns and NaN in the margin"""


@dataclass(frozen=True)
class NonFiniteReport:
    """The first NaN or Inf in training and its place."""

    tensor: str
    """name of the tensor, such as "reward" or "gradient of critic.second.weight\""""
    uav: int | None
    """index of the UAV; None if the number belongs to several"""
    seed: int | None
    """seed of the team; None if the number belongs to several"""
    environment: int | None
    """index among the seed's environments; None for a loss or a gradient"""
    step: int
    """step of the run, counted from 1"""
    update: int | None
    """update of the run, counted from 1; None for a number in a rollout"""
    value: str
    """nan, inf, -inf, or a number whose square is too large"""

    def __str__(self) -> str:
        whose = "" if self.uav is None else f" of UAV {self.uav}"
        whose += "" if self.seed is None else f", seed {self.seed}"
        whose += "" if self.environment is None else f", environment {self.environment}"
        when = f"step {self.step}" + ("" if self.update is None else f", update {self.update}")
        return f"{self.tensor}{whose}{',' if whose else ''} is {self.value} at {when}"


class NonFiniteError(UserError):
    """Reports that training cannot continue because a number is NaN or infinite.

    Args:
        message: one line.
        report: the number and its place.
        dump: folder that reproduces it; None if it was not written.
    """

    def __init__(self, message: str, report: NonFiniteReport, dump: Path | None):
        super().__init__(message)
        self.report, self.dump = report, dump


def report_of(setup: TrainingSetup) -> NonFiniteReport:
    """Returns a report about the number that a setup's guard detected."""
    place, steps, updates = setup.guard.found()
    if place == ROLLOUT:
        return _in_rollout(setup, steps)
    named = {f"{name}'s loss": value for name, value in setup.guard.losses.items()}
    # From the last layer to the first, as gradients are computed.
    gradients = list(setup.guard.gradients.items())[::-1]
    named |= {f"gradient of {name}": value for name, value in gradients}
    for name, value in named.items():
        if value.isfinite().all():
            continue
        row = int((~value.isfinite()).nonzero()[0])
        uav, seed = _owner(setup, row, len(value))
        return NonFiniteReport(
            tensor=name,
            uav=uav,
            seed=seed,
            environment=None,
            step=steps,
            update=updates + 1,
            value=f"{float(value[row]):g}",
        )
    raise AssertionError("the guard has found a number that is finite")


def _in_rollout(setup: TrainingSetup, steps: int) -> NonFiniteReport:
    """Returns a report about the first non-finite number of a rollout.

    Tensors are searched in causal order: observation, teacher, action, position, reward.
    """
    assert setup.guard.rollout is not None, "a rollout was recorded"
    tensors = {
        name.replace(f"{keys.AGENTS}.", ""): value
        for name, value in flatten(setup.guard.rollout).items()
        if value.is_floating_point()
    }
    order = ("observation", "teacher", "action", "next.position", "next.reward")
    for name in sorted(tensors, key=lambda name: order.index(name) if name in order else 9):
        wrong = ~tensors[name].isfinite()
        if not wrong.any():
            if torch.linalg.vector_norm(tensors[name]).isfinite():
                continue
            wrong = tensors[name].abs() == tensors[name].abs().amax()
        # Dimensions: environments, steps, UAVs. The earliest step comes first.
        first = wrong.transpose(0, 1).nonzero()[0].tolist()
        step, environment, uav = first[:3]
        team, environment = divmod(environment, setup.config.num_envs)
        value = tensors[name].transpose(0, 1)[tuple(first)]
        text = f"{name} before the step" if name == "observation" else name.removeprefix("next.")
        return NonFiniteReport(
            tensor=text,
            uav=uav,
            seed=setup.seeds[team],
            environment=environment,
            step=steps + 1 + step,
            update=None,
            value=f"{float(value):g}",
        )
    raise AssertionError("the guard has found a number that is finite")


def first_non_finite(state: Mapping[str, Tensor]) -> str | None:
    """Returns the name of the first tensor of a setup's state that is not finite, or None."""
    for name, value in state.items():
        fires = name.endswith(FIRE_TIMES)
        if not fires and value.is_floating_point() and not value.isfinite().all():
            return name
    return None


def check(setup: TrainingSetup, run: RunFolder, *, wait: bool) -> None:
    """Checks what the guard has detected, and before something is written also the weights.

    Args:
        setup: the training.
        run: folder of a dump.
        wait: whether to wait for a GPU, and to check that the squares of weights are finite.

    Raises:
        NonFiniteError: a number is NaN or infinite.
    """
    if setup.guard.poll(wait=wait):
        raise error_of(setup, run)
    for name, value in setup.learner.networks().items() if wait else ():
        if not value.square().isfinite().all():
            _refuse(setup, name, torch.atleast_1d(value.detach()))


def _refuse(setup: TrainingSetup, name: str, weight: Tensor) -> NoReturn:
    """Raises an error about the first number of a weight whose square is not finite."""
    place = tuple((~weight.square().isfinite()).nonzero()[0].tolist())
    value = float(weight[place])
    stack = setup.learner.stack_dim(name)
    uav, seed = _owner(setup, place[stack], weight.shape[stack])
    report = NonFiniteReport(f"weight {name}", uav, seed, None, setup.step, None, f"{value:g}")
    reason = "; its square is infinite" if math.isfinite(value) else ""
    raise NonFiniteError(f"{report}{reason}; nothing was saved", report, None)


def _owner(setup: TrainingSetup, row: int, rows: int) -> tuple[int | None, int | None]:
    """Returns the UAV and the seed of a row of stacked networks or losses, where it has one."""
    uavs = setup.config.env.num_uavs
    of_uavs, of_seeds = rows == uavs * setup.teams, rows == setup.teams
    team = row // uavs if of_uavs else row
    return (row % uavs if of_uavs else None, setup.seeds[team] if of_uavs or of_seeds else None)


@contextmanager
def in_validation(setup: TrainingSetup, seed: int) -> Iterator[None]:
    """Reports an action of a validation that is not finite as an error of the training.

    Raises:
        NonFiniteError: the networks give an action that is NaN or infinite.
    """
    try:
        yield
    except NonFiniteActionError as error:
        report = NonFiniteReport(
            *("action in the validation", error.uav, seed, error.environment),
            *(setup.step, None, error.value),
        )
        raise NonFiniteError(f"{report}; nothing was saved", report, None) from None


def check_state(setup: TrainingSetup, state: Mapping[str, Tensor]) -> None:
    """Checks that a state is finite before it is saved.

    Raises:
        NonFiniteError: a tensor is not finite; no dump is written.
    """
    if name := first_non_finite(state):
        value = state[name]
        bad = float(value[~value.isfinite()][0])
        report = NonFiniteReport(name, None, None, None, setup.step, None, f"{bad:g}")
        raise NonFiniteError(f"{report}; no checkpoint was made", report, None)


def error_of(setup: TrainingSetup, run: RunFolder) -> NonFiniteError:
    """Writes a dump to a run folder and returns the error that ends the training."""
    report = report_of(setup)
    try:
        dump = _write(setup, run, report)
    except (OSError, UserError) as error:
        return NonFiniteError(f"{report}; its dump cannot be written: {error}", report, None)
    return NonFiniteError(f"{report}; {dump} reproduces it", report, dump)


def _write(setup: TrainingSetup, run: RunFolder, report: NonFiniteReport) -> Path:
    """Writes the rollout or batch, the learner's state before the update, and the report."""
    whole = free_name(run.path, f"divergence_step_{report.step}", ["", ".part"])
    folder = whole.with_name(whole.name + ".part")
    folder.mkdir()
    place, steps, _ = setup.guard.found()
    bad = setup.guard.rollout if place == ROLLOUT else setup.guard.batch
    assert bad is not None, "what was found has been recorded"
    learner = setup.learner.state_dict(transitions=False)
    updates = setup.learner.updates if report.update is None else report.update - 1
    header = {"kind": "divergence", "place": place, "steps": steps, "updates": updates}
    content = prefixed(learner=learner, bad=flatten(bad))
    checkpoint_file.write(folder / _TENSORS, content, header)
    config = setup.config
    kept = fires_of(config.fire).load_copy(run.path)  # the file itself may be gone
    fires_of(kept).save_copy(folder, config.env.grid, config.env.horizon)
    RunFolder(folder).write_config(config)
    about = {
        "report": asdict(report),
        "message": str(report),
        "versions": versions() | {"platform": platform.platform()},
        "device": str(setup.config.device),
    }
    RunFolder(folder).write("report.json", about)
    folder.rename(whole)
    return whole


def replay(dump: Path | str, device: str = "cpu") -> NonFiniteReport | None:
    """Repeats the update of a dump, or checks its rollout again.

    Args:
        dump: folder of the dump.
        device: device of the repetition.

    Returns:
        A report about the first non-finite number; None if all numbers are finite this time.

    Raises:
        UserError: the folder does not hold a dump.
    """
    folder = Path(dump)
    setup = TrainingSetup(RunFolder(folder).config(device=device))
    header, content = checkpoint_file.read(folder / _TENSORS)
    try:
        setup.learner.load_state_dict(group(content, "learner"))
        setup.learner.updates = header["updates"]
        setup.guard.start(header["steps"], header["updates"])
        rollout = header["place"] == ROLLOUT
        bad = unflatten(group(content, "bad"), 2 if rollout else 1, device)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{folder}: not a dump of a divergence: {error}") from None
    if rollout:
        setup.guard.record_rollout(bad, bad.shape[1])
    else:
        with fast_products():  # as in the training
            setup.learner.update(bad)
    return report_of(setup) if setup.guard.poll(wait=True) else None
