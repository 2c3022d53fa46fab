"""Runs `emberlink render`: draws episodes of runs side by side as GIF and MP4."""

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.console import Console
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from emberlink.envs.fire.generator import load_scenario, scenarios
from emberlink.envs.rendering.frame import write_gif
from emberlink.envs.rendering.panels import Episode, Screen
from emberlink.envs.rendering.video import write_mp4
from emberlink.envs.scenarios import ScenarioConfig, fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name, published
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.build import build_env
from emberlink.trainers.config.schema import RunConfig, build_comm
from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.evaluate import (
    BLOCK,
    START_SEED,
    scripted_config,
    shown_scenario,
)
from emberlink.trainers.evaluation.record_episode import record_episode
from emberlink.trainers.runs.pretrained import open_run
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.seal import check_trained_with

FIRES = 65_536
"""number of held-out fires of a scenario, the maximum of an evaluation"""
SHARED = ("grid", "num_uavs", "horizon", "altitude")
"""settings that must be equal for all panels; fires and start positions depend on them"""
_ALONE, _BESIDE = (480, 800), (360, 600)  # minimum and maximum pixels of a map's longer side
_CELL = 8  # pixels of a cell, within those limits

Write = Callable[[Path, Screen, int], None]


@dataclasses.dataclass(frozen=True)
class Panel:
    """The title, configuration and policy of a panel."""

    title: str
    config: RunConfig
    policy: Callable[[WildfireEnv], TensorDictModuleBase]
    """returns the policy for an environment"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choices:
    """The options of the command, with the defaults of the command line."""

    fire: str | None = None
    """NAME, INDEX or NAME:INDEX of a held-out fire; see `find_fire`"""
    policies: Sequence[str] = ()
    """names of scripted policies to draw, too"""
    checkpoints: Sequence[Path] = ()
    """a checkpoint for each run; the newest of each run if empty"""
    output: Path | None = None
    """a file or a folder; the figures of the first run if None"""
    frames: int = 126
    fps: int = 12
    size: int | None = None
    """pixels of a map's longer side"""
    step: int | None = None
    """step of a single picture; the last if None"""
    seen: bool = False
    """whether seen fire is grey"""


def render(runs: Sequence[str], console: Console, choices: Choices) -> int:
    """Plays an episode of each run on the same fire and writes the files.

    Args:
        runs: run folders.
        console: prints the progress and the paths.
        choices: options of the command.

    Returns:
        The exit status 0.

    Raises:
        UserError: a run, fire or output is wrong.
    """
    folders = [open_run(name) for name in runs]
    scenario, index = find_fire(choices.fire, folders[0].config(device="cpu"))
    panels = [*_learned(folders, choices.checkpoints), *_scripted(folders, choices.policies)]
    _check_comparable(panels)
    config = panels[0].config.env
    shown = "episode" if len(panels) == 1 else "side_by_side"
    stem = "_".join([shown, scenario.name, str(index), *(p.stem for p in choices.checkpoints)])
    paths = _free_paths(choices.output, folders[0], stem)
    steps = _steps(choices, config.horizon, [path.suffix for path in paths])
    arrival = fires_of(scenario).test_fire(index, config.grid, config.horizon)
    episodes = [_play(panel, arrival, index, steps, console) for panel in panels]
    least, most = _ALONE if len(panels) == 1 else _BESIDE
    size = min(max(_CELL * max(config.grid), least), most)
    screen = Screen(episodes, size=choices.size or size, grey_seen=choices.seen)
    for path in paths:
        with published(path) as partial:
            _WRITERS[path.suffix](partial, screen, len(steps), choices.fps)
        console.print(str(path), soft_wrap=True, highlight=False)
    return 0


def find_fire(text: str | None, run: RunConfig) -> tuple[ScenarioConfig, int]:
    """Returns the scenario and the index of a held-out fire.

    Args:
        text: NAME, INDEX or NAME:INDEX. The default name is that of `shown_scenario`, and the
            default index is 0.
        run: configuration of the run, whose training scenario is known, too.

    Raises:
        UserError: there is no such scenario or fire.
    """
    usual, trained = shown_scenario(run), run.fire
    text = usual if text is None else text
    name, _, index = (
        text.rpartition(":")
        if ":" in text
        else ((usual, "", text) if text.lstrip("-").isdecimal() else (text, "", "0"))
    )
    known = dict.fromkeys([*scenarios(), trained.name])
    if name not in known:
        raise UserError(f"fire {name!r} is not known; known: {', '.join(known)}")
    if not index.isdecimal() or int(index) >= FIRES:
        raise UserError(
            f"fire {text!r}: there is no held-out fire {index!r}; known: 0 to {FIRES - 1}"
        )
    own = name == trained.name and not run.evaluation.huygens
    return trained if own or name not in scenarios() else load_scenario(name), int(index)


