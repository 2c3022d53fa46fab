"""Chooses and plays the episodes that are shown side by side."""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from emberlink.envs.fire.generator import load_scenario, scenarios
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import is_index, shown
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.config.schema import MAX_FIRES, RunConfig
from emberlink.trainers.evaluation.evaluate import (
    BLOCK,
    START_SEED,
    evaluation_scenarios,
    play_blocks,
    scripted_config,
    shown_scenario,
)
from emberlink.trainers.replay.recording import Recorder, Recording

SHARED = ("grid", "num_uavs", "horizon", "altitude")
"""keys of `env` on which fires and start positions depend"""


class Panel(NamedTuple):
    """A policy that plays an episode of the evaluation, and the title of that episode."""

    title: str
    config: RunConfig
    policy: Callable[[WildfireEnv], TensorDictModuleBase]
    """returns the policy for an environment"""


def scripted(config: RunConfig, names: Sequence[str]) -> Iterator[Panel]:
    """Yields a panel for each scripted policy, in the environment of a configuration."""
    for name in names:
        title = f"{name.replace('_', ' ')} (scripted)"
        yield Panel(title, scripted_config(config, name), SCRIPTED.find(name))


def find_fire(text: str | int | None, run: RunConfig) -> tuple[str, int, Tensor]:
    """Returns the name, the index and the times, [1, X, Y], of a held-out fire.

    `text` is NAME, INDEX or NAME:INDEX, by default the name of `shown_scenario` and the index 0.
    The fires of the run's evaluation are known as well.
    """
    usual, evaluated = shown_scenario(run), evaluation_scenarios(run)
    name, colon, index = (usual if text is None else str(text)).rpartition(":")
    if not colon:
        name, index = (usual, index) if index.isdecimal() else (index, "0")
    known = dict.fromkeys([*scenarios(), *evaluated])
    if name not in known:
        raise UserError(f"fire {shown(name)!r} is not known; known: {', '.join(known)}")
    if not is_index(index, MAX_FIRES):
        raise UserError(f"fire {shown(index)!r}: no held-out fire; known: 0 to {MAX_FIRES - 1}")
    source = fires_of(evaluated.get(name) or load_scenario(name))
    return name, int(index), source.test_fire(int(index), run.env.grid, run.env.horizon)


def play_side_by_side(
    panels: Sequence[Panel],
    arrival: Tensor,
    index: int,
    report: Callable[[str], None] = lambda _: None,
) -> list[Recording]:
    """Plays episode `index` of the evaluation on a fire, [1, X, Y], with the policy of each panel.

    It has the same place in its batch as in an evaluation, so that the numbers are the same to the
    last bit. `report` is called with a line of text after each.
    """
    world = panels[0].config.env
    for panel, name in product(panels, SHARED):
        expected, actual = getattr(world, name), getattr(panel.config.env, name)
        if actual != expected:
            raise UserError(
                f"{panel.title} has env.{name}={actual}, {panels[0].title} has {expected}: "
                f"side by side, {', '.join(SHARED)} must be the same"
            )
    member, episodes = index % BLOCK, []
    for panel in panels:
        recorder, seed = Recorder(member), START_SEED + index - member
        play_blocks(panel.config, panel.policy, arrival, start_seed=seed, watch=recorder.add)
        episode = recorder.recording(panel.title)
        report(f"  {panel.title}: coverage {episode.coverage(episode.horizon):.1f} %")
        episodes.append(episode)
    return episodes
