"""Checks GeoJSON for GDAL, finds the KML in a KMZ, and says what GDAL is to open."""

import json
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError

_MAX_NAMES = 5


class _Link(dict[str, Any]):
    """An object of JSON whose type is a link."""


def check_geojson(content: bytes) -> None:
    """Parses the whole file, because GDAL returns the features before a damage.

    A link to a projection is refused, because GDAL would fetch it from the network.

    Raises:
        UserError: it is not GeoJSON, or its projection is a link.
    """
    links: list[str] = []

    def look(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        # GDAL does not distinguish upper and lower case. A key may be repeated.
        links.extend(
            str(value)[:80]
            for key, value in pairs
            if key.lower() == "crs" and isinstance(value, _Link)
        )
        kinds = [str(value).lower() for key, value in pairs if key.lower() == "type"]
        return _Link(pairs) if {*kinds} & {"link", "url"} else dict(pairs)

    try:
        whole = json.loads(content.decode("utf-8-sig"), object_pairs_hook=look)
    except RecursionError:
        raise UserError("too many levels; expected GeoJSON") from None
    except UnicodeDecodeError as error:
        raise UserError(f"byte {error.start} is not UTF-8; expected GeoJSON in UTF-8") from None
    except ValueError as error:
        raise UserError(f"{error}; expected GeoJSON") from None
    if links:
        raise UserError(f"its crs is a link: {links[0]}; expected one with a name, or none")
    if whole.get("type") not in ("FeatureCollection", "Feature"):
        raise UserError(f"type {str(whole.get('type'))[:40]!r}; expected a FeatureCollection")


def kml_parts(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Returns the .kml files in an archive, in lower or upper case, the main one first.

    The main one is not in a folder; it may link to those in folders, such as `layers/fire.kml`.

    Raises:
        UserError: there is none, or several could be the main one.
    """
    parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
    if not parts:
        raise UserError("the archive holds no .kml; expected KMZ")
    main = [part for part in parts if "/" not in part.filename] or parts
    if len(main) > 1:
        names = ", ".join(part.filename[-60:] for part in main[:_MAX_NAMES])
        more = ", ..." if len(main) > _MAX_NAMES else ""
        raise UserError(f"the archive holds {len(main)} .kml: {names}{more}; expected one")
    return [*main, *(part for part in parts if part is not main[0])]


@contextmanager
def for_gdal(path: Path) -> Iterator[Path | str]:
    """Yields what GDAL is to open.

    This is the path of a file, or that of a copy of the KML if GDAL would not find it in a KMZ, as
    its suffix is in upper case. GeoJSON gets a prefix: without it, a text in the file could make
    GDAL take it for another format, such as one that names other files to read.
    """
    if path.suffix.lower() in (".geojson", ".json"):
        yield f"GeoJSON:{path.absolute()}"
        return
    if path.suffix.lower() == ".kmz":
        with zipfile.ZipFile(path) as archive:
            part = kml_parts(archive)[0]
            if not part.filename.endswith(".kml"):
                with tempfile.TemporaryDirectory() as folder:
                    copy = Path(folder, f"{path.stem}.kml")
                    copy.write_bytes(archive.read(part))
                    yield copy
                return
    yield path.absolute()
