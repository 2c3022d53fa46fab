"""The paper's networks, one per UAV, as one batched product (section III.C; docs/setups.md).

A stack holds the weights of all UAVs in tensors whose first dimension is the UAV: nothing is
shared, no gradient crosses, and one launch serves all. Several teams that train side by side, one
per seed, are a longer stack: team 0's UAVs first.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

Generators = torch.Generator | Sequence[torch.Generator] | None
"""of initial weights: one for all, or one per team of a stack that shares the UAVs out in order"""


class StackedLinear(nn.Module):
    """A linear map per UAV.

    Args:
        uavs: how many.
        inputs, outputs: features per UAV.
        bound: weights and biases start uniform in [-bound, bound]; 1 / sqrt(inputs) if None, as
            in the DDPG paper (Lillicrap et al. 2016, section 7).
        device: of the weights.
        generator: of the initial weights.
    """

    def __init__(
        self,
        uavs: int,
        inputs: int,
        outputs: int,
        *,
        bound: float | None = None,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        bound = 1 / math.sqrt(inputs) if bound is None else bound
        generators = generator if isinstance(generator, Sequence) else [generator]
        team = uavs // len(generators)

        def start(*shape: int) -> nn.Parameter:
            # Drawn on the CPU, so that a seed means the same weights on every device.
            values = [
                torch.empty(team, *shape).uniform_(-bound, bound, generator=one)
                for one in generators
            ]
            return nn.Parameter(torch.cat(values).to(device))

        self.weight = start(inputs, outputs)
        self.bias = start(1, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """[uavs, batch, inputs] -> [uavs, batch, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)


class StackedLayerNorm(nn.Module):
    """Layer normalisation (Ba et al. 2016) with a scale and a shift per UAV."""

    def __init__(self, uavs: int, features: int, *, device: torch.device | str | None = None):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(uavs, 1, features, device=device))
        self.bias = nn.Parameter(torch.zeros(uavs, 1, features, device=device))

    def forward(self, x: Tensor) -> Tensor:
        """[uavs, batch, features] -> the same."""
        normal = nn.functional.layer_norm(x, x.shape[-1:])
        return torch.addcmul(self.bias, normal, self.weight)


class _Trunk(nn.Module):
    """Observation -> first -> second hidden layer, LayerNorm after each, ReLU in between."""

    def __init__(
        self,
        uavs: int,
        features: int,
        hidden: tuple[int, int],
        device: torch.device | str | None,
        generator: Generators,
    ):
        super().__init__()
        self.uavs = uavs
        first, second = hidden
        self.first = StackedLinear(uavs, features, first, device=device, generator=generator)
        self.first_norm = StackedLayerNorm(uavs, first, device=device)
        self.second = StackedLinear(uavs, first, second, device=device, generator=generator)
        self.second_norm = StackedLayerNorm(uavs, second, device=device)

    def by_uav(self, x: Tensor) -> Tensor:
        """[..., uavs, features] -> [uavs, batch, features].

        Where x has the UAVs of one team only, its first dimension holds the teams' environments,
        team 0's first, and each team is read from its own.
        """
        x = x.flatten(0, -3) if x.ndim > 2 else x.unsqueeze(0)
        teams = self.uavs // x.shape[-2]
        return x.unflatten(0, (teams, -1)).transpose(1, 2).flatten(0, 1)

    def by_batch(self, x: Tensor, shape: torch.Size) -> Tensor:
        """The other way: [uavs, batch, features] -> [*shape, features]."""
        return x.unflatten(0, (-1, shape[-1])).transpose(1, 2).reshape(*shape, x.shape[-1])

    def normalised(self, observation: Tensor) -> Tensor:
        """[..., uavs, features] -> [uavs, batch, second], before the second ReLU."""
        x = torch.relu(self.first_norm(self.first(self.by_uav(observation))))
        return self.second_norm(self.second(x))


class StackedActor(_Trunk):
    """Observation -> 400 -> 300 -> action; LayerNorm and ReLU after each, tanh at the end.

    Args:
        uavs: how many.
        features: numbers in an observation.
        actions: numbers in an action.
        hidden: sizes of the two hidden layers.
        device: of the weights.
        generator: of the initial weights.
    """

    def __init__(
        self,
        uavs: int,
        features: int,
        actions: int,
        hidden: tuple[int, int] = (400, 300),
        *,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__(uavs, features, hidden, device, generator)
        self.action = StackedLinear(
            uavs, hidden[1], actions, bound=3e-3, device=device, generator=generator
        )

    def forward(self, observation: Tensor) -> Tensor:
        """float32 [..., uavs, features] -> [..., uavs, actions] in (-1, 1)."""
        x = torch.relu(self.normalised(observation))
        return self.by_batch(torch.tanh(self.action(x)), observation.shape[:-1])


class StackedCritic(_Trunk):
    """Observation and action -> value.

    The action enters late: a linear map of it is added to the normalised second layer before
    its ReLU. Arguments as `StackedActor`.
    """

    def __init__(
        self,
        uavs: int,
        features: int,
        actions: int,
        hidden: tuple[int, int] = (400, 300),
        *,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__(uavs, features, hidden, device, generator)
        self.action = StackedLinear(uavs, actions, hidden[1], device=device, generator=generator)
        self.value = StackedLinear(
            uavs, hidden[1], 1, bound=3e-3, device=device, generator=generator
        )

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """float32 [..., uavs, features] and [..., uavs, actions] -> [..., uavs, 1]."""
        x = torch.relu(self.normalised(observation) + self.action(self.by_uav(action)))
        return self.by_batch(self.value(x), observation.shape[:-1])
