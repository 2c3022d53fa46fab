"""Reads the tables of perimeters: files, folders of files, layers and incidents."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.formats import (
    GEOJSON,
    KML,
    KMZ,
    PERIMETERS,
    find_format,
    perimeter_files,
)
from emberlink.envs.fire_files.gdal_files import for_gdal
from emberlink.envs.fire_files.perimeters.kml_times import with_one_time
from emberlink.envs.fire_files.perimeters.times import known_columns
from emberlink.envs.fire_files.projection import check_projection, first_line, library
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import as_argument, unknown

_INCIDENTS = ("poly_incidentname", "attr_incidentname", "incidentname", "incident", "fire_name")
_INCIDENTS += ("firename", "fire_nm")


def read_table(path: Path, config: FileFireConfig) -> Any:
    """Reads the features of a file, or of all files in a folder, of the chosen incident.

    Args:
        path: a file, or a folder of files of one fire.
        config: the scenario.

    Returns:
        A table of geopandas with a row per feature. Its index names the features in messages.

    Raises:
        UserError: a file or a feature is wrong.
    """
    return _choose_incident(_of_all_files(path, config), config.incident)


def _of_all_files(path: Path, config: FileFireConfig) -> Any:
    """Reads the features of a file, or of all files in a folder."""
    if not path.is_dir():
        return _of_file(path, config).rename(index="feature {}".format)
    names, frames = [], []
    for part in perimeter_files(path):
        try:
            if find_format(part) not in PERIMETERS:
                raise UserError("expected perimeters")
            frame = _in_lower_case(_of_file(part, config))
        except UserError as error:
            raise UserError(f"{part.name}: {error}") from None
        names.append(part.name)
        frames.append(frame.rename(index=f"{part.name}: feature {{}}".format))
    for name, frame in zip(names, frames, strict=True):
        if (frame.crs is None) != (frames[0].crs is None):
            without, other = (name, names[0]) if frame.crs is None else (names[0], name)
            raise UserError(f"{without}: no projection, which {other} has; expected one in each")
    return _join(frames)


def _in_lower_case(frame: Any) -> Any:
    """Returns a table whose columns have names in lower case."""
    lower = [str(name).lower() for name in frame.columns if name != frame.geometry.name]
    twice = {name for name in lower if lower.count(name) > 1 or name == frame.geometry.name}
    if twice:
        raise UserError(f"columns that differ in upper and lower case only: {min(twice)}")
    return frame.rename(columns=str.lower)


def _join(frames: Sequence[Any]) -> Any:
    """Joins tables, in the projection of the first."""
    crs = frames[0].crs
    same = [frame if frame.crs == crs else frame.to_crs(crs) for frame in frames]
    return library("pandas").concat(same)


def _of_file(path: Path, config: FileFireConfig) -> Any:
    """Reads the features of a file, each of which has a geometry."""
    pyogrio = library("pyogrio")
    library("geopandas")
    suffix = path.suffix.lower()
    is_json, is_kml = suffix in GEOJSON.suffixes, suffix in (*KML.suffixes, *KMZ.suffixes)
    # Dates in GeoJSON as text, because GDAL loses zones that differ.
    options: dict[str, Any] = {"DATE_AS_STRING": "YES"} if is_json else {}
    try:
        with for_gdal(path) as source:
            layers = _choose_layers(pyogrio.list_layers(source), config.layer, several=is_kml)
            options["datetime_as_string"] = True
            parts = [pyogrio.read_dataframe(source, layer=name, **options) for name in layers]
        frame = _join(parts).reset_index(drop=True)
    except UserError:
        raise
    except Exception as error:  # GDAL, text and geometries raise many types
        if isinstance(error, pyogrio.errors.CRSError):
            check_projection(path, None)
        raise UserError(f"{first_line(error)}; expected perimeters") from None
    if is_kml:  # without hot spots, and without the columns of KML that are empty
        frame = frame[~frame.geom_type.isin(("Point", "MultiPoint"))]
        frame = frame.dropna(axis="columns", how="all")
        frame = with_one_time(frame) if config.time_field is None else frame
    if not hasattr(frame, "geometry") or len(frame) == 0:
        raise UserError("no feature with a geometry; expected perimeters")
    missing = frame.index[frame.geometry.isna() | frame.geometry.is_empty]
    if len(missing):
        raise UserError(f"feature {missing[0]} has no geometry; expected a perimeter in each")
    if not is_json:
        check_projection(path, frame.crs)
    elif frame.crs is not None and frame.crs.is_geographic and abs(frame.total_bounds).max() > 360:
        return frame.set_crs(None, allow_override=True)  # GDAL assumes degrees
    return frame


def _choose_layers(layers: Sequence[Any], wanted: str | None, *, several: bool) -> list[str]:
    """Returns the layer `wanted`, or the only layer with geometries, or all if `several`."""
    names = [str(name) for name, kind in layers if kind is not None]
    if wanted in names:
        return [str(wanted)]
    known = ", ".join(names[:30]) or "none"
    if wanted is not None:
        raise UserError(f"no layer {wanted!r} (fire.layer); there are {known}")
    if not names:
        raise UserError("no feature with a geometry; expected perimeters")
    if len(names) > 1 and not several:
        raise UserError(f"{len(names)} layers of perimeters; expected fire.layer, one of {known}")
    return names


def _choose_incident(frame: Any, wanted: str | None) -> Any:
    """Returns the features of the incident `wanted`, or of the only incident."""
    known = known_columns({str(name).lower(): str(name) for name in frame.columns}, _INCIDENTS)
    columns = [name for name in known if len(_names(frame[name]))]
    if wanted == "*" or not (columns or wanted):
        return frame
    if not columns:
        raise UserError(f"fire.incident={wanted}: no column of incidents, such as {_INCIDENTS[0]}")
    named = _names(frame[columns[0]])
    names = {name.casefold(): name for name in named[::-1]}
    if wanted is None and len(names) < 2:
        return frame
    if wanted is None:
        several = sorted(names.values())
        raise UserError(
            f"perimeters of {len(several)} incidents: {', '.join(several[:30])}; expected "
            f"{as_argument('fire.incident', several[0])}, or fire.incident=* for all as one fire"
        )
    if wanted.casefold() not in names:
        raise UserError(f"fire.incident={unknown(wanted, sorted(names.values()))}")
    chosen = named.str.casefold() == wanted.casefold()
    return frame.loc[chosen.index[chosen]]


def _names(column: Any) -> Any:
    """Returns the texts of a column that are not empty."""
    texts = column.dropna().astype(str).str.strip()
    return texts[texts != ""]
