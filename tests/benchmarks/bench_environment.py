"""Measures UAV-steps per second of the environment, and of VMAS in the same run."""

import pytest
from workloads import flying, in_turns, jaxmarl_flying, make, strong, vmas_flying


@pytest.mark.parametrize("world", ["paper", "front"])
@pytest.mark.parametrize("method", ["independent", "consensus", "maps"])
@pytest.mark.parametrize("team", ["env.num_uavs=6", "env.num_uavs=64 env.radio.range=.inf"])
def test_held_actions(tell, method, world, team):
    """384 UAVs: a call of `step` for ten steps, beside ten calls."""
    keys, envs = [f"world={world}", *team.split()], 6 if "64" in team else 64
    works = [flying(strong(method, envs, *keys, hold=h), 20 // h) for h in (1, 10)]
    single, held = (384 * 20 / taken for taken in in_turns(7, *works))
    rates = f"held {held:9,.0f} UAV-steps/s, {held / single:.2f} x steps one by one"
    tell(f"{method:11} in {world:5}, {team}: {rates}")


LIMITS = ("bandwidth=64", "shared=true", "delay=5", "loss=0.2", "burst=5", "fade=true")


@pytest.mark.parametrize("limits", [LIMITS, LIMITS[:1], ("bandwidth=16",)])
@pytest.mark.parametrize(
    ("method", "world"),
    [("maps", "front"), ("consensus", "front"), ("positional", "front"), ("independent", "relay")],
)
def test_limits_of_the_radio(tell, method, world, limits):
    """32 environments, held actions: a step with limits beside one without."""
    keys = [f"env.radio.{limit}" for limit in limits]
    works = [flying(strong(method, 32, f"world={world}", *k, hold=10), 5) for k in ([], keys)]
    free, limited = in_turns(9, *works)
    tell(f"{method:11} in {world}, {' '.join(limits)}: {limited / free:.2f} x a step without")


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


@pytest.mark.parametrize("num_envs", [64, 1024])
def test_beside_jaxmarl(tell, num_envs):
    pytest.importorskip("jaxmarl")
    theirs, agents = jaxmarl_flying(num_envs, 200)
    ours, jaxmarl = in_turns(5, flying(strong("independent", num_envs, hold=10), 20), theirs)
    rate = agents * num_envs * 200 / jaxmarl
    tell(
        f"JaxMARL simple_spread {num_envs} environments, 200 steps a call: {rate:12,.0f} "
        f"agent-steps/s; ours, held, {6 * num_envs * 200 / ours / rate:.2f} x that"
    )
