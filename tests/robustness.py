"""How long the tests of robustness run: EMBERLINK_SOAK=1 makes them long."""

import os

SOAK = os.environ.get("EMBERLINK_SOAK", "") not in ("", "0")