def _learned(folders: Sequence[RunFolder], checkpoints: Sequence[Path]) -> Iterator[Panel]:
    """Yields a panel for each run."""
    if checkpoints and len(checkpoints) != len(folders):
        raise UserError(f"{len(checkpoints)} checkpoints for {len(folders)} runs: one each")
    for place, run in enumerate(folders):
        config = run.config(device="cpu")
        checkpoint = checkpoints[place] if checkpoints else run.checkpoint()
        check_trained_with(checkpoint, config)
        actor = load_actor(config, checkpoint)
        title = f"{config.method}, setup {config.setup}, seed {config.seed}"
        if checkpoints:
            title += f", {checkpoint.stem}"
        yield Panel(title, config, lambda env, actor=actor: actor)


def _scripted(folders: Sequence[RunFolder], names: Sequence[str]) -> Iterator[Panel]:
    """Yields a panel for each scripted policy, in the environment of the first run."""
    for name in names:
        if name not in SCRIPTED:
            raise UserError(f"policy {name!r} is not known; known: {', '.join(SCRIPTED)}")
        config = scripted_config(folders[0].config(device="cpu"), name)
        yield Panel(f"{name.replace('_', ' ')} (scripted)", config, SCRIPTED[name])


def _check_comparable(panels: Sequence[Panel]) -> None:
    first, *others = panels
    for other in others:
        for name in SHARED:
            expected, actual = (getattr(panel.config.env, name) for panel in (first, other))
            if actual != expected:
                raise UserError(
                    f"{other.title} has env.{name}={_plain(actual)}, {first.title} has "
                    f"{_plain(expected)}: side by side, {', '.join(SHARED)} must be the same"
                )


def _plain(value: Any) -> str:
    return str(list(value)) if isinstance(value, tuple) else str(value)


def _steps(choices: Choices, horizon: int, suffixes: Sequence[str]) -> list[int]:
    """Returns the steps to draw."""
    if suffixes != [".png"]:
        if choices.step is not None:
            raise UserError(f"step={choices.step}: only of a picture, --output FILE.png")
        frames = min(choices.frames, horizon + 1)
        return np.linspace(0, horizon, frames).round().astype(int).tolist()
    step = horizon if choices.step is None else choices.step
    if step > horizon:
        raise UserError(f"step={step}: the episode has the steps 0 to {horizon}")
    return [step]


def _play(
    panel: Panel, arrival: Tensor, index: int, steps: Sequence[int], console: Console
) -> Episode:
    """Plays episode `index` of the evaluation and returns its frames."""
    config = panel.config
    # The same batch size and index as in an evaluation, so that the episode is bit-identical.
    env = build_env(
        config,
        num_envs=BLOCK,
        fire=arrival.expand(BLOCK, *arrival.shape[1:]),
        seed=[START_SEED + index] * BLOCK,
        device=config.device,
    )
    world: Any = env.base_env
    policy, comm = panel.policy(world), build_comm(config, 1)
    frames = record_episode(env, policy, comm, steps=set(steps), member=index % BLOCK)
    console.print(f"  {panel.title}: coverage {frames[-1].coverage:.1f} %", style="dim")
    return Episode(title=panel.title, view_angle=config.env.view_angle, frames=frames)


def _gif(path: Path, screen: Screen, count: int, fps: int) -> None:
    write_gif(path, map(screen.picture, range(count)), fps=fps)


def _mp4(path: Path, screen: Screen, count: int, fps: int) -> None:
    write_mp4(path, map(screen.picture, range(count)), fps=fps)


def _png(path: Path, screen: Screen, count: int, fps: int) -> None:
    Image.fromarray(screen.picture(0)).quantize(256).save(path, "PNG", optimize=True)


_WRITERS = {".gif": _gif, ".mp4": _mp4, ".png": _png}


def _free_paths(output: Path | None, run: RunFolder, stem: str) -> list[Path]:
    """Returns the paths of the new files.

    Raises:
        UserError: the named file exists, or its folder does not.
    """
    if output is not None and not output.is_dir():
        if output.suffix not in _WRITERS:
            raise UserError(
                f"{output}: there is no such folder, and a file ends in {', '.join(_WRITERS)}"
            )
        if os.path.lexists(output):
            raise UserError(f"{output} exists already; nothing is overwritten")
        if not output.parent.is_dir():
            raise UserError(f"{output.parent}: there is no such folder")
        return [output]
    try:
        folder = run.figures() if output is None else output
    except OSError as error:
        raise UserError(f"{run.path}: {error.strerror or error}") from None
    suffixes = (".gif", ".mp4")
    name = free_name(folder, stem, suffixes)
    return [name.with_name(f"{name.name}{suffix}") for suffix in suffixes]
