"""Reads and writes the manifest of a sweep: a row for each run, in the output folder."""

import json
import os
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from emberlink.envs.utils.atomic_io import write_bytes
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.runs.safe_read import MAX_JSON, parse_json, read_text
from emberlink.trainers.sweep.jobs import Job, folder_name, hash_of, identity, is_finished

FILE = "sweep.json"
"""file of the manifest, in the output folder"""
_FORMAT = 1
STATES = ("new", "queued", "running", "stopped", "failed", "finished")
"""values of `Row.state`"""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A run of a sweep.

    Attributes:
        run: hash of the configuration.
        name: as `Job.name`.
        folder: name of the run folder.
        state: one of `STATES`.
        episodes: number of episodes of the whole training.
        executor: name of the executor that trained it last; empty if there was none.
        task: name of the task that the executor knows; may be empty.
        log: log of the newest task, relative to the output folder.
        restarts: how often the run was started again after it ended without saving.
        note: the reason if the run failed.
        changes: number of changes so far; the version with more changes is the newer one.
    """

    run: str
    name: str
    folder: str
    state: str
    episodes: int
    executor: str = ""
    task: str = ""
    log: str = ""
    restarts: int = 0
    note: str = ""
    changes: int = 0


_EMPTY = Row(run="", name="", folder="", state="", episodes=0)


def read(output: Path) -> dict[str, Row]:
    """Returns the rows of a manifest by `Row.run`; none if there is no manifest.

    Raises:
        UserError: the file is not a manifest.
    """
    path = output / FILE
    if not os.path.lexists(path):
        return {}
    try:
        content = parse_json(read_text(path, MAX_JSON))
        rows = [_row(row) for row in content["runs"]]
        if content["format"] != _FORMAT or any(row.state not in STATES for row in rows):
            raise UserError("of another version")
    except FileNotFoundError:
        return {}
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: not a manifest of a sweep: {error}") from None
    return {row.run: row for row in rows}


def _row(values: Mapping[str, Any]) -> Row:
    """Returns a row, after a check of its types and of the places that it names."""
    row = Row(**values)
    for field in fields(Row):
        value = getattr(row, field.name)
        if type(value) is not type(getattr(_EMPTY, field.name)):
            raise UserError(f"{field.name}={shown(value)}")
    inside = Path(row.folder).name == row.folder and ".." not in (row.folder, *Path(row.log).parts)
    if not row.folder or not inside or Path(row.log).is_absolute():
        raise UserError(f"a run in {shown(row.folder)} with the log {shown(row.log)}")
    return row


def _write(output: Path, rows: Mapping[str, Row]) -> None:
    """Writes the manifest completely, or leaves the earlier one.

    Raises:
        UserError: the file cannot be written.
    """
    content = {"format": _FORMAT, "runs": [asdict(row) for row in rows.values()]}
    try:
        output.mkdir(parents=True, exist_ok=True)
        text = json.dumps(content, indent=1) + "\n"
        # Sweeps on several machines may have the same process number.
        write_bytes(output / FILE, text.encode(), tag=f"-{secrets.token_hex(4)}")
    except OSError as error:
        where = error.filename or os.fspath(output)
        raise UserError(f"{where}: {error.strerror or error}") from None


class Manifest:
    """The rows of the jobs of one sweep command; each change is written at once.

    Other sweeps may write into the same file. Of each row, the newest version is kept; a version
    that another sweep has overwritten at the same time is written again with the next change.

    Args:
        output: folder of the run folders.
        executor: name of the executor.
    """

    def __init__(self, output: Path, executor: str = ""):
        self._output, self.executor = output, executor
        self.rows: dict[str, Row] = {}

    def load(self, jobs: Iterable[Job]) -> None:
        """Reads the earlier rows, updates those of the jobs, and writes all.

        Raises:
            UserError: the earlier file is not a manifest, or it cannot be written.
        """
        rows = read(self._output)
        for job in jobs:
            for row in _rows(job):
                old = rows.get(row.run)
                if old is not None:
                    state = row.state if row.state == "finished" or not job.found else old.state
                    new = replace(old, state=state, folder=row.folder, episodes=row.episodes)
                    row = _changed(old, new)
                elif job.found and row.state != "finished":
                    row = replace(row, state="stopped")
                rows[row.run] = self.rows[row.run] = row
        _write(self._output, rows)

    def set(self, job: Job, state: str, **changes: Any) -> None:
        """Changes the rows of a job and writes the manifest.

        Args:
            job: the job.
            state: one of `STATES`.
            changes: other attributes of the rows.
        """
        rows = read(self._output)
        for run, row in self.rows.items():
            rows[run] = self.rows[run] = max(rows.get(run, row), row, key=lambda row: row.changes)
        for row in _rows(job):
            old = rows.get(row.run, row)
            new = _changed(old, replace(old, state=state, folder=row.folder, **changes))
            rows[row.run] = self.rows[row.run] = new
        _write(self._output, rows)

    def of(self, job: Job) -> list[Row]:
        """Returns the rows of a job."""
        return [self.rows[row.run] for row in _rows(job) if row.run in self.rows]

    def task(self, job: Job) -> str:
        """Returns the name of the task that trained a job last on an executor of this name."""
        tasks = {(row.executor, row.task) for row in self.of(job)}
        executor, task = tasks.pop() if len(tasks) == 1 else ("", "")
        return task if executor == self.executor else ""


def _changed(old: Row, new: Row) -> Row:
    """Returns the new version of a row."""
    return new if new == old else replace(new, changes=old.changes + 1)


def _rows(job: Job) -> list[Row]:
    """Returns a new row for each run of a job."""
    rows = []
    for config in job.configs:
        found = job.found.get(config.seed)
        finished = found is not None and is_finished(found.folder, config)
        rows.append(
            Row(
                run=hash_of(identity(config)),
                name=replace(job, configs=[config]).name,
                folder=found.folder.path.name if found else folder_name(config),
                state="finished" if finished else "new",
                episodes=config.episodes,
            )
        )
    return rows
