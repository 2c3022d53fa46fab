"""All that a training has become, as tensors by name and a few numbers; and back.

What is not here is a function of the configuration: the fires, the initial weights, and every
random number, which is a hash of a seed and of counters that are here.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from emberlink.envs import keys, metrics
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.policies.exploration import NOISE

from . import state_checks, state_header
from .state_header import Header

if TYPE_CHECKING:
    from .trainer import Trainer

_GROUPS = (
    *("networks", "optimizer", "memory", "carried", "world", "communication"),
    *("moments", "losses"),
)
_LARGEST_STEP = 2**24
"""to which Adam can count, in float32"""


def tensors(trainer: "Trainer") -> dict[str, Tensor]:
    """Copies of everything that changes with the steps, "group/name" -> tensor."""
    groups: dict[str, Mapping[str, Tensor]] = {
        "networks": networks(trainer),
        "optimizer": _optimizer(trainer),
        # The action is chosen anew.
        "carried": flat(trainer.collector.carried.exclude(keys.ACTION)),
        "world": trainer.env.base_env.state_dict(),
        "communication": trainer.env.transform.state_dict(),
    }
    if trainer.moments:
        groups["moments"] = flat(_joined(trainer.moments))
    if trainer.losses:
        groups["losses"] = {"all": torch.stack(trainer.losses)}
    found = {
        f"{group}/{name}": value.detach().clone()
        for group, content in groups.items()
        for name, value in content.items()
    }
    filled = len(trainer.memory)
    if filled:  # by far the most: not copied
        rows: Any = trainer.memory.storage[:filled]
        found |= {f"memory/{name}": value for name, value in flat(rows).items()}
    return found


def not_finite(content: Mapping[str, Tensor]) -> str | None:
    """The first of a state's tensors that holds what none may hold, if any."""
    # Fires hold infinity, and their margin NaN; they are compared.
    of_fires = f"world/{state_checks.ARRIVAL}"
    return next(
        (
            name
            for name, value in content.items()
            if name != of_fires and value.is_floating_point() and not value.isfinite().all()
        ),
        None,
    )


def counters(trainer: "Trainer") -> dict[str, Any]:
    """The numbers that go with `tensors`."""
    return {
        "step": trainer.step,
        "updates": trainer.updates,
        "draws": int(trainer.sampler.draws),
        "rows": len(trainer.memory),
        "losses": len(trainer.losses),
        "rate": trainer.rate,
        "tries": trainer.tries,
        "furthest": trainer.furthest,
    }


def restore(trainer: "Trainer", path: Path, header: Mapping[str, Any], content: dict) -> None:
    """Puts a training that was just built where another one was.

    Everything is written into the tensors that there are, on their device.

    Args:
        trainer: of the same configuration.
        path: of the checkpoint, for messages.
        header, content: what `counters` and `tensors` gave.

    Raises:
        ValueError: something is missing, unknown, out of range, of another shape or type, or NaN.
    """
    made = state_header.parse(path, header)
    state_header.check(path, made, trainer)
    groups = _grouped(path, content)
    if name := not_finite(content):
        raise UserError(f"{path}: {shown(name)} holds NaN or infinite numbers")
    trainer.step, trainer.updates = made.step, made.updates
    begun: Any = (made.step, made.updates)
    trainer.begun = begun
    trainer.episode = trainer.step // trainer.config.env.horizon
    restore_learner(trainer, path, header, groups)
    _check_adam(trainer, path, groups["optimizer"])
    world = state_checks.begin_episode(trainer)
    _check_shapes(path, "world", world, groups["world"])
    state_checks.check(path, groups["world"], trainer)
    _copy(path, "world", world, groups["world"])
    _copy(path, "communication", trainer.env.transform.state_dict(), groups["communication"])
    _restore_memory(trainer, path, made, groups["memory"])
    if trainer.step:  # before the first one there is no noise yet, and nothing else to carry
        carried = _carried(trainer, path, groups["carried"])
        state_checks.check_carried(path, groups["carried"], groups["world"])
        trainer.collector.go_on(carried, trainer.step)
    _restore_episode(trainer, path, made, groups)
    trainer.best, trainer.seconds = list(made.best), made.seconds


