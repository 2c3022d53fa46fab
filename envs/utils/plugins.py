"""Finds classes by name: in the files of a package, and among entry points of other packages."""

import importlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from emberlink.configs import entry_points
from emberlink.envs.utils.errors import UserError

T = TypeVar("T")


def registered(group: str) -> dict[str, EntryPoint]:
    """Returns the entry points of a group, such as "emberlink.comm", by name.

    Raises:
        UserError: two packages have an entry point of the same name.
    """
    points: dict[str, EntryPoint] = {}
    for point in entry_points.read(group):
        other = points.setdefault(point.name, point)
        if other.value != point.value:
            raise UserError(
                f"entry point {point.name!r} of {group} is in two packages: {other.value} and "
                f"{point.value}; remove or rename one"
            )
    return points


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Finds the subclasses of a class: one in each file of a package, and entry points.

    Attributes:
        base: the class.
        package: the package. The name of a file is the name of the subclass in it.
        key: configuration key of the name, for messages.
        other_files: files of the package without a subclass, besides those with a leading
            underscore.
        group: group of the entry points; the package's name if empty.
        shared: name -> file, of subclasses that share a file; their names are those of the classes
            in lower case.
    """

    base: type[T]
    package: str
    key: str
    other_files: Collection[str] = ("base", "registry")
    group: str = ""
    shared: Mapping[str, str] = field(default_factory=dict)

    def known(self) -> list[str]:
        """Returns the names in alphabetical order."""
        return sorted({*self._files(), *self._points()})

    def find(self, name: str, key: str = "") -> type[T]:
        """Returns the class of a name.

        Args:
            name: of a file or of an entry point.
            key: configuration key that holds the name, for messages, if not `self.key`.

        Raises:
            UserError: the name is not known or not unique, or the entry point cannot be imported or
                is not such a class.
        """
        key = key or self.key
        points, files = self._points(), self._files()
        if name in points and name in files:
            raise UserError(f"{key}={name}: also an entry point, {points[name].value}; rename it")
        if name in points:
            return self._load(points[name])
        if name in files:
            return self._class_in(name)
        raise UserError(f"{key}={name!r} is not known; known: {', '.join(self.known())}")

    def _points(self) -> dict[str, EntryPoint]:
        return registered(self.group or self.package)

    def _files(self) -> set[str]:
        paths = map(Path, importlib.import_module(self.package).__path__)
        # setuptools adds the name of a hook that is no folder.
        files = _modules(tuple((str(p), p.stat().st_mtime_ns) for p in paths if p.exists()))
        return {name for name in files if not name.startswith("_")} - set(self.other_files) | set(
            self.shared
        )

    def _class_in(self, name: str) -> type[T]:
        file = importlib.import_module(f"{self.package}.{self.shared.get(name, name)}")
        classes = [
            item
            for item in vars(file).values()
            if getattr(item, "__module__", "") == file.__name__
            and self._fits(item)
            and (name not in self.shared or item.__name__.lower() == name)
        ]
        if len(classes) != 1:
            kind = self.base.__name__
            raise UserError(f"{file.__file__}: has {len(classes)} subclasses of {kind}; expected 1")
        return classes[0]

    def _load(self, point: EntryPoint) -> type[T]:
        package = point.dist.name if point.dist else point.module
        where = f"package {package}: entry point {point.name!r} of {point.group}, {point.value}"
        try:
            item = point.load()
        except Exception as error:  # code of another package may raise anything
            message = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(f"{where}: cannot be imported: {message}") from error
        if not self._fits(item):
            raise UserError(f"{where}: not a subclass of {self.base.__name__}")
        return item

    def _fits(self, item: Any) -> bool:
        return isinstance(item, type) and issubclass(item, self.base)


@cache
def _modules(folders: tuple[tuple[str, int], ...]) -> frozenset[str]:
    """Returns the names of the modules in folders that were last changed at the given times."""
    return frozenset(module.name for module in iter_modules([path for path, _ in folders]))
