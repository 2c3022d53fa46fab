"""Tests that a run is finished once its newest checkpoint is evaluated."""

import errno
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from inside import Inside
from tiny_run import TINY

from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import command, plots
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.terminal import SafeConsole
from emberlink.trainers.training.command import _resume_hint
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Trainer


def trained(capsys, *arguments: str | Path) -> tuple[int, str, str]:
    """Returns the exit status, the output and the errors of `emberlink train`."""
    status = main.main(["train", *map(str, arguments)])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def run_of(output: Path) -> RunFolder:
    (folder,) = output.iterdir()
    return RunFolder(folder)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def independent(tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("runs")
    assert main.main(["train", "independent", *TINY, f"output={output}"]) == 0
    return run_of(output).path


@pytest.fixture
def run(independent, tmp_path) -> RunFolder:
    """Returns a copy of a finished run."""
    return RunFolder(shutil.copytree(independent, tmp_path / "runs" / independent.name))


def test_a_full_disk_during_the_evaluation(tmp_path, capsys, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(plots, "timelapse", full)
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


@pytest.mark.slow
def test_an_interrupt_during_the_evaluation_of_the_second_seed(tmp_path, capsys, monkeypatch):
    played, evaluate = [], command.evaluate_run

    def stop(run, *arguments, **options):
        if len(played) == 1:
            raise KeyboardInterrupt
        played.append(run)
        return evaluate(run, *arguments, **options)

    more = ["seeds=[3,5]", f"output={tmp_path / 'runs'}"]
    with monkeypatch.context() as patch:
        patch.setattr(command, "evaluate_run", stop)
        status, said, _ = trained(capsys, "independent", *TINY, *more)
    first, second = (RunFolder(path) for path in sorted((tmp_path / "runs").iterdir()))
    assert status == 130
    assert "resume with" in said
    assert (first.evaluated(), second.evaluated()) == (True, False)
    before = (first.path / "eval.json").stat().st_mtime_ns
    assert trained(capsys, f"resume={second.path}")[0] == 0
    assert second.evaluated()
    assert (first.path / "eval.json").stat().st_mtime_ns == before


@pytest.mark.heavy
def test_an_evaluation_of_an_earlier_checkpoint_does_not_finish_a_run(run, capsys):
    assert trained(capsys, f"resume={run.path}", "episodes=3")[0] == 0
    assert run.evaluated()
    assert run.checkpoint().name == "step_000000045.safetensors"
    (run.path / "eval.json").write_text("{}")
    assert not run.evaluated()
    assert trained(capsys, f"resume={run.path}")[0] == 0
    assert run.evaluated()


def test_a_run_with_deleted_checkpoints_is_not_restarted(run, capsys):
    shutil.rmtree(run.checkpoints)
    before = contents(run.path)
    status, _, error = trained(capsys, f"resume={run.path}")
    assert status == 2
    assert error.count("\n") == 1
    assert f"{run.path}: has metrics of 2 episodes and no checkpoint" in error
    assert contents(run.path) == before


def test_a_killed_run_begins_again_with_a_shorter_interval(run, capsys):
    shutil.rmtree(run.checkpoints)
    (run.path / "eval.json").unlink()
    config = yaml.safe_load((run.path / "config.yaml").read_text()) | {"checkpoint_interval": 5}
    (run.path / "config.yaml").write_text(yaml.safe_dump(config))
    assert trained(capsys, f"resume={run.path}", "checkpoint_interval=1")[0] == 0
    assert len(run.lines()) == 2
    assert run.config().checkpoint_interval == 1


def test_the_best_networks_are_chosen_anew_by_another_measure(run):
    more = ["episodes=3", "evaluation.headline=coverage"]
    same = resume(run.path, overrides=more)
    same.close()
    assert same.best == [max(line["coverage"] for line in run.lines())]
    for text in ("headline=tracking_last", "interval=1", "huygens=false", "interval_episodes=3"):
        other = resume(run.path, overrides=[*more, f"evaluation.{text}"])
        other.close()
        assert other.best == [None], text


def test_only_files_of_emberlink_are_removed(run, capsys):
    removed = [
        run.path / "eval.json.17.part",
        run.path / "figures" / "coverage.png.17.part",
        run.checkpoints / "step_000000099.safetensors.17.part",
    ]
    others = [run.path / "thesis.part", run.path / "figures" / "mine.png.part"]
    for path in (*removed, *others):
        path.write_text("half")
    bundle = run.path / "divergence_step_7.part"
    bundle.mkdir()
    (bundle / "weights.safetensors").write_bytes(b"half")
    assert trained(capsys, f"resume={run.path}", "episodes=3")[0] == 0
    assert not any(path.exists() for path in (*removed, bundle))
    assert all(path.read_text() == "half" for path in others)


def test_a_folder_named_like_the_metrics(run, capsys):
    (run.path / "metrics.jsonl").unlink()
    (run.path / "metrics.jsonl").mkdir()
    status, _, error = trained(capsys, f"resume={run.path}", "episodes=3")
    assert status == 2
    assert error.count("\n") == 1
    assert f"{run.path / 'metrics.jsonl'}: cannot be read: Is a directory" in error
    with pytest.raises(ValueError, match=r"metrics.jsonl: cannot be written: Is a directory"):
        run.append("metrics.jsonl", {"episode": 3})


def test_the_folder_of_parallel_seeds_by_any_path(tmp_path, capsys, monkeypatch):
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
        ("fire.name=paper", "fire.name=paper: choose it with fire=NAME"),
        ("env.reward.exit=-1e13", "env.reward.exit=-10000000000000.0"),
        ("learner.actor_lr=1e31", "learner.actor_lr=1e+31"),
        ("comm.jitter=1e13", "comm.jitter"),
    ],
)
def test_settings_that_cannot_be_changed_are_refused(text, said, tmp_path, capsys):
    status, _, error = trained(capsys, "consensus", *TINY, f"output={tmp_path}", text)
    assert status == 2
    assert error.count("\n") == 1
    assert said in error
    assert not list(tmp_path.iterdir())


