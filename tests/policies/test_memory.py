"""Tests the memories of policies and the networks around them."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.policies.gaussian import MEAN, MEMORY, GaussianExplorer, MemoryActor
from emberlink.policies.networks import memory
from emberlink.policies.networks.memory.gru import GRU
from emberlink.policies.networks.memory.stack import Stack
from emberlink.policies.networks.sequence import GaussianNetwork, SequenceNetwork, TeamNetwork
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers import make_env
from emberlink.trainers.config.compose import resolve

UAVS, FEATURES = 3, 6


def network(kind: str, teams: int = 1, *, shared: bool = True, index=False) -> GaussianNetwork:
    return GaussianNetwork(
        UAVS,
        [(FEATURES,)],
        3,
        (8,),
        policy=PolicyConfig(memory=kind, units=5, decisions=3, agent_index=index),
        share_parameters=shared,
        generator=[torch.Generator().manual_seed(seed) for seed in range(teams)],
    )


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_memories_are_the_files_on_disk():
    assert memory.known() == ["gru", "none", "stack"]
    with pytest.raises(UserError, match=r"policy.memory='lstm' is not known; known: gru, none"):
        resolve("consensus", ["learner=ippo", "policy.memory=lstm"])
    with pytest.raises(UserError, match=r"policy.memory='' is not known; known: gru, none"):
        resolve("consensus", ["learner=ippo", 'policy.memory=""'])


@pytest.mark.parametrize("kind", ["none", "gru", "stack"])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("teams", [1, 2])
def test_decision_by_decision_equals_the_whole_episode(kind, shared, teams):
    actor = network(kind, teams, shared=shared, index=True)
    envs, decisions = 2 * teams, 7
    observed = drawn(envs, decisions, UAVS, FEATURES)
    whole, std = actor(observed)
    state = None
    for k in range(decisions):
        mean, state = actor.step([observed[:, k]], state)
        torch.testing.assert_close(mean, whole[:, k], rtol=1e-5, atol=1e-6)
    assert std.equal(actor.std(torch.Size((envs, UAVS)))[:, None].expand_as(whole))


@pytest.mark.parametrize("kind", ["gru", "stack"])
def test_an_output_depends_on_earlier_observations_of_the_same_uav_alone(kind):
    actor = network(kind)
    observed = drawn(2, 6, UAVS, FEATURES)
    changed = observed.clone()
    changed[1, 2, 0] += 1
    before, after = (actor(x)[0] for x in (observed, changed))
    same = before == after
    assert same[0].all()
    assert same[1, :2].all()
    assert same[1, :, 1:].all()
    assert not same[1, 2:5, 0].any()
    # a stack of three decisions has forgotten it after two more
    assert bool(same[1, 5, 0].all()) == (kind == "stack")


def test_a_stack_holds_the_last_inputs_the_oldest_first():
    stack = Stack(1, 2, PolicyConfig(memory="stack", decisions=3))
    x = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])[None, None]
    output, state = stack(x, torch.zeros(1, 1, stack.size))
    assert output[0, 0].tolist() == [
        [0, 0, 0, 0, 1, 2],
        [0, 0, 1, 2, 3, 4],
        [1, 2, 3, 4, 5, 6],
        [3, 4, 5, 6, 7, 8],
    ]
    assert state[0, 0].tolist() == [5, 6, 7, 8]


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


def test_several_teams_are_the_networks_of_single_teams():
    both = network("gru", 2)
    observed = drawn(4, 5, UAVS, FEATURES)
    whole, _ = both(observed)
    for team in range(2):
        alone = network("gru")
        own = {name: value[team : team + 1] for name, value in both.state_dict().items()}
        alone.load_state_dict(own)
        envs = slice(2 * team, 2 * team + 2)
        torch.testing.assert_close(alone(observed[envs])[0], whole[envs])
    assert not both.output.weight[0].equal(both.output.weight[1])


def test_the_index_tells_uavs_apart_that_share_weights():
    observed = drawn(1, 1, 1, FEATURES).expand(1, 1, UAVS, FEATURES)
    same, other = network("none")(observed)[0], network("none", index=True)(observed)[0]
    assert same[0, 0, 0].equal(same[0, 0, 1])
    assert not other[0, 0, 0].isclose(other[0, 0, 1]).any()


def test_the_values_of_a_team_depend_on_every_observation_and_position():
    config = PolicyConfig(memory="gru", units=5)
    more = {"hidden": (8,), "policy": config, "gain": 1.0}
    critic = TeamNetwork(UAVS, [(FEATURES,), (3, 5, 5)], (0, 0, 1), (9, 9, 4), **more)
    given = drawn(2, 4, UAVS, 3), drawn(2, 4, UAVS, FEATURES), drawn(2, 4, UAVS, 3, 5, 5)
    values = critic(*given)
    assert values.shape == (2, 4, UAVS, 1)
    for k in range(3):
        changed = [x.clone() for x in given]
        changed[k][0, 1, 2] += 1
        differs = critic(*changed) != values
        assert differs[0, 1:].all()
        assert not differs[0, 0].any()
        assert not differs[1].any()


def test_a_critic_of_a_uav_is_a_sequence_network():
    critic = SequenceNetwork(UAVS, [(FEATURES,)], 1, (8,), policy=PolicyConfig(), gain=1.0)
    assert critic(drawn(2, 4, UAVS, FEATURES)).shape == (2, 4, UAVS, 1)


def actor_of(kind: str) -> tuple[MemoryActor, TensorDict]:
    env = make_env("independent", "tuned", num_envs=2, num_uavs=UAVS, seed=4)
    actor = MemoryActor(network(kind), env.observation_spec)
    return actor, env.reset()


@pytest.mark.parametrize("kind", ["gru", "stack"])
def test_the_memory_is_empty_where_an_episode_begins(kind):
    """Environment 0 begins again; environment 1 is within its episode."""
    actor, td = actor_of(kind)
    fresh = actor(td.clone())
    remembered = td.clone().set(MEMORY, drawn(2, UAVS, actor.module.memory.size))
    remembered[keys.STEP] = torch.tensor([0, 5])
    after = actor(remembered)
    for key in (MEAN, MEMORY, keys.ACTION):
        assert after[key][0].equal(fresh[key][0])
    assert not after[MEAN][1].isclose(fresh[MEAN][1]).any()


def test_actions_are_the_means_clipped_to_the_box():
    actor, td = actor_of("none")
    nn.init.constant_(actor.module.output.bias, 3.0)
    acted = actor(td)
    assert acted[MEAN].min() > 2
    assert acted[keys.ACTION].eq(1).all()
    assert MEMORY not in acted.keys(True)


def test_the_density_of_an_exploring_action():
    actor, td = actor_of("gru")
    explorer = GaussianExplorer(actor)
    torch.manual_seed(1)
    first = explorer(td.clone())
    torch.manual_seed(2)
    again = explorer(td.clone())
    assert first[keys.ACTION].equal(again[keys.ACTION])  # no global random state
    scale = torch.tensor(-0.5).exp()
    exact = torch.distributions.Normal(first[MEAN], scale).log_prob(first[keys.ACTION]).sum(-1)
    torch.testing.assert_close(first["agents", "action_log_prob"], exact)
    assert (first[keys.ACTION] - first[MEAN]).std().item() == pytest.approx(0.6065, rel=0.6)
