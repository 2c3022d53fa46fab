"""Tests that links are not followed for writing, and that pipes and devices do not block.

The module that opens files is tested with every kind of link, pipe, socket and device. Each command
is run once with a mixture of them at the names that it writes, and once under an audit hook: every
file that it opens for writing is a temporary one or is opened without following links. What lies
outside of the run folder must not change.
"""

import dataclasses
import errno
import itertools
import os
import re
import shutil
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tiny_run import TINY

from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.publish import published
from emberlink.trainers.cli import main
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.tracking.trackers import Trackers
from emberlink.trainers.training import rollback


class Outside:
    """Holds a folder of the user and its initial contents."""

    def __init__(self, path: Path):
        self.path, self.file, self.folder = path, path / "thesis.txt", path / "data"
        self.folder.mkdir(parents=True)
        self.file.write_text("mine\n")
        for name in ("a.csv", "coverage.png", "step_000000001.safetensors", "x.json.17.part"):
            (self.folder / name).write_text(f"my {name}\n")
        self.before = self.now()

    def now(self) -> dict[str, bytes | None]:
        paths = self.path.rglob("*")
        return {str(p): p.read_bytes() if p.is_file() else None for p in paths}


@pytest.fixture
def outside(tmp_path) -> Iterator[Outside]:
    """Yields a folder outside of the run folder and checks that the test did not change it."""
    made = Outside(tmp_path / "home")
    yield made
    assert made.now() == made.before


def _socket(path: Path, _: Outside) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # a socket's path is short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name[:90])
    os.chdir(here)


KINDS: dict[str, Callable[[Path, Outside], object]] = {
    "link to a file": lambda path, out: path.symlink_to(out.file),
    "link to a folder": lambda path, out: path.symlink_to(out.folder),
    "dangling link": lambda path, out: path.symlink_to(out.path / "new"),
    "link to itself": lambda path, out: path.symlink_to(path.name),
    "link to /dev/zero": lambda path, out: path.symlink_to("/dev/zero"),
    "hard link": lambda path, out: path.hardlink_to(out.file),
    "pipe": lambda path, out: os.mkfifo(path),
    "socket": _socket,
}
if os.geteuid() == 0:
    KINDS["device"] = lambda path, out: os.mknod(path, 0o20666, os.makedev(1, 5))  # /dev/zero
SOME = ["link to a file", "link to a folder", "dangling link", "hard link", "pipe"]
"""kinds that are planted at several names at once, one after the other"""
LINKS = [kind for kind in KINDS if kind.startswith("link") or kind.startswith("dangling")]
REMOVED = [*LINKS, "hard link"]


