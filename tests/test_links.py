"""Nothing is written, cut or deleted through a link, and no pipe or device is waited for.

Links, pipes, devices and sockets are planted at every name that a command writes; the files and
folders outside of the run folder must stay as they are.
"""

import os
import re
import shutil
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tiny_run import TINY

from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.publish import published
from emberlink.trainers.cli import main
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.tracking import Trackers
from emberlink.trainers.training import rollback


class Outside:
    """A folder that belongs to the user, and what was in it."""

    def __init__(self, path: Path):
        self.path, self.file, self.folder = path, path / "thesis.txt", path / "data"
        self.folder.mkdir(parents=True)
        self.file.write_text("mine\n")
        for name in ("a.csv", "coverage.png", "step_000000001.safetensors", "x.json.17.part"):
            (self.folder / name).write_text(f"my {name}\n")
        self.before = self.now()

    def now(self) -> dict[str, bytes | None]:
        found = self.path.rglob("*")
        return {str(p): p.read_bytes() if p.is_file() else None for p in found}


@pytest.fixture
def outside(tmp_path) -> Iterator[Outside]:
    """Unchanged at the end of every test."""
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
"""for commands, which take a second"""
LINKS = [kind for kind in KINDS if kind.startswith("link") or kind.startswith("dangling")]
REMOVED = [*LINKS, "hard link"]


def plant(path: Path, kind: str, outside: Outside) -> None:
    """Puts something in the place of a file or folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    try:
        KINDS[kind](path, outside)
    except PermissionError:  # a root without the right to make devices
        os.mkfifo(path)


def own(path: Path) -> bool:
    """Whether a name is a regular file that has no other name."""
    about = path.lstat()
    return stat.S_ISREG(about.st_mode) and about.st_nlink == 1


def ends(arguments: list[str | Path], capsys) -> tuple[int, str]:
    """The status and the errors of a command, which ends soon, without a traceback."""
    capsys.readouterr()
    began = time.monotonic()
    status = main.main([str(one) for one in arguments])
    error = capsys.readouterr().err
    assert time.monotonic() - began < 300
    assert "Traceback" not in error
    assert (status, error.count("\n")) in ((0, 0), (2, 1)), error
    return status, error


# The one place that opens files


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_is_replaced_and_not_written_through(kind, tmp_path, outside):
    path = tmp_path / "eval.json"
    plant(path, kind, outside)
    plant(
        tmp_path / f"eval.json.{os.getpid()}.part",
        kind if kind in REMOVED else "link to a file",
        outside,
    )
    atomic_io.write_bytes(path, b"whole")
    assert path.read_bytes() == b"whole"
    assert own(path)
    assert [one.name for one in tmp_path.iterdir() if one.name != "home"] == ["eval.json"]


@pytest.mark.parametrize("kind", sorted(set(KINDS) - set(REMOVED)))
def test_a_temporary_name_that_is_taken(kind, tmp_path, outside):
    plant(tmp_path / f"eval.json.{os.getpid()}.part", kind, outside)
    with pytest.raises(OSError, match="no regular file"):
        atomic_io.write_bytes(tmp_path / "eval.json", b"whole")
    assert not (tmp_path / "eval.json").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_file_takes_no_name_that_is_there(kind, tmp_path, outside):
    path = tmp_path / "fires.npy"
    plant(path, kind, outside)
    with pytest.raises(ValueError, match="is there already"), published(path) as partial:
        partial.write_bytes(b"whole")
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("create", [False, True])
def test_a_file_is_not_changed_through_a_link(kind, create, tmp_path, outside):
    path = tmp_path / "metrics.jsonl"
    plant(path, kind, outside)
    if kind == "hard link":
        with atomic_io.changed(path, create=create) as handle:
            os.ftruncate(handle, 2)
            os.write(handle, b"new")
        assert path.read_bytes() == b"minew"
        return
    said = "it is a link" if kind in LINKS else "no regular file|No such device"
    with pytest.raises(OSError, match=said), atomic_io.changed(path, create=create):
        pass


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("names", [("figures",), ("a", "b")])
def test_a_folder_on_the_way_is_no_link(kind, names, tmp_path, outside):
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
        with pytest.raises(OSError, match="no regular file"):
            atomic_io.remove(path)
        assert os.path.lexists(path)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"link to a file", "hard link"}))
def test_only_regular_files_are_read(kind, tmp_path, outside):
    path = tmp_path / "metrics.jsonl"
    plant(path, kind, outside)
    said = r"no regular file|directory|No such (file|device)|symbolic links"
    with pytest.raises(OSError, match=said):
        atomic_io.read_bytes(path, 100)


def test_only_files_of_a_bounded_size_are_read(tmp_path):
    path = tmp_path / "large"
    path.write_bytes(b"")
    os.truncate(path, 2**40)  # takes no room
    with pytest.raises(OSError, match="more than 1000 bytes"):
        atomic_io.read_bytes(path, 1000)


@pytest.mark.parametrize("kind", KINDS)
def test_a_lock(kind, tmp_path, outside):
    plant(tmp_path / "lock", kind, outside)
    with pytest.raises(ValueError, match=r"lock: cannot be locked: .+"):
        Lock(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file", ["timing.jsonl", "metrics.jsonl", rollback.FILE])
def test_lines_of_a_run(kind, file, tmp_path, outside):
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


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run of two episodes that nobody changes, whose tracker is csv."""
    output = tmp_path_factory.mktemp("links") / "runs"
    assert main.main(["train", "independent", *TINY, "logger=csv", f"output={output}"]) == 0
    (folder,) = output.iterdir()
    return folder


