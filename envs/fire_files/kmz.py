"""Makes the KML in an archive readable for GDAL, which knows its name in lower case only."""

import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from emberlink.envs.utils.errors import UserError

_MAX_NAMES = 5


def kml_part(archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    """Returns the only .kml in an archive, in lower or upper case.

    Raises:
        UserError: there is none, or there are several.
    """
    parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
    if not parts:
        raise UserError("the archive holds no .kml; expected KMZ")
    if len(parts) > 1:
        names = ", ".join(part.filename[-60:] for part in parts[:_MAX_NAMES])
        more = ", ..." if len(parts) > _MAX_NAMES else ""
        raise UserError(f"the archive holds {len(parts)} .kml: {names}{more}; expected one")
    return parts[0]


@contextmanager
def for_gdal(path: Path) -> Iterator[Path]:
    """Yields the path of a file, or of a copy of the KML if GDAL would not find it in a KMZ."""
    if path.suffix.lower() == ".kmz":
        with zipfile.ZipFile(path) as archive:
            part = kml_part(archive)
            if not part.filename.endswith(".kml"):
                with tempfile.TemporaryDirectory() as folder:
                    copy = Path(folder, f"{path.stem}.kml")
                    copy.write_bytes(archive.read(part))
                    yield copy
                return
    yield path.absolute()
