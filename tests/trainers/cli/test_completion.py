"""Tests the completion of command lines, in the shells that are installed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from emberlink.trainers.cli import main
from emberlink.trainers.cli.completion import SCRIPTS

METHODS = ["consensus", "independent", "positional", "shared_memory"]


def completed(line: str, capsys) -> list[str]:
    assert main.main(["--complete", *line.split(" ")]) == 0
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("tra", ["train"]),
        ("--comp", ["--completion"]),
        ("--completion ", ["bash", "zsh", "fish"]),
        ("train ", METHODS),
        ("train c", ["consensus", "checkpoint_interval=", "checkpoint_steps="]),
        ("train consensus setup=", ["setup=paper", "setup=released", "setup=tuned"]),
        ("train consensus learner=t", ["learner=td3"]),
        ("train consensus env.ra", ["env.radio."]),
        ("train consensus env.radio.", ["env.radio.range=", "env.radio.loss="]),
        ("train consensus seed=", []),
        ("train consensus comm.head", ["comm.heading."]),
        ("train independent comm.", []),
        ("train consensus executor", []),
        ("sweep executor=su", ["executor=submitit"]),
        ("sweep setup=paper,tu", ["setup=paper,tuned"]),
        ("sweep st", ["status"]),
        ("list wor", ["worlds"]),
        ("list worlds f", ["fires"]),
        ("eval pre", ["pretrained:"]),
        ("eval pretrained:", [*(f"pretrained:{name}" for name in METHODS), "pretrained:tuned/"]),
        ("eval pretrained:tuned/c", ["pretrained:tuned/consensus"]),
        ("compare x pretrained:tuned/consensus/s3", ["pretrained:tuned/consensus/s3"]),
        ("eval x --checkpoint ", []),
        ("render x --policy cour", ["courier"]),
        ("render x --fire hu", ["huygens"]),
        ("fire preview oil", ["oil_slick"]),
        ("world check re", ["relay"]),
        ("world check relay re", ["relay"]),
    ],
)
def test_words_are_completed(line, expected, capsys):
    assert completed(line, capsys) == expected


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
def test_they_are_the_names_that_list_prints(kind, line, capsys):
    main.main(["list", kind])
    listed = [row.split()[0] for row in capsys.readouterr().out.splitlines()]
    assert [word.rpartition("=")[2] for word in completed(line, capsys)] == listed


def test_keys_of_the_chosen_learner_and_own_files_are_known(tmp_path, monkeypatch, capsys):
    assert "learner.policy_delay=" in completed("train m learner=td3 learner.", capsys)
    assert "learner.policy_delay=" not in completed("train m learner.", capsys)
    (tmp_path / "setup").mkdir()
    (tmp_path / "setup" / "mine.yaml").write_text("learner: {own: 1}\n")
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(tmp_path))
    assert completed("train m setup=m", capsys) == ["setup=mine"]
    assert "learner.own=" in completed("train m setup=mine learner.", capsys)


def test_folders_are_completed_and_those_of_runs_end_the_word(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("runs/one", "runs/t w o", "runs/other/deep"):
        Path(name).mkdir(parents=True)
    Path("runs/one/config.yaml").touch()
    assert completed("eval r", capsys) == ["runs/"]
    assert completed("eval runs/", capsys) == ["runs/one", "runs/other/"]
    assert completed("train resume=runs/o", capsys) == ["resume=runs/one", "resume=runs/other/"]


QUICK = """
import sys
from emberlink.trainers.cli import main
for line in ("train ", "train consensus env.", "eval pretrained:", "render x --policy "):
    main.main(["--complete", *line.split(" ")])
print("heavy:", *{"torch", "tensordict", "numpy", "hydra", "pydantic"} & set(sys.modules))
"""


def test_it_imports_nothing_that_is_slow():
    done = subprocess.run([sys.executable, "-c", QUICK], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "heavy:"


TYPED = """emberlink train con
emberlink train consensus setup=tu
emberlink eval pretrained:c
emberlink eval x --checkpoint scr
emberlink list learn
"""
BASH = """
source script
while IFS= read -r line; do
    COMP_LINE="$line" COMP_POINT=${#line}
    _emberlink
    echo "${COMPREPLY[*]}"
done < typed
"""
FISH = """
source script
while read line
    echo (complete -C "$line" | string trim)
end < typed
"""
ZSH = """
compadd() { local -a words; words=("${@[(i)--]}"); shift $words[1]; printf '%s ' "$@"; }
_files() { printf 'files '; }
compdef() { :; }
source script
complete_line() {
    words=("${(@s: :)1}") CURRENT=${#words} PREFIX=$words[-1]
    _emberlink
    echo
}
for line in "${(@f)$(<typed)}"; do complete_line "$line"; done
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
    expected = ["consensus", "tuned", "consensus", "", "learners"]
    assert in_shell("bash", BASH, tmp_path, capsys) == expected


def test_fish_completes(tmp_path, capsys):
    expected = ["consensus", "setup=tuned", "pretrained:consensus", "script", "learners"]
    assert in_shell("fish", FISH, tmp_path, capsys) == expected


def test_zsh_completes(tmp_path, capsys):
    expected = ["consensus", "setup=tuned", "pretrained:consensus", "files", "learners"]
    assert in_shell("zsh", ZSH, tmp_path, capsys) == expected


@pytest.mark.parametrize("shell", ["tcsh", ""])
def test_an_unknown_shell_is_one_line(shell, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["--completion", shell])
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(SCRIPTS) == ["bash", "zsh", "fish"]
