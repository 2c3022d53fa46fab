"""Plays short episodes with random actions, and records the environment at each step."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torchrl.envs import step_mdp

from emberlink.envs import keys
from emberlink.envs.world.coverage_map import with_burn_time
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.replay.recording import Recorder, Recording

SIDES = 12, 10
STEPS = 40
LIMITED = (
    *("setup=tuned", "env.num_uavs=3", f"env.horizon={STEPS}", f"env.grid=[{SIDES[0]},{SIDES[1]}]"),
    *("env.altitude=[1.0,3.5]", "env.measures=all", "env.base=[3.0,4.0]", "env.failures=1.5"),
    *("env.radio.range=5", "env.radio.loss=0.4", "env.displacement=1.0"),
)
"""a base, a radio that loses messages, UAVs that fail"""


@dataclass
class Episode:
    """The recording, and the environment's outputs and state at each step."""

    config: Any
    recording: Recording
    steps: list[Any] = field(default_factory=list)
    fire_map: list[Any] = field(default_factory=list)
    knowledge: list[Any] = field(default_factory=list)
    """[radios, X, Y] at each step: the last step at which each cell was seen, -1 for never"""
    known: list[Any] = field(default_factory=list)
    """[radios] at each step: cells known to have burned"""
    waits: list[Any] = field(default_factory=list)
    """[uavs] at each step: bytes of reports that did not fit; only with `env.radio.bandwidth`"""
    arrival: Any = None
    burn_out: Any = None


def play_small(*overrides: str) -> Episode:
    """Plays an episode of consensus in two environments and records one of them."""
    seed, member, burn_time = 5, 1, 12.0
    config = resolve("consensus", [*LIMITED, *overrides])
    draw = torch.Generator().manual_seed(seed)
    x, y = torch.meshgrid(*(torch.arange(side) for side in config.env.grid), indexing="ij")
    arrival = torch.stack([((x - 6) ** 2 + (y - 5) ** 2).sqrt() * 5 - 4] * 2)
    arrival += torch.rand(arrival.shape, generator=draw)
    arrival[arrival > STEPS] = torch.inf
    fire = with_burn_time(arrival, burn_time)
    env = build_env(config, num_envs=2, fire=fire, seed=seed, device="cpu")
    world: Any = env.base_env
    recorder = Recorder(member)
    episode = Episode(config, None, arrival=arrival[member], burn_out=arrival[member] + burn_time)
    td = returned = env.reset()
    action = torch.zeros(2, config.env.num_uavs, 3)
    for step in range(config.env.horizon + 1):
        if step:
            if step % 7 == 1:  # UAVs meet and part
                action = torch.rand(2, config.env.num_uavs, 3, generator=draw) * 2 - 1
            td = env.step(td.set(keys.ACTION, action))
            returned, td = td["next"], step_mdp(td, keep_other=True)
        recorder.add(env, returned)
        _keep(episode, world, returned[member].clone(), member)
    episode.recording = recorder.recording()
    return episode


def _keep(episode: Episode, world: Any, now: Any, member: int) -> None:
    """Adds the environment's state at a step."""
    episode.steps.append(now)
    episode.fire_map.append(world.fire_map[member].clone())
    sensor, knowledge = world._map._sensor, world.knowledge
    episode.knowledge.append(sensor.crop(knowledge.last_seen[member]).clone())
    episode.known.append(knowledge.seen_fire[member].sum(-1))
    if world.config.radio.bandwidth is not None:
        episode.waits.append(world._measures.reports.waits[member, :-1].tolist())
