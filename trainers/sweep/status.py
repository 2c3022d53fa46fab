"""Runs `emberlink sweep status`: prints the runs of a sweep, from the files in its folder."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

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
        raise UserError("emberlink sweep status FOLDER: expected one folder")
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
        state, where = _state(row, output, leases)
        counts[state] += 1
        failed += [row] if state == "failed" else []
        table.add_row(row.name, state, *_progress(row, output), where, row.folder)
    console.print(table)
    for row in failed:
        console.print(f"{row.name}: {row.note}", soft_wrap=True)
    console.print(f"{len(rows)} runs: " + ", ".join(f"{n} {state}" for state, n in counts.items()))
    return 0


def _state(row: Row, output: Path, leases: Leases) -> tuple[str, str]:
    """Returns the state of a run, and who trains it."""
    lines, episodes = _lines(row, output)
    if lines >= episodes and RunFolder(output / row.folder).evaluated():
        return "finished", ""
    holder = leases.newest(row.run)
    if holder is None or not leases.is_held(row.run, holder):
        # The process that was to change the state may have been killed.
        return "stopped" if row.state in ("running", "finished") else row.state, ""
    since = leases.since(row.run)
    state = {TRAINING: "running", SWEEP: "queued"}[holder.role]
    return "silent" if since > 2 * PATIENCE else state, f"{holder.holder}, {since:.0f} s ago"


def _progress(row: Row, output: Path) -> tuple[str, str]:
    """Returns the finished episodes and the last coverage of a run."""
    lines, episodes = _lines(row, output)
    if not lines:
        return f"0/{episodes}", ""
    last = RunFolder(output / row.folder).lines()[-1]
    return f"{lines}/{episodes}", f"{last['coverage']:.1f} %" if "coverage" in last else ""


def _lines(row: Row, output: Path) -> tuple[int, int]:
    try:
        return len(RunFolder(output / row.folder).lines()), row.episodes
    except (OSError, ValueError):  # the file is being created or truncated
        return 0, row.episodes