@pytest.fixture
def run(trained, tmp_path) -> Path:
    return shutil.copytree(trained, tmp_path / "run")


def written(run: Path) -> list[str]:
    """The names in a run folder that were written, folders left out."""
    found = (path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file())
    return sorted(found)


IN_PLACE = ("metrics.jsonl", "timing.jsonl")


@pytest.mark.parametrize("kind", SOME)
def test_an_evaluation_replaces_what_was_planted(kind, run, outside, capsys):
    drawn = [name for name in written(run) if name.startswith("figures/")]
    assert len(drawn) == 4
    for name in (*drawn, "eval.json"):
        plant(run / name, kind, outside)
    status, error = ends(["eval", run, "--fires", "1"], capsys)
    assert status == 0, error
    for name in (*drawn, "eval.json"):
        assert own(run / name)


@pytest.mark.parametrize("kind", SOME)
@pytest.mark.parametrize("command", ["eval", "render"])
def test_the_folder_of_the_figures(kind, command, run, outside, capsys):
    plant(run / "figures", kind, outside)
    more = ["--fires", "1"] if command == "eval" else ["--frames", "2"]
    status, error = ends([command, run, *more], capsys)
    assert status == 2
    assert "it is a link" in error or "Not a directory" in error


@pytest.mark.parametrize("kind", SOME)
@pytest.mark.parametrize("name", ["timing.jsonl", "metrics.jsonl", "lock", "checkpoints"])
def test_a_resumed_run_that_is_refused(kind, name, run, outside, capsys):
    """With a checkpoint and without one, and with nothing changed."""
    if kind == "hard link" and name.endswith("jsonl"):
        return  # in `test_a_resumed_run_replaces_what_was_planted`
    for begun in (False, True):
        if begun and name != "checkpoints":
            shutil.rmtree(run / "checkpoints")
            (run / "eval.json").unlink()
            (run / "metrics.jsonl").unlink(missing_ok=True)
        plant(run / name, kind, outside)
        before = {file: (run / file).lstat().st_mtime_ns for file in written(run)}
        status, error = ends(["train", f"resume={run}", "episodes=3"], capsys)
        assert status == 2
        assert name.partition(".")[0] in error
        assert {file: (run / file).lstat().st_mtime_ns for file in written(run)} == before


@pytest.mark.parametrize("kind", ["link to a file", "dangling link", "hard link"])
def test_a_resumed_run_replaces_what_was_planted(kind, run, outside, capsys):
    """Everything that a resumed run makes anew or takes away, at once."""
    again = [f"figures/{path.name}" for path in (run / "figures").iterdir()]
    again += ["eval.json", "metrics.csv"]
    later = ["checkpoints/step_000000045.safetensors"]
    taken = [*later, "checkpoints/.tmpX", "x.json.17.part", "figures/x.png.17.part"]
    best = "checkpoints/best.safetensors"  # made anew if an episode is better
    for name in (*again, *taken, best):
        plant(run / name, kind, outside)
    if kind == "hard link":
        for name in IN_PLACE:
            other = outside.path / name
            shutil.copy(run / name, other)
            (run / name).unlink()
            (run / name).hardlink_to(other)
        outside.before = outside.now()
    status, error = ends(["train", f"resume={run}", "episodes=3"], capsys)
    assert status == 0, error
    for name in (*again, *later, *IN_PLACE):
        assert own(run / name)
    assert not any(os.path.lexists(run / name) for name in taken[1:])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("folder", ["tensorboard", "wandb"])
def test_folders_of_trackers(kind, folder, run, outside):
    logger = folder.partition("/")[0]
    plant(run / folder, kind, outside)
    here = RunFolder(run)
    trackers = Trackers([here.config(logger=logger)], [here], episode=2)
    with pytest.warns(UserWarning, match=f"logger={logger} has stopped.*(link|Not a directory)"):
        trackers.close()


