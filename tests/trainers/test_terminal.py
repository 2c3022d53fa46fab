"""Tests output to terminals, pipes and files: encodings, complete tables, progress."""

import io
import os
import sys
from contextlib import suppress

import pytest
from rich.table import Table

from emberlink.trainers.terminal.console import OutputError, SafeConsole
from emberlink.trainers.terminal.progress import TrainingProgress


class Stream(io.TextIOWrapper):
    """A standard output with a given encoding."""

    def __init__(self, encoding: str):
        super().__init__(io.BytesIO(), encoding=encoding, newline="\n")

    @property
    def text(self) -> str:
        self.flush()
        content = self.buffer
        assert isinstance(content, io.BytesIO)
        return content.getvalue().decode(self.encoding)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_every_encoding_can_be_printed_to(encoding, monkeypatch):
    stream = Stream(encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    SafeConsole().print("a → 日 \udcff z")
    SafeConsole().print(table())
    assert stream.text.startswith("a ")
    assert " z\n" in stream.text
    assert "→" in stream.text or encoding != "utf-8"


def test_escape_sequences_of_names_are_not_printed(capsys):
    SafeConsole().print("run\x1b[31m\x1b]0;title\x9b1m\u202egnp.exe", style="bold")
    assert capsys.readouterr().out == "run?[31m?]0;title?1m?gnp.exe\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs Linux's /dev/full")
def test_an_output_that_cannot_be_written_to_is_named(monkeypatch):
    full = open("/dev/full", "w")  # noqa: SIM115
    monkeypatch.setattr(sys, "stdout", full)
    with pytest.raises(OutputError, match="No space left") as caught:
        SafeConsole().print("a line")
    assert caught.value.filename == "standard output"
    with suppress(OSError):
        full.close()


NAMES = ("map_greedy_alone", "consensus, with a long text behind it")
MEASURES = ("coverage", "reward", "exits", "losses", "tracking")


def table() -> Table:
    made = Table(title="evaluation")
    made.add_column()
    for measure in MEASURES:
        made.add_column(measure, justify="right")
    for name in NAMES:
        made.add_row(name, *(f"{place}123.4" for place in range(len(MEASURES))))
    return made


@pytest.mark.parametrize("columns", ["30", "40", "72", "80", None])
def test_a_table_keeps_names_and_numbers_whole_at_every_width(columns, monkeypatch, capsys):
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    SafeConsole().print(table())
    out = capsys.readouterr().out
    words = {"evaluation", *MEASURES, *NAMES[0].split(), *NAMES[1].split(), "0123.4", "4123.4"}
    assert words <= set(out.split())
    longest = max(map(len, out.splitlines()))
    assert longest <= int(columns or 1000)
    assert (out.count("map_greedy_alone") == 1) == (columns not in ("30", "40"))


LINE = {"coverage": 45.06, "mean_reward": -1.234, "front/coverage": 50.0, "front/front_age": 40.0}


def advanced(progress: TrainingProgress, clock: list[float], steps: range) -> None:
    for step in steps:
        clock[0] += 1.0
        progress.step(step)


def test_a_file_gets_a_line_per_episode_and_evaluation(capsys):
    clock = [0.0]
    console = SafeConsole()
    with TrainingProgress(
        console, steps=200, episodes=2, headline="front_age", clock=lambda: clock[0]
    ) as progress:
        advanced(progress, clock, range(1, 101))
        progress.episode(1, LINE)
    assert capsys.readouterr().out.splitlines() == [
        "episode 1/2: coverage 45.1 %, mean reward -1.23, 1 steps/s, 0:01:40 left",
        "  without noise, on validation fires: front_age front 40.0",
    ]


def test_a_terminal_shows_a_bar_and_the_lines(monkeypatch):
    stream = Stream("utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "72")
    clock = [0.0]
    with TrainingProgress(SafeConsole(), steps=20, episodes=2, clock=lambda: clock[0]) as progress:
        advanced(progress, clock, range(1, 11))
        progress.episode(1, LINE)
    assert "step 10/20" in stream.text
    assert "0:00:10" in stream.text
    assert "episode 1/2: coverage 45.1 %" in stream.text
