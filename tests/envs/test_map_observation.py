"""Tests that `env.observation=map` and the communication method are chosen independently."""

import pytest
import torch
from torchrl.envs import check_env_specs

from emberlink.envs import keys
from emberlink.trainers import make_env

METHODS = ["independent", "shared_memory", "positional", "consensus", "maps"]
SMALL = {"observation": "map", "horizon": 30, "env.map.pixels": 8, "env.map.scales": [1, 3]}
UAVS_CHANNEL = 6


def actions(steps: int, envs: int, uavs: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(2)
    return 2 * torch.rand(steps, envs, uavs, 3, generator=generator) - 1


def flown(method: str, **more) -> list:
    env = make_env(method, "strong", world="relay", num_envs=2, seed=3, num_train_fires=2,
                   **{**SMALL, **more})  # fmt: skip
    td, steps = env.reset(), []
    for action in actions(25, 2, 6):
        td = env.step(td.set(keys.ACTION, action))["next"]
        steps.append(td.exclude(keys.ACTION))
    return [env, *steps]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_the_same_pictures_besides_its_vector(method):
    env = make_env(method, num_envs=2, num_uavs=3, measures="all", **SMALL)
    check_env_specs(env)
    spec = env.observation_spec
    assert keys.observation_keys(spec) == [keys.OBSERVATION, keys.CROPS]
    assert spec[keys.CROPS].shape == (2, 3, 2, 8, 8, 8)
    assert spec[keys.OBSERVATION].shape == (2, 3, 5 if method == "consensus" else 2)
    more = make_env(method, num_uavs=3, **SMALL, **{"env.map.position": True}).observation_spec
    assert more[keys.OBSERVATION].shape == (1, 3, 7 if method == "consensus" else 4)


def test_without_a_radio_maps_equal_those_of_independent():
    alone, off, on = (
        flown(method, **{"env.radio.range": heard, **more})[1:]
        for method, heard, more in (
            ("independent", 10, {}), ("maps", 0, {"comm.home": False}),
            ("maps", 90, {"comm.home": False}),
        )
    )  # fmt: skip
    for one, two in zip(alone, off, strict=True):
        for key in (keys.CROPS, keys.OBSERVATION):
            assert one[key].equal(two[key])
    assert not alone[-1][keys.CROPS].equal(on[-1][keys.CROPS])


def test_positional_shows_the_positions_that_a_uav_hears():
    """UAV 1 flies away, out of the range of 3.5 cells; the mark stays and darkens."""
    fire = torch.full((20, 20), torch.inf)
    env = make_env("positional", fire=fire, num_uavs=2, measures="all",
                   **{**SMALL, "env.radio.range": 3.5, "env.displacement": 1.0})  # fmt: skip
    td = env.reset(position=torch.tensor([[5.0, 5, 2], [7, 5, 2]]))
    marks, sent = [], []
    for _ in range(3):
        picture = td[keys.CROPS][0, 0, 0, UAVS_CHANNEL]
        marks.append({(int(x) - 4, int(y) - 4): int(picture[x, y]) for x, y in picture.nonzero()})
        sent += td[keys.BYTES_SENT][0].tolist()
        td = env.step(td.set(keys.ACTION, torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]])))["next"]
    # 255 - round(254 log(2) / log(1001)) after a step without news
    assert marks == [{(2, 0): 255}, {(3, 0): 255}, {(3, 0): 230}]
    assert sent == [12] * 6