@pytest.mark.parametrize("kind", KINDS)
def test_the_table_of_the_csv_tracker(kind, run, outside):
    path = run / "metrics.csv"
    plant(path, kind, outside)
    here = RunFolder(run)
    trackers = Trackers([here.config()], [here], episode=2)
    if path.is_dir() and not path.is_symlink():
        with pytest.warns(UserWarning, match="logger=csv has stopped"):
            trackers.close()
        return
    trackers.close()
    assert own(path)
    assert len(path.read_text().splitlines()) == 1 + 2


def test_a_seed_beside_that_is_a_link(tmp_path, outside, capsys):
    runs = tmp_path / "runs"
    arguments = ["independent", *TINY, "seeds=[0,1]", f"output={runs}"]
    assert main.main(["train", *arguments]) == 0
    first, second = sorted(runs.iterdir())
    elsewhere = second.rename(outside.path / second.name)
    outside.before = outside.now()
    second.symlink_to(elsewhere)
    status, error = ends(["train", f"resume={first}", "episodes=3"], capsys)
    assert status == 2
    assert "is a link" in error


@pytest.mark.parametrize("kind", SOME)
def test_the_logs_of_a_sweep(kind, tmp_path, outside, capsys):
    runs = tmp_path / "runs"
    runs.mkdir()
    plant(runs / "logs", kind, outside)
    status, error = ends(["sweep", "independent", *TINY, f"output={runs}"], capsys)
    assert status == 2
    assert "it is a link" in error or "Not a directory" in error


@pytest.mark.parametrize("kind", SOME)
def test_outputs_that_are_named(kind, run, outside, tmp_path, capsys):
    commands = {
        "out.gif": ["render", run, "--frames", "2", "--output"],
        "report": ["compare", run, "--output"],
        "fires.npy": ["fire", "make", "paper", "--count", "1", "--output"],
        "about.json": ["fire", "make", "paper", "--count", "1", "--output"],
        "fire.png": ["fire", "preview", "paper:0", "--output"],
    }
    if kind == "link to a folder":  # the user's own choice
        return
    for name, command in commands.items():
        plant(tmp_path / name, kind, outside)
        output = tmp_path / name.replace(".json", ".npy")
        assert ends([*command, output], capsys)[0] == 2


@pytest.mark.parametrize("kind", SOME)
@pytest.mark.parametrize("what", ["fire", "scripted"])
def test_caches(kind, what, run, outside, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("EMBERLINK_CACHE", str(tmp_path / "cache"))
    assert ends(["eval", run, "--fires", "1"], capsys)[0] == 0
    files = sorted((tmp_path / "cache").glob(f"{what}-*"))
    contents = [file.read_bytes() for file in files]
    assert files
    for file in files:
        plant(file, kind, outside)
    assert ends(["eval", run, "--fires", "1"], capsys)[0] == 0
    assert [file.read_bytes() for file in files] == contents
    assert not any(file.is_symlink() for file in files)


# No other place opens files


def test_every_file_is_opened_by_the_one_place(tmp_path, capsys, monkeypatch):
    """Python tells of each file that is opened: those to be written are temporary, or known."""
    opened: list[str] = []
    watching = True

    def look(event: str, arguments: tuple) -> None:
        if not watching:
            return
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path, flags = os.fsdecode(arguments[0]), arguments[2] or 0
            if flags & (os.O_WRONLY | os.O_RDWR | os.O_TRUNC | os.O_CREAT | os.O_APPEND):
                opened.append(path)
        elif event in ("os.truncate", "os.remove") and not isinstance(arguments[0], int):
            opened.append(os.fsdecode(arguments[0]))

    sys.addaudithook(look)
    runs = tmp_path / "runs"
    arguments = [
        "train",
        "independent",
        *TINY,
        "logger=csv",
        "keep_checkpoints=1",
        f"output={runs}",
    ]
    try:
        assert main.main([*arguments, "checkpoint_interval=1"]) == 0
        (run,) = runs.iterdir()
        assert main.main(["train", f"resume={run}", "episodes=3"]) == 0
        assert main.main(["eval", str(run), "--fires", "1"]) == 0
        assert main.main(["render", str(run), "--frames", "2"]) == 0
    finally:
        watching = False
    part = re.compile(rf".*\.{os.getpid()}\.part|\.tmp.*")
    known = re.compile(
        r"lock|metrics\.jsonl|timing\.jsonl"
        r"|checkpoints/(step|state)_\d+\.safetensors"
    )
    names = [Path(path).relative_to(run).as_posix() for path in opened if str(run) in path]
    assert len(names) > 20
    assert not [
        name for name in names if not part.fullmatch(Path(name).name) and not known.fullmatch(name)
    ]
