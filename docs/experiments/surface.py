"""Measures what messages are worth over delay, loss and bytes: a file of lines, and its figure.

    python docs/experiments/surface.py surface.jsonl surface.png POLICY... [key=value ...]

A POLICY is a run, `pretrained:METHOD`, or the name of a scripted policy, played with the keys of
a `world=`. Each plays frozen, on the same test fires, with the radio off and with each radio. The
file gets a line for each; what is in it is not played again. The figure shows the gain over the
radio off in the headline; where its 95 % interval, paired by fire, reaches 0, it is in brackets.
"""

import json
import sys
from itertools import product
from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure

from emberlink import trainers
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.worlds.check import played, world_config

DELAYS, LOSSES, BYTES = (0, 1, 5, 20, 50), (0.0, 0.2, 0.5, 0.8), (8, 16, 64, None)
FIRES = 50
lines, figure, *more = sys.argv[1:]
policies = [word for word in more if "=" not in word]
changes = [word for word in more if "=" in word]
OFF = {"env.radio.range": 0}


def measured(policy: str, radio: dict) -> list[float]:
    """Returns the headline of each episode, in the world of `changes`."""
    given = [f"{key}={'null' if value is None else value}" for key, value in radio.items()]
    config = world_config([*changes, *given])
    headline = config.evaluation.headline
    if policy in SCRIPTED.known():
        return played(config, policy, fires=FIRES, split="test")[headline]
    given = (word.partition("=") for word in changes)
    world = {key: yaml.safe_load(value) for key, _, value in given}
    results = trainers.evaluate(policy, episodes=FIRES, scripted=False, **world, **radio)
    return list(next(iter(results.values()))["learned"][headline])


def gain(off: np.ndarray, on: np.ndarray, axis: int = -1):
    return on.mean(axis) - off.mean(axis)


path = Path(lines)
known = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
found = {(x["policy"], json.dumps(x["radio"])): x["values"] for x in known}
radios = [
    {"env.radio.delay": delay, "env.radio.loss": loss, "env.radio.bandwidth": most}
    for delay, loss, most in product(DELAYS, LOSSES, BYTES)
]
for policy, radio in product(policies, [OFF, *radios]):
    if (policy, json.dumps(radio)) not in found:
        values = [float(x) for x in measured(policy, radio)]
        found[policy, json.dumps(radio)] = values
        with path.open("a") as file:
            file.write(json.dumps({"policy": policy, "radio": radio, "values": values}) + "\n")

plot = Figure(figsize=(3 * len(BYTES), 2.6 * len(policies)), layout="constrained")
panels = plot.subplots(len(policies), len(BYTES), squeeze=False)
for (row, policy), (column, most) in product(enumerate(policies), enumerate(BYTES)):
    off, panel = found[policy, json.dumps(OFF)], panels[row][column]
    at = [x for x in radios if x["env.radio.bandwidth"] == most]
    on = [found[policy, json.dumps(radio)] for radio in at]
    gains = [float(np.mean(values) - np.mean(off)) for values in on]
    panel.imshow(np.reshape(gains, (len(DELAYS), -1)), cmap="PuOr", vmin=-10, vmax=10)
    for number, values in enumerate(on):
        low, high = bootstrap.interval(gain, off, values, paired=True) or (0, 0)
        text = f"{gains[number]:.1f}" if low > 0 or high < 0 else f"({gains[number]:.1f})"
        y, x = divmod(number, len(LOSSES))
        panel.text(x, y, text, ha="center", va="center", fontsize=8)
    panel.set_xticks(range(len(LOSSES)), LOSSES)
    panel.set_yticks(range(len(DELAYS)), DELAYS)
    panel.set(xlabel="loss", ylabel="delay, steps")
    panel.set_title(f"{Path(policy).name}, {'no limit' if most is None else f'{most} bytes'}")
plot.savefig(figure)