def _grouped(path: Path, content: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    groups: dict[str, dict[str, Tensor]] = {group: {} for group in _GROUPS}
    for name, value in content.items():
        group, _, rest = name.partition("/")
        if group not in groups:
            raise UserError(f"{path}: holds {shown(name)}, which no state has")
        groups[group][rest] = value
    return groups


def learner(trainer: "Trainer") -> dict[str, Tensor]:
    """What an update changes, "group/name" -> tensor: networks, targets, optimisers."""
    groups = {"networks": networks(trainer), "optimizer": _optimizer(trainer)}
    return {
        f"{group}/{name}": value
        for group, content in groups.items()
        for name, value in content.items()
    }


def restore_learner(
    trainer: "Trainer", path: Path, header: Mapping[str, Any], groups: Mapping[str, dict]
) -> None:
    """Puts networks, targets and optimisers where others were, and the learning rates.

    Raises:
        ValueError: something is missing, is of another shape or type, or out of range.
    """
    _copy(path, "networks", networks(trainer), groups.get("networks", {}))
    _restore_optimizer(trainer, path, groups.get("optimizer", {}))
    # States from before there were rollbacks have no rate.
    rate, tries, furthest = (
        header.get(name, value) for name, value in (("rate", 1.0), ("tries", 0), ("furthest", 0))
    )
    if not 0 < rate <= 1 or not all(isinstance(one, int) and one >= 0 for one in (tries, furthest)):
        raise UserError(f"{path}: rate={rate}, tries={tries}, furthest={furthest}: out of range")
    trainer.rate, trainer.tries, trainer.furthest = float(rate), tries, furthest
    trainer.learner.slow_down(trainer.rate)


def networks(trainer: "Trainer") -> dict[str, Tensor]:
    """The networks of all seeds and their targets, as they lie in memory."""
    state = trainer.learner.loss.state_dict()
    return {name: value for name, value in state.items() if "_params." in name}


def flat(tree: TensorDictBase) -> dict[str, Tensor]:
    return {
        key if isinstance(key, str) else ".".join(key): value
        for key, value in tree.items(include_nested=True, leaves_only=True)
    }


def _joined(moments: list[TensorDictBase]) -> TensorDictBase:
    parts: Any = moments
    joined: Any = torch.cat(parts, dim=1)
    return joined


def nested(content: Mapping[str, Tensor], dims: int, device: torch.device | str) -> TensorDict:
    batch = next(iter(content.values())).shape[:dims]
    tree = TensorDict({}, batch_size=batch, device=device)
    for name, value in content.items():
        key: Any = tuple(name.split("."))
        tree.set(key, value.to(device))
    agents: Any = tree.get(keys.AGENTS, None)
    if agents is not None:
        agents.batch_size = next(iter(agents.values())).shape[: dims + 1]
    return tree


def _copy(path: Path, group: str, place: Mapping[str, Tensor], found: dict[str, Tensor]) -> None:
    _check_shapes(path, group, place, found)
    with torch.no_grad():
        for name, value in place.items():
            value.copy_(found[name])


def _optimizer(trainer: "Trainer") -> dict[str, Tensor]:
    state = trainer.learner.optimizer.state_dict()["state"]
    return {f"{index}.{key}": value for index, of in state.items() for key, value in of.items()}


def _restore_optimizer(trainer: "Trainer", path: Path, found: dict[str, Tensor]) -> None:
    optimizer = trainer.learner.optimizer
    parameters = [one for group in optimizer.param_groups for one in group["params"]]
    places: dict[str, Tensor] = {}
    for index, one in enumerate(parameters if trainer.updates else ()):
        of = {"step": torch.zeros(()), "exp_avg": one, "exp_avg_sq": one}
        places |= {f"{index}.{key}": value for key, value in of.items()}
    _check_shapes(path, "optimizer", places, found)
    state: dict[int, dict[str, Tensor]] = {}
    for name in places:
        index, _, key = name.partition(".")
        state.setdefault(int(index), {})[key] = found[name]
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def _check_adam(trainer: "Trainer", path: Path, found: Mapping[str, Tensor]) -> None:
    """That Adam has counted the updates, and that squares are no less than 0."""
    counted = min(trainer.updates, _LARGEST_STEP)
    for name, value in found.items():
        if name.endswith(".step") and value.item() != counted:
            raise UserError(f"{path}: optimizer/{name} is not {counted}, the number of updates")
        if name.endswith(".exp_avg_sq") and (value < 0).any():
            raise UserError(f"{path}: optimizer/{name} holds a number below 0")


def _check_shapes(
    path: Path, group: str, places: Mapping[str, Tensor], found: Mapping[str, Tensor]
) -> None:
    """That a group holds what it must, and nothing else."""
    for name in found:
        if name not in places:
            raise UserError(f"{path}: holds {shown(f'{group}/{name}')}, which this state has not")
    for name, place in places.items():
        if name not in found:
            raise UserError(f"{path}: holds no {group}/{name}")
        new = found[name]
        if new.shape != place.shape or new.dtype != place.dtype:
            raise UserError(
                f"{path}: {group}/{name} has shape {list(new.shape)}, {new.dtype}; this version "
                f"needs {list(place.shape)}, {place.dtype}"
            )


def _restore_memory(
    trainer: "Trainer", path: Path, header: Header, found: dict[str, Tensor]
) -> None:
    memory, rows = trainer.memory, trainer.sampler.rows
    written = trainer.step * trainer.config.num_envs
    places = _memory_places(trainer, header.rows) if written else {}
    _check_shapes(path, "memory", places, found)
    if written:
        content = nested(found, 2, trainer.config.device)
        memory.extend(content)
        # Of a memory that has come round, once more: the next row goes behind the newest.
        if written > rows and written % rows:
            memory.extend(content[: written % rows])
    trainer.sampler.draws.fill_(header.draws)


def _memory_places(trainer: "Trainer", rows: int) -> dict[str, Tensor]:
    """What a memory of so many rows holds, without taking the room."""
    uavs = trainer.teams * trainer.config.env.num_uavs
    observation = trainer.env.observation_spec[keys.OBSERVATION].shape[-1]
    action = trainer.env.full_action_spec[keys.ACTION].shape[-1]

    def place(features: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(rows, uavs, features, dtype=dtype, device="meta")

    return {
        "observation": place(observation),
        "action": place(action),
        "next.observation": place(observation),
        "next.reward": place(1),
        "next.done": place(1, torch.bool),
        "next.terminated": place(1, torch.bool),
    }


def _restore_episode(
    trainer: "Trainer", path: Path, header: Header, groups: Mapping[str, dict]
) -> None:
    """What is known of the episode that is not finished."""
    config, device = trainer.config, trainer.config.device
    moments, losses = groups["moments"], groups["losses"]
    time = trainer.step % config.env.horizon
    _check_shapes(path, "moments", _moment_places(trainer, time) if time else {}, moments)
    if time:
        trainer.moments = [nested(moments, 2, device)]
    shape = header.losses, 2, trainer.teams * config.env.num_uavs
    places = {"all": torch.empty(shape, device="meta")} if header.losses else {}
    _check_shapes(path, "losses", places, losses)
    if header.losses:
        trainer.losses = list(losses["all"].to(device).unbind(0))


def _moment_places(trainer: "Trainer", time: int) -> dict[str, Tensor]:
    """What is measured of so many steps of an episode, without taking the room."""
    one = flat(trainer.env.fake_tensordict().get("next").select(*metrics.STEP_KEYS))
    return {
        name: torch.empty(len(value), time, *value.shape[1:], dtype=value.dtype, device="meta")
        for name, value in one.items()
    }


def _carried(trainer: "Trainer", path: Path, found: dict[str, Tensor]) -> TensorDict:
    """The carried moment: what the environment's reset gives, and the noise."""
    places = flat(trainer.collector.carried.exclude(keys.ACTION))
    shape = trainer.env.full_action_spec[keys.ACTION].shape
    places[".".join(NOISE)] = torch.empty(shape, device="meta")
    _check_shapes(path, "carried", places, found)
    return nested(found, 1, trainer.config.device)
