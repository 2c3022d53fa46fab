"""Tests closed and full outputs, encodings, signals and internal errors."""

import io
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from test_cli import check_evaluation
from tiny_run import PROGRAM, TINY

from emberlink.trainers.cli import main
from emberlink.trainers.runs.checkpoints import step_of
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training import self_test

ENDLESS = [*TINY, "episodes=100000"]


def started(arguments: list[str], stdout: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments],
        stdout=stdout,  # pyright: ignore
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        # Under nohup SIGHUP is ignored, and subprocesses inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )


def wait_for(condition, process, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.05)


def check_saved(output: Path) -> None:
    """Checks that a training was saved and its folder is unlocked, so that it can be resumed."""
    (folder,) = output.iterdir()
    run = RunFolder(folder)
    assert run.states()
    assert run.checkpoint().exists()
    assert not (folder / "lock").exists()


@pytest.mark.heavy
def test_a_closed_pipe_ends_the_training_with_a_checkpoint(tmp_path):
    process = started(["train", "independent", *ENDLESS, f"output={tmp_path}"], subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()  # like `| head -1`
        _, error = process.communicate(timeout=400)
    finally:
        process.kill()
    assert process.returncode == 2
    assert error.count("\n") == 1
    assert "standard output: Broken pipe; the last good checkpoint is" in error
    check_saved(tmp_path)


@pytest.mark.heavy
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_full_output_is_an_error_and_unlocks_the_folder(tmp_path):
    with open("/dev/full", "w") as full:
        process = started(["train", "independent", *TINY, f"output={tmp_path}"], full)
        _, error = process.communicate(timeout=400)
    assert process.returncode == 2
    assert error.count("\n") == 1
    assert error.startswith("emberlink train: standard output: No space left on device; ")
    (folder,) = tmp_path.iterdir()
    assert not (folder / "lock").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_output_of_other_commands_is_one_line(unbuffered):
    """Status 0 would let a script go on without the text that it redirected to a full disk."""
    program = (
        "import os, sys\n"
        "from emberlink.trainers.cli.main import main\n"
        "for arguments in [], ['--help'], ['--version'], ['fire'], ['train', '-h'], ['list']:\n"
        "    if os.fork() == 0:\n"
        "        sys.exit(main(arguments))\n"
        "    print(os.waitstatus_to_exitcode(os.wait()[1]), file=sys.stderr)\n"
    )
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, "-c", program],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        )
    reason = "standard output: cannot be written: No space left on device\n1\n"
    assert ended.stderr == "".join(
        f"emberlink{name}: {reason}" for name in ("", "", "", " fire", "", " list")
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_wrong_argument_has_status_2_also_if_it_cannot_be_said():
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "emberlink.trainers.cli", "eval"], stderr=full
        )
    assert ended.returncode == 2


@pytest.mark.heavy
def test_a_closed_output_is_one_line():
    ended = subprocess.run(
        [sys.executable, "-m", "emberlink.trainers.cli", "list", "methods"],
        preexec_fn=lambda: os.close(1),
        stderr=subprocess.PIPE,
        text=True,
    )
    assert ended.returncode == 1
    assert ended.stderr == "emberlink list: standard output: cannot be written: it is closed\n"


WARNS = """
import warnings
from emberlink.trainers.cli import list, main
def names(_):
    for _ in range(2):
        warnings.warn("fires are\\nnot \\x1b[31m cached", stacklevel=2)
    warnings.warn("of a library", RuntimeWarning, stacklevel=2)
    return []
list.described = names
"""


