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
