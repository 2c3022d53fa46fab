"""Tests that with `env.knowledge: own` nothing reaches a UAV that is out of range."""

import itertools

import pytest
import torch

from emberlink.envs import keys
from emberlink.trainers import make_env

LIMITED = {"env.radio.delay": 2, "env.radio.bandwidth": 40, "env.radio.loss": 0.3}


@pytest.mark.parametrize("radio", [{}, LIMITED], ids=["at once", "limited"])
@pytest.mark.parametrize(
    ("method", "observation"),
    [
        *itertools.product(("independent", "positional", "consensus"), ("vector", "window", "map")),
        ("maps", "map"),
    ],
)
def test_nothing_that_a_uav_does_reaches_one_out_of_range(method, observation, radio):
    """UAV 0 crosses a burning map; UAV 1 flies ahead of it, out of range, or keeps away.

    Where UAV 0 sees nothing, another fire burns.
    """

    def seen(ahead: bool) -> dict:
        fire = torch.zeros(1, 16, 16)
        fire[:, :, 12:] = torch.inf if ahead else 0
        env = make_env(
            method, fire=fire, seed=3, num_uavs=2, horizon=80,
            observation=observation, knowledge="own", altitude=[1.0, 4.0],
            **{"env.radio.range": 0.5, "env.displacement": 0.3, **radio},
        )  # fmt: skip
        td = env.reset(position=torch.tensor([[2.0, 7.0, 4.0], [3.0, 7.0, 3.0]]))
        result = {}
        for k in range(40):
            away = [0.9, 0.1, 0.0] if ahead else [0.0, -1.0, 0.0]
            td = env.step(td.set(keys.ACTION, torch.tensor([[[0.9, 0.1, 0.0], away]])))["next"]
            for key in keys.observation_keys(env.observation_spec):
                result[k, key] = td[key][:, 0].clone()
        return result

    one, two = seen(True), seen(False)
    for key, value in one.items():
        assert value.equal(two[key]), key
