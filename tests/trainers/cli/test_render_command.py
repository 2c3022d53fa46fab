"""Tests `emberlink render`: its files, their contents, and its errors."""

import imageio_ffmpeg
import numpy as np
import torch
from PIL import Image
from PIL.ImageColor import getrgb
from refusal import refused

from emberlink.envs.utils.config_files import known
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.build import build_actor, empty_env
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import episodes, render
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.replay.screen import LINK
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import RunFolder

SHORT = ("setup=tuned", "learner.hidden=[8,8]", "env.horizon=12", "env.num_uavs=3")


def make_run(folder, method="consensus", *overrides):
    """Writes a run folder with untrained networks."""
    config = resolve(method, [*SHORT, *overrides, f"output={folder}"])
    actor = build_actor(config, empty_env(config), torch.Generator().manual_seed(config.seed))
    weights = {
        f"{checkpoint.WEIGHTS}{ACTOR}{name}": value
        for name, value in actor.module.state_dict().items()
    }
    run = RunFolder.create(config)
    checkpoint.write(run.newest, checkpoint.header_of(config, 12), weights)
    return run.path


def rendered(capsys, *arguments) -> list[str]:
    capsys.readouterr()
    assert main.main(["render", *map(str, arguments)]) == 0
    return capsys.readouterr().out.splitlines()


def gif_frames(path) -> list[np.ndarray]:
    with Image.open(path) as film:
        frames = []
        for index in range(film.n_frames):
            film.seek(index)
            frames.append(np.asarray(film.convert("RGB")))
    return frames


def test_a_run_gives_a_gif_and_an_mp4_that_play(tmp_path, capsys):
    run = make_run(tmp_path)
    *_, gif, mp4 = rendered(capsys, run, "--fps", "10")
    assert gif == str(run / "figures" / "episode_huygens_0.gif")
    assert mp4 == str(run / "figures" / "episode_huygens_0.mp4")
    frames = gif_frames(gif)
    assert len(frames) == 13
    reader = imageio_ffmpeg.read_frames(mp4)
    about = next(reader)
    shots = [np.frombuffer(shot, np.uint8) for shot in reader]
    height, width, _ = frames[0].shape
    assert about["size"] == (width, height)
    assert about["codec"] == "h264"
    assert about["pix_fmt"].startswith("yuv420p")
    assert about["fps"] == 10
    assert len(shots) == 13
    for frame, shot in zip(frames, shots, strict=True):
        assert np.abs(frame.astype(int) - shot.reshape(frame.shape)).mean() < 4
    assert not list(run.rglob(".*"))


def test_episodes_side_by_side_have_the_same_fire_and_starts(tmp_path):
    methods = known("method")
    runs = [str(make_run(tmp_path, method)) for method in methods]
    panels = [*render.learned(runs)]
    policies = ("follow_target", "map_greedy", "map_greedy_alone")
    panels += episodes.scripted(panels[0].config, policies)
    name, index, arrival = episodes.find_fire("paper:3", panels[0].config)
    assert (name, index) == ("paper", 3)
    shown = episodes.play_side_by_side(panels, arrival, index)
    first, *others = shown
    for other in others:
        assert np.array_equal(other.steps["position"][0], first.steps["position"][0])
        assert np.array_equal(other.ignition, first.ignition)
    ends = {other.steps["position"][-1].tobytes() for other in others}
    assert len(ends) > len(methods)
    for method, episode in zip(methods, shown, strict=False):
        assert episode.title == f"{method}, setup tuned, seed 0"
        assert episode.listens == (method in ("consensus", "maps", "positional"))
        assert (
            ("follows" in episode.steps) == ("target" in episode.steps) == (method == "consensus")
        )
    for name, episode in zip(policies, shown[len(methods) :], strict=True):
        follows = SCRIPTED.find(name).recipe is not None
        assert ("follows" in episode.steps) == follows
        assert episode.listens == (follows or SCRIPTED.find(name).hears)


def test_a_picture_of_another_grid(tmp_path, capsys):
    run = make_run(tmp_path, "positional", "env.grid=[8,64]")
    out = tmp_path / "shot.png"
    assert rendered(capsys, run, "--output", out, "--step", 5, "--size", 200)[-1] == str(out)
    with Image.open(out) as picture:
        assert getrgb(LINK) in {colour for _, colour in picture.getcolors(1 << 24)}


def test_errors_of_render(tmp_path, capsys):
    run = make_run(tmp_path)
    wide = make_run(tmp_path, "consensus", "env.grid=[40,30]")
    there = tmp_path / "there.gif"
    there.write_text("mine")
    cases = [
        ([tmp_path / "none"], ["no such run folder"]),
        ([run, "--fire", "zzz"], ["fire 'zzz'", "known: "]),
        ([run, "--policy", "zzz"], ["policy='zzz'", "random_waypoints"]),
        ([run, wide], ["env.grid=(40, 30)", "(30, 30)"]),
        ([run, "--output", tmp_path / "a.png", "--step", "13"], ["step=13", "0 to 12"]),
        ([run, run, "--checkpoint", there], ["1 checkpoints for 2 runs"]),
    ]
    for arguments, words in cases:
        refused(["render", *arguments], capsys, *words)
    RunFolder(run).newest.unlink()
    refused(["render", run], capsys, "checkpoint.safetensors")
    assert there.read_text() == "mine"
    assert not [*tmp_path.rglob("*.mp4"), *tmp_path.rglob("*.png")]
