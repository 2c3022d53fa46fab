"""Prints torch's profile of updates and of environment steps.

python tests/benchmarks/profiles.py
"""

import time
from collections.abc import Callable
from typing import Any

from torch.profiler import profile
from workloads import batch_of, flying, make

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.rollout.products import fast_products
from emberlink.trainers.training.setup import TrainingSetup

KINDS = {
    "matrix products": ("addmm", "baddbmm", "mm", "bmm"),
    "layer normalisation": ("native_layer_norm", "native_layer_norm_backward", "addcmul"),
    "optimiser and targets": ("_fused_adam_", "lerp_", "Optimizer"),
    "gather and scatter": ("take", "index", "gather", "scatter_reduce_", "index_put_"),
    "views": ("view", "select", "slice", "unsqueeze", "squeeze", "unbind", "as_strided", "expand"),
    "copies and conversions": ("copy_", "_to_copy", "to", "clone", "cat", "stack", "empty"),
}


def kind_of(name: str) -> str:
    plain = name.removeprefix("aten::").split(".")[0].split("#")[0]
    return next((kind for kind, names in KINDS.items() if plain in names), "everything else")


def show(title: str, work: Callable[[], object], units: int, calls: int = 10) -> dict[str, float]:
    """Prints milliseconds and operations per unit by kind, and returns each kind's share."""
    for _ in range(3):
        work()
    with profile() as recorded:
        for _ in range(calls):
            work()
    table: dict[str, list[float]] = {}
    for event in recorded.key_averages():
        entry = table.setdefault(kind_of(event.key), [0.0, 0.0])
        entry[0] += event.self_cpu_time_total / calls / units / 1000
        entry[1] += event.count / calls / units
    whole = sum(spent for spent, _ in table.values())
    print(f"\n{title}: {whole:.3f} ms")
    for kind, (spent, count) in sorted(table.items(), key=lambda item: -item[1][0]):
        print(f"| {kind} | {spent:.3f} | {count:.0f} |")
    return {kind: spent / whole for kind, (spent, _) in table.items()}


def iteration(num_envs: int) -> None:
    """Prints the share of CPU time of each part of an iteration of `ippo` with a memory."""
    options = ["setup=strong", "learner=ippo", "episodes=2", f"num_envs={num_envs}"]
    setup = TrainingSetup(resolve("independent", options))
    parts = "steps of the environments", "communication", "actors", "updates"
    spent: dict[str, float] = dict.fromkeys(parts, 0.0)
    batches: list[Any] = []
    base, learner = setup.env.base_env, setup.learner
    _time(base, "_step", "steps of the environments", spent)
    _time(setup.env.transform, "_step", "communication", spent)
    _time(learner.explorer, "forward", "actors", spent)
    _time(learner, "update", "updates", spent, batches)
    setup.dry_run(setup.horizon)
    spent.update(dict.fromkeys(parts, 0.0))
    began = time.process_time()
    setup.dry_run(setup.horizon)
    whole = time.process_time() - began
    print(f"\nan iteration of ippo, {num_envs} environments: {whole:.2f} CPU s")
    for part, seconds in [*spent.items(), ("the rest", whole - sum(spent.values()))]:
        print(f"| {part} | {100 * seconds / whole:.0f} % |")
    environments, updates = spent["steps of the environments"], spent["updates"]
    with fast_products():
        shares = show("an update of ippo", lambda: learner.update(batches[-1]), 1)
    counted = environments + shares["matrix products"] * updates
    print(f"\nmatrix products of updates and steps of environments: {100 * counted / whole:.0f} %")


def _time(
    owner: Any, name: str, part: str, spent: dict[str, float], kept: list[Any] | None = None
) -> None:
    """Adds the CPU time of an object's method to `spent[part]`, and keeps its first arguments."""
    method = getattr(owner, name)

    def timed(*args: Any, **more: Any) -> Any:
        if kept is not None:
            kept[:] = args
        began = time.process_time()
        result = method(*args, **more)
        spent[part] += time.process_time() - began
        return result

    object.__setattr__(owner, name, timed)


def main() -> None:
    for envs in (16, 64, 256, 1024):
        iteration(envs)
    setup = TrainingSetup(resolve("shared_memory", ["env.horizon=1000", "episodes=1"]))
    batch = batch_of(setup)
    show("an update, paper's networks", lambda: setup.learner.update(batch), 1)
    for envs in (1, 1024):
        for method in (None, "consensus"):
            env = make(method, envs)
            show(f"a step of {envs} environments, {method or 'alone'}", flying(env, 20), 20)


if __name__ == "__main__":
    main()
