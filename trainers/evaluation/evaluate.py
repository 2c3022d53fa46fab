"""Plays frozen policies without noise: on test fires, and on validation fires during training."""

from collections.abc import Callable
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
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.scenarios import ScenarioConfig, fires_of
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.baseline_cache import ScriptedResults
from emberlink.trainers.evaluation.results import LEARNED, Measured, Results, means

HELD_OUT_SCENARIO = "huygens"
START_SEED = 20_250_923
"""seed of everything random in test episode 0, start positions included; episode i adds i"""
VALIDATION_START_SEED = 20_350_923
"""the same of validation episode 0; no episode of one set has a seed of the other"""
BLOCK = 50
"""environments stepped together in tests, also where fewer are wanted"""

Policy = Callable[[TensorDictBase], TensorDictBase]


def play(
    env: TransformedEnv,
    policy: Policy,
    at_step: Callable[[int], None] | None = None,
) -> dict[str, Tensor]:
    """Plays one episode in every environment, without noise.

    Args:
        env: an environment with communication.
        policy: writes ("agents", "action").
        at_step: called with each step, 0 ... horizon, once the environments are there.

    Returns:
        Every measure of `metrics.NAMES`, float32 [num_envs].
    """
    world: Any = env.base_env
    horizon: int = world.config.horizon
    steps: list[TensorDictBase] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        td = env.reset()
        for step in range(1, horizon + 1):
            if at_step is not None:
                at_step(step - 1)
            td = env.step(policy(td))
            steps.append(td.get("next").select(*metrics.STEP_KEYS))
            td = step_mdp(td, keep_other=True)
    if at_step is not None:
        at_step(horizon)
    episode: Any = torch.stack(cast(Any, steps), dim=1)
    return metrics.episode_metrics(episode)


def shown_scenario(trained: ScenarioConfig) -> str:
    """Returns the name of the scenario to draw: the file that was trained on, else `huygens`."""
    return trained.name if isinstance(trained, FileFireConfig) else HELD_OUT_SCENARIO


def evaluation_scenarios(config: RunConfig) -> dict[str, ScenarioConfig]:
    """Returns the scenarios of an evaluation by name: `huygens`, and the one trained on."""
    scenarios: dict[str, ScenarioConfig] = {HELD_OUT_SCENARIO: load_scenario(HELD_OUT_SCENARIO)}
    if config.fire not in scenarios.values():
        changed = config.fire.name in scenarios
        scenarios[config.fire.name + ("_as_trained" if changed else "")] = config.fire
    return scenarios


def evaluation_fires(config: RunConfig, count: int) -> dict[str, Tensor]:
    """Returns the test fires of an evaluation by scenario.

    Returns:
        Arrival times, float32 [count, X, Y] each. A scenario that always is the same fire is
        repeated; the start positions differ.
    """
    grid, horizon = config.env.grid, config.env.horizon
    return {
        name: fires_of(scenario).test(count, grid, horizon)
        for name, scenario in evaluation_scenarios(config).items()
    }


def shown_fire(config: RunConfig) -> tuple[str, Tensor]:
    """Returns the fire to draw: the name of its scenario, and arrival times, float32 [X, Y]."""
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
    """Plays a frozen policy, and the scripted ones, on test fires from the same start positions.

    Episode i does not depend on the number of fires: its random numbers come from the seed
    `START_SEED` + i, and `BLOCK` environments are always stepped together, since the last bit of a
    matrix product depends on the number of rows.

    Args:
        config: of the run; its environment is used.
        actor: the frozen policy.
        fires: number of test fires, one episode each.
        scripted: whether the scripted policies are played too.
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


def validate(config: RunConfig, actor: Policy) -> dict[str, float]:
    """Plays a frozen policy on validation fires, to choose among the checkpoints of a training.

    Neither the fires nor the start positions are those of a test. As many environments are stepped
    together as there are episodes, up to `BLOCK`.

    Args:
        config: of the run; `evaluation.interval_episodes` is the number of episodes.
        actor: the frozen policy.

    Returns:
        "fire/measure" -> mean.
    """
    count = config.evaluation.interval_episodes
    found: dict[str, float] = {}
    for name, scenario in evaluation_scenarios(config).items():
        arrival = fires_of(scenario).validation(count, config.env.grid, config.env.horizon)
        measured = play_blocks(
            config,
            lambda _: actor,
            arrival,
            start_seed=VALIDATION_START_SEED,
            block=min(count, BLOCK),
        )
        found |= {f"{name}/{measure}": value for measure, value in means(measured).items()}
    return found


def play_scripted(
    config: RunConfig,
    name: str,
    arrival: Tensor,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Measured:
    """Returns the measures of a scripted policy, read from the cache if it was played before.

    Args:
        config: of the run.
        name: one of `SCRIPTED`.
        arrival: float32 [fires, X, Y].
        report: called with the name before it is played.
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
    """Returns the configuration of the environment that a scripted policy is played in.

    It is the run's, unless the policy needs the communication of another method: then it has the
    communication of that method in the run's setup.
    """
    recipe = SCRIPTED[name].recipe
    if recipe is None:
        return config
    comm = config.baseline_comm.get(recipe) or resolve(recipe, [f"setup={config.setup}"]).comm
    return config if comm["name"] == config.comm["name"] else replace(config, comm=comm)


def play_blocks(
    config: RunConfig,
    policy: Callable[[WildfireEnv], Policy],
    arrival: Tensor,
    *,
    start_seed: int = START_SEED,
    block: int = BLOCK,
) -> Measured:
    """Plays one episode on each fire, some environments at a time.

    Args:
        config: of the environment.
        policy: makes the policy for an environment.
        arrival: arrival times, float32 [fires, X, Y].
        start_seed: seed of episode 0; episode i adds i.
        block: environments stepped together. The last block is filled up with episodes that do
            not count.

    Returns:
        Every measure of `metrics.NAMES`, a number per fire.
    """
    count = len(arrival)
    measured: Measured = {name: [] for name in metrics.NAMES}
    for start in range(0, count, block):
        episodes = torch.arange(start, start + block)
        env = build_env(
            config,
            num_envs=block,
            fire=arrival[episodes.clamp(max=count - 1)],
            seed=(start_seed + episodes).tolist(),
            device=config.device,
        )
        world: Any = env.base_env
        for name, values in play(env, policy(world)).items():
            measured[name] += values[: count - start].tolist()
    return measured


def film(
    config: RunConfig, policy: Policy, *, fire: Tensor | ScenarioConfig, frames: int = 100
) -> tuple[list[np.ndarray], list[int]]:
    """Returns pictures of one test episode in one environment, and their steps."""
    env = build_env(config, num_envs=1, fire=fire, seed=START_SEED, device=config.device)
    world: Any = env.base_env
    horizon = config.env.horizon
    wanted = set(np.linspace(0, horizon, min(frames, horizon + 1)).round().astype(int).tolist())
    pictures: list[np.ndarray] = []

    def draw(step: int) -> None:
        if step in wanted:
            pictures.append(world.render())

    play(env, policy, draw)
    return pictures, sorted(wanted)
