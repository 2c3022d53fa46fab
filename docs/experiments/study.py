"""Trains the arms of the study (docs/study.md) in its order.

    python docs/experiments/study.py list OUTPUT             # prints the commands
    python docs/experiments/study.py run OUTPUT              # runs them, and skips what is finished
    python docs/experiments/study.py run OUTPUT front/map_m  # only those whose folders begin so

Each training is one process with one thread, as many at once as there are processors; one that was
stopped is resumed.
"""

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

NEW = ["evaluation.huygens=false", "fire.test_seed=1500000"]
WORLDS = {"front": [], "relay": ["env.reward.base=1.0"], "paper": NEW, "swarm": []}
ALL = ["setup=strong", "env.reward.unseen=-0.03", "evaluation.scripted=[]"]
OF_SWEEP = ["executor.workers=1", "executor.threads=1"]
OF_VECTOR = [
    *("learner.chunk=25", "learner.critic_map=true"),
    *("episodes=240", "evaluation.interval=15"),
]
OF_PICTURES = ["env.observation=map", "policy.memory=none", "learner.hidden=[64]"]
OF_IMITATION = [
    *("learner=imitation", "learner.updates_per_step=4", "learner.buffer_size=50000"),
    *("learner.lr=1e-3", "learner.bfloat16=true", "num_envs=16", "episodes=8"),
    *("evaluation.interval=8", "evaluation.episodes=1"),
]
TEACHER = {"relay": ["learner.teacher=shuttle"]}
"""in other worlds `map_greedy` is imitated"""
OF_MAP = [
    *("learner.critic_map=true", "learner.bfloat16=true", "learner.log_std=-1.2"),
    *("learner.gamma=0.95", "learner.gae_lambda=0.95", "learner.epochs=1", "learner.lr=1e-3"),
    *("learner.minibatches=8", "num_envs=32", "episodes=40", "evaluation.interval=5"),
]
OF_WORLD = {"swarm": ["num_envs=16"]}
"""in other worlds `num_envs` is that of `OF_MAP`; a team of `swarm` has four times as many UAVs"""
ATTENTION = "policy.message=attention"
EXCHANGES: dict[str, tuple[str, Sequence[str]]] = {
    "none": ("independent", []),
    "maps": ("maps", []),
    "attention": ("independent", [ATTENTION]),
    # As many bytes a step: a message and its key of 8 bytes are sent once in ten steps.
    "maps_16": ("maps", ["env.radio.bandwidth=16"]),
    "attention_16": ("independent", [ATTENTION, "policy.message_size=152"]),
    "maps_unlimited": ("maps", ["env.radio.range=.inf"]),
    "consensus": ("consensus", []),
    "maps_from_none": ("maps", []),
    "none_from_maps": ("independent", []),
}
"""name -> method and settings: all in which arms with the same observation differ"""
START = {"maps_from_none": "none", "none_from_maps": "maps"}
"""exchange -> that of the arm whose imitation is its warm start, where this is another arm"""
ARMS: dict[str, dict[str, Sequence[str]]] = {
    "front": {
        "map": (
            *("none", "maps", "attention", "maps_16", "attention_16", "maps_unlimited"),
            *("maps_from_none", "none_from_maps"),
        ),
        "vector": ("none", "attention", "consensus"),
    },
    "relay": {"map": ("none", "maps", "attention", "maps_unlimited")},
    "paper": {"vector": ("none", "attention")},
    "swarm": {"map": ("maps",)},
}
"""world -> observation -> exchanges"""
MOST = "none", "maps", "attention", "consensus"
"""exchanges with 10 seeds in `front`; all others have 5"""


def arms(world: str) -> list[tuple[str, str]]:
    """Returns observation and exchange of each arm of a world."""
    return [(observed, name) for observed, names in ARMS[world].items() for name in names]


def settings(world: str, observed: str, name: str) -> list[str]:
    """Returns the method and the settings of an arm, in imitation and afterwards."""
    method, exchange = EXCHANGES[name]
    shown = OF_PICTURES if observed == "map" else []
    return [method, *ALL, f"world={world}", *WORLDS[world], *shown, *exchange]


def seeds(world: str, name: str) -> int:
    """Returns how many seeds an arm has."""
    return 10 if world == "front" and name in MOST else 5


def commands(folder: Path, seed: int) -> Iterator[list[str]]:
    """Yields the commands of a seed of OUTPUT/WORLD/ARM; each is known once the one before ran."""
    world, (observed, name) = folder.parent.name, folder.name.split("_", 1)
    common, more = settings(world, observed, name), [f"seed={seed}", *OF_SWEEP]
    if observed == "map":
        start = START.get(name, name)
        first = folder.with_name(f"imitation_{start}") / f"s{seed}"
        taught = [*settings(world, observed, start), *OF_IMITATION, *TEACHER.get(world, [])]
        yield ["sweep", *taught, *more, f"output={first}"]
        more.append(f"learner.warm_start={_run(first)}")
    trained = OF_VECTOR if observed == "vector" else [*OF_MAP, *OF_WORLD.get(world, [])]
    yield ["sweep", *common, *trained, *more, f"output={folder / f's{seed}'}"]
    for fault in ("zero", "shuffle") if "message" in str(common) else ():
        run = _run(folder / f"s{seed}")
        if not (run / f"eval_evaluation.message_fault={fault}.json").exists():
            yield ["eval", str(run), f"evaluation.message_fault={fault}"]


def _run(folder: Path) -> Path:
    """Returns the run in a folder."""
    return next(folder.glob("*_s*_*/"), folder / "RUN")


def main(verb: str, output: str, *parts: str) -> int:
    """Prints or runs all commands; returns how many seeds and checks failed."""
    jobs: list[Iterator[list[str]]] = []
    for world, settings_of_world in WORLDS.items():
        folder = Path(output) / world
        chosen = [
            commands(folder / "_".join(arm), seed)
            for seed, arm in product(range(10), arms(world))
            if seed < seeds(world, arm[1])
            and f"{world}/{'_'.join(arm)}/s{seed}".startswith(parts or "")
        ]
        check = ["world", "check", world, "setup=strong", *settings_of_world, "--json"]
        if chosen and world != "paper" and not (folder / "scripted.json").exists():
            if verb == "run":
                folder.mkdir(parents=True, exist_ok=True)
            jobs.append(iter([[*check, str(folder / "scripted.json")]]))
        jobs.extend(chosen)
    with ThreadPoolExecutor(os.cpu_count() if verb == "run" else 1) as threads:
        return sum(threads.map(lambda lines: any(_do(verb, line) for line in lines), jobs))


def _do(verb: str, line: Sequence[str]) -> bool:
    sys.stdout.write(f"emberlink {shlex.join(line)}\n")
    sys.stdout.flush()
    if verb != "run":
        return False
    program = [sys.executable, "-m", "emberlink"]
    return subprocess.run([*program, *line], check=False).returncode != 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
