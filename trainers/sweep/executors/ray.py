"""Runs trainings as tasks of a Ray cluster."""

import os
import secrets
import signal
import socket
import threading
import time
import warnings
from typing import Annotated, Any

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.sweep.executors import _extras, _process
from emberlink.trainers.sweep.executors.base import (
    DIED,
    Executor,
    Positive,
    QueueFullError,
    Task,
)

_NAMESPACE = "emberlink"
_STOPPED = 128 + signal.SIGTERM
_ANSWER = 10.0
"""seconds for which a cluster may need to answer"""
_IDLE = 60.0
"""seconds after which the owner of ended tasks ends, too"""


def _whole_above_1(value: float) -> float:
    if value > 1 and value % 1:
        raise UserError("expected a fraction of 1 or a whole number")
    return value


Part = Annotated[
    float, Field(ge=0, strict=False, allow_inf_nan=False), AfterValidator(_whole_above_1)
]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RayConfig:
    """Stores the settings of Ray tasks."""

    address: str = "auto"
    """address of the cluster, or local"""
    cpus: Positive = 1
    """cores of a run"""
    gpus: Part = 0.0
    """GPUs of a run; a fraction shares one"""
    memory: Positive | None = None
    """bytes of a run"""
    resources: dict[str, Annotated[Part, Field(gt=0)]] = Field(default_factory=dict)
    """other resources of a run"""
    seeds: Positive = 1
    """seeds of a method that are trained in one process"""
    restarts: CountOrZero = 3
    """how often a run is started again after its node died"""
    workers: Positive | None = None
    """runs at a time; all if None"""


def _train(task: Task, threads: int) -> int:
    """Trains in a process of its own, which saves if the task is cancelled; returns its status."""
    process = _process.start(task, threads)
    try:
        while process.poll() is None:
            time.sleep(0.2)  # Ray does not interrupt a call that waits for a process
    except KeyboardInterrupt:  # of ray.cancel
        process.send_signal(signal.SIGUSR2)
        process.wait()
        return _STOPPED
    return process.returncode


class _Owner:
    """Submits tasks within the cluster, where they go on if the sweep ends.

    The process ends when all tasks have ended and nobody has asked for them for some time.

    Args:
        options: Ray's options of the tasks.
    """

    def __init__(self, options: dict[str, Any]):
        ray = _extras.load("ray")

        self._function = ray.remote(_train).options(**options)
        self._tasks: dict[str, Any] = {}
        self._asked = time.monotonic()
        threading.Thread(target=self._end_when_idle, daemon=True).start()

    def submit(self, name: str, task: Task, threads: int) -> None:
        """Starts a task."""
        self._tasks[name] = self._function.remote(task, threads)

    def poll(self) -> dict[str, int | None]:
        """Returns the exit status of each task, or None if it has not ended."""
        self._asked = time.monotonic()
        return {name: _status(task) for name, task in self._tasks.items()}

    def cancel(self, name: str) -> None:
        """Requests that a task saves and ends."""
        ray = _extras.load("ray")

        ray.cancel(self._tasks[name], force=False)

    def _end_when_idle(self) -> None:
        while time.monotonic() - self._asked < _IDLE or None in map(_status, self._tasks.values()):
            time.sleep(_IDLE / 10)
        os._exit(0)


def _status(task: Any) -> int | None:
    """Returns the exit status of a Ray task, or None if it has not ended."""
    ray = _extras.load("ray")

    if not ray.wait([task], timeout=0)[0]:
        return None
    try:
        return ray.get(task)
    except ray.exceptions.TaskCancelledError:
        return _STOPPED
    except ray.exceptions.RayError:
        return DIED


