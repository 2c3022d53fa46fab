"""Reads and writes files of run folders and caches safely, even if others prepared the folder.

Nothing is written, truncated or deleted through a link, and only regular files are read.
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
"""suffix of incomplete files"""
_LINK = "it is a link, and nothing is written through links"
_DIGEST = 64
"""hexadecimal digits of a SHA-256"""
_NOT_REGULAR = "it is not a regular file"
_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK}
_NO_SYNC = {errno.EINVAL, errno.EBADF, errno.ENOTSUP}
"""errors of file systems that cannot flush a folder"""
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_CHANGE = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


def open_regular(path: Path, max_bytes: int, *, follow: bool = True) -> BinaryIO:
    """Opens a regular file for reading, without blocking on a pipe or a device.

    Args:
        path: path of the file.
        max_bytes: maximum size.
        follow: whether a link to a regular file is accepted.

    Raises:
        OSError: the file cannot be opened, is not regular, is too large, or is a link.
    """
    handle = _open(path, _READ if follow else _READ | os.O_NOFOLLOW)
    try:
        check_regular(handle, path)
        if os.fstat(handle).st_size > max_bytes:
            raise OSError(errno.EFBIG, f"it has more than {max_bytes} bytes", str(path))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, max_bytes: int, *, follow: bool = True) -> bytes:
    """Returns the content of a regular file; arguments and errors are those of `open_regular`."""
    with open_regular(path, max_bytes, follow=follow) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, f"it has more than {max_bytes} bytes", str(path))
    return content


def inner_folder(root: Path, *names: str) -> Path:
    """Creates a folder within another one if it is missing, and returns its path.

    Args:
        root: the outer folder; it may be a link.
        names: names of the folders within `root`, outermost first; none may be a link.

    Raises:
        OSError: one of `names` is a link or not a folder, or cannot be created.
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
def temporary(path: Path, tag: str = "") -> Iterator[Path]:
    """Yields a new empty file in the folder of `path`, and removes it at the end if it exists.

    Args:
        path: the file is named after it.
        tag: distinguishes processes on several machines that write to the same path.

    Raises:
        OSError: the file cannot be created.
    """
    # The process number distinguishes processes that write to the same folder.
    partial = path.with_name(f"{path.name}.{os.getpid()}{tag}{PART}")
    remove(partial)
    os.close(os.open(partial, _CREATE, 0o666))
    try:
        yield partial
    finally:
        with suppress(OSError):
            remove(partial)


@contextmanager
def replaced(path: Path, tag: str = "") -> Iterator[Path]:
    """Yields a new empty file, which is renamed to `path` when the block ends without an error.

    A link, a pipe or a device at `path` is replaced; the target of a link is not changed. Arguments
    are those of `temporary`.

    Raises:
        OSError: the file cannot be written; `path` is unchanged.
    """
    with temporary(path, tag) as partial:
        yield partial
        sync(partial)
        partial.replace(path)
    sync(path.parent)


def write_bytes(path: Path, content: bytes, tag: str = "") -> None:
    """Writes a file completely, or leaves the earlier one; see `replaced`."""
    with replaced(path, tag) as partial:
        partial.write_bytes(content)


def link_new(partial: Path, path: Path) -> None:
    """Gives a complete file the name `path`, which only one of several processes can do.

    Raises:
        FileExistsError: something exists at `path`.
        OSError: the file cannot be renamed.
    """
    try:
        os.link(partial, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # Some file systems have no hard links; an empty file reserves the name.
        path.open("x").close()
        partial.replace(path)


def write_sealed(path: Path, content: bytes | memoryview) -> None:
    """Writes a file followed by the SHA-256 of its content, 64 hexadecimal digits.

    NumPy's readers ignore bytes after the end of an array or an archive.

    Raises:
        OSError: the file cannot be written; `path` is unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.write(hashlib.sha256(content).hexdigest().encode())


def read_sealed(path: Path, max_bytes: int) -> bytes | None:
    """Returns the content of a file that `write_sealed` wrote.

    Args:
        path: path of the file.
        max_bytes: maximum size of the content.

    Returns:
        The content; None if there is no such file or its SHA-256 is wrong.
    """
    try:
        whole = read_bytes(path, max_bytes + _DIGEST)
    except OSError:
        return None
    content, digest = whole[:-_DIGEST], whole[-_DIGEST:]
    return content if digest == hashlib.sha256(content).hexdigest().encode() else None


@contextmanager
def open_in_place(path: Path, *, create: bool = False) -> Iterator[int]:
    """Yields a descriptor of a regular file, for appending or truncating.

    A file with a second name (a hard link) is first replaced by a copy, so that the other file does
    not change.

    Raises:
        OSError: the file is a link, is not regular, or cannot be opened.
    """
    flags = _CHANGE | os.O_CREAT if create else _CHANGE
    handle = _open(path, flags)
    try:
        check_regular(handle, path)
        if os.fstat(handle).st_nlink > 1:
            _separate(handle, path)
            os.close(handle)
            handle = -1
            handle = _open(path, _CHANGE)
            check_regular(handle, path)
        yield handle
    finally:
        if handle >= 0:
            os.close(handle)


def remove(path: Path) -> None:
    """Removes a regular file or a link if it exists; the target of a link is not changed.

    Raises:
        OSError: the path is a folder, a pipe, a socket or a device, or cannot be removed.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise OSError(errno.EINVAL, _NOT_REGULAR, str(path))
    path.unlink(missing_ok=True)


def remove_links(folder: Path) -> None:
    """Removes the links directly in a folder."""
    for path in folder.iterdir():
        if path.is_symlink():
            remove(path)


def sync(path: Path) -> None:
    """Flushes a file, or the list of names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SYNC or not path.is_dir():
            raise
    finally:
        os.close(handle)


def check_regular(handle: int, path: Path) -> None:
    """Checks that an open descriptor is of a regular file.

    Raises:
        OSError: it is of a folder, a pipe, a socket or a device.
    """
    mode = os.fstat(handle).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, _NOT_REGULAR, str(path))


def _open(path: Path, flags: int) -> int:
    """Opens a file and returns its descriptor; error messages name links, pipes and sockets."""
    try:
        return os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP and path.is_symlink() and flags & os.O_NOFOLLOW:
            raise OSError(errno.ELOOP, _LINK, str(path)) from None
        if error.errno == errno.ENXIO:  # a pipe without a reader, or a socket
            raise OSError(errno.EINVAL, _NOT_REGULAR, str(path)) from None
        raise


def _separate(handle: int, path: Path) -> None:
    """Replaces `path`, a name of the open file, by a copy of its content."""
    with replaced(path) as partial, partial.open("wb") as copy:
        offset = 0
        while block := os.pread(handle, 1 << 20, offset):
            copy.write(block)
            offset += len(block)