def test_a_warning_is_one_line_without_a_path():
    program = WARNS + (
        "warnings.simplefilter('always')\n"
        "before = warnings.formatwarning, warnings.showwarning\n"
        "main.main(['list', 'methods'])\n"
        "assert (warnings.formatwarning, warnings.showwarning) == before\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    line, other, *_ = ended.stderr.splitlines()
    assert line == "emberlink: warning: fires are not ?[31m cached"
    assert "RuntimeWarning: of a library" in other


def test_a_warning_of_a_command_can_be_recorded(monkeypatch):
    names: dict[str, object] = {}
    exec(WARNS.replace("list.described = names", ""), names)
    monkeypatch.setattr("emberlink.trainers.cli.list.described", names["names"])
    with pytest.warns() as caught:
        assert main.main(["list", "methods"]) == 0
    assert [warning.category for warning in caught] == [UserWarning, UserWarning, RuntimeWarning]


@pytest.mark.heavy
@pytest.mark.drawn
def test_a_lost_terminal_ends_the_training_with_a_checkpoint(tmp_path, capsys):
    """The run can then be evaluated."""
    process = started(["train", "independent", *ENDLESS, f"output={tmp_path}"], subprocess.PIPE)
    try:
        wait_for(lambda: any(tmp_path.glob("*/metrics.jsonl")), process, seconds=400)
        process.send_signal(signal.SIGHUP)
        out, error = process.communicate(timeout=400)
    finally:
        process.kill()
    assert process.returncode == 129, error
    assert "Traceback" not in error
    assert "stopped" in out
    assert "resume with: emberlink train resume=" in out
    check_saved(tmp_path)
    (folder,) = tmp_path.iterdir()
    done = len((folder / "metrics.jsonl").read_text().splitlines())
    assert done <= step_of(RunFolder(folder).checkpoint()) / 15 < done + 1
    assert not list(folder.rglob("*.part"))
    assert main.main(["eval", str(folder)]) == 0
    check_evaluation(folder, capsys.readouterr().out)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_commands_succeed_with_every_encoding(encoding, run, tmp_path, monkeypatch):
    for arguments in (
        ["compare", str(run), "--output", str(tmp_path / "report")],
        ["fire", "preview", "huygens:0", "--output", str(tmp_path)],
        ["list"],
        [],
    ):
        printed = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, encoding, errors="strict"))
        assert main.main(arguments) == 0
        sys.stdout.flush()
        assert printed.getvalue()
    assert (tmp_path / "report" / "compare.html").exists()


def test_an_internal_error_keeps_its_traceback(monkeypatch):
    def fail(*_):
        raise ValueError("zip() argument 2 is longer than argument 1")

    monkeypatch.setattr("emberlink.trainers.training.command.resolve", fail)
    with pytest.raises(ValueError, match="longer than"):
        main.main(["train", "independent"])


def test_help_is_printed_without_a_command(capsys):
    assert main.main([]) == 0
    assert capsys.readouterr().out.startswith("usage: emberlink")


def test_the_version(capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("emberlink 0.")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train"], ["required: METHOD ("]),
        (["eval"], ["required: RUN ("]),
        (["train", "independent", "--episodes", "5"], ["--episodes", "as episodes=5"]),
        (["train", "independent", "--num-envs=3"], ["--num-envs", "as num_envs=3"]),
        (["eval", "RUN", "--chekpoint", "x"], ["--chekpoint", "did you mean --checkpoint?"]),
    ],
)
def test_usage_errors_suggest_a_correction(arguments, words, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(arguments)
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    for word in words:
        assert word in error


def test_eval_takes_a_single_run(run, capsys):
    assert main.main(["eval", str(run), str(run)]) == 2
    assert "one run is evaluated at a time; compare takes several" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("methods", ["consensus", "independent", "maps", "positional", "shared_memory"]),
        ("setups", ["paper", "released", "strong", "tuned"]),
        ("policies", ["stationary", "oracle"]),
    ],
)
def test_names_are_listed_on_separate_lines(kind, names, capsys):
    assert main.main(["list", kind]) == 0
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert set(names) <= {name for name, _ in lines}
    assert all(len(text) > 10 for _, text in lines)


def test_an_unknown_kind_gives_one_line(capsys):
    assert main.main(["list", "method"]) == 2
    assert capsys.readouterr().err == (
        "emberlink list: 'method' is not known; known: methods, setups, worlds, fires, learners, "
        "executors, policies\n"
    )


def test_doctor_names_a_package_that_is_not_installed(monkeypatch, capsys):
    def version(name: str) -> str:
        if name == "wandb":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(self_test, "version", version)
    monkeypatch.setattr(self_test, "known", lambda group: [])
    assert main.main(["doctor"]) == 0
    assert "pettingzoo 1.0, wandb not installed, hydra-core 1.0" in capsys.readouterr().out


def test_windows_gives_a_one_line_error(monkeypatch, capsys):
    monkeypatch.setattr(sys, "platform", "win32")
    assert main.main(["doctor"]) == 2
    assert capsys.readouterr().err == "emberlink: runs on Linux and macOS; on Windows, use WSL\n"
