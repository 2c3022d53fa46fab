"""What a training says and leaves behind where a number is not finite: culprit, bundle, replay."""

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.learners.nan_guard import CARRIED, COLLECTED, LEARNT, WEIGHTS, Watch
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.run_folder import RunFolder

from . import state

if TYPE_CHECKING:
    from .trainer import Trainer

_PACKAGES = ("emberlink", "torch", "torchrl", "tensordict")
_COLLECTED = {
    "observation": "first observation of the episode",
    "action": "action",
    "next.observation": "observation",
    "next.reward": "reward",
}
"""what is remembered of a step, in the order in which one follows from the other"""
_OBSERVATIONS = (_COLLECTED["observation"], _COLLECTED["next.observation"])


@dataclass(frozen=True)
class Culprit:
    """The first number that was not finite, and where it was."""

    tensor: str
    """what it stands in, such as "reward" or "gradient of critic.second.weight\""""
    uav: int
    """whose, the first being 0"""
    seed: int
    """of whose team"""
    uavs: int
    """how many UAVs of all teams have one in this tensor"""
    environment: int | None
    """of the team, the first being 0, where the number is of one"""
    step: int
    """of the environments, counted through the run from 1"""
    update: int | None
    """counted through the run from 1; None for a number that was collected"""
    value: str
    """nan, inf, -inf, or one that is too large to be squared"""

    def __str__(self) -> str:
        where = "" if self.environment is None else f", environment {self.environment},"
        when = f"step {self.step}" + ("" if self.update is None else f", update {self.update}")
        more = "" if self.uavs == 1 else f" (and {self.uavs - 1} more)"
        return (
            f"{self.tensor} of UAV {self.uav}{more}, seed {self.seed}{where or ','} is "
            f"{self.value} at {when}"
        )


class Divergence(ValueError):
    """A training cannot go on: a number is not finite.

    Args:
        message: one line.
        culprit: the number.
        bundle: what reproduces it; None where it could not be written.
    """

    def __init__(self, message: str, culprit: Culprit, bundle: Path | None):
        super().__init__(message)
        self.culprit, self.bundle = culprit, bundle


def listen(env: TransformedEnv, watch: Watch) -> None:
    """Shows a watch what the UAVs observe before they communicate."""
    module: Any = env.transform.module
    module.register_forward_pre_hook(lambda _, given: watch.heard(given[0].get(keys.OBSERVATION)))


def found(trainer: "Trainer") -> Divergence:
    """Searches for what a training's watch has noticed, and writes the bundle."""
    place, steps, updates = trainer.learner.watch.found.tolist()
    step = trainer.begun[0] + steps + (place == COLLECTED)
    update = None if place == COLLECTED else trainer.begun[1] + updates + 1
    batch = _rows(trainer, step) if place == COLLECTED else trainer.learner.watch.batch
    assert batch is not None, "something was found in a batch"
    culprit = _search(trainer, place, batch, step, update)
    return _kept(trainer, place, batch, culprit)


def _kept(trainer: "Trainer", place: int, batch: TensorDictBase, culprit: Culprit) -> Divergence:
    try:
        bundle = _write(trainer, place, batch, culprit)
    except (OSError, ValueError) as error:
        return Divergence(f"{culprit}; nothing could be kept of it: {error}", culprit, None)
    return Divergence(f"{culprit}; what reproduces it is in {bundle}", culprit, bundle)


def carried(trainer: "Trainer", name: str, value: Tensor) -> Divergence:
    """What is to be said of a state that must not be saved, and the bundle.

    Args:
        name, value: of the tensor of the state that is not finite.
    """
    culprit = _carried(trainer, name, value, trainer.step + 1)
    batch = trainer.collector.carried.exclude(keys.ACTION)
    return _kept(trainer, CARRIED, batch, culprit)


