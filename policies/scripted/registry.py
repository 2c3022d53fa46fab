"""Finds scripted policies by name: those of this folder, and entry points of other packages."""

from collections.abc import Collection, Iterator, Mapping

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import unknown
from emberlink.policies.scripted import ORDER
from emberlink.policies.scripted.base import Scripted

_SIMPLE: tuple[str, ...] = "stationary", "random_actions", "random_waypoints", "follow_target"
_BY_MAPS: tuple[str, ...] = "map_greedy_alone", "map_greedy", "map_greedy_all", "courier"
_REGISTRY = Registry(
    Scripted,
    "emberlink.policies.scripted",
    "policy",
    other_files=("base", "registry", "simple", "planning", "team_maps"),
    group="emberlink.scripted",
    shared={**dict.fromkeys(_SIMPLE, "simple"), **dict.fromkeys(_BY_MAPS, "map_greedy")},
)


class _Policies(Mapping[str, type[Scripted]]):
    """The scripted policies by name: emberlink's in a fixed order, then those of other packages."""

    def __getitem__(self, name: str) -> type[Scripted]:
        if name not in _REGISTRY.known():
            raise KeyError(name)
        return _REGISTRY.find(name)

    def __iter__(self) -> Iterator[str]:
        known = _REGISTRY.known()
        return iter([*ORDER, *(name for name in known if name not in ORDER)])

    def __len__(self) -> int:
        return len(_REGISTRY.known())


SCRIPTED: Mapping[str, type[Scripted]] = _Policies()
"""the scripted policies by name, in the order of tables"""


def to_play(wanted: Collection[str]) -> list[str]:
    """Returns the policies of an evaluation in the order of tables.

    Raises:
        UserError: a name is not known.
    """
    for name in wanted:
        if name not in SCRIPTED:
            raise UserError(unknown(name, SCRIPTED))
    return [name for name in SCRIPTED if name in wanted]
