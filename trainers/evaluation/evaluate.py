"""Frozen policies on held-out fires, beside scripted ones."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv, set_exploration_type, step_mdp
from torchrl.envs.utils import ExplorationType

from emberlink.envs import metrics
from emberlink.envs.fire.generator import load_scenario
from emberlink.envs.fire_files.reader import FileFireConfig
from emberlink.envs.scenarios import ScenarioConfig, fires_of
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig

from .baseline_cache import ScriptedResults
from .results import LEARNED, Measured, Results

HELD_OUT_SCENARIO = "huygens"
START_SEED = 20_250_923
"""of everything random in episode 0, start positions included; that of episode i is i more"""
BLOCK = 50
"""environments stepped together, also where fewer are wanted"""

Policy = Callable[[TensorDictBase], TensorDictBase]


def play(
    env: TransformedEnv,
    policy: Policy,
    watch: Callable[[int], None] | None = None,
) -> dict[str, Tensor]:
    """One episode in every environment, without noise.

    Args:
        env: a recipe's environment.
        policy: writes ("agents", "action").
        watch: called with the step, 0 ... horizon, at each moment.

    Returns:
        Every measure of `metrics.NAMES`, float32 [num_envs].
    """
    world: Any = env.base_env
    horizon: int = world.config.horizon
    steps: list[TensorDictBase] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        moment = env.reset()
        for step in range(1, horizon + 1):
            if watch is not None:
                watch(step - 1)
            moment = env.step(policy(moment))
            steps.append(moment.get("next").select(*metrics.STEP_KEYS))
            moment = step_mdp(moment, keep_other=True)
    if watch is not None:
        watch(horizon)
    episode: Any = torch.stack(cast(Any, steps), dim=1)
    return metrics.episode_metrics(episode)


def shown_scenario(trained: ScenarioConfig) -> str:
    """Of an evaluation's scenarios, the name of the one to draw: one's own file, else `huygens`."""
    return trained.name if isinstance(trained, FileFireConfig) else HELD_OUT_SCENARIO


def evaluation_scenarios(config: RunConfig) -> dict[str, ScenarioConfig]:
    """The scenarios of an evaluation by name: `huygens`, and the one trained on."""
    scenarios: dict[str, ScenarioConfig] = {HELD_OUT_SCENARIO: load_scenario(HELD_OUT_SCENARIO)}
    if config.fire not in scenarios.values():
        changed = config.fire.name in scenarios
        scenarios[config.fire.name + ("_as_trained" if changed else "")] = config.fire
    return scenarios


def evaluation_fires(config: RunConfig, count: int) -> dict[str, Tensor]:
    """The held-out fires of an evaluation by scenario.

    Returns:
        Arrival times, float32 [count, X, Y] each; a scenario that is always the same fire is
        shown `count` times, with other start positions each.
    """
    grid, horizon = config.env.grid, config.env.horizon
    return {
        name: fires_of(scenario).test(count, grid, horizon)
        for name, scenario in evaluation_scenarios(config).items()
    }


def shown_fire(config: RunConfig) -> tuple[str, Tensor]:
    """The evaluation's fire to draw: its scenario's name, and arrival times, float32 [X, Y]."""
    name = shown_scenario(config.fire)
    fires = fires_of(evaluation_scenarios(config)[name])
    return name, fires.test_fire(0, config.env.grid, config.env.horizon)[0]


def evaluate(
    config: RunConfig,
    actor: Policy,
    *,
    fires: int,
    scripted: bool = True,
    report: Callable[[str, str], None] | None = None,
) -> Results:
    """Every policy on every held-out fire, from the same start positions.

    Episode i is the same whatever is played beside it: its random numbers are those of the seed
    `START_SEED` + i, and `BLOCK` environments are always stepped together, since the last bit of a
    product of matrices depends on how large they are.

    Args:
        config: of the run; its environment is used, communication included but where a scripted
            policy needs another.
        actor: the frozen policy.
        fires: how many held-out fires, one episode each.
        scripted: whether the scripted policies are reported too.
        report: called with the fire and the policy before each is played.
    """
    results: Results = {}
    for fire, arrival in evaluation_fires(config, fires).items():

        def say(policy: str, fire: str = fire) -> None:
            if report is not None:
                report(fire, policy)

        say(LEARNED)
        results[fire] = {LEARNED: play_blocks(config, lambda _: actor, arrival)}
        for name in SCRIPTED if scripted else ():
            results[fire][name] = play_scripted(config, name, arrival, report=say)
    return results


def play_scripted(
    config: RunConfig,
    name: str,
    arrival: Tensor,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Measured:
    """What a scripted policy reaches, read from the cache where it has been played before.

    Args:
        config: of the run.
        name: one of `SCRIPTED`.
        arrival: float32 [fires, X, Y].
        report: called with the name if it has to be played.
    """
    world = scripted_config(config, name)
    protocol = {"start_seed": START_SEED, "block": BLOCK}
    cache = ScriptedResults(name, world, arrival, protocol)
    measured = cache.read()
    if measured is None:
        report(name)
        measured = play_blocks(world, SCRIPTED[name], arrival)
        cache.write(measured)
    return measured


def scripted_config(config: RunConfig, name: str) -> RunConfig:
    """The configuration of the environment that a scripted policy is played in.

    The run's own, unless the policy needs the communication of a recipe: then with that of the
    recipe in the run's setup, where the run's is of another kind.
    """
    recipe = SCRIPTED[name].recipe
    if recipe is None:
        return config
    comm = resolve(recipe, [f"setup={config.setup}"]).comm
    return config if comm["name"] == config.comm["name"] else replace(config, comm=comm)


def play_blocks(
    config: RunConfig, policy: Callable[[WildfireEnv], Policy], arrival: Tensor
) -> Measured:
    """One episode on each fire, `BLOCK` at a time.

    Args:
        config: of the environment.
        policy: makes the policy for an environment.
        arrival: float32 [fires, X, Y].

    Returns:
        Every measure of `metrics.NAMES`, a number per fire.
    """
    count = len(arrival)
    measured: Measured = {name: [] for name in metrics.NAMES}
    for start in range(0, count, BLOCK):
        episodes = torch.arange(start, start + BLOCK)
        env = build_env(
            config,
            num_envs=BLOCK,
            fire=arrival[episodes.clamp(max=count - 1)],  # what fills the last block is not kept
            seed=(START_SEED + episodes).tolist(),
            device=config.device,
        )
        world: Any = env.base_env
        for name, values in play(env, policy(world)).items():
            measured[name] += values[: count - start].tolist()
    return measured


def means(results: Mapping[str, list[float]]) -> dict[str, float]:
    """The mean over episodes of each measure."""
    return {name: float(np.mean(values)) for name, values in results.items()}


def film(
    config: RunConfig, policy: Policy, *, fire: Tensor | ScenarioConfig, frames: int = 100
) -> tuple[list[np.ndarray], list[int]]:
    """Pictures of one episode of one environment, and their steps."""
    env = build_env(config, num_envs=1, fire=fire, seed=START_SEED, device=config.device)
    world: Any = env.base_env
    horizon = config.env.horizon
    wanted = set(np.linspace(0, horizon, min(frames, horizon + 1)).round().astype(int).tolist())
    pictures: list[np.ndarray] = []

    def watch(step: int) -> None:
        if step in wanted:
            pictures.append(world.render())

    play(env, policy, watch)
    return pictures, sorted(wanted)
