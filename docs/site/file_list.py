"""Writes the last section of docs/architecture.md: what each file is for, from its first sentence.

Run `python docs/site/file_list.py` after a file was added, moved or described anew.
"""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "architecture.md"
HEADING = "## Every file\n"
FOLDERS = ("configs", "envs", "comm", "policies", "trainers")


def file_list() -> str:
    """Returns the section without its heading, one line per file."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    paths += (ROOT / "trainers" / "replay" / "web").glob("*.js")
    rooms: dict[str, list[str]] = {}
    for path in sorted(paths):
        room = rooms.setdefault(path.parent.relative_to(ROOT).as_posix(), [])
        if path.name not in ("__init__.py", "__main__.py"):
            room.append(f"- `{path.name}`: {_sentence(path)}")
    return "".join(
        f"\n### {room}/\n\n" + "\n".join(files) + "\n" for room, files in rooms.items() if files
    )


def _sentence(path: Path) -> str:
    """Returns the first paragraph of a file's docstring or comment."""
    if path.suffix == ".py":
        text = ast.get_docstring(ast.parse(path.read_text())) or ""
    else:
        lines = path.read_text().splitlines()
        code = next(number for number, line in enumerate(lines) if not line.startswith("//"))
        text = " ".join(line.lstrip("/ ") for line in lines[:code])
    return " ".join(text.split("\n\n")[0].split())


def page() -> str:
    """Returns the page with the present list."""
    return PAGE.read_text().split(HEADING)[0] + HEADING + file_list()


if __name__ == "__main__":
    PAGE.write_text(page())
