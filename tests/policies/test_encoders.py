"""Compares networks with windows, shared weights or other depths with plain torch modules."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Binary, Bounded, Composite, Unbounded

from emberlink.envs import keys
from emberlink.policies.networks.actor_critic import StackedActor, make_actor
from emberlink.policies.networks.encoders import PictureEncoder

UAVS, ACTIONS, WINDOW, HIDDEN = 3, 3, 5, (10, 8)


def specs(envs: int) -> tuple[Composite, Composite]:
    window = torch.Size((envs, UAVS, 3, WINDOW, WINDOW))
    observation = {
        keys.OBSERVATION: Unbounded((envs, UAVS, 9)),
        keys.WINDOW: Binary(shape=window, dtype=torch.bool),
    }
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
    observation, action = specs(4)
    actor = scrambled(make_actor(observation, action, hidden, share_parameters=shared))
    td = observed(4, UAVS)
    actions = actor(td.clone())[keys.ACTION]
    assert actions.shape == (4, UAVS, ACTIONS)
    for uav in range(UAVS):
        plain = PlainActor(actor.module, 0 if shared else uav)
        expected = plain(td[keys.OBSERVATION][:, uav], td[keys.WINDOW][:, uav])
        torch.testing.assert_close(actions[:, uav], expected, atol=1e-5, rtol=1e-5)


def test_pictures_pass_three_convolutions_with_weights_of_their_group():
    encoder = PictureEncoder(2, [2, 3, 9, 12], generator=torch.Generator().manual_seed(1)).double()
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
