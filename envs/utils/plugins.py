"""Finds classes by name: in the files of a package, and among entry points of other packages."""

import importlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from emberlink.configs import entry_points
from emberlink.envs.utils.errors import UserError, unknown

T = TypeVar("T")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Finds the subclasses of a class: one in each file of a package, and entry points.

    Other packages are imported only where their names are asked for.

    Attributes:
        base: the class.
        package: the package. The name of a file is the name of the subclass in it.
        key: configuration key of the name, for messages.
        other_files: files of the package without a subclass, besides those with a leading
            underscore.
        group: group of the entry points; the package's name if empty.
        shared: name -> file, of subclasses that share a file; their names are those of the classes
            in lower case, with underscores.
    """

    base: type[T]
    package: str
    key: str
    other_files: Collection[str] = ("base", "registry")
    group: str = ""
    shared: Mapping[str, str] = field(default_factory=dict)

    def known(self) -> list[str]:
        """Returns the names in alphabetical order."""
        return sorted({*self._files(), *(point.name for point in self._points())})

    def find(self, name: str, key: str = "") -> type[T]:
        """Returns the class of a name.

        Args:
            name: of a file or of an entry point.
            key: configuration key that holds the name, for messages, if not `self.key`.

        Raises:
            UserError: the name is not known or not unique, or the entry point cannot be imported or
                is not such a class.
        """
        points = {point.value: point for point in self._points() if point.name == name}
        places = [*points, *([self.package] if name in self._files() else [])]
        if not places:
            raise UserError(f"{key or self.key}={unknown(name, self.known())}")
        if len(places) > 1:
            raise UserError(
                f"{key or self.key}={name}: in several packages: {', '.join(places)}; rename one"
            )
        return self._load(*points.values()) if points else self._class_in(name)

    def _points(self) -> tuple[EntryPoint, ...]:
        return entry_points.read(self.group or self.package)

    def _files(self) -> set[str]:
        modules = iter_modules(importlib.import_module(self.package).__path__)
        files = {module.name for module in modules if not module.name.startswith("_")}
        return files - set(self.other_files) | set(self.shared)

    def _class_in(self, name: str) -> type[T]:
        file = importlib.import_module(f"{self.package}.{self.shared.get(name, name)}")
        classes = [
            item
            for item in vars(file).values()
            if getattr(item, "__module__", "") == file.__name__
            and self._fits(item)
            and (name not in self.shared or item.__name__.lower() == name.replace("_", ""))
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
