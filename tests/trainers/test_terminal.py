"""Tests output to terminals, pipes and files: names, progress."""

from emberlink.trainers.terminal.console import SafeConsole


def test_escape_sequences_of_names_are_not_printed(capsys):
    SafeConsole().print("run\x1b[31m\x1b]0;title\x9b1m\u202egnp.exe", style="bold")
    assert capsys.readouterr().out == "run?[31m?]0;title?1m?gnp.exe\n"
