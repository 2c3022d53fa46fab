"""Converts TensorDicts and optimizers to tensors by name, and back."""

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from emberlink.envs import keys


def flatten(tree: TensorDictBase) -> dict[str, Tensor]:
    """Returns the leaves of a TensorDict by name; nested keys are joined by dots."""
    return dict(tree.flatten_keys(".").items())


def unflatten(tensors: Mapping[str, Tensor], dims: int, device: torch.device | str) -> TensorDict:
    """Reverses `flatten`.

    Args:
        dims: number of batch dimensions; entries under "agents" have one more, for the UAVs.
    """
    batch = next(iter(tensors.values())).shape[:dims]
    tree = TensorDict({}, batch_size=batch, device=device)
    for name, value in tensors.items():
        tree.set(tuple(name.split(".")), value.to(device))
    for place in (keys.AGENTS, ("next", keys.AGENTS)):
        agents = tree.get(place, None)
        if agents is not None:
            agents.batch_size = next(iter(agents.values(True, True))).shape[: dims + 1]
    return tree


def prefixed(**groups: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the tensors of several groups as one mapping, "group/name" -> tensor."""
    return {
        f"{group}/{name}": value
        for group, tensors in groups.items()
        for name, value in tensors.items()
    }


def group(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    """Returns the tensors of one group of `prefixed`, without the prefix."""
    start = f"{name}/"
    return {
        key.removeprefix(start): value for key, value in tensors.items() if key.startswith(start)
    }


def copy_into(places: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> None:
    """Copies tensors into existing ones of the same names, on their device.

    Raises:
        ValueError: a tensor is missing, not known, or of another shape or type.
    """
    check_like(places, tensors)
    with torch.no_grad():
        for name, place in places.items():
            place.copy_(tensors[name])


def check_like(places: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> None:
    """Checks that tensors have the names, shapes and types of existing ones.

    Raises:
        ValueError: a tensor differs; the message names the first one.
    """
    for name in [*places, *tensors]:
        if name not in tensors or name not in places:
            raise ValueError(f"tensor {name} is {'missing' if name in places else 'not known'}")
        place, tensor = places[name], tensors[name]
        if tensor.shape != place.shape or tensor.dtype != place.dtype:
            raise ValueError(
                f"tensor {name} has shape {list(tensor.shape)}, {tensor.dtype}; expected "
                f"{list(place.shape)}, {place.dtype}"
            )


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Returns the state of an optimizer, "parameter index.key" -> tensor."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{key}": value for index, of in state.items() for key, value in of.items()}


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Restores the state of `optimizer_tensors`; the parameter groups do not change."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        index, _, key = name.partition(".")
        state.setdefault(int(index), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
