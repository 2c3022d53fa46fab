"""The end of a run: it is finished with the evaluation of its newest checkpoint, and not before."""

import errno
import os
import shutil
from pathlib import Path

import pytest
from tiny_run import TINY

from emberlink.trainers import cli, report
from emberlink.trainers.resume import resume
from emberlink.trainers.run_folder import RunFolder


def trained(capsys, *arguments: str | Path) -> tuple[int, str, str]:
    """Status of `emberlink train`, what it printed, and its errors."""
    status = cli.main(["train", *map(str, arguments)])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def run_of(output: Path) -> RunFolder:
    (folder,) = output.iterdir()
    return RunFolder(folder)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def run(tmp_path, capsys) -> RunFolder:
    """A finished run."""
    assert trained(capsys, "independent", *TINY, f"output={tmp_path / 'runs'}")[0] == 0
    return run_of(tmp_path / "runs")


def test_a_disk_that_fills_up_in_the_evaluation(tmp_path, capsys, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(report.figures, "timelapse", full)
        status, _, error = trained(capsys, "consensus", *TINY, f"output={tmp_path / 'runs'}")
    run = run_of(tmp_path / "runs")
    assert status == 2
    assert error.count("\n") == 1
    for words in (f"{run.path / 'figures'}: cannot be written: No space left", "resume with:"):
        assert words in error
    assert not run.evaluated()
    status, said, _ = trained(capsys, f"resume={run.path}")
    assert (status, run.evaluated()) == (0, True)
    assert "is finished" not in said
    assert "is finished" in trained(capsys, f"resume={run.path}")[1]


def test_ctrl_c_in_the_evaluation_of_the_second_seed(tmp_path, capsys, monkeypatch):
    played, evaluate = [], report.evaluate_run

    def stop(run, *arguments, **options):
        if len(played) == 1:
            raise KeyboardInterrupt
        played.append(run)
        return evaluate(run, *arguments, **options)

    more = ["seeds=[3,5]", f"output={tmp_path / 'runs'}"]
    with monkeypatch.context() as patch:
        patch.setattr(report, "evaluate_run", stop)
        status, said, _ = trained(capsys, "independent", *TINY, *more)
    first, second = (RunFolder(path) for path in sorted((tmp_path / "runs").iterdir()))
    assert status == 130
    assert "resume with" in said
    assert (first.evaluated(), second.evaluated()) == (True, False)
    before = (first.path / "eval.json").stat().st_mtime_ns
    assert trained(capsys, f"resume={second.path}")[0] == 0
    assert second.evaluated()
    assert (first.path / "eval.json").stat().st_mtime_ns == before


def test_an_evaluation_of_an_earlier_checkpoint_is_not_the_end(run, capsys):
    status, said, _ = trained(capsys, f"resume={run.path}", "episodes=3")
    assert status == 0
    assert run.evaluated()
    assert run.checkpoint().name == "step_000000045.safetensors"
    (run.path / "eval.json").write_text("{}")
    assert not run.evaluated()
    assert trained(capsys, f"resume={run.path}")[0] == 0
    assert run.evaluated()


def test_a_run_whose_checkpoints_are_gone_is_not_begun_again(run, capsys):
    shutil.rmtree(run.checkpoints)
    before = contents(run.path)
    status, _, error = trained(capsys, f"resume={run.path}")
    assert status == 2
    assert error.count("\n") == 1
    assert f"{run.path}: has metrics of 2 episodes and no checkpoint" in error
    assert contents(run.path) == before


def test_only_what_is_emberlinks_own_is_taken_away(run, capsys):
    own = [run.path / "eval.json.part", run.checkpoints / "step_000000099.safetensors.part"]
    others = [run.path / "thesis.part", run.path / "figures" / "mine.png.part"]
    for path in (*own, *others):
        path.write_text("half")
    bundle = run.path / "divergence_step_7.part"
    bundle.mkdir()
    (bundle / "weights.safetensors").write_bytes(b"half")
    assert trained(capsys, f"resume={run.path}", "episodes=3")[0] == 0
    assert not any(path.exists() for path in (*own, bundle))
    assert all(path.read_text() == "half" for path in others)


def test_a_folder_in_the_place_of_the_metrics(run, capsys):
    (run.path / "metrics.jsonl").unlink()
    (run.path / "metrics.jsonl").mkdir()
    status, _, error = trained(capsys, f"resume={run.path}", "episodes=3")
    assert status == 2
    assert error.count("\n") == 1
    assert f"{run.path / 'metrics.jsonl'}: cannot be read: Is a directory" in error
    with pytest.raises(ValueError, match=r"metrics.jsonl: cannot be written: Is a directory"):
        run.append("metrics.jsonl", {"episode": 3})


def test_the_folder_of_seeds_side_by_side_by_any_path(tmp_path, capsys, monkeypatch):
    more = ["seeds=[0,1]", f"output={tmp_path / 'runs'}"]
    assert trained(capsys, "independent", *TINY, *more)[0] == 0
    first, second = sorted((tmp_path / "runs").iterdir())
    (tmp_path / "link").symlink_to(second)
    monkeypatch.chdir(first)
    for path in (Path("."), Path("../") / second.name, tmp_path / "link"):
        trainer = resume(path, overrides=["episodes=3"])
        assert [run.path.resolve() for run in trainer.runs] == [first, second]
        trainer.close()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("env={}", "'env={}': give its keys one by one, as env.KEY=VALUE"),
        ("learner={gamma: 0.5}", "give its keys one by one, as learner.KEY=VALUE"),
        ("fire.name=paper", "'fire.name=paper': a scenario is chosen with fire=NAME"),
        ("env.reward.exit=-1e13", "env.reward.exit=-10000000000000.0"),
        ("learner.actor_lr=1e31", "learner.actor_lr=1e+31"),
        ("comm.jitter=1e13", "comm.jitter"),
    ],
)
def test_settings_that_would_do_something_else_than_they_say(text, said, tmp_path, capsys):
    status, _, error = trained(capsys, "consensus", *TINY, f"output={tmp_path}", text)
    assert status == 2
    assert error.count("\n") == 1
    assert said in error
    assert not list(tmp_path.iterdir())
