"""Says where messages are worth most in a sweep of worlds, and where they are worth nothing."""

from collections.abc import Iterator, Sequence

from emberlink.trainers.worlds.sweep_folder import Line

ERRORS = 2.0
"""standard errors by which a gain or a loss has to differ from 0 to count as clear"""
NOTHING = 2.0
"""points; a gain is worth nothing if its interval, `ERRORS` to each side, is within these"""


def clear(gain: Sequence[float]) -> bool:
    """Returns whether a gain, given with its standard error, clearly differs from 0."""
    mean, error = gain
    return abs(mean) > ERRORS * error


def nothing(gain: Sequence[float]) -> bool:
    """Returns whether a gain, given with its standard error, is at most `NOTHING` either way."""
    mean, error = gain
    return abs(mean) + ERRORS * error <= NOTHING


def summary(lines: Sequence[Line], headline: str, most: int = 5) -> Iterator[str]:
    """Yields lines of text: counts of worlds, and the worlds of the largest gains.

    Args:
        lines: the worlds of a sweep.
        headline: the measure in which gains are counted.
        most: number of worlds to name.
    """
    gains = [line["gain"] for line in lines]
    plus = sum(clear(gain) and gain[0] > 0 for gain in gains)
    minus = sum(clear(gain) and gain[0] < 0 for gain in gains)
    yield (
        f"radio against no radio, {headline}: a clear gain in {plus} of {len(lines)} worlds, a "
        f"clear loss in {minus}; at most {NOTHING:g} points either way in "
        f"{sum(map(nothing, gains))}"
    )
    for line in sorted(lines, key=lambda line: -line["gain"][0])[:most]:
        (gain, error), (full, _) = line["gain"], line["gain_all"]
        _, before, after, _ = line["headline"]
        yield (
            f"  speed {line['speed']:g}, grid {line['grid']}, {line['uavs']} UAVs, range "
            f"{line['range']:g}: {before:.1f} to {after:.1f}, {gain:+.1f} ± {error:.1f} points "
            f"(all messages {full:+.1f})"
        )
