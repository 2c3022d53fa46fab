"""Runs the page on BenchMARL."""

import re
import runpy
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "benchmarl.md"
(code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
script = Path("page.py")
script.write_text(code)
names = runpy.run_path(str(script), run_name="__main__")  # BenchMARL pickles the task
coverage = names["results"]["front"]["learned"]["coverage"]
print(f"coverage of BenchMARL's MAPPO: {sum(coverage) / len(coverage):.1f} %")
