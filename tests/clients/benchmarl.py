"""Runs the page on BenchMARL."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "benchmarl.md"
(code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
names: dict = {"__name__": "page"}
exec(compile(code, PAGE.name, "exec"), names)
coverage = names["results"]["front"]["learned"]["coverage"]
print(f"coverage of BenchMARL's MAPPO: {sum(coverage) / len(coverage):.1f} %")
