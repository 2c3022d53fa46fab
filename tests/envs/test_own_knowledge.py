"""Tests `env.knowledge: own`: a UAV is shown as old fire what it has seen itself."""

import pytest
import torch

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.wildfire import WildfireEnv
from emberlink.trainers import make_env

ENVS, UAVS, STEPS, SIDE = 3, 4, 60, 14


def flown(knowledge: str, burn_time: float, failures: float):
    """Returns positions as made by a rollout of a small crowded world, and the fires."""
    generator = torch.Generator().manual_seed(4)
    arrival = 50 * torch.rand(ENVS, SIDE, SIDE, generator=generator)
    fires = torch.stack((arrival, arrival + burn_time), 1)
    world = WildfireConfig(
        grid=(SIDE, SIDE), num_uavs=UAVS, horizon=STEPS, knowledge=knowledge, failures=failures
    )
    env = WildfireEnv(ENVS, world, fires, seed=7)
    actions = 2 * torch.rand(ENVS, STEPS, UAVS, 3, generator=generator) - 1
    td, steps = env.reset(), []
    for k in range(STEPS):
        td = env.step(td.set(keys.ACTION, actions[:, k]))["next"]
        steps.append(td.exclude(keys.ACTION))
    return torch.stack(steps, 1), fires


@pytest.mark.parametrize(("burn_time", "failures"), [(1e9, 0), (12, 0), (12, 3)])
def test_flags_and_counts_follow_from_what_a_uav_has_seen(burn_time, failures):
    steps, fires = flown("own", burn_time, failures)
    slope = torch.tensor(30.0).deg2rad().tan().item()
    differs = False
    for env in range(ENVS):
        seen = [set() for _ in range(UAVS)]
        arrival, end = fires[env].tolist()
        for k in range(STEPS):
            now = steps[env, k]
            for uav in range(UAVS):
                x, y, z = (float(c) for c in now[keys.POSITION][uav])
                new, old = [], []
                for i in range(SIDE):
                    for j in range(SIDE):
                        near = abs(i - x) <= z * slope and abs(j - y) <= z * slope
                        burns = arrival[i][j] <= k + 1 < end[i][j]
                        if now[keys.ALIVE][uav] and near and burns:
                            (old if (i, j) in seen[uav] else new).append((i, j))
                assert now[keys.NEW_FIRE][uav] == len(new)
                assert now[keys.OLD_FIRE][uav] == len(old)
                assert now[keys.OBSERVATION][uav, 3:5].tolist() == [bool(new), bool(old)]
                for cells, key in ((new, keys.NEW_CENTRE), (old, keys.OLD_CENTRE)):
                    mean = (
                        [sum(c) / len(cells) for c in zip(*cells, strict=True)] if cells else [0, 0]
                    )
                    assert now[key][uav].tolist() == pytest.approx(mean, abs=1e-5)
                differs |= any(c in seen[other] for c in new for other in range(UAVS))
                seen[uav].update(new)
    assert differs, "some fire is new to a UAV that another one has seen"


def test_rewards_and_measures_are_those_of_the_team():
    own, team = (flown(knowledge, 12, 2)[0] for knowledge in ("own", "team"))
    for key in (keys.REWARD, keys.SEEN, keys.BURNING, keys.POSITION, keys.NO_FIRE):
        assert own[key].equal(team[key]), key
    assert not own[keys.NEW_FIRE].equal(team[keys.NEW_FIRE])


@pytest.mark.parametrize(
    ("method", "observation"),
    [
        ("independent", "vector"),
        ("independent", "window"),
        ("positional", "vector"),
        ("positional", "window"),
        ("consensus", "vector"),
        ("consensus", "window"),
        *((method, "map") for method in ("independent", "positional", "consensus", "maps")),
    ],
)
def test_nothing_that_a_uav_does_reaches_one_out_of_range(method, observation):
    """UAV 0 crosses a burning map; UAV 1 flies ahead of it, out of range, or keeps away."""

    def seen(ahead: bool) -> dict:
        env = make_env(
            method, fire=torch.zeros(1, 16, 16), seed=3, num_uavs=2, horizon=80,
            observation=observation, knowledge="own", altitude=[1.0, 4.0],
            **{"env.radio.range": 0.5, "env.displacement": 0.3},
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
