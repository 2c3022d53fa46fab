"""Tests the counts of the benchmarks and the failure condition of the guard."""

from contextlib import nullcontext
from typing import Any

import guard
import pytest
import time_to_result
import workloads
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup


class Flops(TorchDispatchMode):
    """Sums the floating-point operations by torch's formulas."""

    total = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        formula = flop_registry.get(func._overloadpacket)
        if formula is not None:
            self.total += formula(*args, **(kwargs or {}), out_val=out)
        return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "features", "hidden", "batch"),
    [
        ("independent", 6, (40, 30), 64),
        ("positional", 24, (16, 24), 32),
        ("consensus", 9, (100, 75), 128),
    ],
)
@pytest.mark.parametrize("shared", [False, True])
def test_flops_of_an_update_equal_torchs_count(method, features, hidden, batch, shared):
    settings = ["env.horizon=200", "episodes=1", "env.num_uavs=4"]
    sizes = [f"learner.hidden={list(hidden)}", f"learner.batch_size={batch}"]
    setup = TrainingSetup(resolve(method, [*settings, *sizes]))
    sample = workloads.batch_of(setup)
    if not shared:
        learner: Any = setup.learner
        critic = learner.loss.value_network.module
        critic.sharing = nullcontext
    with Flops() as counter:
        setup.learner.update(sample)
    assert counter.total == workloads.update_flops(4, features, 3, hidden, batch, shared=shared)


def test_workloads_alternate():
    done = []
    seconds = workloads.in_turns(3, lambda: done.append("a"), lambda: done.append("b"))
    assert done == ["a", "b"] * 4
    assert len(seconds) == 2
    assert all(taken >= 0 for taken in seconds)


@pytest.mark.parametrize(
    ("taken", "kept", "calls"),
    [
        ([2.0], True, 1),
        ([1.0], True, 1),
        ([2.8], True, 1),  # 0.71 of the speed
        ([2.9, 2.0], True, 2),  # 0.69 at first, then above the limit
        ([2.9, 5.0, 2.9], False, 3),
    ],
)
def test_the_guard_fails_at_a_loss_of_30_percent(taken, kept, calls, capsys):
    left = list(taken)
    assert guard.check("work", 2.0, lambda: left.pop(0)) is kept
    assert len(taken) - len(left) == calls
    assert ("has lost more than 30%" in capsys.readouterr().out) is not kept


@pytest.mark.heavy
def test_the_guard_has_a_record_of_every_workload():
    recorded = guard.json.loads(guard.BASELINE.read_text())
    assert recorded.keys() == guard.works().keys()
    assert all(ratio > 0 for ratio in recorded.values())


@pytest.mark.drawn
def test_time_to_90_percent(tmp_path, capsys):
    file = tmp_path / "runs.jsonl"
    lines = [(500, 10, 40), (1000, 20, 71), (1500, 30, 73), (2000, 40, 79), (2500, 50, 88)]
    file.write_text(
        "".join(
            f'{{"seed": 3, "step": {step}, "seconds": {seconds}, "coverage": {coverage}}}\n'
            for step, seconds, coverage in lines
        )
    )
    figure = tmp_path / "figure.png"
    time_to_result.draw(figure, [f"now={file}"])
    # The mean of the last three is 80. 90 % of it is 72, which the third reaches.
    assert capsys.readouterr().out == "| now | 3 | 80.0 | 30 | 1500 | 50 | 20.0 |\n"
    assert figure.stat().st_size > 5000
