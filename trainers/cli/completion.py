"""Completes commands, methods and runs for the script of `register-python-argcomplete`."""

import argparse
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

from emberlink.envs.utils import config_files


def answer(parser: argparse.ArgumentParser) -> None:
    """Answers the script of a shell and exits, if it asks for words."""
    import argcomplete

    words: Any = _words
    argcomplete.autocomplete(
        parser, always_complete_options=False, exit_method=sys.exit, default_completer=words
    )


def _words(prefix: str, action: argparse.Action, **_: Any) -> list[str]:
    """Returns the words of an argument by what its help calls it."""
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    name = str(action.metavar)
    if name.startswith("METHOD"):
        return config_files.known("method")
    if name.startswith("RUN"):
        folders = DirectoriesCompleter()(prefix)
        shipped = Path(str(files("emberlink.policies"))) / "pretrained"
        paths = {file.parent.parent for file in shipped.glob("*/*/*/config.yaml")}
        names = sorted(f"pretrained:{path.relative_to(shipped)}" for path in paths)
        return [*names, *sorted(folders)]
    return FilesCompleter()(prefix)
