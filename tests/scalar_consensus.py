"""Implements method 4 for one team in plain Python, with loops and explicit rounds."""

import math
from collections.abc import Container, Sequence

Point = tuple[float, float, float]


class ScalarConsensus:
    """Computes the consensus of one team and keeps each discoverer's track record.

    Args:
        reach: range of communication, cells; UAVs nearer than this hear each other.
        any_fire: whether a UAV over old fire is a discoverer too.
        agree: whether UAVs forward the messages that they receive.
        nearest: whether they follow the nearest discoverer instead of the best.
    """

    def __init__(
        self, reach: float, *, any_fire: bool = False, agree: bool = True, nearest: bool = False
    ):
        self.reach, self.any_fire, self.agree, self.nearest = reach, any_fire, agree, nearest
        self.history: dict[int, list[tuple[int, float]]] = {}
        """discoverer -> (fire points, altitude) of each step of its streak"""

    def step(
        self,
        position: Sequence[Point],
        new: Sequence[int],
        old: Sequence[int],
        lost: Container[tuple[int, int]] = (),
    ) -> list[int]:
        """Returns the UAV that each UAV follows: itself if it is a discoverer, -1 if none.

        Args:
            position, new, old: position and cells of new and old fire in view of each UAV.
            lost: the pairs (i, j) where i does not hear j.
        """
        uavs = range(len(position))
        finds = [new[i] > 0 or (self.any_fire and old[i] > 0) for i in uavs]
        for i in uavs:
            if finds[i]:
                self.history.setdefault(i, []).append((new[i], position[i][2]))
            else:
                self.history.pop(i, None)
        hears = {
            i: [
                j
                for j in uavs
                if j != i
                and math.dist(position[i], position[j]) < self.reach
                and (i, j) not in lost
            ]
            for i in uavs
        }
        knows = {i: {j for j in hears[i] if finds[j]} for i in uavs if not finds[i]}
        while self.agree:
            forwarded = {
                i: knows[i].union(*(knows[j] for j in hears[i] if not finds[j])) for i in knows
            }
            if forwarded == knows:
                break
            knows = forwarded

        def worse(i: int, j: int) -> tuple[float, int]:
            """Returns the sort key of a discoverer; the lowest is followed."""
            return (math.dist(position[i], position[j]) if self.nearest else -self.rank(j)), j

        return [
            i if finds[i] else min(knows[i], key=lambda j, i=i: worse(i, j), default=-1)
            for i in uavs
        ]

    def streak(self, uav: int) -> int:
        """Returns the number of consecutive steps as a discoverer."""
        return len(self.history.get(uav, []))

    def altitude_sum(self, uav: int) -> float:
        """Returns the sum of the altitudes over the streak."""
        return sum(altitude for _, altitude in self.history.get(uav, []))

    def fire_score(self, uav: int) -> int:
        """Returns the fire points discovered over the streak."""
        return sum(points for points, _ in self.history.get(uav, []))

    def rank(self, uav: int) -> float:
        """Returns the rank of a discoverer."""
        points, altitude = self.history[uav][-1]
        mean = self.altitude_sum(uav) / self.streak(uav)
        record = self.fire_score(uav) / (mean * self.streak(uav))
        return record * (points / altitude)


def bearing(start: Point, end: Point) -> float:
    """Returns the direction in the x-y plane, degrees in (-180, 180]."""
    return math.degrees(math.atan2(end[1] - start[1], end[0] - start[0]))


def heading_term(form: str, before: Point, after: Point, target: Point) -> float:
    """Returns the bonus for one UAV's move, by the name of its form."""
    aimed, moved = bearing(before, target), bearing(before, after)
    folded = abs(abs(aimed) - abs(moved))
    if form == "folded_linear":
        return (180 - folded) / 10
    if form == "folded_exponential":
        return 20 * 0.94**folded
    return math.dist(before, target) - math.dist(after, target)
