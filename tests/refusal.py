"""Runs commands whose input is invalid."""

from emberlink.trainers.cli import main


def refused(arguments, capsys, *words: str) -> str:
    """Checks that a command ends with status 2 and one line, and returns the line.

    Args:
        arguments: of the command, text or paths.
        capsys: fixture of pytest.
        words: texts that the line contains.
    """
    capsys.readouterr()
    try:
        status = main.main([*map(str, arguments)])
    except SystemExit as ended:  # of argparse, for options
        status = ended.code
    out, err = capsys.readouterr()
    assert (status, err.count("\n")) == (2, 1), out + err
    for word in words:
        assert word in err, err
    return err
