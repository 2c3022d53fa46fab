"""Tests encodings, warnings and internal errors."""

import io
import subprocess
import sys

import pytest

from emberlink.trainers.cli import main


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
