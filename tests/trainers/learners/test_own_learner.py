"""Tests the learner of docs/extensions.md: SAC trains, resumes exactly and learns its alpha."""

import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest
import torch

from emberlink.envs.utils import config_files
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

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


def test_it_trains_all_that_the_loss_registers(sac):
    setup = made()
    before = {name: value.clone() for name, value in setup.learner.loss.named_parameters()}
    assert "log_alpha" in before
    setup.dry_run(40)
    assert setup.learner.updates > 20
    for name, value in setup.learner.loss.named_parameters():
        assert value.isfinite().all()
        assert not value.equal(before[name]), name


def test_it_resumes_bit_for_bit(sac):
    whole, first, second = made(), made(), made()
    whole.dry_run(40)
    first.dry_run(20)
    torch.manual_seed(5)
    second.load_state_dict({k: v.clone() for k, v in first.state_dict().items()}, 20)
    second.dry_run(20)
    state = second.state_dict()
    assert any(name.endswith("log_alpha") for name in state)
    for name, value in whole.state_dict().items():
        assert value.numpy().tobytes() == state[name].numpy().tobytes(), name
