"""Finds classes by name: emberlink's own, and entry points of other packages."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any, Generic, TypeVar

from emberlink.envs.utils import config_files
from emberlink.envs.utils.errors import UserError, unknown

T = TypeVar("T")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Finds the subclasses of a class; each is imported when its name is asked for.

    Attributes:
        base: the class.
        group: group of the entry points of other packages.
        key: configuration key of the name, for messages.
        own: name -> `module:class`, of emberlink's own subclasses.
    """

    base: type[T]
    group: str
    key: str
    own: Mapping[str, str]

    def known(self) -> list[str]:
        """Returns the names in alphabetical order."""
        return sorted({point.name for point in self._points()})

    def find(self, name: str, key: str = "") -> type[T]:
        """Returns the class of a name, which is the value of `key` or else of `self.key`.

        Raises:
            UserError: the name is not known or not unique, or the entry point cannot be imported or
                is not such a class.
        """
        points = {point.value: point for point in self._points() if point.name == name}
        if not points:
            raise UserError(f"{key or self.key}={unknown(name, self.known())}")
        if len(points) > 1:
            places = ", ".join(points)
            raise UserError(f"{key or self.key}={name}: in several packages: {places}; rename one")
        return self._load(*points.values())

    def _points(self) -> list[EntryPoint]:
        own = [EntryPoint(n, f"emberlink.{place}", self.group) for n, place in self.own.items()]
        return [*config_files.entry_points(self.group), *own]

    def _load(self, point: EntryPoint) -> type[T]:
        package = point.dist.name if point.dist else point.module
        where = f"package {package}: entry point {point.name!r} of {point.group}, {point.value}"
        try:
            item: Any = point.load()
        except Exception as error:  # code of another package may raise anything
            message = " ".join(f"{type(error).__name__}: {error}".split())
            raise UserError(f"{where}: cannot be imported: {message}") from error
        if not (isinstance(item, type) and issubclass(item, self.base)):
            raise UserError(f"{where}: not a subclass of {self.base.__name__}")
        return item
