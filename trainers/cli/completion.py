"""Completes names and keys on command lines; the library argcomplete does the rest.

A completer is called at each press of the tab key. It imports no torch.
"""

import argparse
import glob
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

from emberlink import configs
from emberlink.configs import entry_points
from emberlink.policies.scripted import ORDER

SHELLS = ("bash", "zsh", "fish")
KINDS = {
    "methods": "method",
    "setups": "setup",
    "worlds": "world",
    "fires": "fire",
    "learners": "learner",
    "executors": "executor",
}
"""kind of `emberlink list` -> group of YAML files"""
_GROUPS = tuple(group for group in KINDS.values() if group != "method")


class PrintScript(argparse.Action):
    """Prints the script of a shell."""

    def __call__(self, parser: Any, namespace: Any, values: Any, *_: Any) -> None:
        from argcomplete.shell_integration import shellcode

        parser._print_message(shellcode(["emberlink"], shell=values), sys.stdout)
        parser.exit()


def answer(parser: argparse.ArgumentParser) -> None:
    """Answers the script of a shell and exits, if it asks for words."""
    import argcomplete

    argcomplete.autocomplete(parser, always_complete_options=False, exit_method=sys.exit)


# Completers get the beginning of a word and the arguments before it, as argcomplete defines.


def kinds(**_: Any) -> list[str]:
    """Returns the kinds of `emberlink list`."""
    return [*KINDS, "policies"]


def policies(**_: Any) -> list[str]:
    """Returns the names of scripted policies."""
    others = [point.name for point in entry_points.read("emberlink.scripted")]
    return [*ORDER, *sorted(others)]


def fires(**_: Any) -> Sequence[str]:
    """Returns the names of scenarios."""
    return configs.known("fire")


def fires_and_files(prefix: str, **_: Any) -> list[str]:
    """Returns the names of scenarios, and files."""
    return [*fires(), *_files(prefix)]


def runs(prefix: str, **_: Any) -> list[str]:
    """Returns the names of trained policies, and folders."""
    return [*_pretrained(prefix), *_folders(prefix)]


def settings(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Iterable[str]:
    """Returns key=value of a run."""
    return _settings(prefix, _given(parsed_args), _GROUPS[:-1])  # the last one is the executor


def method_or_settings(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Iterator[str]:
    """Yields methods, and key=value where a word has begun."""
    yield from configs.known("method")
    if prefix:
        yield from settings(prefix, parsed_args)


def sweep_arguments(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Iterator[str]:
    """Yields methods, `status`, and key=value of runs and of the executor."""
    yield from configs.known("method")
    if not getattr(parsed_args, "arguments", None):
        yield "status"
    yield from _settings(prefix, _given(parsed_args), _GROUPS)


def worlds_and_settings(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Iterator[str]:
    """Yields worlds, and key=value after one or where a word has begun."""
    yield from configs.known("world")
    if prefix or getattr(parsed_args, "arguments", None):
        yield from settings(prefix, parsed_args)


def files_and_settings(prefix: str, parsed_args: argparse.Namespace, **_: Any) -> Iterator[str]:
    """Yields files, and key=value after one or where a word has begun."""
    yield from _files(prefix)
    if prefix or getattr(parsed_args, "arguments", None):
        yield from settings(prefix, parsed_args)


def _files(prefix: str) -> list[str]:
    from argcomplete.completers import FilesCompleter

    return FilesCompleter()(prefix)


def _given(parsed_args: argparse.Namespace) -> list[str]:
    """Returns the words of a command line that are texts."""
    values = vars(parsed_args).values()
    lists = (value if isinstance(value, list) else [value] for value in values)
    return [word for words in lists for word in words if isinstance(word, str)]


def _pretrained(current: str) -> list[str]:
    """Returns the names of trained policies up to their next part."""
    if not current.startswith("pretrained:"):
        return ["pretrained:"]
    shipped = Path(str(package_files("emberlink.policies"))) / "pretrained"
    forms: dict[str, None] = {}
    for path in sorted(shipped.glob("*/*/*/config.yaml")):
        setup, method, seed = path.parts[-4:-1]
        every = (method, f"{setup}/", f"{setup}/{method}", f"{setup}/{method}/{seed}")
        forms |= dict.fromkeys(every)
    depth = current.count("/")
    return [f"pretrained:{form}" for form in sorted(forms) if form.rstrip("/").count("/") == depth]


def _folders(current: str) -> list[str]:
    """Returns the folders whose path begins with a text; those of runs without a final slash."""
    found = sorted(glob.glob(f"{glob.escape(current)}*/"))
    return [path[:-1] if Path(path, "config.yaml").is_file() else path for path in found]


def _settings(current: str, given: Sequence[str], groups: Sequence[str]) -> Iterable[str]:
    """Returns key=value: the keys up to their next part, or the values of a key."""
    key, equals, value = current.partition("=")
    if not equals:
        chosen = dict(word.split("=", 1) for word in given if "=" in word)
        return _keys(_tree(chosen, given, "executor" in groups), current, groups)
    start = f"{key}={value[: value.rfind(',') + 1]}"  # of a list of values, the last one
    names = configs.known(key) if key in groups else []
    if key == "resume":
        names = _folders(value)
    return [start + name for name in names]


def _keys(tree: Any, current: str, groups: Sequence[str]) -> list[str]:
    """Returns the keys that begin with a text, up to their next part.

    A single key does not end in ".", since shells write a space after it: those within it follow.
    """
    *parts, _ = current.split(".")
    inner = tree
    for part in parts:
        inner = inner.get(part, {}) if isinstance(inner, dict) else {}
    start = "".join(f"{part}." for part in parts)
    found = [] if parts else [f"{group}=" for group in groups]
    for name, value in inner.items() if isinstance(inner, dict) else ():
        found.append(f"{start}{name}{'.' if value and isinstance(value, dict) else '='}")
    found = [key for key in found if key.startswith(current)]
    if len(found) == 1 and found[0].endswith("."):
        return _keys(tree, found[0], groups)
    return found


def _tree(chosen: Mapping[str, str], methods: Sequence[str], sweep: bool) -> dict[str, Any]:
    """Returns the keys of the YAML files that are chosen, nested."""
    tree = _read("", "base")
    for group in ("setup", "world"):
        tree = _merged(tree, _read(group, chosen.get(group, "paper")))
    for method in methods:
        tree = _merged(tree, _read("method", method))
    usual = {"learner": "ddpg", "fire": "paper"} | ({"executor": "local"} if sweep else {})
    for group, name in usual.items():
        inner = {group: _read(group, chosen.get(group, name))}
        tree = _merged({**tree, group: tree.get(group) or {}}, inner)
        tree[group].pop("name", None)
    tree.get("comm", {}).pop("name", None)
    return tree


def _read(group: str, name: str) -> dict[str, Any]:
    """Returns the content of a YAML file, with that of the files that it extends."""
    import yaml

    for folder in configs.folders():
        file = folder / group / f"{name}.yaml"
        if file.is_file():
            content = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
            first = content.pop("defaults", [])
            tree: dict[str, Any] = {}
            for other in first:
                if isinstance(other, str) and other not in ("_self_", name):
                    tree = _merged(tree, _read(group, other))
            return _merged(tree, content)
    return {}


def _merged(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    both = {**one, **other}
    for key in one.keys() & other.keys():
        if isinstance(one[key], dict) and isinstance(other[key], dict):
            both[key] = _merged(one[key], other[key])
    return both
