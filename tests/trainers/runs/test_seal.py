"""Tests that changes on disk are detected: cached files, and config.yaml of networks."""

import json
import re
import shutil

import numpy as np
import pytest
import torch
import yaml
from fire_files import Ellipses, raster_of, write_asc
from safetensors.torch import load_file, save_file
from tiny_run import TINY

from emberlink.envs.fire.cache import fire_bank
from emberlink.envs.fire.generator import load_scenario
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import with_checksum
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.atomic_io import read_sealed, write_sealed
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import flat
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.seal import check_trained_with

FREE = re.compile(
    r"(evaluation\.|(episodes|output|device|logger|checkpoint_interval|checkpoint_steps|keep_checkpoints)$)"
)
"""keys that change nothing of what is learnt or of the world"""


def flips(content: bytes):
    """Yields the content with each bit changed, one at a time."""
    for place in range(len(content)):
        for bit in range(8):
            yield content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def test_a_change_of_any_bit_of_a_cached_file_is_detected(tmp_path):
    path = tmp_path / "one"
    write_sealed(path, b"some content")
    whole = path.read_bytes()
    assert read_sealed(path, 100) == b"some content"
    for changed in (*flips(whole), *(whole[:length] for length in range(len(whole))), whole + b"x"):
        path.write_bytes(changed)
        assert read_sealed(path, 100) is None


def test_a_cached_bank_with_a_changed_bit_is_computed_again(tmp_path, monkeypatch):
    monkeypatch.setenv("EMBERLINK_CACHE", str(tmp_path))
    arguments = load_scenario("paper"), "train", 1, (9, 9), 5
    right = fire_bank(*arguments)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for changed in list(flips(whole))[::61]:
        file.write_bytes(changed)
        assert torch.equal(fire_bank(*arguments), right)
        assert file.read_bytes() == whole


def test_a_runs_copy_of_its_fires_with_a_changed_bit_is_not_read(tmp_path):
    raster = write_asc(tmp_path / "fire.asc", raster_of(Ellipses(), 300.0, cells=40, cell=75.0), 75)
    config = fires_of(with_checksum(FileFireConfig(path=str(raster), units="minutes")))
    grid = (12, 10), 15
    kept = config.save_copy(tmp_path, *grid)
    right = config.train(*grid)
    raster.unlink()
    assert torch.equal(fires_of(kept).train(*grid), right)
    file = tmp_path / "fires.npz"
    assert np.load(file)["train"].shape == right.shape
    whole = file.read_bytes()
    for changed in (*list(flips(whole))[::101], whole[:-1], whole + b"x"):
        file.write_bytes(changed)
        with pytest.raises(ValueError, match=r"fire.asc: there is no such file"):
            fires_of(kept).train(*grid)


def test_a_folder_without_its_copy_of_the_fires_is_no_run(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise UserError("no space left")

    np.save(tmp_path / "bank.npy", np.random.default_rng(0).uniform(0, 15, (3, 30, 30)))
    monkeypatch.setattr("emberlink.envs.scenarios.fire_files.save_copy", fail)
    fire = "fire=file", f"fire.path={tmp_path / 'bank.npy'}", f"output={tmp_path / 'runs'}"
    assert main.main(["train", "independent", *TINY, *fire]) == 2
    assert "no space left" in capsys.readouterr().err
    assert not list((tmp_path / "runs").glob("*/config.yaml"))


def test_changed_digits_of_a_configuration(run):
    """A changed digit is invalid, differs from the networks' header, or has no effect on them."""
    folder, file = RunFolder(run), run / "config.yaml"
    text, checkpoint, refused, free = file.read_text(), RunFolder(run).checkpoint(), 0, 0
    check_trained_with(checkpoint, folder.config())
    digits = list(re.finditer(r"\d", text))[::9]
    before = flat(yaml.safe_load(text))
    for digit in digits:
        other = (int(digit[0]) + 1) % 10
        file.write_text(f"{text[: digit.start()]}{other}{text[digit.end() :]}")
        after = flat(yaml.safe_load(file.read_text()))
        try:
            check_trained_with(checkpoint, folder.config())
        except ValueError as error:
            refused += "\n" not in str(error)
        else:
            free += all(FREE.match(key) for key in before if before[key] != after[key])
    assert refused + free == len(digits)
    assert refused > 12
    assert free > 0


@pytest.mark.parametrize("command", ["eval", "render", "compare", "train"])
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("view_angle: 30.0", "view_angle: 31.0", "env.view_angle=30.0"),
        ("range: 10.0", "range: 70.0", "env.radio.range=10.0"),
        ("tau: 0.001", "tau: 0.002", "learner.tau=0.001"),
    ],
)
def test_a_changed_configuration_is_refused(command, old, new, said, run, tmp_path, capsys):
    file = run / "config.yaml"
    assert old in file.read_text(), file.read_text()
    file.write_text(file.read_text().replace(old, new))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    more = {
        "eval": [str(run), "--fires", "1"],
        "render": [str(run), "--output", str(tmp_path / "a.gif")],
        "compare": [str(run), "--output", str(tmp_path / "out")],
        "train": [f"resume={run}", "episodes=3"],
    }
    capsys.readouterr()
    assert main.main([command, *more[command]]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    key, value = said.split("=")
    assert f"made with {said}; the run has {key}={new.split(': ')[1]}: put {value} back" in error
    assert ("to evaluate with another value: emberlink eval RUN" in error) == (key[0] != "l")
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_changed_settings_are_printed_by_the_command(run, capsys):
    before = (run / "eval.json").read_bytes()
    assert main.main(["eval", str(run), "env.view_angle=31.0", "--fires", "1"]) == 0
    assert (run / "eval.json").read_bytes() == before
    assert (run / "eval_env.view_angle=31.0.json").is_file()


def test_networks_without_a_header_are_refused(run, capsys):
    path = RunFolder(run).checkpoint()
    save_file(load_file(path), path)
    assert main.main(["eval", str(run)]) == 2
    assert (
        "not a readable checkpoint: damaged, or of another program (no header of emberlink)"
        in capsys.readouterr().err
    )


def test_a_changed_setting_of_evaluations_is_said_and_recorded(run, tmp_path, capsys):
    """It is not sealed, because a resumed run may change it."""
    assert json.loads((run / "eval.json").read_text())["changed"] == []
    folder = shutil.copytree(run, tmp_path / "changed")
    values = yaml.safe_load((folder / "config.yaml").read_text())
    values["evaluation"]["episodes"] = 1
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    assert main.main(["eval", str(folder)]) == 0
    changed = f"evaluation.episodes is 1 here, 2 in {RunFolder(folder).checkpoint().name}"
    assert f"note: {changed}\n" in capsys.readouterr().out
    recorded = json.loads((folder / "eval.json").read_text())
    assert (recorded["fires"], recorded["changed"]) == (1, [changed])
