"""Configuration of fires that are read from files."""

import dataclasses
import math
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.validation import STRICT, Name

Units = Literal["steps", "seconds", "minutes", "hours", "days", "day_of_year"]
COPY_FILE = "fires.safetensors"
"""Name of the file in a run folder that holds the run's copy of its fires."""
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Time = _Number | Annotated[str, Field(min_length=1, max_length=40)]
_FORMAT = r"^((day|month|year)_first|(milli)?seconds|.*%.*)$"
_Text = Annotated[str, Field(min_length=1, max_length=1000)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class FileFireConfig:
    """Fires read from a file: a raster, perimeters, points of the front, or a bank."""

    kind: Literal["file", "masks"] = "file"
    """`file`, or `masks` for an array of states `[time, y, x]`, such as 0 unburnt, 1 and 2 fire."""
    name: Name = "file"
    """Name of the scenario and its file in configs/fire."""
    path: _Text
    """The file, or a folder of one fire's perimeters; relative to the working directory."""
    test: _Text | None = None
    """A second file, of the test fires; without one every fifth fire of the file is a test fire."""
    units: Units | None = None
    """Unit of the numbers in the file, and of `start` and `end`."""
    start: _Time | None = None
    """Time of step 0, in `units`, or ISO text for calendar times; when the fire began if None."""
    end: _Time | None = None
    """Time of the last step, as `start`; the last arrival if None."""
    minutes_per_step: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """Minutes of the fire per step of the episode, instead of `end`."""
    margin: Annotated[float, Field(ge=0, le=0.45)] | None = 0.1
    """Part of the grid left free on each side of the burnt area; None takes the file's extent."""
    ring_width: Annotated[float, Field(gt=0, le=30)] | None = 3.0
    """Width of the burning edge at step 0, cells of a 30-cell side; None burns nothing out."""
    burn_time: Annotated[float, Field(ge=1)] = math.inf
    """Steps for which a cell burns; inf for ever."""
    crs: _Text | None = None
    """Projection of a file that carries none, else the target projection."""
    layer: _Text | None = None
    """Layer of a GeoPackage, variable of a NetCDF, or band of a GeoTIFF, that has several."""
    time_field: _Text | tuple[_Text, ...] | None = None
    """Column of the perimeters' times, or columns of the date, the time of day, or their parts."""
    time_format: Annotated[str, Field(pattern=_FORMAT, max_length=100)] | None = None
    """`day_first`, `month_first`, `seconds` since 1970, or a pattern such as `%d.%m.%y %H:%M`."""
    incident: _Text | int | None = None
    """Incident whose perimeters are read, where a file has several; "*" reads all as one fire."""
    incident_field: _Text | None = None
    """Column in which `incident` is looked for."""
    where: _Text | tuple[_Text, ...] | None = None
    """Features that are read: `COLUMN=VALUE` (`*`, `|` allowed), `COLUMN` if not empty, a list."""
    radius: Annotated[float, Field(gt=0, le=1e5)] | None = None
    """Radius in metres of the circle that stands for a point, such as a detection of FIRMS."""
    unburned: float | tuple[float, ...] | Literal["none"] | None = None
    """Values of a raster, or states of masks, that are no fire; a list has all, `none` is empty."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the content of `path` and `test`; a run records it and checks it afterwards."""
    saved_copy: Annotated[str | None, Field(exclude=True)] = dataclasses.field(
        default=None, compare=False
    )
    """A run's own copy of the grids; set when a run folder is opened, and never written."""

    @property
    def conditions(self) -> tuple[str, ...]:
        """The conditions of `where`."""
        return (self.where,) if isinstance(self.where, str) else self.where or ()

    @property
    def never(self) -> tuple[float, ...] | None:
        """The values of `unburned`; empty for `none`, None if it is not given."""
        if isinstance(self.unburned, int | float):
            return (self.unburned,)
        return () if self.unburned == "none" else self.unburned
