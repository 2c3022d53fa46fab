"""Compares the constants of the recipes with the table of agreed values."""

import dataclasses
import math

import pytest

from emberlink.comm.consensus import ConsensusConfig
from emberlink.envs.config import RewardConfig, WildfireConfig
from emberlink.envs.utils.validation import from_plain
from emberlink.trainers.config.compose import flat, resolve, to_values
from emberlink.trainers.config.schema import build_comm

METHODS = ["independent", "shared_memory", "positional", "consensus"]
PAPER, RELEASED = "paper", "released"

# key -> value in setup paper, value in setup released
TABLE = {
    "env.grid": ((30, 30), (30, 30)),
    "env.altitude": ((1.0, 4.0), (1.0, 4.0)),
    "env.num_uavs": (6, 6),
    "env.horizon": (1000, 1000),
    "episodes": (200, 200),
    "env.view_angle": (30.0, 30.0),
    "env.displacement": (1.0, 0.1),
    "env.reward.new_fire": (1.0, 12.0),
    "env.reward.old_fire": (-4.0, 6.0),
    "env.reward.no_fire": (-10.0, -4.0),
    "env.reward.exit": (-100.0, -150.0),
    "env.reward.exit_axes": ("xyz", "xy"),
    "env.observation_scale": ("raw", "raw"),
    "learner.hidden": ((400, 300), (400, 300)),
    "learner.actor_lr": (1e-4, 1e-4),
    "learner.critic_lr": (1e-3, 1e-3),
    "learner.critic_weight_decay": (0.01, 0.01),
    "learner.tau": (0.001, 0.001),
    "learner.buffer_size": (1_000_000, 1_000_000),
    "learner.batch_size": (512, 512),
    "learner.updates_per_step": (1, 1),
    "num_envs": (1, 1),
    "learner.exploration.theta": (0.2, 0.2),
    "learner.exploration.sigma": (0.15, 0.15),
    "learner.exploration.dt": (0.01, 0.01),
    "fire.name": ("paper", "paper"),
}
GAMMA = {(method, setup): 0.95 for method in METHODS for setup in (PAPER, RELEASED)}
GAMMA["independent", RELEASED] = 0.92
COMM = {"independent": "no_comm", "shared_memory": "no_comm"}
"""communication of a method, if it isn't its name"""
CONSENSUS = {
    "discoverer": ("new_fire", "any_fire"),
    "jitter": (0.0, 0.75),
    "target": ("absolute", "absolute"),
    "heading.form": ("folded_linear", "folded_exponential"),
    "heading.weight": (1.0, 1.0),
    "heading.circle": (0.0, 0.0),
}
OTHERS = {"independent": {}, "shared_memory": {}, "positional": {"own_first": False}}


def read(config, key: str):
    for part in key.split("."):
        config = getattr(config, part)
    return config


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("column", [0, 1], ids=[PAPER, RELEASED])
def test_every_row_of_the_table(method, column):
    setup = (PAPER, RELEASED)[column]
    config = resolve(method, [f"setup={setup}"])
    assert (config.method, config.setup) == (method, setup)
    assert {key: read(config, key) for key in TABLE} == {k: v[column] for k, v in TABLE.items()}
    assert config.learner.gamma == GAMMA[method, setup]
    settings = build_comm(config, num_envs=1).config
    if method == "consensus":
        expected = {key: values[column] for key, values in CONSENSUS.items()}
        assert {key: read(settings, key) for key in CONSENSUS} == expected
    else:
        assert dataclasses.asdict(settings) == OTHERS[method]


NOISE = {"learner.exploration.theta": 1.0, "learner.exploration.sigma": 0.35}
PRICE = {"env.reward.new_fire": 1.0}
OWN = {
    "independent": {"replay": "per_agent"},
    "shared_memory": {},
    "positional": {"env.radio.range": math.inf},
    "consensus": {},
    "maps": {
        "env.observation": "map",
        "learner.share_parameters": True,
        "learner.buffer_size": 50_000,
    },
}
"""settings that distinguish a method from shared_memory, beside its communication"""
OF_SETUP = {
    RELEASED: {"independent": {"learner.gamma": 0.92}},
    "tuned": {
        "independent": {**PRICE, **NOISE},
        "positional": PRICE,
        "consensus": {"learner.gamma": 0.9, **NOISE},
        "maps": {**PRICE, **NOISE, "policy.hold": 10},
    },
}
"""settings that a setup adds to `OWN`"""


@pytest.mark.parametrize("setup", [PAPER, RELEASED, "tuned"])
@pytest.mark.parametrize("method", OWN)
def test_methods_differ_only_in_listed_settings(method, setup):
    values, others = (
        flat(to_values(resolve(name, [f"setup={setup}"]))) for name in (method, "shared_memory")
    )
    differ = {key: value for key, value in values.items() if value != others.get(key)}
    differ = {k: v for k, v in differ.items() if k.split(".")[0] not in ("method", "comm")}
    assert differ == OWN[method] | OF_SETUP.get(setup, {}).get(method, {})
    assert values["comm.name"] == COMM.get(method, method)


def test_defaults_in_code_equal_setup_paper():
    config = resolve("consensus")
    assert WildfireConfig() == config.env
    assert RewardConfig() == config.env.reward
    settings = {key: value for key, value in config.comm.items() if key != "name"}
    assert settings.keys() == {field.name for field in dataclasses.fields(ConsensusConfig)}
    assert ConsensusConfig() == from_plain(ConsensusConfig, settings)