class RayExecutor(Executor):
    """Runs each task as a Ray task, which Ray starts again elsewhere if its node dies."""

    config_type = RayConfig
    interval = 1.0

    def __init__(self, config: RayConfig):
        _extras.require("ray", "ray", "ray")
        self._config = config
        self.seeds, self.restarts = config.seeds, config.restarts
        self.may_leave = config.address != "local"
        self._owner = ""
        self._cancelled: set[tuple[str, str]] = set()
        self._polled: dict[str, tuple[float, dict[str, int | None]]] = {}

    def slots(self, tasks: int) -> int:
        self._connect()
        self._check_nodes()
        return self._config.workers or max(tasks, 1)

    def submit(self, task: Task) -> tuple[str, str]:
        ray = _extras.load("ray")

        name = secrets.token_hex(8)
        try:
            ray.get(self._own().submit.remote(name, task, self._config.cpus))
        except (ray.exceptions.RayError, ValueError) as error:
            self._owner = ""
            text = " ".join(str(error).split())
            raise QueueFullError(f"executor=ray: cannot submit a task: {text[:200]}") from None
        return self._owner, name

    def poll(self, handle: tuple[str, str]) -> int | None:
        owner, name = handle
        asked, tasks = self._polled.get(owner, (0.0, {}))
        if name not in tasks or time.monotonic() - asked > self.interval / 2:
            tasks = self._ask(owner)
            self._polled[owner] = time.monotonic(), tasks
        return tasks.get(name, DIED)

    def cancel(self, handle: tuple[str, str]) -> None:
        ray = _extras.load("ray")

        owner, name = handle
        if handle in self._cancelled:
            return
        self._cancelled.add(handle)
        try:
            ray.get(ray.get_actor(owner, _NAMESPACE).cancel.remote(name))
        except (ray.exceptions.RayError, ValueError):
            return  # the owner has died, and its tasks with it

    def name_of(self, handle: tuple[str, str]) -> str:
        return " ".join(handle)

    def find(self, name: str) -> tuple[str, str] | None:
        owner, _, task = name.partition(" ")
        handle = owner, task
        return handle if task in self._ask(owner) and self.poll(handle) is None else None

    def _ask(self, owner: str) -> dict[str, int | None]:
        """Returns the status of each task of an owner; none if the owner has ended."""
        ray = _extras.load("ray")

        try:
            return ray.get(ray.get_actor(owner, _NAMESPACE).poll.remote())
        except (ray.exceptions.RayError, ValueError):
            if owner == self._owner:
                self._owner = ""
            return {}

    def _own(self) -> Any:
        """Returns the actor that owns this sweep's tasks, on this machine if possible."""
        ray, scheduling = _extras.load("ray"), _extras.load("ray.util.scheduling_strategies")

        if self._owner:
            return ray.get_actor(self._owner, _NAMESPACE)
        config, here = self._config, ray.get_runtime_context().get_node_id()
        options = {
            "num_cpus": config.cpus,
            "num_gpus": config.gpus,
            "memory": config.memory,
            "resources": config.resources,
            "max_retries": config.restarts,
        }
        self._owner = f"sweep-{secrets.token_hex(4)}"
        owner = ray.remote(num_cpus=0, max_restarts=0)(_Owner)
        return owner.options(
            name=self._owner,
            namespace=_NAMESPACE,
            lifetime="detached",
            scheduling_strategy=scheduling.NodeAffinitySchedulingStrategy(here, soft=True),
        ).remote(options)

    def _check_nodes(self) -> None:
        """Warns if no node is large enough for a run, which then waits for such a node."""
        ray, config = _extras.load("ray"), self._config

        wanted = {"CPU": config.cpus, "GPU": config.gpus, "memory": config.memory or 0}
        wanted = {key: value for key, value in {**wanted, **config.resources}.items() if value}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(all(node.get(k, 0) >= v for k, v in wanted.items()) for node in nodes):
            text = ", ".join(f"{key}={value:g}" for key, value in wanted.items())
            warnings.warn(f"executor=ray: no node has {text}; the runs wait for one", stacklevel=2)

    def _connect(self) -> None:
        """Connects to the cluster.

        Raises:
            UserError: there is none at the address.
        """
        ray = _extras.load("ray")

        if ray.is_initialized():
            return
        self._check_address()
        path = os.environ.get("PYTHONPATH")
        try:
            ray.init(
                self._config.address,
                namespace=_NAMESPACE,
                log_to_driver=False,
                logging_level="ERROR",
                runtime_env={"env_vars": {"PYTHONPATH": path}} if path else None,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            text = " ".join(str(error).split())[:200]
            if isinstance(error, ConnectionError) and ":" in self._config.address:
                text += "; if the cluster asks for a token, set RAY_AUTH_MODE=token"
            raise UserError(f"executor.address={self._config.address}: {text}") from None

    def _check_address(self) -> None:
        """Checks that a HOST:PORT answers; Ray would try for minutes and print its own messages."""
        host, _, port = self._config.address.rpartition("://")[2].rpartition(":")
        if not host or not port.isdecimal():
            return
        try:
            socket.create_connection((host.strip("[]"), int(port)), _ANSWER).close()
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"executor.address={self._config.address}: {reason}") from None
