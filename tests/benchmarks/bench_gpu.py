"""The paper's full protocol on a GPU: run where there is one."""

import time

import pytest
import torch

from emberlink.trainers.config import resolve
from emberlink.trainers.loop import Trainer

METHODS = ["independent", "shared_memory", "positional", "consensus"]

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def seconds_of(method: str, output, *overrides: str) -> float:
    """Of the whole protocol, from the steady state of a run of 10 episodes."""
    config = resolve(
        method,
        ["device=cuda", "episodes=10", "evaluation.interval=0", f"output={output}", *overrides],
    )
    trainer = Trainer(config)
    trainer.start()
    marks = {}

    def watch(progress) -> None:
        if progress.step % 1000 == 0:
            torch.cuda.synchronize()
            marks[progress.episode] = time.perf_counter()

    trainer.train(watch)
    return 200 * (marks[10] - marks[2]) / 8


def test_one_method_one_seed(tell, tmp_path):
    seconds = seconds_of("consensus", tmp_path)
    tell(f"200 episodes, 200,000 updates, consensus: {seconds:.0f} s (goal: at most 180)")


def test_four_methods_five_seeds(tell, tmp_path):
    seconds = sum(seconds_of(method, tmp_path, "seeds=[0,1,2,3,4]") for method in METHODS)
    tell(f"four methods x 5 seeds, the same each: {seconds / 60:.1f} min (goal: at most 20)")


def test_nothing_waits_for_the_device(tmp_path):
    """torch itself raises where a step would wait for the GPU."""
    trainer = Trainer(resolve("consensus", ["device=cuda", "episodes=1", f"output={tmp_path}"]))
    for step, collected in enumerate(trainer.collector):
        if step == trainer.enough + 10:
            torch.cuda.set_sync_debug_mode("error")
        if step == trainer.enough + 60:
            break
        trainer._learn(collected)
    torch.cuda.set_sync_debug_mode("default")
