"""Prints torch's profile of an update and of environment steps.

python tests/benchmarks/profiles.py
"""

from collections.abc import Callable

from torch.profiler import profile
from workloads import batch_of, flying, make

from emberlink.trainers.config.compose import resolve
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


def show(title: str, work: Callable[[], object], units: int, calls: int = 10) -> None:
    """Prints milliseconds and operations per unit, by kind."""
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
    print(f"\n{title}: {sum(time for time, _ in table.values()):.3f} ms")
    for kind, (time, count) in sorted(table.items(), key=lambda item: -item[1][0]):
        print(f"| {kind} | {time:.3f} | {count:.0f} |")


def main() -> None:
    setup = TrainingSetup(resolve("shared_memory", ["env.horizon=1000", "episodes=1"]))
    batch = batch_of(setup)
    show("an update, paper's networks", lambda: setup.learner.update(batch), 1)
    for envs in (1, 1024):
        for method in (None, "consensus"):
            env = make(method, envs)
            show(f"a step of {envs} environments, {method or 'alone'}", flying(env, 20), 20)


if __name__ == "__main__":
    main()
