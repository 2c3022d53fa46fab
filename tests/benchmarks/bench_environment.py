"""Measures UAV-steps per second of the environment, and of VMAS in the same run."""

import pytest
from workloads import flying, in_turns, make, vmas_flying

from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve


def strong(method: str, num_envs: int, *options: str, hold: int = 1):
    """Returns a training environment of `strong` that holds actions."""
    config = resolve(method, ["setup=strong", "fire.num_train_fires=16", *options])
    return build_env(config, num_envs=num_envs, fire=config.fire, seed=0, device="cpu", hold=hold)


@pytest.mark.parametrize("world", ["paper", "front"])
@pytest.mark.parametrize("method", ["independent", "consensus"])
def test_held_actions(tell, method, world):
    """64 environments: a call of `step` for ten steps, beside ten calls."""
    works = [flying(strong(method, 64, f"world={world}", hold=h), 20 // h) for h in (1, 10)]
    single, held = (6 * 64 * 20 / taken for taken in in_turns(7, *works))
    tell(
        f"{method:11} in {world:5}: held {held:9,.0f} UAV-steps/s, {held / single:.2f} x steps one "
        "by one"
    )


@pytest.mark.parametrize("scenario", ["discovery", "sampling", "simple_spread"])
def test_beside_vmas(tell, scenario):
    pytest.importorskip("vmas")
    num_envs, steps = 4096, 20
    theirs, agents = vmas_flying(scenario, num_envs, steps)
    ours, consensus, vmas = in_turns(
        5, flying(make(None, num_envs), steps), flying(make("consensus", num_envs), steps), theirs
    )
    rate = agents * num_envs * steps / vmas
    tell(
        f"vmas {scenario:13} {num_envs} environments: {rate:12,.0f} agent-steps/s; ours alone "
        f"{6 * num_envs * steps / ours / rate:.1f} x, with consensus "
        f"{6 * num_envs * steps / consensus / rate:.1f} x that"
    )
