"""Tests output to terminals, pipes and files: names, progress."""

import io
import sys

from emberlink.trainers.terminal.console import SafeConsole, plain_table
from emberlink.trainers.terminal.progress import TrainingProgress


def test_escape_sequences_of_names_are_not_printed(capsys):
    SafeConsole().print("run\x1b[31m\x1b]0;title\x9b1m\u202egnp.exe", style="bold")
    assert capsys.readouterr().out == "run?[31m?]0;title?1m?gnp.exe\n"


def test_a_name_without_spaces_is_not_broken(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    table, folder = plain_table("run", "state", "episodes", "folder"), f"consensus_{'0' * 23}"
    table.add_row("consensus, tuned, paper, seed 0", "unfinished", "3/15", folder)
    SafeConsole().print(table)
    assert folder in capsys.readouterr().out


LINE = {"coverage": 45.06, "mean_reward": -1.234, "front/coverage": 50.0, "front/front_age": 40.0}


def test_a_terminal_shows_a_bar_and_the_lines(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", newline="\n")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "72")
    with TrainingProgress(SafeConsole(), steps=20, episodes=2, headline="coverage") as progress:
        progress.step(10)
        progress.episode(1, LINE)
    stream.flush()
    text = stream.buffer.getvalue().decode()  # pyright: ignore
    assert "step 10/20" in text
    assert "episode 1/2: coverage 45.1 %" in text
