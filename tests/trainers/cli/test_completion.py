"""Tests the completion of command lines, in the shells that are installed."""

import io
import os
import shutil
import subprocess
import sys
from pathlib import Path

import argcomplete
import pytest

from emberlink.trainers.cli import main
from emberlink.trainers.cli.completion import SHELLS

RADIO = [f"env.radio.{name}=" for name in ("range", "loss", "bandwidth")]
SETUPS = [f"setup={name}" for name in ("paper", "released", "strong", "tuned")]
METHODS = ["consensus", "independent", "positional", "shared_memory"]
PRETRAINED = sorted([*METHODS, "maps", "strong/", "strong_front/", "tuned/"])
"""the methods with trained policies"""


ASKED = {
    "_ARGCOMPLETE": "1",
    "_ARGCOMPLETE_IFS": "\n",
    "_ARGCOMPLETE_SHELL": "fish",
    "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
}
"""what a shell's script sets, besides the line"""


@pytest.fixture
def completed(tmp_path, monkeypatch):
    """Returns what a line may become, as a list of words."""
    # argcomplete takes the file descriptor 9, which may be one of pytest.
    monkeypatch.setattr(argcomplete.CompletionFinder, "_init_debug_stream", lambda self: None)
    monkeypatch.setattr(argcomplete.io, "debug_stream", io.StringIO())
    written = tmp_path / "words"

    def words(line: str) -> list[str]:
        line = f"emberlink {line}"
        given = {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        output = {"_ARGCOMPLETE_STDOUT_FILENAME": str(written)}
        with monkeypatch.context() as patch:
            for name, value in (ASKED | given | output).items():
                patch.setenv(name, value)
            with pytest.raises(SystemExit) as ended:
                main.main([])
        assert ended.value.code == 0
        return written.read_text().splitlines()

    return words


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("tra", ["train"]),
        ("--comp", ["--completion"]),
        ("--completion ", ["bash", "zsh", "fish"]),
        ("train ", sorted([*METHODS, "maps"])),
        ("train c", ["consensus", "checkpoint_interval=", "checkpoint_steps="]),
        (
            "train consensus setup=",
            SETUPS,
        ),
        ("train consensus learner=t", ["learner=td3"]),
        ("train consensus env.r", ["env.radio.", "env.reward."]),
        ("train consensus env.ra", RADIO),
        ("train consensus env.radio.", RADIO),
        ("train consensus seed=", []),
        ("train consensus comm.heading.w", ["comm.heading.weight="]),
        ("train independent comm.", []),
        ("train consensus executor", []),
        ("sweep executor=su", ["executor=submitit"]),
        ("sweep setup=paper,tu", ["setup=paper,tuned"]),
        ("sweep st", ["status"]),
        ("list wor", ["worlds"]),
        ("list worlds f", ["fires"]),
        ("eval pre", ["pretrained:"]),
        ("eval pretrained:", [f"pretrained:{name}" for name in PRETRAINED]),
        ("eval pretrained:tuned/c", ["pretrained:tuned/consensus"]),
        ("compare x pretrained:tuned/consensus/s3", ["pretrained:tuned/consensus/s3"]),
        ("eval x --checkpoint f env.rad", RADIO),
        ("render x --policy cour", ["courier"]),
        ("render x --fire hu", ["huygens"]),
        ("fire preview oil", ["oil_slick"]),
        ("world check re", ["relay"]),
        ("world check relay re", ["relay"]),
    ],
)
def test_words_are_completed(line, expected, completed):
    assert completed(line) == expected


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("methods", "train "),
        ("setups", "train m setup="),
        ("worlds", "train m world="),
        ("fires", "train m fire="),
        ("learners", "train m learner="),
        ("executors", "sweep executor="),
        ("policies", "render x --policy "),
    ],
)
def test_they_are_the_names_that_list_prints(kind, line, completed, capsys):
    main.main(["list", kind])
    listed = [row.split()[0] for row in capsys.readouterr().out.splitlines()]
    assert [word.rpartition("=")[2] for word in completed(line)] == listed


