"""Re-implements the wildfire environment with scalars, as a reference for the batched one."""

import math

import numpy as np

NO_FIRE, OLD_FIRE, NEW_FIRE = 0, 1, 2


class ScalarWildfire:
    """Simulates one environment with Python floats; stored positions are rounded to float32.

    Args:
        arrival: times of arrival in steps, a list of X lists of Y numbers.
        position: start of each UAV, three numbers each.
        altitude: lowest and highest z.
        rewards: per cell of new fire, old fire and no fire in view, then for leaving the box.
        exit_axes: "xyz" or "xy".
    """

    def __init__(
        self, arrival, position, *, displacement, view_angle, altitude, rewards, exit_axes
    ):
        self.arrival = arrival
        self.position = [[np.float32(c) for c in p] for p in position]
        self.displacement = displacement
        self.slope = math.tan(math.radians(view_angle))
        x, y = len(arrival), len(arrival[0])
        corners = [(0.0, x - 1.0), (0.0, y - 1.0), altitude]
        self.box = [(float(np.float32(low)), float(np.float32(high))) for low, high in corners]
        self.rewards = rewards
        self.exit_axes = ["xyz".index(axis) for axis in exit_axes]
        self.time, self.views = 0, {}
        self.fire = [[NO_FIRE] * y for _ in range(x)]
        self.spread()

    def spread(self):
        for i, column in enumerate(self.arrival):
            for j, time in enumerate(column):
                if self.fire[i][j] == NO_FIRE and time <= self.time:
                    self.fire[i][j] = NEW_FIRE

    def step(self, actions):
        """Moves every UAV; returns counts (new, old, none), exits per axis and reward per UAV."""
        self.time += 1
        self.spread()
        exits = [self.move(n, action) for n, action in enumerate(actions)]
        counts = [self.look(n) for n in range(len(self.position))]
        return counts, exits, [self.reward(c, e) for c, e in zip(counts, exits, strict=True)]

    def move(self, n, action):
        exits = []
        for axis in range(3):
            low, high = self.box[axis]
            pushed = max(-1.0, min(1.0, float(action[axis])))
            wanted = float(self.position[n][axis]) + self.displacement * pushed
            exits.append(wanted < low or wanted > high)
            self.position[n][axis] = np.float32(max(low, min(high, wanted)))
        return exits

    def look(self, n):
        x, y, z = (float(c) for c in self.position[n])
        radius = z * self.slope
        counts = {NEW_FIRE: 0, OLD_FIRE: 0, NO_FIRE: 0}
        view = self.views[n] = {}  # offset from the cell nearest to the UAV -> class
        rows = [j for j in range(len(self.fire[0])) if abs(j - y) <= radius]
        for i in range(len(self.fire)):
            if abs(i - x) > radius:
                continue
            for j in rows:
                counts[self.fire[i][j]] += 1
                view[i - round(x), j - round(y)] = self.fire[i][j]
                if self.fire[i][j] == NEW_FIRE:
                    self.fire[i][j] = OLD_FIRE
        return counts[NEW_FIRE], counts[OLD_FIRE], counts[NO_FIRE]

    def reward(self, counts, exits):
        if any(exits[axis] for axis in self.exit_axes):
            return self.rewards[3]
        return sum(count * worth for count, worth in zip(counts, self.rewards, strict=False))

    def seen(self):
        return sum(cell == OLD_FIRE for column in self.fire for cell in column)

    def burning(self):
        return sum(cell != NO_FIRE for column in self.fire for cell in column)
