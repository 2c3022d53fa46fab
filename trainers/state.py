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
from emberlink.policies.noise import NOISE

from . import checkpoint as files

if TYPE_CHECKING:
    from .loop import Trainer

_FINITE = ("networks", "optimizer", "memory")
"""groups in which a number that is not finite is damage; fires hold infinity, edges NaN"""


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
        ValueError: something is missing, is of another shape or type, or is NaN.
    """
    groups: dict[str, dict[str, Tensor]] = {}
    for name, value in content.items():
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest] = value
        if group in _FINITE:
            files.check_finite(path, {name: value})
    env = trainer.env
    places = {
        "world": env.base_env.state_dict(),
        "communication": env.transform.state_dict(),
    }
    for group, place in places.items():
        _copy(path, group, place, groups.get(group, {}))
    trainer.step, trainer.updates = header["step"], header["updates"]
    trainer.begun = trainer.step, trainer.updates
    trainer.episode = trainer.step // trainer.config.env.horizon
    restore_learner(trainer, path, header, groups)
    _restore_memory(trainer, path, header, groups.get("memory", {}))
    if trainer.step:  # before the first one there is no noise yet, and nothing else to carry
        carried = _carried(trainer, path, groups.get("carried", {}))
        trainer.collector.go_on(carried, trainer.step)
    _restore_episode(trainer, path, header, groups)


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
        raise ValueError(f"{path}: rate={rate}, tries={tries}, furthest={furthest}: out of range")
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
    for name, value in place.items():
        if name not in found:
            raise ValueError(f"{path}: holds no {group}/{name}")
        new = found[name]
        if new.shape != value.shape or new.dtype != value.dtype:
            raise ValueError(
                f"{path}: {group}/{name} has shape {list(new.shape)}, {new.dtype}; this version "
                f"needs {list(value.shape)}, {value.dtype}"
            )
    with torch.no_grad():
        for name, value in place.items():
            value.copy_(found[name])


def _optimizer(trainer: "Trainer") -> dict[str, Tensor]:
    state = trainer.learner.optimizer.state_dict()["state"]
    return {f"{index}.{key}": value for index, of in state.items() for key, value in of.items()}


def _restore_optimizer(trainer: "Trainer", path: Path, found: dict[str, Tensor]) -> None:
    optimizer = trainer.learner.optimizer
    parameters = [one for group in optimizer.param_groups for one in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in found.items():
        index, _, key = name.partition(".")
        state.setdefault(int(index), {})[key] = value
    if state.keys() != set(range(len(parameters) if trainer.updates else 0)):
        raise ValueError(f"{path}: holds the optimiser's state of {len(state)} tensors")
    for index, of in state.items():
        one = parameters[index]
        places = {"step": torch.zeros(()), "exp_avg": one, "exp_avg_sq": one}
        _check_shapes(path, f"optimizer/{index}", places, of)
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def _check_shapes(
    path: Path, group: str, places: Mapping[str, Tensor], found: Mapping[str, Tensor]
) -> None:
    for name, place in places.items():
        if name not in found:
            raise ValueError(f"{path}: holds no {group}.{name}")
        if found[name].shape != place.shape or found[name].dtype != place.dtype:
            raise ValueError(
                f"{path}: {group}.{name} has shape {list(found[name].shape)}, "
                f"{found[name].dtype}; this version needs {list(place.shape)}, {place.dtype}"
            )


def _restore_memory(
    trainer: "Trainer", path: Path, header: Mapping[str, Any], found: dict[str, Tensor]
) -> None:
    memory, envs = trainer.memory, trainer.config.num_envs
    rows, written = trainer.sampler.rows, trainer.step * envs
    if header["rows"] != min(rows, written):
        raise ValueError(
            f"{path}: holds {header['rows']} rows of memory; after {trainer.step} steps there are "
            f"{min(rows, written)}"
        )
    if written:
        _check_shapes(path, "memory", _memory_places(trainer, header["rows"]), found)
        content = nested(found, 2, trainer.config.device)
        memory.extend(content)
        # Of a memory that has come round, once more: the next row goes behind the newest.
        if written > rows and written % rows:
            memory.extend(content[: written % rows])
    trainer.sampler.draws.fill_(header["draws"])


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
    trainer: "Trainer", path: Path, header: Mapping[str, Any], groups: Mapping[str, dict]
) -> None:
    """What is known of the episode that is not finished."""
    config, device = trainer.config, trainer.config.device
    moments, losses = groups.get("moments", {}), groups.get("losses", {})
    batch = (trainer.envs, trainer.step % config.env.horizon)
    if batch[1]:
        for key in metrics.STEP_KEYS:
            name = key if isinstance(key, str) else ".".join(key)
            if name not in moments or moments[name].shape[:2] != batch:
                raise ValueError(f"{path}: holds no moments/{name} of {batch[1]} steps")
        trainer.moments = [nested(moments, 2, device)]
    if header["losses"]:
        shape = header["losses"], 2, trainer.teams * config.env.num_uavs
        _check_shapes(path, "losses", {"all": torch.empty(shape, device="meta")}, losses)
        trainer.losses = list(losses["all"].to(device).unbind(0))


def _carried(trainer: "Trainer", path: Path, found: dict[str, Tensor]) -> TensorDict:
    """The carried moment: what the environment's reset gives, and the noise."""
    places = flat(trainer.collector.carried.exclude(keys.ACTION))
    shape = trainer.env.full_action_spec[keys.ACTION].shape
    places[".".join(NOISE)] = torch.empty(shape, device="meta")
    _check_shapes(path, "carried", places, found)
    return nested(found, 1, trainer.config.device)
