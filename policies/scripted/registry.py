"""Finds scripted policies by name: emberlink's own, and entry points of other packages."""

from collections.abc import Collection, Iterator, Mapping

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Registry
from emberlink.envs.utils.validation import unknown
from emberlink.policies.scripted import ORDER
from emberlink.policies.scripted.base import Scripted

_OWN = {
    "stationary": "simple:Stationary",
    "random_actions": "simple:RandomActions",
    "random_waypoints": "simple:RandomWaypoints",
    "lawnmower": "lawnmower:Lawnmower",
    "follow_target": "simple:FollowTarget",
    "map_greedy_alone": "map_greedy:MapGreedyAlone",
    "map_greedy": "map_greedy:MapGreedy",
    "map_greedy_all": "map_greedy:MapGreedyAll",
    "courier": "map_greedy:Courier",
    "oracle": "oracle:Oracle",
}
_REGISTRY = Registry(
    Scripted,
    "emberlink.scripted",
    "policy",
    {name: f"policies.scripted.{place}" for name, place in _OWN.items()},
)


class _Policies(Mapping[str, type[Scripted]]):
    """The scripted policies by name: emberlink's in a fixed order, then other packages'."""

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
