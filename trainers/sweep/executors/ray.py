"""Runs trainings as tasks of a Ray cluster."""

import os
import time
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.errors import UserError, require
from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.sweep.executors.base import DIED, Executor, Positive, Task

Part = Annotated[float, Field(ge=0, strict=False, allow_inf_nan=False)]


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
    resources: dict[str, Part] = Field(default_factory=dict)
    """other resources of a run"""
    restarts: CountOrZero = 3
    """how often a run is started again after its node died"""
    workers: Positive | None = None
    """runs at a time; all if None"""


def _train(task: Task, threads: int) -> int:
    """Trains in a new process, which saves if the task is cancelled; returns its status."""
    process = task.start(threads)
    try:
        while process.poll() is None:
            time.sleep(0.2)  # Ray does not interrupt a call that waits for a process
    except KeyboardInterrupt:  # of ray.cancel
        process.terminate()
    return process.wait()


class RayExecutor(Executor):
    """Runs each task as a Ray task, which Ray starts again elsewhere if its node dies."""

    config_type = RayConfig

    def __init__(self, config: RayConfig):
        require("ray", "ray", "executor=ray")
        self.workers = config.workers
        self._config = config

    def submit(self, tasks: Sequence[Task]) -> Sequence[Any]:
        ray, config = import_module("ray"), self._config
        path = os.environ.get("PYTHONPATH")
        try:
            if not ray.is_initialized():
                ray.init(
                    config.address,
                    log_to_driver=False,
                    logging_level="ERROR",
                    runtime_env={"env_vars": {"PYTHONPATH": path}} if path else None,
                )
            train = ray.remote(_train).options(
                num_cpus=config.cpus,
                num_gpus=config.gpus,
                memory=config.memory,
                resources=config.resources,
                max_retries=config.restarts,
            )
            return [train.remote(task, config.cpus) for task in tasks]
        except (ConnectionError, ValueError, RuntimeError) as error:
            text = " ".join(str(error).split())[:200]
            raise UserError(f"executor=ray executor.address={config.address}: {text}") from None

    def poll(self, handle: Any) -> int | None:
        ray = import_module("ray")
        if not ray.wait([handle], timeout=0)[0]:
            return None
        try:
            return ray.get(handle)
        except ray.exceptions.RayError:
            return DIED

    def cancel(self, handle: Any) -> None:
        import_module("ray").cancel(handle, force=False)
