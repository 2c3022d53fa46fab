"""Sets the duration of the robustness tests: EMBERLINK_SOAK=1 selects the long version."""

import os

SOAK = os.environ.get("EMBERLINK_SOAK", "") not in ("", "0")
