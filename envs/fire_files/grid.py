"""Crops a fire to the cells of a grid, and stretches its times over an episode."""

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import binary_propagation, distance_transform_edt, label, minimum_filter

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.plane import Window
from emberlink.envs.fire_files.report import SECONDS, Report, ask
from emberlink.envs.fire_files.times import in_utc, parse_dates
from emberlink.envs.utils.errors import UserError

if TYPE_CHECKING:
    from emberlink.envs.fire_files.perimeters import Perimeters
    from emberlink.envs.fire_files.rasters import Raster

_EIGHT = np.ones((3, 3))  # a cell and the eight around it


def on_grid(
    fire: "Raster | Perimeters",
    config: FileFireConfig,
    grid: tuple[int, int],
    horizon: int,
    report: Report,
) -> np.ndarray:
    """Returns a fire on a grid, float32 steps [X, Y] of an episode: 0 from the start, inf never."""
    no_span = config.start is config.end is config.minutes_per_step is None
    in_steps = no_span and fire.clock.unit == "steps"
    start, end = (0.0, float(horizon)) if in_steps else _span(fire, config, horizon)
    margin = None if fire.whole else config.margin
    bounds = fire.bounds(None if margin is None else end)
    times = fire.on(Window.around(bounds, grid, margin or 0), end, report)
    times[times > end] = np.inf
    if config.start is None and not in_steps and not (times <= start).any():
        times[times == times.min()] = start  # the first cell burns from step 0
    if not fire.whole:
        places = _beginnings(((times - start) / (end - start)).round(2))
        report.facts.append(f"{places} place{'s' * (places != 1)} where it begins")
        near: Any = distance_transform_edt(np.isinf(times))
        parts = label(near <= min(grid) / 10, _EIGHT)[1]  # pyright: ignore
        if parts > 1:
            found = f"{parts} groups of parts never join and lie a fifth of the grid apart"
            report.doubts.append(f"{found}: one fire? (fire.incident)")
        if config.ring_width is not None:
            times[_burnt_out(times, start, config.ring_width * min(grid) / BASE_SIDE)] = np.inf
    steps = (np.maximum(times, start) - start) / (end - start) * horizon
    burning = steps[np.isfinite(steps)]
    if len(burning) < 2 or (not in_steps and burning.min() == burning.max()):
        ends = map(fire.clock.format, (start, end, fire.first, fire.last))
        seen = "from {} to {} no fire spreads; it burns from {} to {}".format(*ends)
        raise UserError("; ".join([seen, *report.doubts]))
    return steps.astype(np.float32)


def _span(fire: "Raster | Perimeters", config: FileFireConfig, horizon: int) -> tuple[float, float]:
    """Returns the times of the first and last step."""
    clock, steps = fire.clock, config.minutes_per_step
    start, end = (_time(key, fire, config) for key in ("start", "end"))
    start = clock.beginning(fire.first, fire.last) if start is None else start
    end = fire.last if end is None else end
    if steps is not None:
        if config.end is not None:
            raise ask("fire.end and fire.minutes_per_step", "one of them")
        if clock.unit not in SECONDS:
            raise ask(f"fire.minutes_per_step: times are in {clock.unit}", "fire.units")
        end = start + horizon * steps * 60 / SECONDS[clock.unit]
    return start, end


def _time(key: str, fire: "Raster | Perimeters", config: FileFireConfig) -> float | None:
    """Returns `fire.start` or `fire.end` in the clock's unit."""
    value, clock = getattr(config, key), fire.clock
    if value is None or (clock.origin is None and not isinstance(value, str)):
        return value
    if clock.origin is None or not (isinstance(value, str) or config.units in SECONDS):
        seen = f"fire.{key}={value}: times are such as {clock.format(fire.first)}"
        raise ask(seen, "one of these, or a number with fire.units")
    if isinstance(value, str):
        form = None if value[:4].isdecimal() and value[4:5] == "-" else config.time_format
        date = in_utc(parse_dates([value], form, f"fire.{key}")[0])
        return (date - clock.origin).total_seconds() / SECONDS[clock.unit]
    return fire.first + value * SECONDS[str(config.units)] / SECONDS[clock.unit]


def _beginnings(times: np.ndarray) -> int:
    """Returns the number of places that burn before all cells around them."""
    burns, earliest = np.isfinite(times), times == minimum_filter(times, 3)
    # Of cells that burn at the same time, one may have an earlier neighbour: no beginning.
    later = minimum_filter(np.where(burns & ~earliest, times, np.inf), 3) == times
    places: Any = label(burns & earliest, _EIGHT)
    return int(places[1] - len(np.unique(places[0][burns & earliest & later])))


def _burnt_out(times: np.ndarray, start: float, width: float) -> np.ndarray:
    """Returns the mask of burnt cells deeper behind the front than the ring's width, [X, Y]."""
    burnt = times <= start
    if not burnt.any():
        return burnt
    later = np.isfinite(times) & ~burnt
    unburnt: Any = binary_propagation(
        np.pad(later, 1, constant_values=True), mask=~np.pad(burnt, 1)
    )
    depth: Any = distance_transform_edt(~unburnt)  # gaps without cells that burn later are burnt
    return burnt & (depth[1:-1, 1:-1] - 0.5 > width)