def _carried(trainer: "Trainer", name: str, value: Tensor, step: int) -> Culprit:
    """Whose a number is in what a step begins with: a UAV's where [environments, uavs, ...]."""
    wrong = ~value.isfinite()
    place = wrong.nonzero()[0].tolist()
    uavs = trainer.config.env.num_uavs
    of_uavs = value.ndim > 1 and value.shape[:2] == (trainer.envs, uavs)
    text = name.replace("/", " ").replace(f"{keys.AGENTS}.", "")
    return Culprit(
        tensor=f"{text}, with which the step begins",
        uav=place[1] if of_uavs else 0,
        seed=trainer.configs[place[0] // trainer.config.num_envs if of_uavs else 0].seed,
        uavs=int(wrong.flatten(2).any(2).any(0).sum()) if value.ndim > 2 and of_uavs else 1,
        environment=place[0] % trainer.config.num_envs if of_uavs else None,
        step=step,
        update=None,
        value=f"{float(value[tuple(place)]):g}",
    )


def replay(bundle: Path | str, device: str = "cpu") -> Culprit | None:
    """Repeats the update of a bundle, or looks through the step that was collected.

    Args:
        bundle: a folder that a training has left.
        device: on which it is repeated.

    Returns:
        What is not finite, as the training named it; None where everything is finite this time.

    Raises:
        ValueError: one line: the folder holds no bundle.
    """
    from .trainer import Trainer

    folder = Path(bundle)
    trainer = Trainer(RunFolder(folder).config(device=device))
    header, weights = checkpoint_file.read(folder / "weights.safetensors")
    _, content = checkpoint_file.read(folder / "batch.safetensors")
    try:
        assert header is not None
        place, step, update = header["place"], header["bad_step"], header["bad_update"]
        trainer.updates = int(any(name.startswith("optimizer/") for name in weights))
        state.restore_learner(trainer, folder / "weights.safetensors", header, _grouped(weights))
        groups = _grouped(content)
        watch = trainer.learner.watch
        batch = state.nested(groups["batch"], 1, trainer.config.device)
        if place == CARRIED:
            return _replayed(trainer, groups["batch"], step)
        if place == COLLECTED:
            watch.own = groups["own"]["all"].to(trainer.config.device) if "own" in groups else None
            watch.collected(batch)
        else:
            trainer.learner.update(batch)
            place = int(watch.found[0]) or place
    except (AssertionError, KeyError, TypeError) as error:
        raise UserError(f"{folder}: not a bundle of a divergence: {error}") from None
    return _search(trainer, place, batch, step, update) if watch.look(wait=True) else None


def _replayed(trainer: "Trainer", content: Mapping[str, Tensor], step: int) -> Culprit | None:
    for name, value in content.items():
        if value.is_floating_point() and not value.isfinite().all():
            return _carried(trainer, f"carried/{name}", value, step)
    return None


def _rows(trainer: "Trainer", step: int) -> TensorDictBase:
    """What is remembered of a step, batch size [environments, teams * uavs]."""
    count, device = trainer.config.num_envs, trainer.config.device
    rows = torch.arange(count, device=device) + (step - 1) * count
    storage: Any = trainer.memory.storage
    return storage.get(rows % trainer.sampler.rows)


def _search(
    trainer: "Trainer", place: int, batch: TensorDictBase, step: int, update: int | None
) -> Culprit:
    """The first tensor that is not finite, in the order in which one follows from the other."""
    # The networks first: while all else is wrong for another reason, they are kept as they were.
    every = {**_networks(trainer), **_batch(place, batch)}
    if place != COLLECTED:
        every |= _learnt(trainer.learner.watch)
    for tensor, value in every.items():
        wrong = _wrong(value)
        if not wrong.any():
            continue
        collected = place == COLLECTED and tensor in _COLLECTED.values()
        chosen = wrong
        own = trainer.learner.watch.own
        if collected and tensor in _OBSERVATIONS and own is not None:
            # Who has it of itself, not who has heard it.
            own_wrong = wrong & _by_team(own, trainer.teams)
            chosen = own_wrong if own_wrong.any() else wrong
        uav = int(chosen.nonzero()[0])
        team, number = divmod(uav, trainer.config.env.num_uavs)
        environment, shown = _first(value[uav])
        return Culprit(
            tensor=tensor,
            uav=number,
            seed=trainer.configs[team].seed,
            uavs=int(wrong.sum()),
            environment=environment if collected else None,
            step=step,
            update=update,
            value=shown,
        )
    raise AssertionError("the watch has noticed what is not there")


def _networks(trainer: "Trainer") -> dict[str, Tensor]:
    """Weights, then targets, one row per UAV."""
    trained = trainer.learner.watch.trained
    found = {f"weight {name}": value for name, value in trained.items()}
    networks = {
        name.replace("_network_params.module", "").replace("value", "critic", 1): value
        for name, value in state.networks(trainer).items()
        if name.startswith("target_")
    }
    return found | {f"weight {name}": value for name, value in networks.items()}


def _batch(place: int, batch: TensorDictBase) -> dict[str, Tensor]:
    """A step's or an update's numbers, one row per UAV."""
    found = {
        name.replace(f"{keys.AGENTS}.", ""): value.transpose(0, 1)
        for name, value in state.flat(batch).items()
        if value.is_floating_point()
    }
    named = _COLLECTED if place == COLLECTED else {one: f"batch {one}" for one in _COLLECTED}
    return {text: found[name] for name, text in named.items()}


def _learnt(watch: Watch) -> dict[str, Tensor]:
    """Losses, then the norms of gradients as they were made: from the last layer to the first."""
    assert watch.losses is not None, "there was an update"
    assert watch.gradients is not None, "there was an update"
    found = {"critic's loss": watch.losses[1], "actor's loss": watch.losses[0]}
    gradients = list(zip(watch.trained, watch.gradients, strict=True))[::-1]
    return found | {f"gradient of {name}": value for name, value in gradients}


def _wrong(value: Tensor) -> Tensor:
    """Whose part of a tensor [uavs, ...] is not finite, or too large to be squared: bool [uavs]."""
    flat = value.detach().reshape(len(value), -1)
    wrong = ~flat.isfinite().all(1)
    if not wrong.any():
        wrong = ~torch.linalg.vector_norm(flat, dim=1).isfinite()
    if not wrong.any() and not torch.linalg.vector_norm(flat).isfinite():
        wrong[flat.abs().amax(1).argmax()] = True  # only all together
    return wrong


def _first(value: Tensor) -> tuple[int, str]:
    """The first number of a tensor [rows, ...] that is not finite, else the largest: row, text."""
    flat = value.detach().reshape(len(value) if value.ndim else 1, -1)
    wrong = ~flat.isfinite()
    index = int(wrong.flatten().nonzero()[0] if wrong.any() else flat.abs().argmax())
    number = float(flat.flatten()[index])
    return index // flat.shape[1], f"{number:g}"


def _by_team(own: Tensor, teams: int) -> Tensor:
    """[teams * environments, uavs] -> [teams * uavs], whether in any environment."""
    return own.unflatten(0, (teams, -1)).any(1).flatten()


def _write(trainer: "Trainer", place: int, batch: TensorDictBase, culprit: Culprit) -> Path:
    """Writes a bundle to a new folder of the first seed's run."""
    stem = f"divergence_step_{culprit.step}"
    whole = free_name(trainer.run.path, stem, ["", ".part"])
    folder = whole.with_name(whole.name + ".part")
    folder.mkdir()
    watch = trainer.learner.watch
    content = {f"batch/{name}": value for name, value in state.flat(batch).items()}
    if place == COLLECTED and watch.own is not None:
        content["own/all"] = watch.own
    header = {
        **state.counters(trainer),
        "kind": "divergence",
        "place": place,
        "bad_step": culprit.step,
        "bad_update": culprit.update,
    }
    learner = state.learner(trainer)
    checkpoint_file.write(folder / "batch.safetensors", content, header)
    checkpoint_file.write(folder / "weights.safetensors", learner, header)
    RunFolder(folder).write_config(trainer.config)
    shown = {**content, **learner}
    if place in (LEARNT, WEIGHTS):
        shown |= _learnt(watch)
    report = {
        "culprit": asdict(culprit),
        "message": str(culprit),
        "versions": {name: version(name) for name in _PACKAGES}
        | {"python": platform.python_version(), "platform": platform.platform()},
        "device": str(trainer.config.device),
        "learning_rates": [group["lr"] for group in trainer.learner.optimizer.param_groups],
        "ranges": {name: _range(value) for name, value in shown.items()},
        "config": to_values(trainer.config),
    }
    RunFolder(folder).write("report.json", report)
    folder.rename(whole)
    return whole


def _range(value: Tensor) -> dict[str, Any]:
    """Lowest and highest finite number of a tensor, and how many are not."""
    value = value.detach().double()
    finite = value[value.isfinite()]
    ends = [finite.min().item(), finite.max().item()] if finite.numel() else None
    return {"finite": ends, "not_finite": value.numel() - finite.numel()}


def _grouped(content: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    groups: dict[str, dict[str, Tensor]] = {}
    for name, value in content.items():
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest] = value
    return groups
