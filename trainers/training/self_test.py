"""Runs `emberlink doctor`: prints versions and devices, and runs a self-test."""

import platform
import time
from importlib.metadata import PackageNotFoundError, version

import torch
from rich.console import Console
from torchrl.envs.utils import check_env_specs

from emberlink.envs.utils.config_files import known
from emberlink.trainers.build import make_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

_PACKAGES = "emberlink", "torch", "torchrl", "tensordict", "pettingzoo", "wandb", "hydra-core"
_GEO = "rasterio", "geopandas", "pyogrio", "shapely", "pyproj"
_TINY = ("env.horizon=40", "env.num_uavs=3", "episodes=1", "num_envs=2", "learner.batch_size=32")


def doctor(console: Console) -> int:
    """Prints versions and devices, runs the self-test, and returns 0 if it passed, else 1."""
    console.print(f"python {platform.python_version()} on {platform.platform()}")
    console.print(_versions(*_PACKAGES), soft_wrap=True)
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    cpu = f"cpu ({torch.get_num_threads()} threads)"
    console.print(f"devices: {cpu}, {', '.join(gpus) or 'no GPU'}")
    console.print(f"fires from files: {_versions(*_GEO)} (extra geo)", soft_wrap=True)
    began, failures, methods = time.monotonic(), 0, known("method")
    for name in methods:
        try:
            console.print(f"  ok      {name}: {_method(name)}")
        except Exception as error:  # the other checks must run
            failures += 1
            why = f"{type(error).__name__}: {error}"
            console.print(f"  FAILED  {name}: {why}", style="red", soft_wrap=True)
    seconds = time.monotonic() - began
    console.print(f"self-test: {failures} of {len(methods)} failed, {seconds:.1f} s")
    return int(failures > 0)


def _versions(*names: str) -> str:
    """Returns the versions of packages, or which one is missing."""
    try:
        return ", ".join(f"{name} {version(name)}" for name in names)
    except PackageNotFoundError as error:
        return f"{error.name} is not installed"


def _method(method: str) -> str:
    check_env_specs(make_env(method, num_envs=2, horizon=5, num_uavs=3))
    setup = TrainingSetup(resolve(method, _TINY))
    setup.dry_run(steps=20)
    return f"environment and {setup.learner.updates} updates"
