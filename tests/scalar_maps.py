"""Computes the pictures of method `maps` and what UAVs tell each other, cell by cell."""

import math
from fractions import Fraction

FULL = 255


def rounded(value) -> int:
    return math.floor(Fraction(value) + Fraction(1, 2))


def age_byte(age: int) -> int:
    return min(254, round(254 * math.log(1 + age) / math.log(1001)))


def picture(looks, fires, grid, centre, others, base, step, *, pixels, scale, spread):
    """Returns the channels of a picture as nested lists.

    Args:
        looks: cell -> (step, "none" | "fire" | "burnt out") of the last look.
        fires: cells that were seen while they burned.
        grid, centre: cells.
        others: (cell, step) of the other UAVs that are known.
        base: cell or None.
        step: the current one.
        pixels, scale, spread: of the picture.
    """
    names = ("fire", "seen", "burnt_out", "near", "age", "outside", "uavs", "base")
    result = {name: [[0] * pixels for _ in range(pixels)] for name in names}
    burning = [cell for cell, (_, what) in looks.items() if what == "fire"]
    for p in range(pixels):
        for q in range(pixels):
            cells = [
                (
                    centre[0] + (p - pixels // 2) * scale - scale // 2 + a,
                    centre[1] + (q - pixels // 2) * scale - scale // 2 + b,
                )
                for a in range(scale)
                for b in range(scale)
            ]
            size = len(cells)
            inside = [c for c in cells if 0 <= c[0] < grid[0] and 0 <= c[1] < grid[1]]
            share = dict.fromkeys(names, 0)
            for cell in inside:
                when, what = looks.get(cell, (None, None))
                share["fire"] += what == "fire"
                share["seen"] += cell in fires
                share["burnt_out"] += what == "burnt out"
                share["age"] += FULL if when is None else age_byte(step - when)
                near = spread and any(
                    max(abs(cell[0] - x), abs(cell[1] - y)) <= spread for x, y in burning
                )
                if near and what in (None, "none"):
                    chance = 1 if when is None else 1 - math.exp(-(step - when) / 50)
                    share["near"] += round(FULL * chance)
            for name in ("fire", "seen", "burnt_out"):
                result[name][p][q] = rounded(Fraction(FULL * share[name], size))
            result["near"][p][q] = rounded(Fraction(share["near"], size))
            result["age"][p][q] = rounded(Fraction(share["age"], max(1, len(inside))))
            result["outside"][p][q] = rounded(Fraction(FULL * (size - len(inside)), size))
            known = [FULL - age_byte(step - when) for cell, when in others if cell in cells]
            result["uavs"][p][q] = max(known, default=0)
            result["base"][p][q] = FULL * (base in cells)
    return [result[name] for name in names]


class Teller:
    """The maps of a team and their messages, with dictionaries.

    A map holds cell -> (step, code) with code 0, 1 (fire) or 2, and a set of cells seen burning.
    """

    def __init__(self, uavs: int):
        self.looks = [{} for _ in range(uavs)]
        self.fires = [set() for _ in range(uavs)]

    def see(self, uav: int, cells: dict, step: int) -> None:
        for cell, code in cells.items():
            self.looks[uav][cell] = (step, code)
            if code == 1:
                self.fires[uav].add(cell)

    def talk(self, near, hears, budget=None) -> list[int]:
        """Passes on what is new, and returns the number of cells that each UAV said.

        What is said depends on the UAVs in range, what is received on those that hear.
        """
        looks, fires = [dict(m) for m in self.looks], [set(m) for m in self.fires]
        counts = []
        for speaker, mine in enumerate(looks):
            hearers = [uav for uav in range(len(looks)) if hears[uav][speaker]]
            in_range = [uav for uav in range(len(looks)) if near[uav][speaker]]
            new = [
                cell
                for cell in mine
                if any(
                    mine[cell] > looks[uav].get(cell, (-1, 0))
                    or (cell in fires[speaker] and cell not in fires[uav])
                    for uav in in_range
                )
            ]
            # Fire first, then the newest; among equal ones the cell of the larger index.
            new.sort(key=lambda cell: (mine[cell][1] == 1, mine[cell], cell), reverse=True)
            said = new if budget is None else new[: max(0, budget[speaker])]
            counts.append(len(said))
            for uav in hearers:
                for cell in said:
                    other = self.looks[uav].get(cell, (-1, 0))
                    self.looks[uav][cell] = max(other, mine[cell])
                    if cell in fires[speaker]:
                        self.fires[uav].add(cell)
        return counts
