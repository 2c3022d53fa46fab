"""Tests `emberlink tune`: trials are runs, an interrupted one goes on, a poor one is stopped."""

import pytest
import yaml

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.cli.main import main
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.tune import tune
from emberlink.trainers.terminal.console import PlainConsole
from emberlink.trainers.training.trainer import Trainer

TINY = [
    *("setup=strong", "episodes=3", "num_envs=2", "env.horizon=20", "env.num_uavs=2"),
    *("learner.hidden=[4]", "policy.units=4", "evaluation.interval=1"),
    *("evaluation.interval_episodes=2", "checkpoint_steps=10", "learner.minibatches=1"),
]


@pytest.fixture
def space(tmp_path):
    file = tmp_path / "space.yaml"
    text = "learner.lr: {low: 1.0e-4, high: 1.0e-2, log: true}\nlearner.epochs: [1, 2]\n"
    file.write_text(text + "learner.minibatches: [2]\n")  # which the command gives
    return file


def runs(tmp_path):
    return sorted((tmp_path / "tune_independent_strong_paper").glob("*/config.yaml"))


def test_an_interrupted_trial_goes_on_with_its_settings(tmp_path, space, monkeypatch, capsys):
    words = ["tune", "independent", *TINY, f"output={tmp_path}", "--space", str(space)]
    assert main([*words, "--trials", "1"]) == 0
    train = Trainer.train

    def dies(self, report):
        def stop(state):
            report(state)
            if state.step >= 30:
                raise SystemExit(9)

        train(self, stop)

    monkeypatch.setattr(Trainer, "train", dies)
    with pytest.raises(SystemExit):
        main([*words, "--trials", "3"])
    monkeypatch.undo()
    before = [file.read_text() for file in runs(tmp_path)]
    assert main([*words, "--trials", "3"]) == 0
    after = [file.read_text() for file in runs(tmp_path)]
    assert before == after[:2]
    assert len(after) == 3
    ends = [RunFolder(file.parent).metrics()[-1]["episode"] for file in runs(tmp_path)]
    assert ends[:2] == [3, 3]
    values = [yaml.safe_load(text)["learner"] for text in after]
    assert {value["minibatches"] for value in values} == {1}
    assert all(1e-4 <= value["lr"] <= 1e-2 and value["epochs"] in (1, 2) for value in values)
    assert not [*tmp_path.glob("*/*/eval.json")]  # test fires are not played
    assert "best: coverage" in capsys.readouterr().out
    assert main([*words, "--trials", "3"]) == 0
    assert len(runs(tmp_path)) == 3


def test_a_trial_below_the_median_is_stopped(tmp_path, space, monkeypatch):
    coverage = iter([*[50.0] * 15, 10.0, 10.0, 10.0])
    validate = "emberlink.trainers.evaluation.evaluate.validate"
    monkeypatch.setattr(validate, lambda *_: {"huygens/coverage": next(coverage)})
    tune("independent", [*TINY, f"output={tmp_path}"], PlainConsole(), space=space, trials=6)
    *whole, poor = [len(RunFolder(file.parent).metrics()) for file in runs(tmp_path)]
    assert whole == [3] * 5
    assert poor == 1


@pytest.mark.parametrize(
    ("settings", "text", "message"),
    [
        (["evaluation.interval=0"], "learner.lr: [1.0]", "evaluation.interval=0"),
        ([], "learner.lr: 0.1", "space.yaml: learner.lr: 0.1: expected a list, or low and high"),
    ],
)
def test_a_mistake_is_named(tmp_path, settings, text, message):
    file = tmp_path / "space.yaml"
    file.write_text(text)
    words = [*TINY, *settings, f"output={tmp_path}"]
    with pytest.raises(UserError, match=message):
        tune("independent", words, PlainConsole(), space=file, trials=1)
    assert [*tmp_path.iterdir()] == [file]
