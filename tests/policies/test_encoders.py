"""Compares networks with windows, shared weights or other depths with plain torch modules."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.objectives import DDPGLoss, TD3Loss

from emberlink.envs import keys
from emberlink.policies.networks import STATE_ACTION_VALUE, make_actor, make_critic, team_of
from emberlink.policies.networks.encoders import (
    PICTURE_CHANNELS,
    ObservationEncoder,
    PictureEncoder,
    WindowEncoder,
)
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.stacked import StackedActor, StackedCritic

UAVS, ACTIONS, WINDOW, HIDDEN = 3, 3, 5, (10, 8)


def specs(envs: int, *, window: bool) -> tuple[Composite, Composite]:
    observation = {keys.OBSERVATION: Unbounded((envs, UAVS, 9))}
    if window:
        shape = torch.Size((envs, UAVS, 3, WINDOW, WINDOW))
        observation[keys.WINDOW] = Binary(shape=shape, dtype=torch.bool)
    action = {keys.ACTION: Bounded(-1, 1, (envs, UAVS, ACTIONS))}
    return Composite(observation, shape=(envs,)), Composite(action, shape=(envs,))


def observed(*batch: int, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    window = torch.rand(*batch, 3, WINDOW, WINDOW, generator=generator) < 0.4
    vector = torch.randn(*batch, 9, generator=generator)
    action = torch.rand(*batch, ACTIONS, generator=generator) * 2 - 1
    return TensorDict(
        {keys.OBSERVATION: vector, keys.WINDOW: window, keys.ACTION: action}, batch[:1]
    )


def scrambled(module):
    for weight in module.parameters():
        nn.init.normal_(weight, std=0.3, generator=torch.Generator().manual_seed(weight.numel()))
    return module


class PlainActor(nn.Module):
    """Implements the actor of one group in plain torch modules."""

    def __init__(self, stack: StackedActor, group: int):
        super().__init__()
        self.stack, self.group = stack, group

    def linear(self, layer, x):
        return x @ layer.weight[self.group] + layer.bias[self.group, 0]

    def forward(self, vector, window):
        first, second = self.stack.encoder.parts[1].first, self.stack.encoder.parts[1].second
        x = window.float()
        for layer, stride in ((first, 1), (second, 2)):
            conv = nn.Conv2d(layer.weight.shape[2], layer.weight.shape[1], 3, stride, padding=1)
            conv.weight.data, conv.bias.data = layer.weight[self.group], layer.bias[self.group]
            x = conv(x).relu()
        x = torch.cat((vector, x.flatten(1)), -1)
        for name in self.stack.names:
            norm = getattr(self.stack, f"{name}_norm")
            x = self.linear(getattr(self.stack, name), x)
            x = nn.functional.layer_norm(x, x.shape[-1:])
            x = (x * norm.weight[self.group, 0] + norm.bias[self.group, 0]).relu()
        return self.linear(self.stack.action, x).tanh()


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("hidden", [(10,), (10, 8), (6, 10, 8)])
@torch.no_grad()
def test_window_and_vector_equal_a_plain_network(shared, hidden):
    observation, action = specs(4, window=True)
    actor = scrambled(make_actor(observation, action, hidden, share_parameters=shared))
    td = observed(4, UAVS)
    actions = actor(td.clone())[keys.ACTION]
    assert actions.shape == (4, UAVS, ACTIONS)
    for uav in range(UAVS):
        plain = PlainActor(actor.module, 0 if shared else uav)
        expected = plain(td[keys.OBSERVATION][:, uav], td[keys.WINDOW][:, uav])
        torch.testing.assert_close(actions[:, uav], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("window", [False, True])
def test_shared_weights_are_the_same_for_all_uavs(window):
    observation, action = specs(4, window=window)
    for make in (make_actor, make_critic):
        generator = torch.Generator().manual_seed(1)
        network = make(observation, action, HIDDEN, share_parameters=True, generator=generator)
        assert {len(weight) for weight in network.parameters()} == {1}
        scrambled(network)
        td, (out,) = observed(4, UAVS), network.out_keys[-1:]
        order = torch.tensor([2, 0, 1])
        permuted = td.apply(lambda x, order=order: x[:, order])
        torch.testing.assert_close(network(td)[out][:, order], network(permuted)[out])


@pytest.mark.parametrize("shared", [False, True])
def test_teams_have_separate_weights_and_environments(shared):
    teams, envs = 2, 3
    observation, action = specs(teams * envs, window=True)
    generators = [torch.Generator().manual_seed(seed) for seed in range(teams)]
    more = {"share_parameters": shared}
    both = make_actor(observation, action, HIDDEN, generator=generators, **more)
    collected = observed(teams * envs, UAVS)
    # As a batch of the replay buffer: the UAVs of all teams in one dimension.
    batch = collected.apply(
        lambda x: x.unflatten(0, (teams, envs)).transpose(0, 1).flatten(1, 2), batch_size=[envs]
    )
    actions, learnt = both(collected.clone())[keys.ACTION], both(batch)[keys.ACTION]
    for team in range(teams):
        rows, columns = (slice(team * of, team * of + of) for of in (envs, UAVS))
        generator = torch.Generator().manual_seed(team)
        alone = make_actor(*specs(envs, window=True), HIDDEN, generator=generator, **more)
        expected = alone(collected[rows].clone())[keys.ACTION]
        torch.testing.assert_close(actions[rows], expected)
        torch.testing.assert_close(learnt[:, columns], expected)
        apart = team_of(both, team, teams)
        torch.testing.assert_close(apart(collected[rows].clone())[keys.ACTION], expected)
        for weight, other in zip(apart.parameters(), alone.parameters(), strict=True):
            assert weight.equal(other)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("batch", [(4, 6), (8, 3)])
def test_grouping_round_trip(shared, batch):
    grouping = Grouping(3, 2, shared=shared)
    x = torch.randn(*batch, 5)
    split = grouping.split(x, torch.Size(batch))
    assert split.shape == ((2, 12, 5) if shared else (6, 4, 5))
    assert grouping.join(split, torch.Size(batch)).equal(x)


@pytest.mark.parametrize(
    ("side", "features"), [(1, 16), (5, 144), (15, 1024), (16, 256), (63, 784)]
)
def test_windows_of_any_size_have_a_bounded_number_of_features(side, features):
    encoder = WindowEncoder(2, (3, side, side))
    out = encoder(torch.rand(2, 4, 3, side, side) < 0.5)
    assert out.shape == (2, 4, features) == (2, 4, encoder.features)


def test_a_map_may_have_sides_of_different_lengths():
    """A map of 40 x 12 cells is pooled to 14 x 4; the second convolution halves both sides."""
    encoder = WindowEncoder(1, (2, 40, 12))
    assert encoder.features == 16 * 7 * 2
    assert encoder(torch.ones(1, 3, 2, 40, 12, dtype=torch.bool)).shape == (1, 3, encoder.features)


def test_unsupported_observations_are_errors():
    with pytest.raises(ValueError, match=r"no encoder for an observation of shape \[2, 3\]"):
        ObservationEncoder(1, [(2, 3)])
    for hidden in ((), (8,) * 9):
        with pytest.raises(ValueError, match="1 to 8 layers"):
            StackedActor(2, [(4,)], 3, hidden)


def transitions(size: int) -> TensorDict:
    td, following = observed(size, UAVS), observed(size, UAVS, seed=1)
    flags = torch.zeros(size, UAVS, 1, dtype=torch.bool)
    following = following.exclude(keys.ACTION)
    following[keys.REWARD] = torch.randn(size, UAVS, 1)
    following["agents", "done"] = following["agents", "terminated"] = flags
    return td.set("next", following)


def prepared(loss):
    loss.set_keys(
        state_action_value=STATE_ACTION_VALUE,
        reward=keys.REWARD,
        done=("agents", "done"),
        terminated=("agents", "terminated"),
    )
    loss.make_value_estimator(gamma=0.9)
    return loss


@pytest.mark.parametrize("vmap", [False, True], ids=["one by one", "vmap"])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("window", [False, True])
def test_td3_of_torchrl_trains_these_networks(window, shared, vmap):
    observation, action = specs(1, window=window)
    actor = make_actor(observation, action, HIDDEN, share_parameters=shared)
    critics = [make_critic(observation, action, HIDDEN, share_parameters=shared) for _ in range(2)]
    loss = TD3Loss(actor, critics, bounds=(-1.0, 1.0), reduction="none", deactivate_vmap=not vmap)
    loss.set_keys(action=keys.ACTION)
    losses = prepared(loss)(transitions(16))
    assert losses["loss_actor"].shape == losses["loss_qvalue"].shape == (16, UAVS)
    (losses["loss_actor"] + losses["loss_qvalue"]).sum().backward()
    for name in ("actor", "qvalue"):
        for key, weight in getattr(loss, f"{name}_network_params").items(True, True):
            assert weight.grad.flatten(int(name == "qvalue") + 1).any(-1).all(), key


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, pytest.param(True, marks=pytest.mark.heavy)])
def test_ddpg_of_torchrl_fits_a_reward_seen_in_the_window(shared):
    torch.manual_seed(0)
    observation, action = specs(1, window=True)
    actor, critic = (
        make(observation, action, (32, 32), share_parameters=shared)
        for make in (make_actor, make_critic)
    )
    assert isinstance(critic.module, StackedCritic)
    loss = prepared(DDPGLoss(actor, critic, delay_actor=True, delay_value=True, reduction="none"))
    loss.make_value_estimator(gamma=0.0)
    batch = transitions(128)
    near_fire = batch[keys.WINDOW][..., 0, 1:4, 1:4].sum((-1, -2))
    batch["next", *keys.REWARD] = near_fire.unsqueeze(-1).float()
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    values = []
    for _ in range(120):
        with critic.module.sharing():
            losses = loss(batch)
        values.append(losses["loss_value"].mean().item())
        (losses["loss_value"] + losses["loss_actor"]).mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    assert values[-1] < 0.2 * values[0]


def test_pictures_pass_three_convolutions_with_weights_of_their_group():
    generators = [torch.Generator().manual_seed(seed) for seed in (1, 2)]
    encoder = PictureEncoder(2, [2, 3, 9, 12], generator=generators).double()
    pictures = torch.randint(0, 256, (2, 4, 2, 3, 9, 12), dtype=torch.uint8)
    encoded = encoder(pictures)
    assert encoded.shape == (2, 4, encoder.features)
    for group in range(2):
        for row in range(4):
            parts = []
            for picture, layers in enumerate(encoder.pictures):
                x = pictures[group, row, picture].double() / 255
                for layer in layers:
                    weight, bias = layer.weight[group], layer.bias[group]
                    x = nn.functional.conv2d(x[None], weight, bias, stride=2, padding=1)[0].relu()
                parts.append(x.flatten())
            torch.testing.assert_close(encoded[group, row], torch.cat(parts))
    # The weights of a team do not depend on the others.
    alone = PictureEncoder(1, [2, 3, 9, 12], generator=torch.Generator().manual_seed(2))
    for mine, stacked in zip(alone.parameters(), encoder.parameters(), strict=True):
        assert mine[0].double().equal(stacked[1])


def test_pictures_of_floats_are_not_written_to():
    pictures = torch.ones(1, 2, 1, 1, 8, 8)
    PictureEncoder(1, [1, 1, 8, 8], generator=torch.Generator().manual_seed(0))(pictures)
    assert pictures.eq(1).all()


def test_pictures_take_about_a_million_multiplications():
    multiplications, side, inputs = 0, 24, 8
    for outputs in PICTURE_CHANNELS:
        side //= 2
        multiplications += 9 * inputs * outputs * side**2
        inputs = outputs
    hidden = 2 * inputs * side**2 * 128 + 128 * 128
    assert 1e6 < 2 * multiplications + hidden < 1.3e6
