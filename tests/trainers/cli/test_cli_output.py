"""Tests closed and full outputs, encodings, warnings and internal errors."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_run import PROGRAM, TINY

from emberlink.trainers.cli import main

NEEDS_FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")


def started(arguments: list[str], stdout: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments],
        stdout=stdout,  # pyright: ignore
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


@pytest.mark.heavy
def test_a_closed_pipe_ends_the_training_with_a_checkpoint(tmp_path):
    arguments = ["train", "independent", *TINY, "episodes=100000", f"output={tmp_path}"]
    process = started(arguments, subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()  # like `| head -1`
        _, error = process.communicate(timeout=400)
    finally:
        process.kill()
    assert (process.returncode, error.count("\n")) == (2, 1), error
    assert "standard output: Broken pipe; " in error
    assert list(tmp_path.rglob("*.safetensors"))


@pytest.mark.heavy
@NEEDS_FULL
def test_a_full_output_ends_a_training_with_one_line(tmp_path):
    with open("/dev/full", "w") as full:
        process = started(["train", "independent", *TINY, f"output={tmp_path}"], full)
        _, error = process.communicate(timeout=400)
    assert (process.returncode, error.count("\n")) == (2, 1), error
    assert error.startswith("emberlink train: standard output: No space left on device; ")


@NEEDS_FULL
def test_a_full_output_of_other_commands_is_one_line():
    """Status 0 would let a script go on without the text that it redirected to a full disk."""
    program = (
        "import os, sys\n"
        "from emberlink.trainers.cli.main import main\n"
        "for arguments in ['fire'], ['list']:\n"
        "    if os.fork() == 0:\n"
        "        sys.exit(main(arguments))\n"
        "    print(os.waitstatus_to_exitcode(os.wait()[1]), file=sys.stderr)\n"
    )
    with open("/dev/full", "w") as full:
        ended = subprocess.run(
            [sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE, text=True
        )
    reason = "standard output: No space left on device\n1\n"
    assert ended.stderr == f"emberlink fire: {reason}emberlink list: {reason}"


def test_a_warning_is_one_line_without_a_path():
    program = (
        "import warnings\n"
        "from emberlink.trainers.cli import list, main\n"
        "def names(_):\n"
        "    for _ in range(2):\n"
        "        warnings.warn('fires are\\nnot \\x1b[31m cached', stacklevel=2)\n"
        "    warnings.warn('of a library', RuntimeWarning, stacklevel=2)\n"
        "    return [('a', 'b')]\n"
        "list.described = names\n"
        "warnings.simplefilter('always')\n"
        "before = warnings.formatwarning\n"
        "main.main(['list', 'methods'])\n"
        "assert warnings.formatwarning == before\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    line, other, *_ = ended.stderr.splitlines()
    assert line == "emberlink: warning: fires are not ?[31m cached"
    assert "RuntimeWarning: of a library" in other


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


def test_an_internal_error_keeps_its_traceback(monkeypatch):
    def fail(*_):
        raise ValueError("zip() argument 2 is longer than argument 1")

    monkeypatch.setattr("emberlink.trainers.training.command.resolve", fail)
    with pytest.raises(ValueError, match="longer than"):
        main.main(["train", "independent"])


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