def test_keys_of_the_chosen_learner_and_own_files_are_known(tmp_path, monkeypatch, completed):
    assert "learner.policy_delay=" in completed("train m learner=td3 learner.")
    assert "learner.policy_delay=" not in completed("train m learner.")
    (tmp_path / "setup").mkdir()
    (tmp_path / "setup" / "mine.yaml").write_text("learner: {own: 1}\n")
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(tmp_path))
    assert completed("train m setup=m") == ["setup=mine"]
    assert "learner.own=" in completed("train m setup=mine learner.")


def test_folders_are_completed_and_those_of_runs_end_the_word(tmp_path, monkeypatch, completed):
    monkeypatch.chdir(tmp_path)
    for name in ("runs/one", "runs/t w o", "runs/other/deep"):
        Path(name).mkdir(parents=True)
    Path("runs/one/config.yaml").touch()
    assert completed("eval r") == ["runs/"]
    assert completed("eval runs/") == ["runs/one", "runs/other/", "runs/t w o/"]
    assert completed("train resume=runs/o") == ["resume=runs/one", "resume=runs/other/"]


QUICK = """
import os, sys
from emberlink.trainers.cli import main
for line in ("train ", "train consensus env.", "eval pretrained:", "render x --policy "):
    line = "emberlink " + line
    os.environ |= {"COMP_LINE": line, "COMP_POINT": str(len(line))}
    try:
        main.main([])
    except SystemExit:
        print(open(os.environ["_ARGCOMPLETE_STDOUT_FILENAME"]).read().count("\\n") > 1)
print("heavy:", *{"torch", "tensordict", "numpy", "hydra", "pydantic"} & set(sys.modules))
"""


def test_it_imports_nothing_that_is_slow(tmp_path):
    environment = os.environ | ASKED | {"_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words")}
    command = [sys.executable, "-c", QUICK]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True"] * 4 + ["heavy:"]


TYPED = """emberlink train con
emberlink train consensus setup=tu
emberlink eval pretrained:c
emberlink eval x --checkpoint scr
emberlink list learn
"""
BASH = """
source script
while IFS= read -r line; do
    COMP_LINE="$line" COMP_POINT=${#line} COMP_TYPE=9 COMPREPLY=()
    _python_argcomplete emberlink
    echo "${COMPREPLY[*]}"
done < typed
"""
FISH = """
source script
while read line
    echo (complete -C "$line" | string split -f 1 \\t | string trim)
end < typed
"""
ZSH = """
autoload is-at-least
compdef() { :; }
_describe() { print -r -- "${${(@)${(P)2}%:*}//\\\\\\:/:}"; }
source script
for line in "${(@f)$(<typed)}"; do
    words=("${(@s: :)line}") BUFFER=$line CURSOR=${#line}
    _python_argcomplete
done
"""


def in_shell(shell: str, lines: str, folder: Path, capsys) -> list[str]:
    """Runs lines in a shell, beside a file `script` and with a command `emberlink`."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    with pytest.raises(SystemExit):
        main.main(["--completion", shell])
    (folder / "script").write_text(capsys.readouterr().out)
    (folder / "typed").write_text(TYPED)
    (folder / "lines").write_text(lines)
    command = folder / "emberlink"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m emberlink.trainers.cli "$@"\n')
    command.chmod(0o755)
    quiet = {"bash": ["--norc"], "zsh": ["-f"], "fish": ["--no-config"]}[shell]
    done = subprocess.run(
        [shell, *quiet, "lines"],
        cwd=folder,
        env={**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return [line.strip() for line in done.stdout.splitlines()]


def test_bash_completes(tmp_path, capsys):
    # After "=" and ":" bash completes a word of its own.
    expected = ["consensus", "tuned", "consensus", "script", "learners"]
    assert in_shell("bash", BASH, tmp_path, capsys) == expected


def test_fish_completes(tmp_path, capsys):
    expected = ["consensus", "setup=tuned", "pretrained:consensus", "script", "learners"]
    assert in_shell("fish", FISH, tmp_path, capsys) == expected


def test_zsh_completes(tmp_path, capsys):
    expected = ["consensus", "setup=tuned", "pretrained:consensus", "script", "learners"]
    assert in_shell("zsh", ZSH, tmp_path, capsys) == expected


@pytest.mark.parametrize("shell", ["tcsh", ""])
def test_an_unknown_shell_is_one_line(shell, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["--completion", shell])
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(SHELLS) == ["bash", "zsh", "fish"]
