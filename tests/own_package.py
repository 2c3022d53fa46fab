"""Writes the extension package of docs/extensions.md with an additional setup and fire."""

import re
from pathlib import Path

from emberlink.envs.utils.config_files import find

PAGE = (Path(__file__).parents[1] / "docs" / "extensions.md").read_text()
MODULE, *_ = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
METHOD, _, SETUP_OF_PAGE, CONSENSUS_OF_PAGE = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
(PROJECT,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
SETUP = """# @package _global_
defaults:
  - paper
  - override /fire: faint
env:
  horizon: 15
"""


def write(folder: Path, files: dict[str, str]) -> Path:
    """Writes files into a folder; `files` maps relative names to contents."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def yaml_files() -> dict[str, str]:
    """Returns the method `headcount`, the setup `small`, its fire and its change of that method."""
    fire = find("fire", "paper").read_text().replace("name: paper", "name: faint")
    return {
        "method/headcount.yaml": METHOD,
        "setup/small.yaml": SETUP,
        "fire/faint.yaml": fire,
        "setup_method/small_headcount.yaml": "# @package _global_\ncomm:\n  scale: 0.5\n",
    }


def write_package(folder: Path) -> Path:
    """Writes the sources of a package that contains these files."""
    files = {f"headcount/configs/{name}": text for name, text in yaml_files().items()}
    files |= {"pyproject.toml": PROJECT, "headcount/module.py": MODULE}
    files |= {"headcount/__init__.py": "", "headcount/configs/__init__.py": ""}
    return write(folder, files)
