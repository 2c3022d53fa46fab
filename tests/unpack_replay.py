"""Reads the data of a replay."""

import base64
import gzip
import json
import re


def data_of(page: str) -> dict:
    """Returns the data of a page, with the steps of a panel beside its other entries."""
    (text,) = re.findall(r'<script type="text/plain" id="data">([A-Za-z0-9+/=]*)</script>', page)
    data = json.loads(gzip.decompress(base64.b64decode(text)))
    return data | {"panels": [panel | panel["steps"] for panel in data["panels"]]}
