"""Finds classes by name: in the files of a package, and in what other packages register."""

import importlib
from collections.abc import Collection
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from emberlink.configs import entry_points
from emberlink.envs.utils.errors import UserError

T = TypeVar("T")


def registered(group: str) -> dict[str, EntryPoint]:
    """Returns the entry points of a group by name.

    Args:
        group: such as "emberlink.comm".
    """
    return {point.name: point for point in entry_points.read(group)}


@dataclass(frozen=True)
class Registry(Generic[T]):
    """The subclasses of a class: one in each file of a package, and entry points.

    Attributes:
        base: the class.
        package: whose files define them, a file's name being the class's.
        key: of the name in a configuration, for messages.
        other_files: of the package, without those that begin with an underscore.
        group: of the entry points, which name a class; the package's name if empty.
    """

    base: type[T]
    package: str
    key: str
    other_files: Collection[str] = ("base", "registry")
    group: str = ""

    def known(self) -> list[str]:
        """Returns the names in alphabetical order."""
        return sorted({*self._files(), *self._points()})

    def find(self, name: str) -> type[T]:
        """Returns the class of a name.

        Raises:
            UserError: the name is not known, or several classes have it; or the package of an
                entry point cannot be imported or does not hold such a class.
        """
        points, files = self._points(), self._files()
        if name in points and name in files:
            raise UserError(
                f"{self.key}={name}: also an entry point, {points[name].value}; rename it"
            )
        if name in points:
            return self._load(points[name])
        if name in files:
            return self._class_in(name)
        raise UserError(f"{self.key}={name!r} is not known; known: {', '.join(self.known())}")

    def _points(self) -> dict[str, EntryPoint]:
        return registered(self.group or self.package)

    def _files(self) -> set[str]:
        folders = importlib.import_module(self.package).__path__
        files = {module.name for module in iter_modules(folders)}
        return {name for name in files if not name.startswith("_")} - set(self.other_files)

    def _class_in(self, name: str) -> type[T]:
        file = importlib.import_module(f"{self.package}.{name}")
        own = [
            item for item in vars(file).values() if getattr(item, "__module__", "") == file.__name__
        ]
        classes = [item for item in own if self._fits(item)]
        if len(classes) != 1:
            kind = self.base.__name__
            raise UserError(f"{file.__file__}: has {len(classes)} subclasses of {kind}; expected 1")
        return classes[0]

    def _load(self, point: EntryPoint) -> type[T]:
        package = point.dist.name if point.dist else point.module
        where = f"package {package}: entry point {point.name!r} of {point.group}, {point.value}"
        try:
            found = point.load()
        except Exception as error:  # whatever the code of another package does at its import
            message = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(f"{where}: cannot be imported: {message}") from error
        if not self._fits(found):
            raise UserError(f"{where}: not a subclass of {self.base.__name__}")
        return found

    def _fits(self, item: Any) -> bool:
        return isinstance(item, type) and issubclass(item, self.base)
