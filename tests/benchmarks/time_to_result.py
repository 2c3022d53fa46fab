"""Measures the coverage of frozen policies against training time in seconds.

    python tests/benchmarks/time_to_result.py train FILE [key=value ...]
    python tests/benchmarks/time_to_result.py draw FIGURE.png LABEL=FILE [LABEL=FILE ...]

`train` trains `consensus` in `tuned` with the given overrides, stops the clock every 500 steps,
plays 32 held-out fires, and appends {"seed", "step", "seconds", "coverage"} to FILE. `draw` draws
such files, a line per seed, and prints when each run reached 90 % of its final coverage (mean of
the last three measurements).
"""

import json
import sys
import time
from pathlib import Path

from emberlink.envs.fire.cache import fire_bank
from emberlink.envs.fire.generator import load_scenario
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.training.trainer import Trainer

EVERY, FIRES = 500, 32


def train(file: Path, overrides: list[str]) -> None:
    config = resolve("consensus", ["setup=tuned", "evaluation.interval=0", *overrides])
    if config.seeds:
        raise SystemExit("seeds: one run at a time is timed; give seed=")
    trainer = Trainer(config)
    trainer.start()
    grid, horizon = config.env.grid, config.env.horizon
    fires = fire_bank(load_scenario("huygens"), "test", FIRES, grid, horizon)
    began, paused = time.monotonic(), 0.0

    def measure(progress) -> None:
        nonlocal paused
        if progress.step % EVERY:
            return
        stopped = time.monotonic()
        env = build_env(
            config, num_envs=FIRES, fire=fires, seed=evaluate.START_SEED, device=config.device
        )
        coverage = evaluate.play(env, trainer.setup.learner.actor)["coverage"].mean().item()
        line = {
            "seed": config.seed,
            "step": progress.step,
            "seconds": round(stopped - began - paused, 2),
            "coverage": round(coverage, 2),
        }
        with file.open("a") as out:
            out.write(json.dumps(line) + "\n")
        paused += time.monotonic() - stopped

    trainer.train(measure)


def read(file: str) -> dict[int, list[dict]]:
    """Returns seed -> measurements, in order."""
    runs: dict[int, list[dict]] = {}
    for line in Path(file).read_text().splitlines():
        measured = json.loads(line)
        runs.setdefault(measured["seed"], []).append(measured)
    return runs


def draw(figure: Path, named: list[str]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    canvas, panel = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for number, (label, file) in enumerate(name.split("=") for name in named):
        for seed, run in read(file).items():
            seconds, coverage = ([line[key] for line in run] for key in ("seconds", "coverage"))
            first = {} if seed else {"label": label}
            panel.plot(seconds, coverage, color=f"C{number}", alpha=0.8, **first)
            final = sum(coverage[-3:]) / 3
            reached = next(line for line in run if line["coverage"] >= 0.9 * final)
            per_step = 1000 * seconds[-1] / run[-1]["step"]
            print(
                f"| {label} | {seed} | {final:.1f} | {reached['seconds']:.0f} | "
                f"{reached['step']} | {seconds[-1]:.0f} | {per_step:.1f} |"
            )
    panel.set(xlabel="seconds of training", ylabel="coverage, %", ylim=(0, 100))
    panel.grid(alpha=0.3)
    panel.legend()
    canvas.savefig(figure, dpi=110)


if __name__ == "__main__":
    {"train": train, "draw": draw}[sys.argv[1]](Path(sys.argv[2]), sys.argv[3:])
