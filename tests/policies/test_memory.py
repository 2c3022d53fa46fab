"""Tests the memories of policies and the networks around them."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from emberlink.envs import keys
from emberlink.policies.gaussian import MEMORY, GaussianActor, GaussianExplorer
from emberlink.policies.networks.memory.gru import GRU
from emberlink.policies.networks.sequence import GaussianNetwork, TeamNetwork
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers import make_env

UAVS, FEATURES = 3, 6


def network(kind: str, *, shared: bool = True, index=False) -> GaussianNetwork:
    return GaussianNetwork(
        UAVS,
        [(FEATURES,)],
        3,
        (8,),
        policy=PolicyConfig(memory=kind, units=5, agent_index=index),
        share_parameters=shared,
        generator=torch.Generator().manual_seed(0),
    )


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("groups", [1, 2])
def test_the_gru_is_that_of_torch(groups):
    config = PolicyConfig(memory="gru", units=4)
    ours = GRU(groups, 3, config, generator=torch.Generator().manual_seed(1))
    x, state = drawn(groups, 5, 6, 3), drawn(groups, 5, 4, seed=1)
    nn.init.normal_(ours.input_bias)
    nn.init.normal_(ours.state_bias)
    outputs, states = ours(x, state)
    for group in range(groups):
        theirs = nn.GRU(4, 4, batch_first=True)
        parts = {
            "weight_ih_l0": ours.input_weight,
            "weight_hh_l0": ours.state_weight,
            "bias_ih_l0": ours.input_bias,
            "bias_hh_l0": ours.state_bias,
        }
        theirs.load_state_dict({name: part[group].detach() for name, part in parts.items()})
        read = (x[group] @ ours.input.weight[group] + ours.input.bias[group]).tanh()
        expected, last = theirs(read, state[group][None])
        torch.testing.assert_close(outputs[group], expected)
        torch.testing.assert_close(states[group], last[0])


def test_the_index_tells_uavs_apart_that_share_weights():
    observed = drawn(1, 1, 1, FEATURES).expand(1, 1, UAVS, FEATURES)
    empty = observed.new_zeros(1, UAVS, 0)
    same, other = (network("none", index=index)(empty, observed)[0] for index in (False, True))
    assert same[0, 0, 0].equal(same[0, 0, 1])
    assert not other[0, 0, 0].isclose(other[0, 0, 1]).any()


def test_the_values_of_a_team_depend_on_every_observation_and_position():
    config = PolicyConfig(memory="gru", units=5)
    more = {"hidden": (8,), "policy": config, "gain": 1.0}
    critic = TeamNetwork(UAVS, [(FEATURES,), (3, 5, 5)], (0, 0, 1), (9, 9, 4), **more)
    given = drawn(2, 4, UAVS, 3), drawn(2, 4, UAVS, FEATURES), drawn(2, 4, UAVS, 3, 5, 5)
    state = critic.empty_state(2)
    values, _ = critic(state, *given)
    assert values.shape == (2, 4, UAVS, 1)
    for k in range(3):
        changed = [x.clone() for x in given]
        changed[k][0, 1, 2] += 1
        differs = critic(state, *changed)[0] != values
        assert differs[0, 1:].all()
        assert not differs[0, 0].any()
        assert not differs[1].any()


def actor_of(kind: str) -> tuple[GaussianActor, TensorDict]:
    few = {"num_envs": 2, "num_uavs": UAVS, "num_train_fires": 2}
    env = make_env("independent", "tuned", seed=4, **few)
    actor = GaussianActor(network(kind), env.observation_spec)
    return actor, env.reset()


def test_the_memory_is_empty_where_an_episode_begins():
    """Environment 0 begins again; environment 1 is within its episode."""
    actor, td = actor_of("gru")
    fresh = actor(td.clone())
    remembered = td.clone().set(MEMORY, drawn(2, UAVS, actor.module.memory.size))
    remembered[keys.STEP] = torch.tensor([0, 5])
    after = actor(remembered)
    for key in (("next", *MEMORY), keys.ACTION):
        assert after[key][0].equal(fresh[key][0])
        assert not after[key][1].isclose(fresh[key][1]).any()


def test_actions_are_the_means_clipped_to_the_box():
    actor, td = actor_of("none")
    nn.init.constant_(actor.module.output.bias, 3.0)
    acted = actor(td)
    assert actor.mean(td).min() > 2
    assert acted[keys.ACTION].eq(1).all()
    assert MEMORY not in acted.keys(True)


def test_the_density_of_an_exploring_action():
    actor, td = actor_of("gru")
    first, again = (
        GaussianExplorer(actor, torch.Generator().manual_seed(1))(td.clone()) for _ in range(2)
    )
    assert first[keys.ACTION].equal(again[keys.ACTION])  # no global random state
    mean, scale = actor.mean(td.clone()), torch.tensor(-0.5).exp()
    exact = torch.distributions.Normal(mean, scale).log_prob(first[keys.ACTION]).sum(-1)
    torch.testing.assert_close(first["agents", "action_log_prob"], exact)
    assert (first[keys.ACTION] - mean).std().item() == pytest.approx(0.6065, rel=0.6)