def test_the_folder_stays_locked_until_the_evaluation_is_written(tmp_path, capsys, monkeypatch):
    seen, evaluate = [], command.evaluate_run

    def look(run, *arguments, **options):
        with pytest.raises(ValueError, match="is training here"):
            resume(run.path)
        seen.append(run)
        return evaluate(run, *arguments, **options)

    monkeypatch.setattr(command, "evaluate_run", look)
    more = ["seeds=[0,1]", f"output={tmp_path / 'runs'}"]
    assert trained(capsys, "independent", *TINY, *more)[0] == 0
    assert len(seen) == 2
    assert not list((tmp_path / "runs").glob("*/lock"))


KILLED = """
import os, signal, sys
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.cli.main import main
import emberlink.trainers.training.command

def counted(real):
    def wrapped(*given):
        if next(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*given)
    return wrapped

RunFolder.write = counted(RunFolder.write)
RunFolder.write_config = counted(RunFolder.write_config)
for call in (3, 4):
    calls = iter(range(1, 99))
    child = os.fork()  # after the imports, which take longer than the rest
    if child == 0:
        os._exit(main([*sys.argv[2:], f"output={sys.argv[1]}/{call}"]))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
"""


@pytest.mark.heavy
def test_a_kill_during_the_creation_of_the_folders_of_seeds(tmp_path, capsys):
    """Either no folder looks like a run, or the run can be resumed with all its seeds."""
    arguments = ["independent", *TINY, "seeds=[0,1]"]
    program = [sys.executable, "-c", KILLED, str(tmp_path), "train", *arguments]
    ended = subprocess.run(program, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    started = []
    for call in (3, 4):
        runs = tmp_path / str(call)
        folders = sorted(runs.iterdir())
        assert len(folders) == 2
        first, second = map(RunFolder, folders)
        assert first.has_config() >= second.has_config()
        started.append(first.has_config())
        if first.has_config():
            assert trained(capsys, f"resume={second.path}")[0] == 0
            assert [RunFolder(path).config().seed for path in folders] == [0, 1]
            assert first.evaluated()
            assert second.evaluated()
        repeated = [*arguments, f"output={runs}"]
        assert sweep(repeated, SafeConsole(), executor=Inside()) == 0
        complete = [RunFolder(file.parent) for file in runs.glob("*/config.yaml")]
        assert [run.evaluated() for run in complete] == [True, True]
    assert started == [False, True]


def test_copies_of_a_user_are_not_part_of_the_run(run, capsys):
    newest, state = run.checkpoint(), run.states()[-1]
    for name in ("step_mine.safetensors", "step_1.safetensors", "state_backup.safetensors"):
        shutil.copy(state if "state" in name else newest, run.checkpoints / name)
    assert run.checkpoint() == newest
    assert run.states()[-1] == state
    status, said, _ = trained(capsys, f"resume={run.path}", "episodes=3")
    assert status == 0
    assert "resumed at step 30" in said
    assert run.evaluated()
    assert (run.checkpoints / "state_backup.safetensors").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"folders": []}', "does not name the folders"),
        ('{"folders": ["' + 5000 * "x" + '"]}', "does not name the folders"),
        ('{"folders": ["elsewhere"]}', "does not name the folders"),
        ('{"folders": 3}', "does not name the folders"),
    ],
)
def test_invalid_lists_of_seed_folders(content, said, run, capsys):
    (run.path / "seed_runs.json").write_text(content)
    status, _, error = trained(capsys, f"resume={run.path}")
    assert status == 2
    assert error.count("\n") == 1
    assert f"{run.path / 'seed_runs.json'}: {said}" in error


