"""Re-implements the belief maps of the team and the base in plain Python, cell by cell."""

import math


class ScalarWorld:
    """Follows one environment from its positions and links.

    Args:
        arrival, burn_out: times in steps, [X][Y].
        view_angle: half the opening angle of the cameras, degrees.
        uavs: number of UAVs; the base is one more radio.
    """

    def __init__(self, arrival, burn_out, view_angle: float, uavs: int):
        self.arrival, self.burn_out = arrival, burn_out
        self.slope, self.uavs = math.tan(math.radians(view_angle)), uavs
        self.cells = [(i, j) for i in range(len(arrival)) for j in range(len(arrival[0]))]
        self.seen: dict[tuple[int, int], list[int]] = {cell: [] for cell in self.cells}
        # radio -> cell -> steps of all looks that the radio knows of
        self.known = [{cell: set() for cell in self.cells} for _ in range(uavs + 1)]
        self.ages: list[int] = []
        self.base_ages: list[int] = []
        self.told: list[int] = []  # cells new to the base in the last step, per UAV

    def burns(self, cell, step) -> bool:
        i, j = cell
        return self.arrival[i][j] <= step < self.burn_out[i][j]

    def step(self, step: int, position, alive, hears) -> None:
        """Adds one step.

        Args:
            position: (x, y, z) of each UAV.
            hears: [radios][radios], whether a radio (row) hears another one; the base is last.
        """
        before = self.base_seen()
        for uav, (x, y, z) in enumerate(position):
            for i, j in self.cells:
                if alive[uav] and abs(i - x) <= z * self.slope and abs(j - y) <= z * self.slope:
                    self.seen[i, j].append(step)
                    self.known[uav][i, j].add(step)
        for _ in range(self.uavs + 1):  # messages are passed on along any path
            for taker, row in enumerate(hears):
                for source, heard in enumerate(row):
                    if heard:
                        for cell in self.cells:
                            self.known[taker][cell] |= self.known[source][cell]
        for cell in self.cells:
            if self.burns(cell, step):
                ignition = max(0, math.ceil(self.arrival[cell[0]][cell[1]]))
                looks, reported = self.seen[cell], self.known[-1][cell]
                self.ages.append(step - max([ignition, *looks]))
                self.base_ages.append(step - max([ignition, *reported]))

        arrives = {self.uavs}  # the radios whose messages arrive at the base
        for _ in range(self.uavs):
            arrives |= {source for taker in arrives for source, h in enumerate(hears[taker]) if h}
        news = self.base_seen() - before
        self.told = [news if uav in arrives else 0 for uav in range(self.uavs)]

    def unseen(self, step: int) -> int:
        """Returns how many cells burn that no UAV has seen while they burned."""
        return sum(
            self.burns(cell, step) and not any(self.burns(cell, look) for look in looks)
            for cell, looks in self.seen.items()
        )

    def burning(self, step: int) -> int:
        return sum(self.burns(cell, step) for cell in self.cells)

    def burnt(self, step: int) -> int:
        return sum(self.arrival[i][j] <= step for i, j in self.cells)

    def seen_fire(self) -> int:
        return sum(any(self.burns(cell, s) for s in self.seen[cell]) for cell in self.cells)

    def base_seen(self) -> int:
        return sum(any(self.burns(cell, s) for s in self.known[-1][cell]) for cell in self.cells)

    def last_seen(self, radio: int, cell) -> int:
        return max(self.known[radio][cell], default=-1)
