"""Reads and writes files in folders that somebody else may have prepared.

Every file that a command leaves in a run folder, in the cache or under `--output` is opened here.
Nothing is written, cut or deleted through a link, and only regular files are read.
"""

import errno
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

PART = ".part"
"""ends the names of files that are not whole yet"""
_LINK = "it is a link, and nothing is written through links"
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_CHANGE = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


def open_regular(path: Path, longest: int, *, follow: bool = True) -> BinaryIO:
    """Opens a regular file of bounded size for reading; a pipe or a device is never waited for.

    Args:
        path: of the file.
        longest: bytes that it may have.
        follow: whether it may be a link to such a file.

    Raises:
        OSError: it cannot be opened, is not regular, is larger, or is a link.
    """
    handle = _opened(path, _READ if follow else _READ | os.O_NOFOLLOW)
    try:
        _check_regular(handle, path)
        if os.fstat(handle).st_size > longest:
            raise OSError(errno.EFBIG, f"it has more than {longest} bytes", str(path))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, longest: int, *, follow: bool = True) -> bytes:
    """Returns the content of a regular file; see `open_regular`."""
    with open_regular(path, longest, follow=follow) as file:
        content = file.read(longest + 1)
    if len(content) > longest:
        raise OSError(errno.EFBIG, f"it has more than {longest} bytes", str(path))
    return content


def inner_folder(root: Path, *names: str) -> Path:
    """Returns a folder within another one, made where it is missing.

    Args:
        root: the user's own choice, which may be a link.
        names: of the folders below it, none of which may be.

    Raises:
        OSError: a name is a link or not a folder, or cannot be made.
    """
    folder = root
    for name in names:
        folder = folder / name
        with suppress(FileExistsError):
            folder.mkdir()
        mode = folder.lstat().st_mode
        if stat.S_ISLNK(mode):
            raise OSError(errno.ELOOP, _LINK, str(folder))
        if not stat.S_ISDIR(mode):
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(folder))
    return folder


@contextmanager
def temporary(path: Path) -> Iterator[Path]:
    """Yields a new empty file beside `path`, and removes it at the end if it is still there.

    Raises:
        OSError: it cannot be made.
    """
    # The number keeps two processes apart, such as an evaluation beside a training.
    partial = path.with_name(f"{path.name}.{os.getpid()}{PART}")
    remove(partial)
    os.close(os.open(partial, _CREATE, 0o666))
    try:
        yield partial
    finally:
        with suppress(OSError):
            remove(partial)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yields a new empty file, which takes the place of `path` once it is whole.

    A link, a pipe or a device of that name is replaced itself.

    Raises:
        OSError: it cannot be written; what was there stays.
    """
    with temporary(path) as partial:
        yield partial
        sync(partial)
        partial.replace(path)
    sync(path.parent)


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file whole, in place of what is there; see `replaced`."""
    with replaced(path) as partial:
        partial.write_bytes(content)


def write_sealed(path: Path, content: bytes | memoryview) -> None:
    """Writes a file of the cache: the SHA-256 of the content, a line break, the content.

    Raises:
        OSError: it cannot be written; what was there stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as partial, partial.open("wb") as file:
        file.write(f"{hashlib.sha256(content).hexdigest()}\n".encode())
        file.write(content)


def read_sealed(path: Path, longest: int) -> bytes | None:
    """Returns the content of a file of the cache.

    Args:
        path: as for `write_sealed`.
        longest: bytes that the content may have.

    Returns:
        None where there is no such file, or any of its bytes has changed.
    """
    try:
        whole = read_bytes(path, longest + 65)
    except OSError:
        return None
    seal, content = whole[:65], whole[65:]
    return content if seal == f"{hashlib.sha256(content).hexdigest()}\n".encode() else None


@contextmanager
def changed(path: Path, *, create: bool = False) -> Iterator[int]:
    """Yields a descriptor of a regular file to append to or to cut.

    A file that has a second name (a hard link) becomes a copy first, so that the other name keeps
    its content.

    Raises:
        OSError: it is a link, not a regular file, or cannot be opened.
    """
    flags = _CHANGE | os.O_CREAT if create else _CHANGE
    handle = _opened(path, flags)
    try:
        _check_regular(handle, path)
        if os.fstat(handle).st_nlink > 1:
            _separate(handle, path)
            os.close(handle)
            handle = -1
            handle = _opened(path, _CHANGE)
            _check_regular(handle, path)
        yield handle
    finally:
        if handle >= 0:
            os.close(handle)


def remove(path: Path) -> None:
    """Removes a regular file or a link, not what the link leads to; nothing where none is.

    Raises:
        OSError: it is something else, such as a folder or a pipe, or cannot be removed.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    path.unlink(missing_ok=True)


def remove_links(folder: Path) -> None:
    """Removes the links that lie directly in a folder."""
    for path in folder.iterdir():
        if path.is_symlink():
            remove(path)


def sync(path: Path) -> None:
    """Flushes a file, or the names in a folder, so that they outlive a loss of power."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _opened(path: Path, flags: int) -> int:
    try:
        return os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP and path.is_symlink() and flags & os.O_NOFOLLOW:
            raise OSError(errno.ELOOP, _LINK, str(path)) from None
        if error.errno == errno.ENXIO:  # a pipe that nobody reads, or a socket
            raise OSError(errno.EINVAL, "it is no regular file", str(path)) from None
        raise


def _check_regular(handle: int, path: Path) -> None:
    mode = os.fstat(handle).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))


def _separate(handle: int, path: Path) -> None:
    """Gives a name a copy of the file's content for its own."""
    with replaced(path) as partial, partial.open("wb") as copy:
        place = 0
        while block := os.pread(handle, 1 << 20, place):
            copy.write(block)
            place += len(block)
