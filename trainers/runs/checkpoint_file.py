"""Reads and writes checkpoint files: safetensors with a JSON header and a SHA-256 of every byte."""

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
from emberlink.envs.utils.validation import shown

FORMAT = 1
"""version of the file format; files of another version are refused"""

_KEY = "emberlink"
_BLANK = "0" * 64
"""stands for the digest while it is computed"""
_SEAL = re.compile(rb'sha256\\": \\"([0-9a-f]{64})\\"')
_MAX_HEADER = 4_000_000
"""bytes; that of a checkpoint with 2,000 tensors has a tenth of it"""
_MAX_FILE = 2**35
"""bytes; the largest checkpoint measured has 333 MB"""


def write(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Writes a checkpoint completely, or leaves the earlier file.

    The file is written under another name, flushed to the disk and renamed.

    Args:
        path: path of the file; an existing file is replaced.
        tensors: tensors by name, on any device.
        header: other content, as plain values.

    Raises:
        UserError: the file cannot be written, such as to a full disk.
    """
    content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps({"sha256": _BLANK, "format": FORMAT, **header})
    try:
        with replaced(path) as partial:
            save_file(content, partial, metadata={_KEY: text})
            partial.chmod(path.parent.stat().st_mode & 0o666)  # safetensors makes it private
            with partial.open("r+b") as file:
                digest, place = _digest(file)
                file.seek(place)
                file.write(digest)
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: cannot be written: {_reason(error)}") from None


def read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns a checkpoint's header and its tensors, on the CPU, after checking its SHA-256.

    Raises:
        UserError: the file cannot be read, is damaged, or is not of this format.
    """
    header = read_header(path)
    try:
        with open_regular(path, _MAX_FILE) as file:
            digest, _ = _digest(file)
        if not digest or digest.decode() != header.get("sha256"):
            raise UserError(f"{path}: not a readable checkpoint: damaged, its SHA-256 is wrong")
        return header, load_file(path)
    except (OSError, SafetensorError) as error:
        raise UserError(f"{path}: not a readable checkpoint: {_reason(error)}") from None


def read_header(path: Path) -> dict[str, Any]:
    """Returns a checkpoint's header without checking the SHA-256.

    Raises:
        UserError: there is no such file, it is not a checkpoint, or it is not of this format.
    """
    try:
        with open_regular(path, _MAX_FILE) as file:
            head = json.loads(_head(file))
        if not isinstance(head, dict) or "__metadata__" not in head:
            raise UserError("no header of emberlink")
        header = json.loads(head["__metadata__"][_KEY])
        version = header["format"]
    except OSError as error:
        raise UserError(f"{path}: not a readable checkpoint: {_reason(error)}") from None
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:100]
        raise UserError(
            f"{path}: not a readable checkpoint: damaged, or of another program ({reason})"
        ) from None
    if version != FORMAT:
        raise UserError(
            f"{path}: a checkpoint of format {shown(version)}; this version reads {FORMAT}"
        )
    return header


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Checks that all tensors are finite.

    Raises:
        UserError: a number is NaN or infinite; the message names the tensor.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise UserError(f"{path}: {name} holds NaN or infinite numbers")


def _head(file: BinaryIO) -> bytes:
    """Returns the JSON at the beginning of a safetensors file, after its length."""
    length = int.from_bytes(file.read(8), "little")
    if length > _MAX_HEADER:
        raise UserError(f"its header has {length} bytes")
    return file.read(length)


def _digest(file: BinaryIO) -> tuple[bytes, int]:
    """Returns the SHA-256 of a file and the offset at which its header holds it.

    It is computed with zeros in its place, and empty if the header has no place for it.
    """
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
    """Returns the message of an error on one line."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split()).removeprefix("Error while serializing: I/O error: ")
