"""Implements DDPG for one UAV in plain torch modules, as a reference for the stacked learner."""

import copy
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from emberlink.policies.networks.actor_critic import StackedActor, StackedCritic
from emberlink.policies.networks.layers import StackedLayerNorm, StackedLinear


class SingleActor(nn.Module):
    def __init__(self, features: int, actions: int, hidden: tuple[int, int]):
        super().__init__()
        self.first = nn.Linear(features, hidden[0])
        self.first_norm = nn.LayerNorm(hidden[0])
        self.second = nn.Linear(*hidden)
        self.second_norm = nn.LayerNorm(hidden[1])
        self.action = nn.Linear(hidden[1], actions)

    def forward(self, observation: Tensor) -> Tensor:
        x = torch.relu(self.first_norm(self.first(observation)))
        x = torch.relu(self.second_norm(self.second(x)))
        return torch.tanh(self.action(x))


class SingleCritic(nn.Module):
    def __init__(self, features: int, actions: int, hidden: tuple[int, int]):
        super().__init__()
        self.first = nn.Linear(features, hidden[0])
        self.first_norm = nn.LayerNorm(hidden[0])
        self.second = nn.Linear(*hidden)
        self.second_norm = nn.LayerNorm(hidden[1])
        self.action = nn.Linear(actions, hidden[1])
        self.value = nn.Linear(hidden[1], 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        x = torch.relu(self.first_norm(self.first(observation)))
        return self.value(torch.relu(self.second_norm(self.second(x)) + self.action(action)))


def matched(
    stack: StackedActor | StackedCritic, single: nn.Module, uav: int
) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yields name, the UAV's slice of the stack, and the single network's parameter."""
    assert not list(stack.encoder.parameters())  # a vector
    for name, layer in stack.named_children():
        if name == "encoder":
            continue
        assert isinstance(layer, StackedLinear | StackedLayerNorm)
        module = single.get_submodule(name)
        weight = layer.weight[uav]
        weight = weight.T if isinstance(layer, StackedLinear) else weight[0]
        yield f"{name}.weight", weight, module.get_parameter("weight")
        yield f"{name}.bias", layer.bias[uav, 0], module.get_parameter("bias")


@torch.no_grad()
def copy_uav(stack: StackedActor | StackedCritic, single: nn.Module, uav: int) -> nn.Module:
    """Copies one UAV's weights into the single network and returns it."""
    for _, source, parameter in matched(stack, single, uav):
        parameter.copy_(source)
    return single


class SingleDDPG:
    """Implements algorithm 1 of Lillicrap et al. 2016 after the sampling of the batch."""

    def __init__(
        self,
        actor: nn.Module,
        critic: nn.Module,
        *,
        gamma: float,
        tau: float,
        actor_lr: float,
        critic_lr: float,
        critic_weight_decay: float,
    ):
        self.actor, self.critic, self.gamma, self.tau = actor, critic, gamma, tau
        self.target_actor, self.target_critic = copy.deepcopy(actor), copy.deepcopy(critic)
        self.actor_optimizer = torch.optim.Adam(actor.parameters(), lr=actor_lr)
        self.critic_optimizer = torch.optim.Adam(
            critic.parameters(), lr=critic_lr, weight_decay=critic_weight_decay
        )

    def critic_loss(self, observation, action, reward, following, terminated) -> Tensor:
        with torch.no_grad():
            value = self.target_critic(following, self.target_actor(following))
            wanted = reward + self.gamma * ~terminated * value
        return ((self.critic(observation, action) - wanted) ** 2).mean()

    def actor_loss(self, observation: Tensor) -> Tensor:
        return -self.critic(observation, self.actor(observation)).mean()

    def update(self, observation, action, reward, following, terminated) -> tuple[float, float]:
        critic_loss = self.critic_loss(observation, action, reward, following, terminated)
        actor_loss = self.actor_loss(observation)
        critic_gradients = torch.autograd.grad(critic_loss, list(self.critic.parameters()))
        actor_gradients = torch.autograd.grad(actor_loss, list(self.actor.parameters()))
        self._step(self.critic, self.critic_optimizer, critic_gradients)
        self._step(self.actor, self.actor_optimizer, actor_gradients)
        self._follow(self.target_critic, self.critic)
        self._follow(self.target_actor, self.actor)
        return actor_loss.item(), critic_loss.item()

    def _step(self, network, optimizer, gradients) -> None:
        for parameter, gradient in zip(network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()

    @torch.no_grad()
    def _follow(self, target: nn.Module, network: nn.Module) -> None:
        for slow, fast in zip(target.parameters(), network.parameters(), strict=True):
            slow.copy_(self.tau * fast + (1 - self.tau) * slow)
