"""Measures what messages are worth over delay, loss and bytes, and draws it.

    python docs/experiments/surface.py NAME POLICY... [key=value ...]

A POLICY is a run, `pretrained:METHOD`, or the name of a scripted policy. Each plays frozen, in the
world of `key=value`, on the same test fires with each radio, with the radio off and without limits.
NAME.jsonl gets a line for each; what is in it is not played again. NAME.png is drawn from its lines
with these `key=value` at the end, at Ctrl-C, and where no POLICY is named. It shows the gain of
messages in the headline and, below, their value (docs/comparison.md), with 95 % intervals over
fires.
"""

import json
import sys
from itertools import product
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from emberlink.envs.scenarios import fires_of
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.comparison.communication import gain_and_value
from emberlink.trainers.evaluation.evaluate import play_learned, play_scripted
from emberlink.trainers.evaluation.policy import load
from emberlink.trainers.worlds.check import world_config

FIRES = 20
DELAYS, LOSSES, BYTES = (0, 1, 5, 20, 50), (0.0, 0.2, 0.5, 0.8), (8, 16, 64, "null")
KEYS = "delay", "bandwidth", "loss"
RADIOS = [
    tuple(f"env.radio.{key}={value}" for key, value in zip(KEYS, values, strict=True))
    for values in product(DELAYS, BYTES, LOSSES)
]
OFF = ("env.radio.range=0",)
FULL = "env.radio.range=.inf", "env.radio.fade=false", *RADIOS[3 * len(LOSSES)]


def measured(policy: str, settings: list[str]) -> dict:
    """Returns the world, the headline and its value on each fire."""
    scripted = policy in SCRIPTED.known()
    loaded = None if scripted else load(policy, settings, device="cpu")
    config = world_config(settings) if loaded is None else loaded.config
    fires = fires_of(config.fire).fires("test", FIRES, config.env.grid, config.env.horizon)
    if loaded is None:
        found = play_scripted(config, policy, fires, block=FIRES)
    else:
        found = play_learned(config, loaded.actor, fires, block=FIRES)
    headline = config.evaluation.headline
    return {"world": config.world, "headline": headline, "values": list(found[headline])}


def draw(found: dict, policies: list[str], changes: list[str], path: Path) -> None:
    """Draws a row for each policy and a panel for each limit of bytes."""
    first = found[policies[0], *changes, *OFF]
    plot = Figure(figsize=(4 * len(BYTES), 3.4 * len(policies)), layout="constrained")
    plot.suptitle(f"gain and value of messages in {first['headline']}, world {first['world']}")
    panels = plot.subplots(len(policies), len(BYTES), squeeze=False)
    for (row, policy), (column, most) in product(enumerate(policies), enumerate(BYTES)):
        gains, panel = np.full((len(DELAYS), len(LOSSES)), np.nan), panels[row][column]
        for y, x in np.ndindex(gains.shape):
            radio = RADIOS[(y * len(BYTES) + column) * len(LOSSES) + x]
            lines = [found.get((policy, *changes, *one)) for one in (OFF, radio, FULL)]
            samples = [np.array([line["values"]]) for line in lines if line]
            if len(samples) < len(lines):
                continue
            now = gain_and_value(first["headline"], samples, retrained=False)
            gains[y, x] = now["gain"]
            text = "{gain:.1f} [{gain_low:.1f}, {gain_high:.1f}]".format(**now)
            if "value" in now:
                ends = [now["value_low"], now["value_high"]]
                shares = 100 * np.array([now["value"], *ends], float)
                text += "\n{:.0f} % [{:.0f}, {:.0f}]".format(*shares)
            panel.text(x, y, text, ha="center", va="center", fontsize=6.5)
        panel.imshow(gains, cmap="PuOr", vmin=-10, vmax=10, alpha=0.7, aspect="auto")
        panel.set_xticks(range(len(LOSSES)), LOSSES)
        panel.set_yticks(range(len(DELAYS)), DELAYS)
        panel.set(xlabel="loss", ylabel="delay, steps")
        limit = "no limit" if most == "null" else f"{most} bytes a step"
        panel.set_title(f"{policy.removeprefix('pretrained:')}, {limit}", fontsize=9)
    plot.savefig(path)


def main(name: str, *words: str) -> None:
    """Plays the missing radios one by one, and draws the figure."""
    torch.set_num_threads(1)
    policies, changes = ([w for w in words if ("=" in w) == given] for given in (False, True))
    path = Path(f"{name}.jsonl")
    text = path.read_text().splitlines() if path.exists() else []
    found = {tuple(line["played"]): line for line in map(json.loads, text)}
    try:
        for radio, policy in product([OFF, FULL, *RADIOS], policies):
            played = (policy, *changes, *radio)
            if played not in found:
                found[played] = {"played": played, **measured(policy, [*changes, *radio])}
                with path.open("a") as file:
                    file.write(json.dumps(found[played]) + "\n")
    finally:
        off = (*changes, *OFF)
        if drawn := [policy for policy, *settings in found if (*settings,) == off]:
            draw(found, drawn, changes, Path(f"{name}.png"))


main(*sys.argv[1:])
