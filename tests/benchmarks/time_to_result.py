"""Coverage of the frozen policies against seconds of training: one run, one line per measurement.

    python tests/benchmarks/time_to_result.py FILE [key=value ...]

Trains `consensus` in `tuned` with the given overrides, stops the clock every 500 steps, plays 32
held-out fires, and appends {"step", "seconds", "coverage"} to FILE.
"""

import json
import sys
import time
from pathlib import Path

from emberlink.envs.fire import load_scenario
from emberlink.envs.fire_bank import fire_bank
from emberlink.trainers import evaluate
from emberlink.trainers.build import build_env
from emberlink.trainers.config import resolve
from emberlink.trainers.loop import Trainer

EVERY, FIRES = 500, 32


def main(file: Path, overrides: list[str]) -> None:
    config = resolve("consensus", ["setup=tuned", "evaluation.interval=0", *overrides])
    trainer = Trainer(config)
    trainer.start()
    grid, horizon = config.env.grid, config.env.horizon
    fires = fire_bank(load_scenario("huygens"), "heldout", FIRES, grid, horizon)
    began, paused = time.monotonic(), 0.0

    def measure(progress) -> None:
        nonlocal paused
        if progress.step % EVERY:
            return
        stopped = time.monotonic()
        env = build_env(
            config, num_envs=FIRES, fire=fires, seed=evaluate.START_SEED, device=config.device
        )
        coverage = evaluate.play(env, trainer.actor)["coverage"].mean().item()
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


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
