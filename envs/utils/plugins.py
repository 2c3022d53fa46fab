"""Finds classes by name: in a folder of emberlink, and by entry points of other packages."""

import ast
import re
import sys
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Generic, TypeVar

from emberlink.envs.utils import config_files
from emberlink.envs.utils.errors import UserError, unknown

T = TypeVar("T")


@cache
def defined(folder: Path, base: str) -> dict[str, tuple[str, str]]:
    """Returns `module:class` and docstring by name of the subclasses in the files of a folder.

    A subclass alone in its file has the name of the file; of several, `MapGreedy` is `map_greedy`.
    Classes that are private or inherit from ABC themselves have no name. Nothing is imported.
    """
    classes = [
        (file.stem, node)
        for file in sorted(folder.glob("*.py"))
        for node in ast.parse(file.read_text("utf-8")).body
        if isinstance(node, ast.ClassDef)
    ]
    bases = {node.name: [ast.unparse(parent) for parent in node.bases] for _, node in classes}

    def inherits(name: str) -> bool:
        return any(parent == base or inherits(parent) for parent in bases.get(name, ()))

    named = [
        (stem, node)
        for stem, node in classes
        if inherits(node.name) and node.name[0] != "_" and "ABC" not in bases[node.name]
    ]
    stems, found = [stem for stem, _ in named], dict[str, tuple[str, str]]()
    for stem, node in named:
        snake = re.sub("(?<=[a-z])(?=[A-Z])", "_", node.name).lower()
        name = stem if stems.count(stem) == 1 else snake
        found[name] = f"{stem}:{node.name}", ast.get_docstring(node) or ""
    return found


@dataclass(frozen=True)
class Plugins(Generic[T]):
    """Finds the subclasses of a class in its folder; each is imported when it is asked for."""

    base: type[T]
    group: str
    """group of the entry points of other packages"""
    key: str
    """configuration key of the name, for messages"""

    def known(self) -> list[str]:
        """Returns the names in alphabetical order."""
        return sorted({point.name for point in self._points()})

    def find(self, name: str, key: str = "") -> type[T]:
        """Returns the class of a name, which is the value of `key` or else of `self.key`."""
        points = {point.value: point for point in self._points() if point.name == name}
        if not points:
            raise UserError(f"{key or self.key}={unknown(name, self.known())}")
        if len(points) > 1:
            places = ", ".join(points)
            raise UserError(f"{key or self.key}={name}: in several packages: {places}; rename one")
        (point,) = points.values()
        where = f"entry point {name!r} of {self.group}, {point.value}"
        try:
            item: Any = point.load()
        except Exception as error:  # code of another package may raise anything
            message = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(f"{where}: cannot be imported: {message}") from error
        if not (isinstance(item, type) and issubclass(item, self.base)):
            raise UserError(f"{where}: not a subclass of {self.base.__name__}")
        return item

    def _points(self) -> list[EntryPoint]:
        module = self.base.__module__
        folder, package = Path(str(sys.modules[module].__file__)).parent, module.rpartition(".")[0]
        own = defined(folder, self.base.__name__)
        return [
            *config_files.entry_points(self.group),
            *(EntryPoint(n, f"{package}.{place}", self.group) for n, (place, _) in own.items()),
        ]