def plant(path: Path, kind: str, outside: Outside) -> None:
    """Replaces a file or folder by a link, pipe, socket or device."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    try:
        KINDS[kind](path, outside)
    except PermissionError:  # root without the right to create devices
        os.mkfifo(path)


def is_regular(path: Path) -> bool:
    """Checks whether a path is a regular file with a single name."""
    about = path.lstat()
    return stat.S_ISREG(about.st_mode) and about.st_nlink == 1


def run_command(arguments: list[str | Path], capsys) -> tuple[int, str]:
    """Returns status and errors of a command; checks for a timeout and for tracebacks."""
    capsys.readouterr()
    began = time.monotonic()
    status = main.main([str(argument) for argument in arguments])
    error = capsys.readouterr().err
    assert time.monotonic() - began < 300
    assert "Traceback" not in error
    assert (status, error.count("\n")) in ((0, 0), (2, 1)), error
    return status, error


# The module that opens files


@pytest.mark.parametrize("kind", KINDS)
def test_an_existing_link_is_replaced(kind, tmp_path, outside):
    path = tmp_path / "eval.json"
    plant(path, kind, outside)
    plant(
        tmp_path / f"eval.json.{os.getpid()}.part",
        kind if kind in REMOVED else "link to a file",
        outside,
    )
    atomic_io.write_bytes(path, b"whole")
    assert path.read_bytes() == b"whole"
    assert is_regular(path)
    assert [file.name for file in tmp_path.iterdir() if file.name != "home"] == ["eval.json"]


@pytest.mark.parametrize("kind", sorted(set(KINDS) - set(REMOVED)))
def test_an_existing_temporary_file(kind, tmp_path, outside):
    plant(tmp_path / f"eval.json.{os.getpid()}.part", kind, outside)
    with pytest.raises(OSError, match="not a regular file"):
        atomic_io.write_bytes(tmp_path / "eval.json", b"whole")
    assert not (tmp_path / "eval.json").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_file_does_not_replace_an_existing_one(kind, tmp_path, outside):
    path = tmp_path / "fires.npy"
    plant(path, kind, outside)
    with pytest.raises(ValueError, match="exists already"), published(path) as partial:
        partial.write_bytes(b"whole")
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("create", [False, True])
def test_a_file_is_not_changed_through_a_link(kind, create, tmp_path, outside):
    path = tmp_path / "metrics.jsonl"
    plant(path, kind, outside)
    if kind == "hard link":
        with atomic_io.open_in_place(path, create=create) as handle:
            os.ftruncate(handle, 2)
            os.write(handle, b"new")
        assert path.read_bytes() == b"minew"
        return
    said = "it is a link" if kind in LINKS else "not a regular file|No such device"
    with pytest.raises(OSError, match=said), atomic_io.open_in_place(path, create=create):
        pass


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("names", [("figures",), ("a", "b")])
def test_a_parent_folder_must_not_be_a_link(kind, names, tmp_path, outside):
    run = tmp_path / "run"
    run.joinpath(*names[:-1]).mkdir(parents=True)
    plant(run.joinpath(*names), kind, outside)
    with pytest.raises(OSError, match=r"it is a link|Not a directory"):
        atomic_io.inner_folder(run, *names)
    with pytest.raises(OSError, match=r"it is a link|Not a directory"):
        atomic_io.inner_folder(run, *names, "below")


def test_the_run_folder_itself_may_be_a_link(tmp_path):
    (tmp_path / "scratch").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "scratch")
    assert atomic_io.inner_folder(tmp_path / "runs", "a", "b").is_dir()
    assert (tmp_path / "scratch" / "a" / "b").is_dir()


@pytest.mark.parametrize("kind", KINDS)
def test_only_files_and_links_are_removed(kind, tmp_path, outside):
    path = tmp_path / "one.part"
    plant(path, kind, outside)
    if kind in REMOVED:
        atomic_io.remove(path)
        assert not os.path.lexists(path)
    else:
        with pytest.raises(OSError, match="not a regular file"):
            atomic_io.remove(path)
        assert os.path.lexists(path)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"link to a file", "hard link"}))
def test_only_regular_files_are_read(kind, tmp_path, outside):
    path = tmp_path / "metrics.jsonl"
    plant(path, kind, outside)
    said = r"not a regular file|directory|No such (file|device)|symbolic links"
    with pytest.raises(OSError, match=said):
        atomic_io.read_bytes(path, 100)


def test_only_files_of_a_bounded_size_are_read(tmp_path):
    path = tmp_path / "large"
    path.write_bytes(b"")
    os.truncate(path, 2**40)  # takes no room
    with pytest.raises(OSError, match="more than 1000 bytes"):
        atomic_io.read_bytes(path, 1000)


def test_folders_of_a_file_system_that_cannot_flush_them(tmp_path, monkeypatch):
    def fsync(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(os, "fsync", fsync)
    atomic_io.write_bytes(tmp_path / "file", b"content")
    assert (tmp_path / "file").read_bytes() == b"content"


@pytest.mark.parametrize("kind", KINDS)
def test_a_lock(kind, tmp_path, outside):
    plant(tmp_path / "lock", kind, outside)
    with pytest.raises(ValueError, match=r"lock: cannot be locked: .+"):
        Lock(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file", ["timing.jsonl", "metrics.jsonl", rollback.FILE])
def test_metrics_of_a_run(kind, file, tmp_path, outside):
    run = RunFolder(tmp_path)
    plant(run.path / file, kind, outside)
    if kind == "hard link":
        run.cut(file, 0)
        run.append(file, {"episode": 1})
        assert (run.path / file).read_text() == '{"episode": 1}\n'
        return
    with pytest.raises(ValueError, match=f"{file}: cannot be cut: "):
        run.cut(file, 0)
    with pytest.raises(ValueError, match=f"{file}: cannot be written: "):
        run.append(file, {"episode": 1})
    with pytest.raises(ValueError, match=f"{file}: cannot be read: "):
        run.check_lines(file, 0, 0)


# Commands


@dataclasses.dataclass
class Opened:
    """Describes a file that was opened for writing, or removed."""

    path: Path
    safe: bool
    """whether a link of that name would not have been followed"""


OPENED: list[Opened] | None = None
"""what an audit hook has seen; None before `watched`"""


def _look(event: str, arguments: tuple) -> None:
    if OPENED is None:
        return
    if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        flags = arguments[2] or 0
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_TRUNC | os.O_CREAT | os.O_APPEND):
            path = Path(os.fsdecode(arguments[0]))
            OPENED.append(Opened(path, bool(flags & os.O_NOFOLLOW)))
    elif event == "os.truncate" and not isinstance(arguments[0], int):
        OPENED.append(Opened(Path(os.fsdecode(arguments[0])), False))
    elif event == "os.remove":  # which never follows a link
        OPENED.append(Opened(Path(os.fsdecode(arguments[0])), True))


@contextmanager
def watched() -> Iterator[list[Opened]]:
    """Yields a list that collects every file that is opened for writing."""
    global OPENED
    if not _HOOKED:
        sys.addaudithook(_look)  # an audit hook cannot be removed
        _HOOKED.append(True)
    OPENED = []
    try:
        yield OPENED
    finally:
        OPENED = None


_HOOKED: list[bool] = []


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, list[Opened]]:
    """Trains two episodes with the csv tracker; returns the run and the files that it opened."""
    output = tmp_path_factory.mktemp("links") / "runs"
    with watched() as opened:
        assert main.main(["train", "independent", *TINY, "logger=csv", f"output={output}"]) == 0
    (folder,) = output.iterdir()
    return folder, opened


@pytest.fixture
def run(trained, tmp_path) -> Path:
    return shutil.copytree(trained[0], tmp_path / "run")


IN_PLACE = ("metrics.jsonl", "timing.jsonl")


def test_every_file_is_opened_without_following_links(trained, run, tmp_path, monkeypatch):
    """Temporary files are created with O_EXCL beforehand."""
    monkeypatch.setenv("EMBERLINK_CACHE", str(tmp_path / "cache"))
    folder, begun = trained
    with watched() as opened:
        assert main.main(["train", f"resume={run}", "episodes=3", "keep_checkpoints=1"]) == 0
        assert main.main(["render", str(run), "--frames", "2"]) == 0
    mine = [file for file in [*begun, *opened] if {run, folder} & set(file.path.parents)]
    cached = [file for file in opened if tmp_path / "cache" in file.path.parents]
    assert len(mine) > 30
    assert len(cached) > 5
    part = re.compile(rf".*\.{os.getpid()}\.part|\.tmp.*")
    followed = [
        file.path
        for file in (*mine, *cached)
        if not file.safe and not part.fullmatch(file.path.name)
    ]
    assert not followed


def test_an_evaluation_replaces_links(run, outside, tmp_path, capsys, monkeypatch):
    """The links are at the names of figures, eval.json and caches."""
    incomplete = shutil.ignore_patterns("*.part")  # of another process of the tests
    cache = shutil.copytree(os.environ["EMBERLINK_CACHE"], tmp_path / "cache", ignore=incomplete)
    monkeypatch.setenv("EMBERLINK_CACHE", str(cache))
    contents = {file: file.read_bytes() for file in cache.iterdir()}
    drawn = [file for file in (run / "figures").iterdir() if not file.is_symlink()]
    assert len(drawn) == 5
    assert len(contents) > 1
    names = [*drawn, run / "eval.json", *contents]
    for path, kind in zip(names, itertools.cycle(SOME)):
        plant(path, kind, outside)
    status, error = run_command(["eval", run], capsys)
    assert status == 0, error
    used = [file for file in contents if is_regular(file)]
    assert {file.name.partition("-")[0] for file in used} == {"fire", "scripted"}
    assert all(file.read_bytes() == contents[file] for file in used)
    assert all(is_regular(path) for path in (*drawn, run / "eval.json"))


@pytest.mark.parametrize("arguments", [["eval"], ["render", "--frames", "2"]])
def test_the_folder_of_the_figures(arguments, run, outside, capsys):
    plant(run / "figures", "link to a folder", outside)
    status, error = run_command([arguments[0], run, *arguments[1:]], capsys)
    assert status == 2
    assert "it is a link" in error


@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("timing.jsonl", "link to a file"),
        ("metrics.jsonl", "pipe"),
        ("lock", "hard link"),
        ("checkpoints", "link to a folder"),
    ],
)
def test_a_refused_resume_changes_no_file(name, kind, begun, run, outside, capsys):
    """Tests a run with and without a checkpoint."""
    if begun:
        shutil.rmtree(run / "checkpoints")
        (run / "eval.json").unlink()
        (run / "metrics.jsonl").unlink()
    plant(run / name, kind, outside)
    before = {file: file.lstat().st_mtime_ns for file in run.rglob("*") if file.is_file()}
    status, error = run_command(["train", f"resume={run}", "episodes=3"], capsys)
    assert status == 2
    assert name.partition(".")[0] in error
    now = {file: file.lstat().st_mtime_ns for file in run.rglob("*") if file.is_file()}
    assert {file: now[file] for file in before} == before
    assert {file.name for file in now if file not in before} <= {"lock"}


def test_a_resumed_run_replaces_links(run, outside, capsys):
    """The links are at all names that a resumed run writes or removes."""
    again = [path for path in (run / "figures").iterdir() if not path.is_symlink()]
    again += [run / "eval.json", run / "metrics.csv"]
    later = run / "checkpoints" / "step_000000045.safetensors"
    removed = [run / "checkpoints" / ".tmpX", run / "x.json.17.part"]
    removed += [run / "figures" / "x.png.17.part"]
    best = run / "checkpoints" / "best.safetensors"  # written again if an episode is better
    kinds = ["link to a file", "dangling link", "hard link"]
    for path, kind in zip((*again, later, *removed, best), itertools.cycle(kinds)):
        plant(path, kind, outside)
    for name in IN_PLACE:  # links are refused, a second name of the file is kept unchanged
        shutil.copy(run / name, outside.path / name)
        (run / name).unlink()
        (run / name).hardlink_to(outside.path / name)
    outside.before = outside.now()
    status, error = run_command(["train", f"resume={run}", "episodes=3"], capsys)
    assert status == 0, error
    assert all(is_regular(path) for path in (*again, later, *(run / name for name in IN_PLACE)))
    assert not any(os.path.lexists(path) for path in removed)


@pytest.mark.parametrize("folder", ["tensorboard", "wandb"])
def test_folders_of_trackers(folder, run, outside):
    plant(run / folder, "link to a folder", outside)
    here = RunFolder(run)
    trackers = Trackers([here.config(logger=folder)], [here], episode=2)
    with pytest.warns(UserWarning, match=f"logger={folder} has stopped.*it is a link"):
        trackers.close()


@pytest.mark.parametrize("kind", SOME)
def test_the_table_of_the_csv_tracker(kind, run, outside):
    path = run / "metrics.csv"
    plant(path, kind, outside)
    here = RunFolder(run)
    Trackers([here.config()], [here], episode=2).close()
    assert is_regular(path)
    assert len(path.read_text().splitlines()) == 1 + 2


def test_a_link_as_the_folder_of_another_seed(run, outside, capsys):
    """A file of the run folder, not the user, names the folders of the other seeds."""
    other = outside.path / "other"
    shutil.copytree(run, other)
    outside.before = outside.now()
    (run.parent / "other").symlink_to(other)
    (run / "seed_runs.json").write_text('{"folders": ["run", "other"]}')
    status, error = run_command(["train", f"resume={run}", "episodes=3"], capsys)
    assert status == 2
    assert "is a link" in error


def test_the_logs_of_a_sweep(tmp_path, outside, capsys):
    runs = tmp_path / "runs"
    runs.mkdir()
    plant(runs / "logs", "link to a folder", outside)
    status, error = run_command(["sweep", "independent", *TINY, f"output={runs}"], capsys)
    assert status == 2
    assert f"{runs / 'logs'}: it is a link" in error


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("out.gif", ["render", "RUN", "--frames", "2", "--output"]),
        ("report", ["compare", "RUN", "--output"]),
        ("fires.npy", ["fire", "make", "paper", "--count", "1", "--output"]),
        ("fires.json", ["fire", "make", "paper", "--count", "1", "--output"]),
        ("fire.png", ["fire", "preview", "paper:0", "--output"]),
    ],
)
def test_output_files_given_by_the_user(name, command, run, outside, tmp_path, capsys):
    plant(tmp_path / name, "dangling link", outside)
    output = tmp_path / name.replace(".json", ".npy")
    command = [str(run) if word == "RUN" else word for word in command]
    assert run_command([*command, output], capsys)[0] == 2
