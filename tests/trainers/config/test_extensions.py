"""Tests methods, setups and fires in a user's folder, and invalid entry points.

`test_packaging.py` tests an installed extension package.
"""

import json
import os
import shutil
from importlib import metadata
from pathlib import Path

import pytest
import torch
from own_package import CONSENSUS_OF_PAGE, METHOD, SETUP, SETUP_OF_PAGE, write, yaml_files
from refusal import refused
from test_resume import SMALL, assert_same, until
from tiny_run import TINY

from emberlink.comm.base import MODULES
from emberlink.comm.consensus import Consensus
from emberlink.envs.fire.generator import load_scenario, scenarios
from emberlink.envs.utils import config_files
from emberlink.envs.utils.config_files import find
from emberlink.envs.utils.errors import UserError
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Trainer


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Returns a folder of YAML files that EMBERLINK_CONFIGS lists after a missing folder."""
    folder = write(tmp_path / "a user's folder", yaml_files())
    text = METHOD.replace("headcount", "no_comm").replace("  scale: 0.1\n", "")
    write(folder, {"method/alone.yaml": text})
    both = os.pathsep.join([str(tmp_path / "nowhere"), str(folder)])
    monkeypatch.setenv("EMBERLINK_CONFIGS", both)
    return folder


def test_a_folder_adds_a_method_a_setup_and_a_fire(folder):
    assert {"alone", "headcount"} < set(config_files.known("method"))
    assert find("setup", "small") == folder / "setup" / "small.yaml"
    config = resolve("alone", ["setup=small", "env.num_uavs=3"])
    assert (config.env.horizon, config.env.num_uavs, config.fire.name) == (15, 3, "faint")
    assert config.learner == resolve("shared_memory").learner
    assert resolve("consensus", ["setup=small"]).env.horizon == 15
    write(folder, {"setup/page.yaml": SETUP_OF_PAGE})
    config = resolve("consensus", ["setup=page"])
    assert (config.env.num_uavs, config.fire.name) == (3, "oil_slick")
    tuned = resolve("consensus", ["setup=tuned"])
    assert config.env.reward == tuned.env.reward
    assert (config.learner.gamma, tuned.learner.gamma) == (0.97, 0.9)
    write(folder, {"setup_method/page_consensus.yaml": CONSENSUS_OF_PAGE})
    config = resolve("consensus", ["setup=page"])
    assert (config.comm, config.learner) == (tuned.comm, tuned.learner)
    assert "faint" in scenarios()
    assert load_scenario("faint").head_ros == load_scenario("paper").head_ros
    with pytest.raises(UserError, match=r"comm.name='headcount' is not known.*known: consensus"):
        resolve("headcount")


def test_a_duplicate_name_is_an_error(folder):
    write(folder, {"setup/paper.yaml": SETUP})
    with pytest.raises(UserError, match=r"setup 'paper' is in several folders: .*folder/setup"):
        resolve("consensus")
    assert resolve("positional", ["setup=tuned"]).setup == "tuned"


def test_an_invalid_file_of_a_user(folder):
    write(folder, {"method/mine.yaml": "replay: shared\n"})
    with pytest.raises(UserError, match=r"mine.yaml must begin with '# @package _global_'"):
        resolve("mine")
    assert resolve("consensus").method == "consensus"


def entry_point(monkeypatch, group: str, name: str, value: str) -> None:
    point = metadata.EntryPoint(name, value, group)
    monkeypatch.setattr(
        "emberlink.envs.utils.config_files.entry_points",
        lambda group: (point,) if point.group == group else (),
    )


def test_an_invalid_entry_point_is_named_in_the_error(monkeypatch):
    for value, message in (
        ("nowhere:Module", "cannot be imported: ModuleNotFoundError: No module named 'nowhere'"),
        ("emberlink.comm.consensus:ConsensusConfig", "not a subclass of CommModule"),
    ):
        entry_point(monkeypatch, "emberlink.comm", "other", value)
        with pytest.raises(UserError, match=f"entry point 'other' of emberlink.comm.*{message}"):
            MODULES.find("other")
    entry_point(monkeypatch, "emberlink.comm", "no_comm", "emberlink.comm.consensus:Consensus")
    with pytest.raises(UserError, match="no_comm: in several packages"):
        MODULES.find("no_comm")
    entry_point(monkeypatch, "emberlink.comm", "other", "emberlink.comm.consensus:Consensus")
    assert MODULES.find("other") is Consensus
    for value in ("nowhere.configs", "json.decoder"):
        entry_point(monkeypatch, "emberlink.configs", "other", value)
        with pytest.warns(UserWarning, match=f"emberlink.configs: there is no package {value}"):
            assert "consensus" in config_files.known("method")


def test_a_run_folder_needs_its_yaml_files_for_scripted_policies_alone(
    folder, tmp_path, monkeypatch, capsys
):
    arguments = ["train", "alone", "setup=small", *TINY, f"output={tmp_path / 'runs'}"]
    assert main.main(arguments) == 0
    (run,) = (tmp_path / "runs").iterdir()
    before = json.loads((run / "eval.json").read_text())["results"]
    shutil.rmtree(folder)
    monkeypatch.delenv("EMBERLINK_CONFIGS")
    refused(["eval", run], capsys, "follow_target flies with the communication of consensus")
    assert main.main(["eval", str(run), "evaluation.scripted=[]"]) == 0
    (file,) = run.glob("eval_*.json")
    after = json.loads(file.read_text())["results"]
    assert {k: v["learned"] for k, v in after.items()} == {
        k: v["learned"] for k, v in before.items()
    }
    assert main.main(["train", f"resume={run}", "episodes=3", "evaluation.scripted=[]"]) == 0


POINTS = """
[emberlink.comm]
visited_map = visited_map:VisitedMap
broken = broken_on_import:Module

[emberlink.scripted]
still = emberlink.policies.scripted.simple:Stationary
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Writes a package and its pip metadata to a new folder on the path."""
    (tmp_path / "broken_on_import.py").write_text("raise RuntimeError('no such\\nsensor')\n")
    about = tmp_path / "guests-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: guests\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(POINTS)
    monkeypatch.syspath_prepend(str(tmp_path))


def test_policies_of_other_packages_are_known(installed):
    assert SCRIPTED.find("still").__name__ == "Stationary"
    assert {"visited_map", "broken", "consensus"} <= {*MODULES.known()}


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
