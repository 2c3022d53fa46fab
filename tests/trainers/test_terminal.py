"""Tests output to terminals, pipes and files: encodings, complete tables, progress."""

import io
import os
import sys
from contextlib import suppress

import pytest
from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.trainers.terminal import (
    OutputError,
    SafeConsole,
    TrainingProgress,
    print_table,
)
from emberlink.trainers.terminal.progress import BETWEEN_LINES, FIRST_LINE, TimeLeft


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


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1", "utf-8"])
def test_every_encoding_can_be_printed_to(encoding, monkeypatch):
    stream = Stream(encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    SafeConsole().print("a → b, c ↑ … \udcff 日")
    assert (
        stream.text
        == {
            "ascii": "a -> b, c ^ ... ? ?\n",
            "latin-1": "a -> b, c ^ ... ? ?\n",
            "cp1252": "a -> b, c ^ … ? ?\n",
            "utf-8": "a → b, c ↑ … ? 日\n",
        }[encoding]
    )


def test_escape_sequences_of_names_are_not_printed(capsys):
    SafeConsole().print("run\x1b[31m\x1b]0;title\x07\x9b1m\u202egnp.exe", style="bold")
    assert capsys.readouterr().out == "run?[31m?]0;title?1m?gnp.exe\n"


@pytest.mark.parametrize(("columns", "width"), [("0", None), ("", None), ("33", 33), (None, None)])
def test_columns_sets_the_width_of_a_pipe(columns, width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns or "")
    if columns is None:
        monkeypatch.delenv("COLUMNS")
    console = SafeConsole()
    assert console.line_width == width
    console.print("words " * 10)
    assert capsys.readouterr().out.split() == ["words"] * 10


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs Linux's /dev/full")
def test_an_output_that_cannot_be_written_to_is_named(monkeypatch):
    full = open("/dev/full", "w")  # noqa: SIM115
    monkeypatch.setattr(sys, "stdout", full)
    with pytest.raises(OutputError, match="No space left") as caught:
        SafeConsole().print("a line")
    assert caught.value.filename == "standard output"
    with suppress(OSError):
        full.close()


def table(label: str) -> Table:
    made = Table(title="title", caption="caption")
    made.add_column("name")
    made.add_column("mean", justify="right")
    made.add_column("95 %\ninterval", justify="right")
    made.add_row(Text("coverage", "bold"))
    made.add_row(label, Text("12.3"), "[10.1, 14.5]")
    made.add_row("b", "1", "2")
    return made


def printed(width: int, label: str) -> list[str]:
    console = Console(width=width, file=io.StringIO(), record=True)
    print_table(console, table(label))
    return console.export_text().splitlines()


def test_a_table_that_fits_has_one_part():
    assert printed(40, "consensus") == [
        "title",
        "                       95 %",
        "name      mean     interval",
        "---------------------------",
        "coverage",
        "consensus 12.3 [10.1, 14.5]",
        "b            1            2",
        "caption",
        "",
    ]


def test_a_long_name_is_wrapped_and_indented():
    assert printed(40, "consensus (learner=ippo, episodes=9)")[1:7] == [
        "                                    95 %",
        "name                   mean     interval",
        "-" * 40,
        "coverage",
        "consensus              12.3 [10.1, 14.5]",
        "  (learner=ippo,",
    ]


def test_a_name_with_underscores_is_wrapped_after_one():
    lines = printed(29, "random_waypoints")
    assert "random_     12.3 [10.1, 14.5]" in lines
    assert lines[lines.index("random_     12.3 [10.1, 14.5]") + 1] == "waypoints"


@pytest.mark.parametrize("width", [12, 20, 40, 64, 72, 80, 120])
def test_a_table_shows_every_cell_completely(width):
    label = "consensus (learner.batch_size=64)"
    text = "\n".join(printed(width, label))
    for cell in (*label.split(), "12.3", "[10.1, 14.5]"):
        assert cell in text


@pytest.mark.parametrize("width", [60, 72, 80])
def test_no_line_is_wider_than_the_terminal(width):
    assert max(map(len, printed(width, "consensus (learner=ippo, policy.memory=none)"))) <= width


def test_the_console_splits_every_table(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "24")
    SafeConsole().print(table("a_name_of_runs (learner=ippo)"))
    text = capsys.readouterr().out
    assert "  (learner=ippo)" in text
    assert "[10.1, 14.5]" in text
    assert "title (part 2 of 2)" in text


def times(seconds: list[tuple[float, int, int]], steps: int = 1000) -> TimeLeft:
    left = TimeLeft(steps)
    for now, step, updates in seconds:
        left.add(now, step, updates)
    return left


def test_the_remaining_time_is_estimated_from_steps_with_updates():
    quick = [(step * 0.01, step, 0) for step in range(101)]
    slow = [(1 + i * 1.0, 100 + i, i) for i in range(1, 11)]
    assert times(quick).seconds is None
    assert times(quick).speed == pytest.approx(100)
    left = times(quick + slow)
    assert left.seconds == pytest.approx(1000 - 110)
    assert times(quick + slow[:2]).seconds is None  # too few steps
    later = times(quick + [(1 + i, 100 + i, i) for i in range(1, 101)])
    assert later.seconds == pytest.approx(800)
    assert later.speed == pytest.approx(1, rel=0.05)


def test_the_speed_is_averaged_over_an_episode_whose_updates_take_long():
    """An episode has ten decisions of ten steps in a second; the last one waits a minute."""
    left, now = TimeLeft(1000, span=100), 0.0
    left.add(now, 0, 0)
    for step in range(10, 301, 10):
        now += 61 if step % 100 == 0 else 1
        left.add(now, step, step // 100)
        if step > 100:
            assert left.speed == pytest.approx(100 / 70, rel=0.01)


def test_the_remaining_time_begins_again_after_a_rollback():
    steps = [(i * 1.0, 100 + i, i) for i in range(1, 51)]
    after = [(60 + i * 1.0, 2 * i, i) for i in range(1, 11)]
    left = times(steps + after)
    assert left.speed == pytest.approx(2)
    assert left.seconds == pytest.approx((1000 - 20) / 2)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


LINE = {"episode": 1, "updates": 90, "coverage": 45.06, "mean_reward": -1.234}


def test_a_file_gets_lines_during_and_after_episodes(capsys):
    clock = Clock()
    progress = TrainingProgress(SafeConsole(), steps=2000, episodes=2, clock=clock)
    with progress:
        for step in range(1, 1001):
            clock.now = float(step)
            progress.step(step, step // 1000, max(step - 100, 0))
        lines = [LINE, {**LINE, "coverage": 46.06}]
        progress.episode(1, [{**line, "huygens/coverage": 50.0} for line in lines])
    printed = capsys.readouterr().out.splitlines()
    first = f"episode 1/2, step {FIRST_LINE:.0f}/2000: 1.0 steps/s, no updates yet"
    assert printed[0] == first
    assert printed[2] == (
        f"episode 1/2, step {FIRST_LINE + 2 * BETWEEN_LINES:.0f}/2000: 1.0 steps/s, 0:31:10 left"
    )
    assert len(printed) == 1 + 990 // BETWEEN_LINES + 2
    assert printed[-2:] == [
        "episode 1/2: coverage 45.6 %, mean reward -1.23, 1.0 steps/s, 0:16:40 left",
        "  without noise, on validation fires: coverage huygens 50.0 %",
    ]
    assert max(map(len, printed)) <= 80


def test_the_headline_of_the_world_is_printed(capsys):
    evaluated = {"front/coverage": 50.0, "front/base_coverage": 12.34, "front/front_age": 40.0}
    for headline, text in (("base_coverage", "front 12.3 %"), ("front_age", "front 40.0")):
        progress = TrainingProgress(SafeConsole(), steps=2000, episodes=2, headline=headline)
        progress.episode(1, [{**LINE, **evaluated}])
        last = capsys.readouterr().out.splitlines()[-1]
        assert last == f"  without noise, on validation fires: {headline} {text}"


def test_a_terminal_shows_a_bar_and_the_lines(monkeypatch):
    stream = Stream("utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "72")
    clock = Clock()
    with TrainingProgress(SafeConsole(), steps=20, episodes=2, clock=clock) as progress:
        for step in range(1, 11):
            clock.now += 1
            progress.step(step, step // 10, step)
        progress.episode(1, [LINE])
    assert "step 10/20 1.0 steps/s, 0:00:10 left" in stream.text
    assert "episode 1/2: coverage 45.1 %" in stream.text
