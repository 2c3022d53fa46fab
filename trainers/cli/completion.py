"""Completes command lines: `--completion SHELL` prints a script, which asks for the words.

The script runs `emberlink --complete WORD...` at each press of the tab key. That imports no torch.
"""

import argparse
import glob
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from emberlink import configs
from emberlink.configs import entry_points
from emberlink.policies.scripted import ORDER

SCRIPTS = {
    "bash": r"""
_emberlink() {
    local line="${COMP_LINE:0:COMP_POINT}" words=() prefix="" IFS=$' \t'
    read -ra words <<< "$line"
    [[ $line == *[$' \t'] ]] && words+=("")
    local breaks="${COMP_WORDBREAKS//[^=:]/}" current="${words[${#words[@]}-1]}"
    [[ -n $breaks ]] && prefix="${current%"${current##*[$breaks]}"}"
    IFS=$'\n'
    COMPREPLY=($(emberlink --complete "${words[@]:1}" 2>/dev/null))
    COMPREPLY=("${COMPREPLY[@]#"$prefix"}")
    [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *[=:./] ]] && compopt -o nospace 2>/dev/null
    return 0
}
complete -o default -F _emberlink emberlink
""",
    "zsh": r"""#compdef emberlink
_emberlink() {
    local -a found
    found=("${(@f)$(emberlink --complete "${(@)words[2,CURRENT-1]}" "$PREFIX" 2>/dev/null)}")
    found=(${found:#})
    (( ${#found} )) || { _files; return }
    compadd -S '' -- ${(M)found:#*[=:./]}
    compadd -- ${found:#*[=:./]}
}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    _emberlink "$@"
else
    compdef _emberlink emberlink
fi
""",
    "fish": r"""
function __emberlink
    set -l words (commandline -opc)
    set -l current (commandline -ct)
    set -l found (emberlink --complete $words[2..-1] "$current" 2>/dev/null)
    if set -q found[1]
        printf '%s\n' $found
    else
        __fish_complete_path "$current"
    end
end
complete -c emberlink -f -a '(__emberlink)'
""",
}
"""shell -> its script"""
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
_POSITIONALS = {"METHOD": "method", "SOURCE": "fire", "SCENARIO": "fire", "NAME": "world"}
_MANY = ("*", "+")


class PrintScript(argparse.Action):
    """Prints the script of a shell."""

    def __call__(self, parser: Any, namespace: Any, values: Any, *_: Any) -> None:
        parser._print_message(SCRIPTS[values].lstrip(), sys.stdout)
        parser.exit()


def complete(words: Sequence[str], parser: argparse.ArgumentParser) -> list[str]:
    """Returns what the last word may become; nothing where a file is expected.

    Args:
        words: the words after `emberlink`; the last one is to be completed and may be empty.
        parser: of the whole command line.
    """
    *before, current = words or [""]
    given: list[str] = []
    for word in before:
        if word in (commands := _commands(parser)):
            parser, given = commands[word], []
        else:
            given.append(word)
    return [name for name in _candidates(parser, given, current) if name.startswith(current)]


def _candidates(
    parser: argparse.ArgumentParser, given: Sequence[str], current: str
) -> Iterator[str]:
    options = {name: action for action in parser._actions for name in action.option_strings}
    last = options.get(given[-1]) if given else None
    if last is not None and last.nargs != 0:
        yield from _values_of(last)
    elif current.startswith("-"):
        yield from options
    elif commands := _commands(parser):
        yield from commands
    else:
        yield from _arguments(parser, given, current)


def _commands(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return action.choices
    return {}


def _values_of(option: argparse.Action) -> Sequence[str]:
    if option.choices is not None:
        return list(map(str, option.choices))
    names = {"NAME": _policies, "FIRE": lambda: configs.known("fire")}
    return names[str(option.metavar)]() if option.metavar in names else []


def _arguments(
    parser: argparse.ArgumentParser, given: Sequence[str], current: str
) -> Iterator[str]:
    """Yields what the arguments without a leading "-" may be."""
    named = [word for word in given if "=" not in word and not word.startswith("-")]
    for action in parser._actions:
        kinds = [] if action.option_strings else str(action.metavar).split(" | ")
        if "=" not in current and (action.nargs in _MANY or not named):
            for kind in kinds:
                yield from _names(kind, current)
        sweep = kinds[-1:] == ["key=value,value"]
        if sweep and not given:
            yield "status"
        if sweep or (kinds[-1:] == ["key=value"] and (given or current)):
            groups = _GROUPS if sweep else _GROUPS[:-1]  # the last one is the executor
            yield from _settings(given, current, groups)


def _names(kind: str, current: str) -> Sequence[str]:
    if kind == "KIND":
        return [*KINDS, "policies"]
    if kind == "RUN":
        return [*_pretrained(current), *_folders(current)]
    return configs.known(_POSITIONALS[kind]) if kind in _POSITIONALS else []


def _policies() -> list[str]:
    others = [point.name for point in entry_points.read("emberlink.scripted")]
    return [*ORDER, *sorted(others)]


def _pretrained(current: str) -> list[str]:
    """Returns the names of trained policies up to their next part."""
    if not current.startswith("pretrained:"):
        return ["pretrained:"]
    shipped = Path(str(files("emberlink.policies"))) / "pretrained"
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
    plain = (path for path in found if shlex.quote(path) == path)
    return [path[:-1] if Path(path, "config.yaml").is_file() else path for path in plain]


def _settings(given: Sequence[str], current: str, groups: Sequence[str]) -> Iterator[str]:
    """Yields key=value: the keys up to their next part, or the values of a key."""
    key, equals, value = current.partition("=")
    if equals:
        start = f"{key}={value[: value.rfind(',') + 1]}"  # of a list of values, the last one
        names = configs.known(key) if key in groups else []
        if key == "resume":
            names = _folders(value)
        yield from (start + name for name in names)
        return
    chosen = dict(word.split("=", 1) for word in given if "=" in word)
    tree: Any = _tree(chosen, given, "executor" in groups)
    *parts, _ = key.split(".")
    for part in parts:
        tree = tree.get(part, {}) if isinstance(tree, dict) else {}
    start = "".join(f"{part}." for part in parts)
    for name, inner in tree.items() if isinstance(tree, dict) else ():
        yield f"{start}{name}{'.' if inner and isinstance(inner, dict) else '='}"
    if not parts:
        yield from (f"{group}=" for group in groups)


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
