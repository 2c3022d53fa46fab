"""Frozen policies on held-out fires, beside scripted ones."""

from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv, set_exploration_type, step_mdp
from torchrl.envs.utils import ExplorationType

from emberlink.envs import metrics
from emberlink.envs.fire import FireConfig, load_scenario
from emberlink.envs.fire_bank import fire_bank
from emberlink.policies.scripted import SCRIPTED

from .build import build_env
from .config import RunConfig

HELD_OUT_SCENARIO = "huygens"
START_SEED = 20_250_923
"""of the start positions, the same for every policy"""
LEARNED = "learned"

Policy = Callable[[TensorDictBase], TensorDictBase]
Results = dict[str, dict[str, dict[str, list[float]]]]
"""fire -> policy -> measure -> one number per episode"""


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


def evaluation_fires(config: RunConfig, count: int) -> dict[str, Tensor]:
    """The fires of an evaluation by scenario: held-out `huygens`, and the fire trained on.

    Returns:
        Arrival times, float32 [count, X, Y] each; a scenario that is always the same fire is
        shown `count` times, with other start positions each.
    """
    scenarios: dict[str, FireConfig] = {HELD_OUT_SCENARIO: load_scenario(HELD_OUT_SCENARIO)}
    if config.fire not in scenarios.values():
        changed = config.fire.name in scenarios
        scenarios[config.fire.name + ("_as_trained" if changed else "")] = config.fire
    grid, horizon = config.env.grid, config.env.horizon
    return {
        name: fire_bank(scenario, "heldout", count, grid, horizon)
        for name, scenario in scenarios.items()
    }


def evaluate(
    config: RunConfig,
    actor: Policy,
    *,
    fires: int,
    scripted: bool = True,
    report: Callable[[str, str], None] | None = None,
) -> Results:
    """Every policy on every held-out fire, from the same start positions.

    Args:
        config: of the run; its environment, communication included, is used.
        actor: the frozen policy.
        fires: how many held-out fires, one episode each.
        scripted: whether the scripted policies are played too.
        report: called with the fire and the policy before each is played.
    """
    policies: dict[str, Policy] = {LEARNED: actor}
    if scripted:
        for name, policy in SCRIPTED.items():
            policies[name] = policy(config.env).to(config.device)
    results: Results = {}
    for fire, arrival in evaluation_fires(config, fires).items():
        for name, policy in policies.items():
            if report is not None:
                report(fire, name)
            env = build_env(
                config, num_envs=fires, fire=arrival, seed=START_SEED, device=config.device
            )
            measured = play(env, policy)
            results.setdefault(fire, {})[name] = {k: v.tolist() for k, v in measured.items()}
    return results


def means(results: Mapping[str, list[float]]) -> dict[str, float]:
    """The mean over episodes of each measure."""
    return {name: float(np.mean(values)) for name, values in results.items()}


def film(
    config: RunConfig, policy: Policy, *, fire: Tensor | FireConfig, frames: int = 100
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


def record(config: RunConfig, results: Results, **about: Any) -> dict[str, Any]:
    """What eval.json holds: enough to redo any statistics without running anything."""
    return {
        "method": config.method,
        "setup": config.setup,
        "seed": config.seed,
        "start_seed": START_SEED,
        **about,
        "results": results,
    }
