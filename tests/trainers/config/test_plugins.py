"""Tests communication and scripted policies of other packages, and their saved state."""

import sys

import pytest
import torch
from test_resume import SMALL, assert_same, until

from emberlink.comm.base import MODULES
from emberlink.envs.utils.errors import UserError
from emberlink.policies.networks.memory.base import MEMORIES
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.sweep.executors.base import EXECUTORS
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Trainer

STILL = """
from emberlink.policies.scripted.base import Scripted
from emberlink.policies.scripted.simple import Stationary


class Still(Stationary):
    pass
"""
POINTS = """
[emberlink.comm]
visited_map = visited_map:VisitedMap
broken = broken_on_import:Module
number = still:STILL

[emberlink.scripted]
still = still:Still
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Writes a package and its pip metadata to a new folder on the path."""
    (tmp_path / "still.py").write_text(STILL + "\nSTILL = 3\n")
    (tmp_path / "broken_on_import.py").write_text("raise RuntimeError('no such\\nsensor')\n")
    about = tmp_path / "guests-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: guests\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(POINTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in ("still", "broken_on_import"):
        sys.modules.pop(name, None)


def test_policies_of_other_packages_are_known(installed):
    own = {
        *("stationary", "random_actions", "random_waypoints", "lawnmower", "follow_target"),
        *("map_greedy_alone", "map_greedy", "map_greedy_all", "courier", "oracle"),
    }
    assert {*SCRIPTED.known()} == {*own, "still"}
    assert SCRIPTED.find("still").__name__ == "Still"
    assert MEMORIES.known() == ["gru", "none"]
    assert EXECUTORS.known() == ["local", "ray", "submitit"]
    own = {"consensus", "maps", "no_comm", "positional"}
    assert {*MODULES.known()} == own | {"broken", "number", "visited_map"}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("broken", "cannot be imported: RuntimeError: no such sensor"),
        ("number", "not a subclass of CommModule"),
    ],
)
def test_a_broken_package_is_named_in_one_line(installed, name, message):
    with pytest.raises(UserError, match=r"^package guests: entry point ") as error:
        MODULES.find(name)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_map_of_another_package_is_restored_bit_for_bit(installed, tmp_path):
    given = {"name": "visited_map"}
    radio = {"range": 8.0, "loss": 0.1}

    def begin() -> Trainer:
        settings = [*SMALL, f"output={tmp_path / 'runs'}"]
        trainer = Trainer(resolve("shared_memory", settings, comm=given, radio=radio))
        trainer.start()
        return trainer

    whole = until(begin(), None)
    stopped = until(begin(), 27)
    saved = stopped.setup.env.transform.state_dict()
    (seen,) = (value for key, value in saved.items() if key.endswith("module.map"))
    assert torch.count_nonzero(seen) > 0
    assert_same(whole, until(resume(stopped.run.path), None))
