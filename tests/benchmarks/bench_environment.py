"""Measures UAV-steps per second of the environment, and of VMAS in the same run."""

import math
import time
from dataclasses import replace
from itertools import islice

import pytest
import torch
from workloads import flying, in_turns, make, steps_for, vmas_flying

from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.coverage_map import with_burn_time
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

GOALS = {None: 1_000_000, "consensus": 300_000}


@pytest.mark.parametrize("num_envs", [256, 1024, 4096])
@pytest.mark.parametrize("method", GOALS)
def test_uav_steps(benchmark, tell, method, num_envs):
    steps = steps_for(num_envs)
    benchmark.pedantic(flying(make(method, num_envs), steps), rounds=5, warmup_rounds=1)
    rate = 6 * num_envs * steps / benchmark.stats.stats.median
    benchmark.extra_info["uav_steps_per_second"] = rate
    tell(
        f"{method or 'environment alone':17} {num_envs:5} environments: {rate:12,.0f} UAV-steps/s, "
        f"{rate / GOALS[method]:.2f} x the goal of {GOALS[method]:,}"
    )


@pytest.mark.parametrize("method", GOALS)
def test_one_environment(benchmark, tell, method):
    benchmark.pedantic(flying(make(method, 1), 400), rounds=5, warmup_rounds=1)
    rate = 400 / benchmark.stats.stats.median
    benchmark.extra_info["steps_per_second"] = rate
    goal = f", {rate / 2000:.2f} x the goal of 2,000" if method is None else ""
    tell(f"{method or 'environment alone':17}     1 environment : {rate:12,.0f} steps/s{goal}")


@pytest.mark.parametrize("num_envs", [16, 64, 256])
def test_knowledge_maps(tell, num_envs):
    """In `relay`: 60 x 60 cells, six UAVs, a base."""
    steps = 200
    relay = resolve("independent", ["world=relay", "env.measures=paper"]).env
    worlds = (replace(relay, base=None), relay, replace(relay, measures="all"))
    works = [flying(WildfireEnv(num_envs, world), steps) for world in worlds]
    alone, maps, measured = (6 * num_envs * steps / taken for taken in in_turns(5, *works))
    tell(
        f"{num_envs:5} environments: {alone:9,.0f} UAV-steps/s, with knowledge maps "
        f"{maps:9,.0f}, {maps / 100_000:.2f} x the goal; maps and all measures {measured:9,.0f}"
    )


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


def test_all_measures(tell):
    """In `front`, 1,024 environments."""
    works = [
        flying(strong("independent", 1024, "world=front", f"env.measures={measures}"), 5)
        for measures in ("paper", "all")
    ]
    paper, every = (6 * 1024 * 5 / taken for taken in in_turns(5, *works))
    tell(f"all measures: {every:9,.0f} UAV-steps/s, {every / paper:.2f} x those of the paper alone")


@pytest.mark.parametrize("burn_time", [math.inf, 30.0])
def test_price_of_unseen_fire(tell, burn_time):
    """64 environments with one round fire each, 30 x 30 and 256 x 256 cells."""
    works = []
    for side in (30, 256):
        line = torch.arange(side) - side / 2
        arrival = 20 * (torch.hypot(line[:, None], line[None]) - 6).clamp(min=0)
        fire = with_burn_time(arrival.expand(64, -1, -1), burn_time)
        works.append(flying(make("independent", 64, setup="strong", fire=fire), 20))
    small, large = in_turns(7, *works)
    tell(f"a step with a price of unseen fire, 256 x 256 cells: {large / small:.2f} x 30 x 30")


def test_maps_in_one_clique(tell):
    """4 environments, 64 UAVs that all hear each other."""
    settings = {"env.radio.range": math.inf, "policy.hold": 10}
    env = make("maps", 4, world="front", num_uavs=64, **settings)
    (taken,) = in_turns(3, flying(env, 4))
    rate = 4 * 64 * 4 / taken
    tell(f"maps, 64 UAVs in one clique: {rate:,.0f} UAV-steps/s, {rate / 9000:.2f} x the goal")


@pytest.mark.parametrize("hold", [1, 10])
def test_maps_with_its_network(tell, hold):
    """Collects an episode of `front`: 60 x 60 cells, six UAVs, 64 environments."""
    options = ["setup=strong", "world=front", "num_envs=64", f"policy.hold={hold}"]
    setup = TrainingSetup(resolve("maps", options))
    began = time.perf_counter()
    for _ in islice(setup.collector, setup.horizon // setup.rollout_steps):
        pass
    rate = 6 * 64 * setup.horizon / (time.perf_counter() - began)
    tell(
        f"maps, its network at every {hold} steps: {rate:9,.0f} UAV-steps/s, "
        f"{rate / 20_000:.2f} x the goal"
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
