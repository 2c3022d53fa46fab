"""Tests the outputs of the communication modules."""

import pytest
import torch
from torchrl.envs import step_mdp

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.trainers import make_env

METHODS = ["independent", "shared_memory", "positional", "consensus"]
EVERY = [*METHODS, "maps"]
OBSERVED = {"independent": 6, "shared_memory": 6, "positional": 30, "consensus": 9}
UAVS, ENVS, HORIZON = 5, 3, 8


def ablaze() -> torch.Tensor:
    """Returns cells that ignite one after another, so that most UAVs find new fire each step."""
    return 16 * torch.rand(12, 10, generator=torch.Generator().manual_seed(0))


def recipe(method: str, **more):
    more = {"num_envs": ENVS, "num_uavs": UAVS, "horizon": HORIZON, **more}
    return make_env(method, fire=ablaze(), seed=4, **more)


def features_of_uav(td) -> torch.Tensor:
    """Computes a UAV's 6 numbers from the other entries of the environment."""
    new, old = td[keys.NEW_FIRE] > 0, td[keys.OLD_FIRE] > 0
    step = td[keys.STEP].unsqueeze(-1).expand_as(new)
    flags = torch.stack((new, old, step), -1).float()
    return torch.cat((td[keys.POSITION], flags), -1)


def expected(method: str, td) -> torch.Tensor:
    features = features_of_uav(td)
    if method == "consensus":
        return torch.cat((features, td[keys.TARGET]), -1)
    if method == "positional":
        all_features = torch.cat([features[..., uav, :] for uav in range(UAVS)], -1)
        return torch.stack([all_features] * UAVS, -2)
    return features


@pytest.mark.parametrize("method", METHODS)
def test_root_and_next_observations_are_rewritten_alike(method):
    env = recipe(method)
    rollout = env.rollout(2 * HORIZON, break_when_any_done=False)
    assert rollout[keys.OBSERVATION].shape == (ENVS, 2 * HORIZON, UAVS, OBSERVED[method])
    assert rollout[keys.OBSERVATION].equal(expected(method, rollout))
    following = rollout["next"]
    assert following[keys.OBSERVATION].equal(expected(method, following))
    assert env.observation_spec[keys.OBSERVATION].shape == (ENVS, UAVS, OBSERVED[method])


@pytest.mark.parametrize("method", EVERY)
def test_communication_does_not_change_the_world(method):
    env = recipe(method)
    plain = WildfireEnv(ENVS, env.base_env.config, ablaze(), seed=4)
    rewritten, bare = env.reset(), plain.reset()
    for step in range(HORIZON):
        action = torch.rand(ENVS, UAVS, 3, generator=torch.Generator().manual_seed(step)) * 2 - 1
        rewritten, bare = (
            env.step(rewritten.set(keys.ACTION, action)),
            plain.step(bare.set(keys.ACTION, action)),
        )
        for key in (keys.POSITION, keys.NEW_FIRE, keys.SEEN, keys.HIT_BOUNDARY):
            assert rewritten["next"].get(key).equal(bare["next"].get(key)), key
        bonus = (rewritten["next", *keys.REWARD] - bare["next", *keys.REWARD]).abs().max()
        assert (bonus > 0) == (method == "consensus")
        rewritten, bare = step_mdp(rewritten, keep_other=True), step_mdp(bare, keep_other=True)


@pytest.mark.parametrize("reach", [torch.inf, 4.0])
def test_a_uav_observes_its_own_vector_first(reach):
    """Without limit, UAV 1 observes the vectors of UAVs 1, 2, …, 0; unheard ones are 0."""
    mine, theirs = (
        recipe("positional", **{"comm.own_first": own, "env.radio.range": reach}).reset()
        for own in (True, False)
    )
    for uav in range(UAVS):
        for place in range(UAVS):
            other = (uav + place) % UAVS
            shown = mine[keys.OBSERVATION][:, uav, 6 * place : 6 * place + 6]
            assert shown.equal(theirs[keys.OBSERVATION][:, uav, 6 * other : 6 * other + 6])
