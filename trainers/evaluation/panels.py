"""Chooses the episodes that are shown side by side: runs, changed settings, scripted policies."""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from emberlink.envs.fire.generator import load_scenario, scenarios
from emberlink.envs.scenarios import ScenarioConfig, fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import is_index, shown
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import evaluated_with
from emberlink.trainers.config.schema import MAX_FIRES, RunConfig, build_comm
from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.evaluate import (
    BLOCK,
    START_SEED,
    evaluation_scenarios,
    play,
    scripted_config,
    shown_scenario,
)
from emberlink.trainers.replay.pack import Shown
from emberlink.trainers.replay.page import Replay
from emberlink.trainers.replay.record import Recorder
from emberlink.trainers.runs.pretrained import read_run
from emberlink.trainers.runs.seal import check_trained_with

SHARED = ("grid", "num_uavs", "horizon", "altitude")
"""settings that must be equal for all panels; fires and start positions depend on them"""
_SETTING = re.compile(r"((comm|env|fire)\.[\w.]+|world)=")
_KEY = re.compile(r"[\w.]+")


@dataclasses.dataclass(frozen=True)
class Panel:
    """The title, configuration and policy of a panel."""

    title: str
    config: RunConfig
    policy: Callable[[WildfireEnv], TensorDictModuleBase]
    """returns the policy for an environment"""

    def env(self, arrival: Tensor, index: int) -> TransformedEnv:
        """Returns the environments of episode `index` of the evaluation, at `index % BLOCK`.

        They are as many as in an evaluation, so that the episode is bit-identical.

        Args:
            arrival: the fire, for one environment.
            index: number of the episode.
        """
        return build_env(
            self.config,
            num_envs=BLOCK,
            fire=arrival.expand(BLOCK, *arrival.shape[1:]),
            seed=[START_SEED + index] * BLOCK,
            device=self.config.device,
        )


def learned(arguments: Sequence[str], checkpoints: Sequence[Path]) -> Iterator[Panel]:
    """Yields a panel for each run.

    Args:
        arguments: run folders or names of trained policies; a text such as `env.radio.range=0`
            changes a setting of the run before it.
        checkpoints: a checkpoint for each run; the newest of each run if empty.

    Raises:
        UserError: there is no such run, or a setting does not fit.
    """
    runs = [(read_run(name), changes) for name, changes in _with_settings(arguments)]
    if checkpoints and len(checkpoints) != len(runs):
        raise UserError(f"{len(checkpoints)} checkpoints for {len(runs)} runs: one each")
    titles: set[str] = set()
    for place, (run, changes) in enumerate(runs):
        trained = run.config(device="cpu")
        checkpoint = checkpoints[place] if checkpoints else run.checkpoint()
        check_trained_with(checkpoint, trained)
        config = evaluated_with(trained, changes)
        actor = load_actor(config, checkpoint)
        others = [text for text in changes if not text.startswith("world=")]
        title = title_of(config, *others, *([checkpoint.stem] if checkpoints else []))
        if title in titles:  # runs that were trained with other settings
            title = f"{title}, {run.path.name}"
        titles.add(title)
        yield Panel(title, config, lambda env, actor=actor: actor)


def _with_settings(arguments: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Returns each run with the settings that follow it."""
    runs: list[tuple[str, list[str]]] = []
    for text in arguments:
        key = text.partition("=")[0]
        if not _SETTING.match(text):
            if _KEY.fullmatch(key) and key != text and not Path(text).exists():
                raise UserError(
                    f"{text!r}: only the world and keys under env and comm can be changed here"
                )
            runs.append((text, []))
        elif runs:
            runs[-1][1].append(text)
        else:
            raise UserError(f"{text!r}: a setting stands after the run that it changes")
    return runs


def title_of(config: RunConfig, *more: str) -> str:
    """Returns the title of a run."""
    world = [] if config.world == "paper" else [f"world {config.world}"]
    parts = [config.method, f"setup {config.setup}", *world, f"seed {config.seed}", *more]
    return ", ".join(part for part in parts if part)


def scripted(config: RunConfig, names: Sequence[str]) -> Iterator[Panel]:
    """Yields a panel for each scripted policy, in the environment of a configuration."""
    for name in [names] if isinstance(names, str) else names:
        if name not in SCRIPTED:
            raise UserError(f"policy {name!r} is not known; known: {', '.join(SCRIPTED)}")
        title = f"{name.replace('_', ' ')} (scripted)"
        yield Panel(title, scripted_config(config, name), SCRIPTED[name])


def check_comparable(panels: Sequence[Panel]) -> None:
    """Checks that episodes on the same fire have the same start positions.

    Raises:
        UserError: a setting of `SHARED` differs.
    """
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


def find_fire(text: str | int | None, run: RunConfig) -> tuple[str, ScenarioConfig, int]:
    """Returns the name, the scenario and the index of a held-out fire.

    Args:
        text: NAME, INDEX or NAME:INDEX. The default name is that of `shown_scenario`, and the
            default index is 0.
        run: configuration of the run; the fires of its evaluation are known, too.

    Raises:
        UserError: there is no such scenario or fire.
    """
    usual, evaluated = shown_scenario(run), evaluation_scenarios(run)
    text = usual if text is None else str(text)
    name, _, index = (
        text.rpartition(":")
        if ":" in text
        else ((usual, "", text) if text.lstrip("-").isdecimal() else (text, "", "0"))
    )
    known = dict.fromkeys([*scenarios(), *evaluated])
    if name not in known:
        raise UserError(f"fire {shown(name)!r} is not known; known: {', '.join(known)}")
    if not is_index(index, MAX_FIRES):
        raise UserError(
            f"fire {shown(text)!r}: there is no held-out fire; known: 0 to {MAX_FIRES - 1}"
        )
    return name, evaluated.get(name) or load_scenario(name), int(index)


def follows_advice(config: RunConfig, policy: Any) -> bool:
    """Returns whether a policy reads an output of the communication."""
    written = build_comm(config, 1).out_keys
    return any(key in written for key in getattr(policy, "in_keys", ()))


def replay(
    panels: Sequence[Panel],
    fire: str | int | None,
    report: Callable[[str], None] = lambda _: None,
) -> Replay:
    """Plays the same episode of each panel and returns a page of them.

    Args:
        panels: what is shown side by side.
        fire: see `find_fire`.
        report: called with a line of text after each episode.

    Raises:
        UserError: there is no such fire, or the panels cannot be compared.
    """
    check_comparable(panels)
    config = panels[0].config
    name, scenario, index = find_fire(fire, config)
    arrival = fires_of(scenario).test_fire(index, config.env.grid, config.env.horizon)
    shown = []
    for panel in panels:
        env = panel.env(arrival, index)
        world: Any = env.base_env
        policy = panel.policy(world)
        advised = follows_advice(panel.config, policy)
        recorder = Recorder(member=index % BLOCK, advised=advised)
        measured = play(env, policy, recorder.add)
        report(f"  {panel.title}: coverage {measured['coverage'][index % BLOCK]:.1f} %")
        shown.append(Shown(title=panel.title, recording=recorder.recording()))
    return Replay(shown, f"{name}:{index}")
