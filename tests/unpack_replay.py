"""Reads the data of a replay in plain Python, number by number, without NumPy."""

import base64
import gzip
import json
import re
import struct

CODES = {"u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "f4": "f"}


def data_of(page: str) -> dict:
    """Returns the header of a page, with lists instead of arrays."""
    (text,) = re.findall(r'<script type="text/plain" id="data">([A-Za-z0-9+/=]*)</script>', page)
    plain = gzip.decompress(base64.b64decode(text))
    (length,) = struct.unpack("<I", plain[:4])
    return _read(json.loads(plain[4 : 4 + length]), plain, 4 + length)


def _read(value, plain: bytes, start: int):
    if isinstance(value, list):
        return [_read(item, plain, start) for item in value]
    if not isinstance(value, dict):
        return value
    if "at" not in value:
        return {name: _read(item, plain, start) for name, item in value.items()}
    count = 1
    for side in value["shape"]:
        count *= side
    code, width = CODES[value["type"]], value["shape"][-1]
    size = struct.calcsize(code)
    numbers = list(struct.unpack_from(f"<{count}{code}", plain, start + value["at"]))
    rows = [numbers[place : place + width] for place in range(0, count, width)]
    return [_summed(row, size, code.islower()) for row in rows] if value["delta"] else rows


def _summed(row: list[int], size: int, signed: bool) -> list[int]:
    """Returns the running sums, in integers that wrap round."""
    total, sums, limit = 0, [], 1 << 8 * size
    for difference in row:
        total = (total + difference) % limit
        sums.append(total - limit if signed and total >= limit // 2 else total)
    return sums


def bit(rows: list[list[int]], row: int, step: int) -> bool:
    """Returns whether a link was there at a step."""
    return bool(rows[row][step // 8] >> step % 8 & 1)
