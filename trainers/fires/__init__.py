"""Commands on fires: draws a fire, writes fires to a file, joins files of fires."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.fires.banks import import_files, make
    from emberlink.trainers.fires.select import SelectedFire, find_fire

__all__ = ["SelectedFire", "find_fire", "import_files", "make"]

__getattr__ = lazy(
    __name__,
    {"SelectedFire": "select", "find_fire": "select", "import_files": "banks", "make": "banks"},
)
