"""Finds, writes and removes the checkpoints of a run folder, whose names hold the step."""

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import flat
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.seal import to_header, unsealed

_NUMBERED = re.compile(r"(state|step)_\d{9,18}\.safetensors")
_OF_NETWORKS = (
    *("policy.agent_index", "policy.memory", "policy.units", "policy.decisions"),
    *("learner.share_parameters", "learner.hidden", "learner.actor_of", "learner.name"),
    *("env.observation", "env.num_uavs"),
)
"""keys of settings on which the names and shapes of weights depend, besides those of `comm`"""
_PARTIAL = ("*.safetensors.[0-9]*.part", ".tmp*")  # safetensors writes to .tmp*


class Checkpoints:
    """The checkpoints of a run: networks (`step_N`), training states (`state_N`) and `best`.

    Files with other names, such as `step_mine.safetensors`, are ignored.
    """

    path: Path
    """the run folder"""

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints."""
        return self.path / "checkpoints"

    def own_checkpoints(self) -> Path:
        """Creates the folder of the checkpoints if it is missing, and returns it.

        Raises:
            UserError: it is a link or not a folder, or cannot be created.
        """
        try:
            return atomic_io.inner_folder(self.path, "checkpoints")
        except OSError as error:
            raise UserError(f"{self.checkpoints}: cannot be written: {error.strerror}") from None

    def save(self, weights: Mapping[str, Tensor], config: RunConfig, step: int) -> Path:
        """Writes the networks of a step and returns the path.

        Raises:
            UserError: it cannot be written.
        """
        path = self.own_checkpoints() / f"step_{step:09d}.safetensors"
        checkpoint_file.write(path, weights, _network_header(config, step))
        return path

    def save_best(self, weights: Mapping[str, Tensor], config: RunConfig, step: int) -> None:
        """Writes networks to best.safetensors.

        Raises:
            UserError: it cannot be written.
        """
        path = self.own_checkpoints() / "best.safetensors"
        checkpoint_file.write(path, weights, _network_header(config, step))

    def state(self, step: int) -> Path:
        """Returns the path of the training state of a step."""
        return self.own_checkpoints() / f"state_{step:09d}.safetensors"

    def states(self) -> list[Path]:
        """Returns the paths of the training states, oldest first."""
        return self._numbered("state")

    def networks(self) -> list[Path]:
        """Returns the paths of the networks, oldest first."""
        return self._numbered("step")

    def checkpoint(self) -> Path:
        """Returns the path of the newest networks.

        Raises:
            UserError: there is no checkpoint.
        """
        networks = self.networks()
        if not networks:
            raise UserError(f"{self.path}: holds no checkpoint (checkpoints/*.safetensors)")
        return networks[-1]

    def rotate(self, keep: int, states: int) -> None:
        """Removes all but the newest `keep` networks and `states` states."""
        self.own_checkpoints()
        for path in self.networks()[:-keep] + self.states()[:-states]:
            atomic_io.remove(path)

    def checkpoints_after(self, step: int) -> list[Path]:
        """Returns the paths of the networks and training states after a step."""
        return [path for path in self.networks() + self.states() if step_of(path) > step]

    def partial_checkpoints(self) -> list[Path]:
        """Returns the paths of incomplete checkpoints, which a killed process left."""
        folder = self.own_checkpoints()
        return [path for pattern in _PARTIAL for path in folder.glob(pattern)]

    def _numbered(self, name: str) -> list[Path]:
        paths = self.checkpoints.glob(f"{name}_*.safetensors")
        return sorted((path for path in paths if _is_numbered(path)), key=step_of)


def step_of(checkpoint: Path) -> int:
    """Returns the step in the name of a checkpoint, or -1 if there is none."""
    with suppress(ValueError):
        return int(checkpoint.stem.rpartition("_")[2])
    return -1


def load_weights(
    path: Path, expected: Mapping[str, Tensor], config: RunConfig | None = None
) -> dict[str, Tensor]:
    """Reads the weights of a checkpoint.

    Args:
        path: a checkpoint file.
        expected: tensors with the expected names, shapes and types: those of actors.
        config: configuration with the expected method, and the number of UAVs if each has its own
            weights; not checked if None.

    Returns:
        The weights with the names of `expected`.

    Raises:
        UserError: the file cannot be read or is damaged, a tensor is missing, of another shape or
            type, or not finite, or the actors have more tensors.
    """
    header, weights = checkpoint_file.read(path)
    if config is not None:
        _check_header(path, header, config)
    reason = _misfit(weights, expected)
    if reason:
        raise UserError(f"{path}: {_trained_with(path, header, config)}{reason}")
    chosen = {name: weights[name] for name in expected}
    checkpoint_file.check_finite(path, chosen)
    return chosen


def _misfit(weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> str:
    """Returns how the weights of a checkpoint differ from the expected ones; "" if they fit."""
    for name, tensor in expected.items():
        if name not in weights:
            return f"holds no {name}"
        weight = weights[name]
        if weight.shape != tensor.shape or weight.dtype != tensor.dtype:
            return (
                f"{name} has shape {list(weight.shape)}, {weight.dtype}; this configuration needs "
                f"{list(tensor.shape)}, {tensor.dtype}"
            )
    more = [name for name in weights if name.startswith(ACTOR) and name not in expected]
    return f"holds {more[0]}, which this configuration does not have" if more else ""


def _trained_with(path: Path, header: Mapping[str, Any], config: RunConfig | None) -> str:
    """Returns the settings of networks that differ from those of a checkpoint.

    They begin a message: "it was trained with KEY=VALUE (now VALUE): ".
    """
    if config is None or not isinstance(header.get("config"), Mapping):
        return ""
    try:
        trained = unsealed(path, header["config"], config)
    except UserError:  # the message is about the weights
        return ""
    before, now = flat(to_header(trained)), flat(to_header(config))
    keys = [*_OF_NETWORKS, *(key for key in before if key.startswith("comm."))]
    differ = {
        key: f"{key}={shown(before[key])}" + (f" (now {shown(now[key])})" if key in now else "")
        for key in keys
        if key in before and before[key] != now.get(key)
    }
    if len(differ) > 1 and _flies_in_any_team(config):
        differ.pop("env.num_uavs", None)  # it is hardly the reason
    return f"it was trained with {', '.join(differ.values())}: " if differ else ""


def _check_header(path: Path, header: Mapping[str, Any], config: RunConfig) -> None:
    expected = _network_header(config, 0)
    if header.get("kind") == "state":
        name = path.name.replace("state", "step", 1)
        raise UserError(f"{path}: a state of a training; expected networks, such as {name}")
    for name in ("method",) if _flies_in_any_team(config) else ("method", "uavs"):
        if header.get(name, expected[name]) != expected[name]:
            reason = "" if name == "method" else _why_not_any_team(config)
            raise UserError(
                f"{path}: a checkpoint of {name}={shown(header[name])}; "
                f"this configuration has {name}={expected[name]}{reason}"
            )


def _flies_in_any_team(config: RunConfig) -> bool:
    """Returns whether the weights do not depend on the number of UAVs, apart from observations."""
    return config.learner.share_parameters and not config.policy.agent_index


def _why_not_any_team(config: RunConfig) -> str:
    if config.policy.agent_index:
        return " (env.num_uavs), and its networks read the index of a UAV (policy.agent_index)"
    return " (env.num_uavs), and each UAV has networks of its own (learner.share_parameters=false)"


def _network_header(config: RunConfig, step: int) -> dict[str, Any]:
    return {
        "kind": "networks",
        "step": step,
        "method": config.method,
        "uavs": config.env.num_uavs,
        "seed": config.seed,
        "config": to_header(config),
    }


def _is_numbered(path: Path) -> bool:
    return _NUMBERED.fullmatch(path.name) is not None and path.is_file()
