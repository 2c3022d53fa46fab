"""Names files for GDAL, so that it reads them, and reads them as the format that was checked."""

import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from emberlink.envs.utils.errors import UserError

_MAX_NAMES = 5


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
