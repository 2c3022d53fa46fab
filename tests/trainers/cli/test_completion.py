"""Tests the completion of commands and names, in the shells that are installed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = "import sys; from emberlink.trainers.cli.main import main; sys.exit(main())"


def completed(line: str, folder: Path) -> list[str]:
    """Returns the completions of a line's last word, asked as a shell's script does."""
    written = folder / "words"
    line = f"emberlink {line}"
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SHELL": "fish",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(written),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    imported = "import atexit, sys; atexit.register(lambda: print('torch' in sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", f"{imported}\n{PROGRAM}"],
        env={**os.environ, **asked},
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "False\n", done.stderr
    return [word.split("\t")[0].strip() for word in written.read_text().splitlines()]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("tra", {"train"}),
        ("train con", {"consensus"}),
        ("eval pretrained:strong/m", {"pretrained:strong/maps"}),
    ],
)
def test_commands_and_names_are_completed(line, expected, tmp_path):
    (tmp_path / "runs").mkdir()
    assert set(completed(line, tmp_path)) == expected
