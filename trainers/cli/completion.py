"""Completes commands, methods and runs in a shell; the library argcomplete does the rest."""

import argparse
import glob
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

from emberlink.envs.utils import config_files

SHELLS = ("bash", "zsh", "fish")


class PrintScript(argparse.Action):
    """Prints the script of a shell."""

    def __call__(self, parser: Any, namespace: Any, values: Any, *_: Any) -> None:
        from argcomplete.shell_integration import shellcode

        print(shellcode(["emberlink"], shell=values))
        parser.exit()


def answer(parser: argparse.ArgumentParser) -> None:
    """Answers the script of a shell and exits, if it asks for words."""
    import argcomplete

    words: Any = _words
    argcomplete.autocomplete(
        parser, always_complete_options=False, exit_method=sys.exit, default_completer=words
    )


def _words(prefix: str, action: argparse.Action, **_: Any) -> list[str]:
    """Returns the words of an argument by what its help calls it."""
    from argcomplete.completers import FilesCompleter

    name = str(action.metavar)
    if name.startswith("METHOD"):
        return config_files.known("method")
    if name.startswith("RUN"):
        folders = [path.rstrip("/") for path in glob.glob(f"{glob.escape(prefix)}*/")]
        shipped = Path(str(files("emberlink.policies"))) / "pretrained"
        paths = {file.parent.parent for file in shipped.glob("*/*/*/config.yaml")}
        names = sorted(f"pretrained:{path.relative_to(shipped)}" for path in paths)
        return [*names, *sorted(folders)]
    return FilesCompleter()(prefix)
