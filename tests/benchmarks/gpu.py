"""Compares a GPU with this machine's CPU, from the environment to a team trained in `front`.

    python tests/benchmarks/gpu.py [DEVICE] [EPISODES]

Takes three minutes on an H200 with the defaults, cuda and 20 episodes. With cpu as DEVICE, it
checks itself: all results agree. Ratios are the CPU's wall time, with all its
threads, over the device's.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from workloads import in_turns

from emberlink.envs import keys
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.training.setup import TrainingSetup

METHODS = ("independent", "consensus", "maps")
TOLERANCE = 1e-3
"""largest difference of numbers, relative to 1 + their size, after the same actions or updates"""
POINTS = 5.0
"""largest difference of the coverage in training, whose random numbers differ between devices"""


def configured(method: str, device: str, *options: str) -> RunConfig:
    """Returns the configuration of a method in `front` with the setup `strong`."""
    return resolve(method, ["setup=strong", "world=front", f"device={device}", *options])


def env_of(method: str, device: str, num_envs: int) -> Any:
    """Returns training environments with few fires."""
    config = configured(method, device, "fire.num_train_fires=16")
    given = {"fire": config.fire, "seed": 0, "device": device, "hold": config.policy.hold}
    return build_env(config, num_envs=num_envs, **given)


def fly(env: Any, decisions: int) -> TensorDictBase:
    """Flies with the same random actions on any device and returns the last time step."""
    generator, td = torch.Generator().manual_seed(0), env.reset()
    last = td
    for _ in range(decisions):
        action = torch.rand(env.full_action_spec[keys.ACTION].shape, generator=generator)
        td.set(keys.ACTION, action.mul(2).sub(1).to(env.device))
        done, td = env.step_and_maybe_reset(td)
        last = done.get("next")
    return last


def updated(learner: Any, batches: list[TensorDictBase], device: str) -> dict[str, torch.Tensor]:
    """Makes updates from batches and returns the actors' weights after them."""
    for batch in batches:
        learner.update(batch.to(device))
    return learner.weights()


def batches_of(setup: TrainingSetup) -> list[TensorDictBase]:
    """Returns the batches of an iteration, from which the learner did not learn."""
    learner: Any = setup.learner
    update, batches = learner.update, []
    learner.update = lambda batch: batches.append(batch) or {}
    setup.dry_run(setup.horizon)
    learner.update = update
    return batches


def finished(device: str, work: Callable[[], object]) -> None:
    """Calls a function and waits for the device."""
    work()
    if device != "cpu":
        torch.cuda.synchronize()


def difference(ours: Any, theirs: Any) -> float:
    """Returns the largest difference of tensors by name, relative to 1 + their size."""
    pairs = [(value.cpu().double(), theirs[name].cpu().double()) for name, value in ours.items()]
    return max(float(((a - b).abs() / (1 + b.abs())).nan_to_num().max()) for a, b in pairs)


def tell(name: str, found: float, limit: float = TOLERANCE) -> bool:
    """Prints whether a difference is within a limit, and returns it."""
    print(f"{name:44} difference {found:.2g}, {'agrees' if found <= limit else 'DIFFERS'}")
    return found <= limit


def main(device: str, episodes: int) -> int:
    both, agree = ("cpu", device), []
    for method in METHODS:
        ours, theirs = (
            dict(fly(env_of(method, at, 8), 30).items(True, leaves_only=True)) for at in both
        )
        agree.append(tell(f"{method}: 300 steps", difference(ours, theirs)))
        for num_envs in (64, 1024) if method != "maps" else (64,):
            flights = [partial(fly, env_of(method, at, num_envs), 10) for at in both]
            cpu, other = in_turns(3, *map(partial(partial, finished), both, flights))
            print(
                f"{method}: {num_envs} environments, 100 steps: {other:.2f} s, x {cpu / other:.2f}"
            )
    for method in ("independent", "maps"):
        options = f"episodes={episodes}", "num_envs=32"
        setups = [TrainingSetup(configured(method, at, *options)) for at in both]
        batches = batches_of(TrainingSetup(configured(method, "cpu", *options)))[:4]
        weights = [updated(s.learner, batches, at) for s, at in zip(setups, both, strict=True)]
        agree.append(tell(f"{method}: {len(batches)} updates of MAPPO", difference(*weights)))
        updates = [
            partial(updated, s.learner, batches, at) for s, at in zip(setups, both, strict=True)
        ]
        cpu, other = in_turns(3, *map(partial(partial, finished), both, updates))
        print(f"{method}: these updates: {other:.2f} s, x {cpu / other:.2f}")
    coverage, taken = [], []
    for at in both:
        setup = TrainingSetup(configured("independent", at, f"episodes={episodes}"))
        began = time.perf_counter()
        for _ in range(episodes):
            setup.record.clear()
            setup.dry_run(setup.horizon)
        coverage.append(setup.record.measures()["coverage"])
        taken.append(time.perf_counter() - began)
    (cpu, other), (before, after) = taken, coverage
    print(f"independent: {episodes} episodes of training: {other:.0f} s, x {cpu / other:.2f}")
    print(f"coverage of the last one: {after:.1f} %, on the CPU {before:.1f} %")
    agree.append(tell("independent: coverage in training", abs(after - before), POINTS))
    return int(not all(agree))


if __name__ == "__main__":
    device, episodes = [*sys.argv[1:], *("cuda", "20")[len(sys.argv) - 1 :]]
    sys.exit(main(device, int(episodes)))
