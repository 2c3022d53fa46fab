"""Checkpoint files: safetensors with a seal over every byte, written whole or not at all."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from emberlink.envs.utils.atomic_io import open_regular, replaced
from emberlink.envs.utils.errors import UserError

FORMAT = 1
"""of the files; a reader accepts its own alone, and files from before there was a number"""

_KEY = "emberlink"
_BLANK = "0" * 64
_SEAL = re.compile(rb'sha256\\": \\"([0-9a-f]{64})\\"')
_LONGEST_HEADER = 100_000_000
_LONGEST = 2**35
"""bytes of a file; the largest state that was measured has 333 MB"""


def write(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Writes a checkpoint beside its place, flushes it to the disk and renames it.

    Args:
        path: of the file; what is there of that name is replaced.
        tensors: by name, on any device.
        header: what else is to be known, as JSON.

    Raises:
        ValueError: it cannot be written, such as to a full disk; nothing is left of it then.
    """
    content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps({"sha256": _BLANK, "format": FORMAT, **header})
    try:
        with replaced(path) as partial:
            save_file(content, partial, metadata={_KEY: text})
            partial.chmod(path.parent.stat().st_mode & 0o666)  # safetensors lets nobody else read
            with partial.open("r+b") as file:
                digest, place = _digest(file)
                file.seek(place)
                file.write(digest)
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: cannot be written: {_reason(error)}") from None


def read(path: Path) -> tuple[dict[str, Any] | None, dict[str, Tensor]]:
    """A checkpoint's header and tensors, after its seal has been checked.

    Returns:
        The header, None for a file from before there were any, and the tensors on the CPU.

    Raises:
        ValueError: it cannot be read, has been damaged, or is of another format.
    """
    try:
        header = read_header(path)
        if header is not None:
            with open_regular(path, _LONGEST) as file:
                digest, _ = _digest(file)
            if digest.decode() != header.get("sha256"):
                raise UserError(
                    f"{path}: not a readable checkpoint: damaged, its bytes are not those that "
                    "were written"
                )
        return header, load_file(path)
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: not a readable checkpoint: {_reason(error)}") from None


def read_header(path: Path) -> dict[str, Any] | None:
    """A checkpoint's header, its seal not checked; None for a file from before there were any.

    Raises:
        ValueError: there is no such file, it is no checkpoint, or it is of another format.
    """
    try:
        with open_regular(path, _LONGEST) as file:
            whole = json.loads(_head(file))
        if not isinstance(whole, dict):
            raise UserError("its header holds no names")
        if "__metadata__" not in whole:
            return None
        header = json.loads(whole["__metadata__"][_KEY])
        found = header["format"]
    except OSError as error:
        raise UserError(f"{path}: not a readable checkpoint: {_reason(error)}") from None
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:100]
        raise UserError(
            f"{path}: not a readable checkpoint: damaged, or of another program ({reason})"
        ) from None
    if found != FORMAT:
        raise UserError(f"{path}: a checkpoint of format {found}; this version reads {FORMAT}")
    return header


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Looks for what no network and no memory may hold.

    Raises:
        ValueError: a number is NaN or infinite; the message names the tensor.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise UserError(f"{path}: {name} holds NaN or infinite numbers")


def _head(file: BinaryIO) -> bytes:
    """The JSON that a safetensors file begins with, after its length."""
    length = int.from_bytes(file.read(8), "little")
    if length > _LONGEST_HEADER:
        raise UserError("its header has no end")
    return file.read(length)


def _digest(file: BinaryIO) -> tuple[bytes, int]:
    """The SHA-256 of a file in which the seal is blank, and where in it the seal stands."""
    file.seek(0)
    head = _head(file)
    found = _SEAL.search(head)
    if found is None:
        return b"", 0
    blank = head[: found.start(1)] + _BLANK.encode() + head[found.end(1) :]
    sha = hashlib.sha256(len(head).to_bytes(8, "little") + blank)
    while block := file.read(2**20):
        sha.update(block)
    return sha.hexdigest().encode(), 8 + found.start(1)


def _reason(error: Exception) -> str:
    """What went wrong in a few words, on one line."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split()).removeprefix("Error while serializing: I/O error: ")
