"""Directives that print reference tables from the program itself: keys, measures, commands."""

import argparse
import inspect
import math
import re
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import yaml
from docutils import nodes
from pydantic import TypeAdapter
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

from emberlink.comm.base import MODULES
from emberlink.envs import FileFireConfig, FireConfig, ReactionConfig, metrics
from emberlink.trainers import RunConfig, resolve
from emberlink.trainers.cli.list import described
from emberlink.trainers.cli.main import _parser
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.learners.base import LEARNERS
from emberlink.trainers.sweep.executors.base import EXECUTORS

_FLOW: Any = {"default_flow_style": True, "width": math.inf}
_BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
_SKIPPED = {"comm", "learner", "fire", "saved_copy", "sha256"}


def setup(app: Sphinx) -> dict[str, Any]:
    """Registers a directive for each function that returns Markdown."""
    for text in (configuration_keys, measures, command_help, choices):
        app.add_directive(text.__name__.replace("_", "-"), _directive(text))
    return {"parallel_read_safe": True}


def _directive(text: Callable[..., str]) -> type[SphinxDirective]:
    class Generated(SphinxDirective):
        optional_arguments = 2

        def run(self) -> list[nodes.Node]:
            return self.parse_text_to_nodes(text(*self.arguments), allow_section_headings=True)

    return Generated


def configuration_keys(kind: str, name: str = "") -> str:
    """Returns a table of keys: `run`, `learner NAME`, `comm NAME`, `executor NAME`, `fire KIND`."""
    head = "| key | default | meaning; type and range |\n|---|---|---|\n"
    return head + "\n".join(f"| {' | '.join(row)} |" for row in _rows(kind, name))


def measures() -> str:
    """Returns a table of all measures."""
    lines = ["| measure | better | meaning |", "|---|---|---|"]
    for name in metrics.ALL:
        better = "more" if name in metrics.HIGHER_IS_BETTER else "less"
        lines.append(f"| `{name}` | {better} | {_first(getattr(metrics, name).__doc__)} |")
    return "\n".join(lines)


def command_help() -> str:
    """Returns the help of every command."""
    first, *others = _helps(_parser()[0])
    return "\n\n".join([first[1], *(f"## {name}\n\n{text}" for name, text in others)])


def choices(kind: str) -> str:
    """Returns the names that `emberlink list KIND` prints, with their descriptions."""
    return "\n".join(f"- `{name}`: {text}" for name, text in described(kind))


def _helps(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Yields the name and the help of a command, then those of its subcommands."""
    yield parser.prog, f"```text\n{parser.format_help()}```"
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _helps(command)


def _rows(kind: str, name: str) -> Iterator[tuple[str, ...]]:
    """Yields the rows of a table of keys."""
    if kind == "run":
        yield from _keys(RunConfig, "", to_values(resolve("independent")))
    elif kind == "fire":
        types = {"spread": FireConfig, "reaction": ReactionConfig, "file": FileFireConfig}
        yield from _keys(types[name], "fire.", {})
    else:
        plugins = {"learner": LEARNERS, "comm": MODULES, "executor": EXECUTORS}[kind]
        values = to_values(resolve("independent", [f"learner={name}"])) if kind == "learner" else {}
        yield from _keys(plugins.find(name).config_type, f"{kind}.", values.get(kind, {}))


def _keys(cls: type, prefix: str, values: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yields the row of each key of a configuration class, and of the classes in it."""
    meanings, hints = _meanings(cls), typing.get_type_hints(cls)
    schema = TypeAdapter(cls).json_schema()
    for field in fields(cls):
        name = field.name
        if name in _SKIPPED:
            continue
        if is_dataclass(hints[name]):
            yield from _keys(hints[name], f"{prefix}{name}.", values.get(name, {}))
            continue
        about = schema["properties"][name]
        empty = {} if cls.__pydantic_fields__[name].default_factory else MISSING
        default = values.get(name, about.get("default", empty))
        as_yaml = "" if default is MISSING else yaml.safe_dump([default], **_FLOW)[1:-2]
        yield (
            f"`{prefix}{name}`",
            f"`{as_yaml}`" if as_yaml else "by choice",
            f"{meanings.get(name, '')}; {_type(about)}",
        )


def _meanings(cls: type) -> dict[str, str]:
    """Returns the docstring of each attribute of a class, on one line."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base.__module__.startswith("emberlink"):
            documented = ModuleAnalyzer.for_module(base.__module__).find_attr_docs()
            for (owner, name), lines in documented.items():
                if owner == base.__qualname__:
                    text = " ".join(lines).strip().rstrip(".").replace("|", "\\|")
                    found[name] = re.sub(r"\bNone\b", "null", text)
    return found


def _type(schema: Mapping[str, Any]) -> str:
    """Returns the type and the range of a JSON schema as text, such as "integer ≥ 1"."""
    if "anyOf" in schema:
        return " or ".join(map(_type, schema["anyOf"]))
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if "prefixItems" in schema:
        parts = [_type(part) for part in schema["prefixItems"]]
        return f"{len(parts)} values, each {parts[0]}" if len({*parts}) == 1 else ", ".join(parts)
    if "items" in schema:
        return f"list, each {_type(schema['items'])}"
    bounds = [
        f"{sign} {schema[bound]:,.10f}".rstrip("0").rstrip(".")
        for bound, sign in _BOUNDS.items()
        if bound in schema
    ]
    return f"{schema.get('type', 'names and values')} {' and '.join(bounds)}".strip()


def _first(doc: str | None) -> str:
    """Returns the text of a docstring before its arguments, on one line."""
    text = inspect.cleandoc(doc or "").split("\n\nArgs:")[0].split("\n\nReturns:")[0]
    return re.sub(r"\s+", " ", text).removeprefix("Returns ").replace("|", "\\|")