@pytest.mark.parametrize("other", ["..", ".", "", "a/../..", "Documents", "copy"])
def test_a_list_of_seed_folders_leads_to_no_folder_of_the_user(other, run, capsys):
    """The list may come from a stranger; `resume=` writes into the folders that it names."""
    (run.path.parent / "Documents").mkdir()
    copy = run.path.parent / "copy"
    copy.mkdir()
    (copy / "seed_runs.json").write_text('{"folders": ["copy"]}')
    text = yaml.safe_load((run.path / "config.yaml").read_text()) | {"seeds": [0, 1]}
    (run.path / "config.yaml").write_text(yaml.safe_dump(text))
    (run.path / "seed_runs.json").write_text(json.dumps({"folders": [run.path.name, other]}))
    before = contents(run.path.parent.parent)
    status, _, error = trained(capsys, f"resume={run.path}")
    assert status == 2
    assert error.count("\n") == 1
    assert "seed_runs.json" in error
    assert contents(run.path.parent.parent) == before


def test_a_seed_of_another_training_is_refused(tmp_path, capsys):
    more = ["seeds=[0,1]", f"output={tmp_path}"]
    assert trained(capsys, "independent", *TINY, *more)[0] == 0
    first, second = sorted(tmp_path.iterdir())
    text = (second / "config.yaml").read_text()
    for old, new, said in (
        ("tau: 0.001", "tau: 0.002", "not of the run of"),
        ("\nseed: 1", "\nseed: 7", "seed=7, not 1"),
    ):
        assert old in text
        (second / "config.yaml").write_text(text.replace(old, new))
        status, _, error = trained(capsys, f"resume={first}")
        assert status == 2
        assert said in error


def test_folders_named_like_temporary_files_are_kept(run, capsys):
    for name in ("eval.json.17.part", "checkpoints/x.safetensors.17.part", "checkpoints/.tmpx"):
        (run.path / name).mkdir()
    (run.checkpoints / "step_999999999.safetensors").mkdir()
    (run.path / "divergence_step_3.part").write_text("mine")
    assert trained(capsys, f"resume={run.path}", "episodes=3")[0] == 0
    assert (run.path / "divergence_step_3.part").read_text() == "mine"


@pytest.mark.heavy
def test_an_infinite_range_round_trips(tmp_path, capsys):
    arguments = ["consensus", *TINY, "env.radio.range=inf", f"output={tmp_path / 'runs'}"]
    assert trained(capsys, *arguments)[0] == 0
    run = run_of(tmp_path / "runs")
    assert run.config().env.radio.range == float("inf")
    assert trained(capsys, f"resume={run.path}", "episodes=3")[0] == 0
    assert main.main(["eval", str(run.path), "--fires", "2"]) == 0
    assert main.main(["compare", str(run.path), "--output", str(tmp_path / "out")]) == 0


@pytest.fixture(scope="module")
def tuned(tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("tuned")
    assert main.main(["train", "consensus", *TINY, "setup=tuned", f"output={output}"]) == 0
    return run_of(output).path


@pytest.mark.slow
@pytest.mark.parametrize("key", ["displacement", "num_uavs", "new_fire", "range"])
def test_a_configuration_that_lacks_a_key_is_refused(key, tuned, tmp_path, capsys):
    """Its default may belong to another setup and change the evaluated world."""
    run = RunFolder(shutil.copytree(tuned, tmp_path / "run"))
    file = run.path / "config.yaml"
    pattern = re.compile(rf"^ *{key}: .*\n|\b{key}: [^,}}\n]*, ", re.MULTILINE)
    text, count = pattern.subn("", file.read_text(), count=1)
    assert count == 1
    file.write_text(text)
    assert main.main(["eval", str(run.path)]) == 2
    error = capsys.readouterr().err
    assert f"{file}: key " in error
    assert f".{key}' is missing" in error


def test_metrics_are_flushed_before_the_state(tmp_path, monkeypatch):
    """Otherwise a loss of power could leave a state that counts missing lines."""
    trainer = Trainer(resolve("independent", [*TINY, "episodes=1", f"output={tmp_path}"]))
    run = trainer.start()
    synced: list[str] = []
    flush = os.fsync

    def note(handle: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{handle}"))
        flush(handle)

    monkeypatch.setattr(os, "fsync", note)
    trainer.train()
    names = [Path(path).name for path in synced]
    state = names.index(f"state_000000015.safetensors.{os.getpid()}.part")
    assert {"metrics.jsonl", "timing.jsonl"} <= set(names[:state])
    del synced[:]
    run.write("eval.json", {})
    assert [Path(path).name.split(".")[0] for path in synced] == ["eval", run.path.name]


def test_the_command_to_resume_can_be_copied():
    run = RunFolder("a b;c/x_s0")
    trainer: Any = SimpleNamespace(run=run, config=SimpleNamespace(on_nan="stop"))
    words = shlex.split(_resume_hint(trainer).partition("with: ")[2])
    assert words == ["emberlink", "train", "resume=a b;c/x_s0"]
