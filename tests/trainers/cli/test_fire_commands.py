"""Tests `emberlink fire`: pictures, numbers, banks and errors."""

from pathlib import Path

import numpy as np
import pytest
import refusal
from burning import burning_cells
from fire_files import write_asc
from PIL import Image

from emberlink.envs.fire.generator import fire_seeds, load_scenario, make_fires
from emberlink.trainers.cli import main
from emberlink.trainers.fires import plot

pytestmark = pytest.mark.drawn

HUYGENS = load_scenario("huygens")


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def ran(capsys, *arguments) -> list[str]:
    """Runs a command without an error and returns the lines that it prints."""
    capsys.readouterr()
    assert main.main(["fire", *map(str, arguments)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out.splitlines()


def refused(capsys, *arguments) -> str:
    """Runs a command that ends at status 2 and returns its message."""
    return refusal.refused(["fire", *arguments], capsys, f"emberlink fire {arguments[0]}: ")


def area(path, colour: tuple[float, ...] | str) -> int:
    """Returns the number of pixels of a colour or a grey value."""
    wanted = [255 * float(colour)] * 3 if isinstance(colour, str) else colour
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB"), dtype=float)
    return int((np.abs(pixels - wanted) <= 1).all(-1).sum())


def asc(path: Path, times: np.ndarray) -> Path:
    """Writes arrival times [X, Y], inf for never, north up as other programs do."""
    return write_asc(path, np.where(np.isinf(times), -9999, times).T[::-1])


def disc(side: int = 40, speed: float = 0.05, at: tuple[int, int] = (15, 22)) -> np.ndarray:
    """Returns a fire that spreads evenly from a point, [X, Y], minutes."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    times = np.hypot(x - at[0], y - at[1]) / speed
    return np.where(times <= 250, times, np.inf)


def test_preview_prints_the_numbers_of_the_test_fire(capsys):
    (fire,) = make_fires(HUYGENS, fire_seeds("test", 4)[3:], (40, 30), 400)
    burning = burning_cells(fire[None], 400)[0]
    lines = ran(capsys, "preview", "huygens:3", "env.grid=[40,30]", "env.horizon=400")
    assert lines[0] == "huygens, test fire 3: 40 x 30 cells, 400 steps, setup paper"
    assert lines[1] == f"{burning[0]} cells burn by step 0, {burning[-1]} at the end"
    assert all(len(line) <= 80 for line in lines)
    assert lines[-1] == "fire_huygens_3.png"


def test_preview_draws_its_numbers(capsys):
    (*_, name) = ran(capsys, "preview", "paper")
    with Image.open(name) as picture:
        assert picture.format == "PNG"
        assert max(picture.size) == 900
    cell = area(name, plot.BURNT_OUT) / 30  # cells that are burnt out (docs/fire.md)
    never = 900 - 30 - 141  # without these and the burning cells; lines cover a part
    assert 0.9 * never < area(name, plot.NEVER) / cell < never


def test_import_of_several_files(capsys, tmp_path):
    first = asc(tmp_path / "one.asc", disc())
    second = asc(tmp_path / "a=b.asc", disc(30, 0.03, (12, 12)))
    keys = ("fire.units=minutes", "env.grid=[25,20]", "env.horizon=200")
    lines = ran(capsys, "import", first, *keys, second, "--output", "both.npy")
    assert [line.partition(": read: ")[0] for line in lines[:2]] == ["one.asc", "a=b.asc"]
    assert lines[2:] == ["2 fires of 25 x 20 cells, in steps", "both.npy"]
    both = np.load("both.npy")
    for fire, name, file in zip(both, ("first.npy", "second.npy"), (first, second), strict=True):
        ran(capsys, "import", file, *keys, "--output", name)
        assert np.array_equal(np.load(name)[0], fire)
        assert fire.min() == 0
        assert 190 < fire[np.isfinite(fire)].max() <= 200
    ran(capsys, "import", "both.npy", *keys[1:], "--output", "again.npy")
    assert np.array_equal(np.load("again.npy"), both)
    lines = ran(capsys, "preview", "both.npy:1", *keys[1:])
    assert lines[1].startswith("read: a bank of 2 fires of 25 x 20 cells")
    assert lines[0] == "both.npy, fire 1 of 2: 25 x 20 cells, 200 steps, setup paper"
    assert lines[2].endswith(f", {np.isfinite(both[1]).sum()} at the end")
    assert lines[-1] == "fire_both_1.png"
    with pytest.warns(UserWarning, match="fire.end=200 stretches them"):
        ran(capsys, "import", "both.npy", "env.horizon=150", "--output", "cut.npy")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["preview", "huygns"], ["huygns", "did you mean huygens?", "known: front, huygens"]),
        (["preview", "bank.npy:2"], ["bank.npy", "no fire '2'", "0 to 1"]),
        (["preview", "paper", "--output", "there.png"], ["there.png exists already"]),
        (["import", "bank.npy", "--output", "bank.npy"], ["bank.npy exists already"]),
    ],
)
def test_errors_are_one_line_and_leave_no_files(arguments, words, capsys, tmp_path):
    (tmp_path / "there.png").write_text("mine")
    fires = make_fires(HUYGENS, fire_seeds("train", 2), (30, 30), 300)
    np.save(tmp_path / "bank.npy", fires.numpy())
    before = {path.name: path.is_file() and path.read_bytes() for path in tmp_path.iterdir()}
    err = refused(capsys, *arguments)
    assert len(err) < 400
    for word in words:
        assert word in err, err
    assert before == {p.name: p.is_file() and p.read_bytes() for p in tmp_path.iterdir()}


def test_preview_takes_the_keys_of_train(capsys, tmp_path):
    asc(tmp_path / "my fire.asc", disc())
    keys = ("fire.units=minutes", "env.grid=[20,20]")
    plain = ran(capsys, "preview", "my fire.asc", *keys)
    cells = np.isfinite(disc()).sum()
    assert plain[1].startswith(f"read: {cells} cells burn from 0 minutes to 247.386 minutes; ")
    keyed = ran(capsys, "preview", "fire=file", 'fire.path="my fire.asc"', *keys)
    assert keyed[:-1] == plain[:-1]
    *lines, first = ran(capsys, "preview", "fire=paper")
    *again, second = ran(capsys, "preview", "paper", "--output", tmp_path)
    assert again == lines
    assert (first, second) == ("fire_paper_0.png", str(tmp_path / "fire_paper_0_2.png"))
