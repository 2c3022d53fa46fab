"""Finds executors by name: emberlink's own, and entry points of other packages."""

from collections.abc import Mapping, Sequence
from typing import Any

from emberlink.envs.utils.config_files import read
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import from_plain, unknown
from emberlink.trainers.config.values import check_not_removed, parse
from emberlink.trainers.sweep.executors.base import Executor

_OWN = {
    "local": "trainers.sweep.executors.local:LocalExecutor",
    "ray": "trainers.sweep.executors.ray:RayExecutor",
    "submitit": "trainers.sweep.executors.submitit:SubmititExecutor",
}
_REGISTRY = Registry(Executor, "emberlink.executors", "executor", _OWN)
known, find = _REGISTRY.known, _REGISTRY.find


def make(arguments: Sequence[str]) -> Executor:
    """Returns the executor of `executor=NAME` (`local` if missing) and `executor.KEY=VALUE`.

    Raises:
        UserError: the name or a key is not known, or a value is wrong.
    """
    given = dict(map(parse, arguments))
    name = str(given.pop("executor", "local"))
    executor = find(name)
    values = {key: value for key, value in read("executor", name).items() if key != "name"}
    for key, value in given.items():
        _, first, *rest = key.split(".")
        inner = values.get(first)
        if rest and isinstance(inner, Mapping):
            values[first] = {**inner, ".".join(rest): value}
        elif not rest and first in values:
            values[first] = value
        else:
            check_not_removed(key, value)
            raise UserError(f"key {unknown(key, [f'executor.{known}' for known in values])}")
    config: Any = from_plain(executor.config_type, values, "executor")
    return executor(config)
