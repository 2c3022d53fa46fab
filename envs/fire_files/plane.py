"""Chooses the plane on which a fire is gridded, and measures how its projection bends shapes."""

import math
from typing import Any, NamedTuple

from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.report import ask

Bounds = tuple[float, float, float, float]
"""Minimum x, minimum y, maximum x, maximum y."""
_BENT = 1.1  # ratio of a projection's axes above which a file is projected to another plane
_MAX_DEGREES = 20.0  # across; a UTM zone is no plane for more


class Plane(NamedTuple):
    """How a file's coordinates become coordinates on a plane: `target` is None if they are."""

    about: str
    source: Any = None
    target: Any = None

    @property
    def unit(self) -> float | None:
        """Returns the metres of a unit of length on the plane, if known."""
        axes = getattr(self.target or self.source, "axis_info", None)
        return axes[0].unit_conversion_factor if axes else None

    def project(self, x: Any, y: Any, *, back: bool = False) -> tuple[Any, Any]:
        """Projects coordinates of the file onto the plane, or back."""
        if self.target is None:
            return x, y
        ends = (self.target, self.source) if back else (self.source, self.target)
        return library("pyproj").Transformer.from_crs(*ends, always_xy=True).transform(x, y)


def choose_plane(crs: Any, wanted: str | None, bounds: Bounds) -> Plane:
    """Chooses the plane for the coordinates of a file; a projection that bends is replaced.

    `wanted` is `fire.crs`: the projection of a file without one, otherwise the target.
    """
    size = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    where = f"coordinates from {bounds[:2]} to {bounds[2:]}"
    in_degrees = max(map(abs, bounds[::2])) <= 360 and max(map(abs, bounds[1::2])) <= 90.01
    if crs is None and wanted is None:
        if in_degrees and size < 5:
            seen = f"{where} may be degrees, and no projection is given"
            raise ask(seen, "fire.crs, such as fire.crs=EPSG:4326 for longitude and latitude")
        return Plane("no projection in the file: its coordinates are taken as a plane")
    source = parse_crs(crs or wanted)
    if source.is_geographic and not (in_degrees and size <= _MAX_DEGREES):
        seen = f"{where} are not the degrees of {source.name}, or too far apart for one UTM zone"
        raise ask(seen, "another fire.crs", "a file of the fire alone")
    shape, ratio = _shape(source, source, bounds)
    if not (crs and wanted) and ratio <= _BENT:
        return Plane(f"projection {source.name} ({shape})", source)
    box = library("geopandas").GeoSeries([library("shapely").box(*bounds)], crs=source)
    target = parse_crs(wanted) if crs and wanted else box.estimate_utm_crs()
    after, bent = _shape(target, source, bounds)
    if bent > _BENT:
        raise ask(f"fire.crs={wanted} has {after} here", "one as UTM is")
    about = f"projection {source.name} ({shape}), projected to {target.name} ({after})"
    return Plane(about, source, target)


def parse_crs(value: Any) -> Any:
    """Returns a projection, pyproj.CRS."""
    pyproj = library("pyproj", "a projection")
    try:
        return pyproj.CRS.from_user_input(value)
    except pyproj.exceptions.CRSError:
        raise ask(f"projection {str(value)[:100]!r} is not known", "such as EPSG:32611") from None


def _shape(crs: Any, source: Any, bounds: Bounds) -> tuple[str, float]:
    """Returns how a projection bends a small circle at the fire, as text, and the ratio of axes."""
    if not crs.is_projected:  # degrees, or a plane of its own
        return ("degrees", math.inf) if crs.is_geographic else ("a plane", 1.0)
    pyproj = library("pyproj")
    at = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    to_degrees = pyproj.Transformer.from_crs(source, source.geodetic_crs, always_xy=True)
    try:
        factors = pyproj.Proj(crs).get_factors(*to_degrees.transform(*at), errcheck=True)
    except pyproj.exceptions.ProjError:
        raise ask(f"the fire at {at} lies outside {crs.name}", "another fire.crs") from None
    ratio = float(factors.tissot_semimajor / factors.tissot_semiminor)
    turn = round(factors.meridian_convergence)
    return f"axes {ratio:.2f} : 1, north turned by {turn} degrees", ratio
