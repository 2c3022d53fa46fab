"""Tests the learner of docs/extensions.md: SAC trains, resumes exactly and learns its alpha."""

import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from test_contract import check_that_it_learns_and_resumes

from emberlink import trainers
from emberlink.envs.utils import config_files
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup
from emberlink.trainers.training.trainer import Trainer

PAGE = Path(__file__).parents[3] / "docs" / "extensions.md"
SMALL = [
    *("setup=tuned", "learner=sac", "env.horizon=20", "env.num_uavs=3", "num_envs=2"),
    *("episodes=2", "learner.hidden=[8,8]", "learner.batch_size=8", "fire.num_train_fires=2"),
]


@pytest.fixture
def sac(tmp_path, monkeypatch):
    """Installs the learner of the page as a package does."""
    text = PAGE.read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.S) if "SAC(" in block]
    (values,) = [b for b in re.findall(r"```yaml\n(.*?)```", text, re.S) if "name: sac" in b]
    assert len(code.splitlines()) < 120
    module = ModuleType("own_sac")
    monkeypatch.setitem(sys.modules, "own_sac", module)
    exec(compile(code, str(PAGE), "exec"), module.__dict__)
    (tmp_path / "learner").mkdir()
    (tmp_path / "learner" / "sac.yaml").write_text(values)
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(tmp_path))
    group = "emberlink.learners"
    point = EntryPoint("sac", "own_sac:SAC", group)
    monkeypatch.setattr(config_files, "entry_points", lambda of: [point] * (of == group))


def made() -> TrainingSetup:
    return TrainingSetup(resolve("consensus", SMALL))


def test_the_learner_of_the_page_trains_all_weights_and_resumes_bit_for_bit(sac):
    assert "log_alpha" in dict(made().learner.loss.named_parameters())
    check_that_it_learns_and_resumes(made)


@pytest.mark.parametrize("member", ["state_dict", "load_state_dict"])
def test_a_state_that_is_not_restored_fails_before_the_first_episode(sac, member, monkeypatch):
    def fails(*_):
        raise RuntimeError("no state")

    trainer = Trainer(resolve("consensus", SMALL))
    monkeypatch.setattr(trainer.setup.learner, member, fails)
    with pytest.raises(RuntimeError, match="no state"):
        trainer.start()


def test_its_run_is_exported_flown_and_resumed(sac, tmp_path):
    pytest.importorskip("onnxscript")
    values = dict(text.split("=", 1) for text in SMALL)
    small = {key: yaml.safe_load(text) for key, text in values.items()}
    short = {"evaluation.episodes": 1, "evaluation.scripted": []}
    run = trainers.train("consensus", **small, **short, output=tmp_path / "runs")
    onnx, _ = trainers.export(run.path, tmp_path / "sac.onnx")
    world = {"setup": "tuned", "env.horizon": 20, "env.num_uavs": 3}
    flown = trainers.evaluate(onnx, "consensus", episodes=1, scripted=False, **world)
    for measure, value in run.results["huygens"]["learned"].items():
        assert flown["huygens"]["learned"][measure] == value
    assert trainers.resume(run.path, episodes=3).config.episodes == 3
