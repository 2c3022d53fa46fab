"""Runs `emberlink sweep status`: prints the runs of a sweep, from the files in its folder."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep import manifest
from emberlink.trainers.sweep.leases import PATIENCE, SWEEP, TRAINING, Leases
from emberlink.trainers.sweep.manifest import Row


def status(arguments: Sequence[str], console: Console) -> int:
    """Prints a row for each run of a sweep: its state, its episodes, and where it is trained.

    Below, there is a line for each run that failed.

    Nothing is written. The sweep may still be running, in another shell or on another machine.

    Args:
        arguments: the output folder.
        console: prints the table.

    Raises:
        UserError: there is not one folder, or it holds no sweep.
    """
    if len(arguments) != 1:
        raise UserError("status: expected one output folder, such as emberlink sweep status runs")
    output = Path(arguments[0].removeprefix("output="))
    rows = manifest.read(output)
    if not rows:
        raise UserError(f"{output}: holds no sweep ({manifest.FILE} is missing)")
    leases = Leases(output)
    table = Table("run", "state", "episodes", "coverage", "where")
    table.add_column("folder", overflow="fold")
    counts: Counter[str] = Counter()
    failed: list[Row] = []
    for row in rows.values():
        lines = _lines(output / row.folder)
        state, where = _state(row, output, leases, len(lines))
        counts[state] += 1
        failed += [row] if state == "failed" else []
        table.add_row(row.name, state, *_progress(row, lines), where, row.folder)
    console.print(table)
    for row in failed:
        console.print(f"{row.name}: {row.note}", soft_wrap=True)
    console.print(f"{len(rows)} runs: " + ", ".join(f"{n} {state}" for state, n in counts.items()))
    return 0


def _state(row: Row, output: Path, leases: Leases, episodes: int) -> tuple[str, str]:
    """Returns the state of a run with a number of finished episodes, and who trains it."""
    if episodes >= row.episodes and RunFolder(output / row.folder).evaluated():
        return "finished", ""
    holder = leases.newest(row.run)
    if holder is None or not leases.is_held(row.run, holder):
        # The process that was to change the state may have been killed.
        return "stopped" if row.state in ("running", "finished") else row.state, ""
    since = leases.since(row.run)
    state = {TRAINING: "running", SWEEP: "queued"}[holder.role]
    return "silent" if since > 2 * PATIENCE else state, f"{holder.holder}, {since:.0f} s ago"


def _progress(row: Row, lines: list[dict[str, Any]]) -> tuple[str, str]:
    """Returns the finished episodes and the last coverage of a run."""
    coverage = lines[-1].get("coverage") if lines else None
    return f"{len(lines)}/{row.episodes}", "" if coverage is None else f"{coverage:.1f} %"


def _lines(folder: Path) -> list[dict[str, Any]]:
    """Returns the metrics of each episode; none while the file is being created or truncated."""
    try:
        return RunFolder(folder).lines()
    except (OSError, ValueError):
        return []
