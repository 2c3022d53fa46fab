"""The paper's networks, one per UAV, as one batched product (section III.C; docs/setups.md).

A stack holds the weights of all UAVs in tensors whose first dimension is the UAV: nothing is
shared, no gradient crosses, and one launch serves all. Several teams that train side by side, one
per seed, are a longer stack: team 0's UAVs first.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

Layer = Callable[[Tensor], Tensor]
Generators = torch.Generator | Sequence[torch.Generator] | None
"""of initial weights: one for all, or one per team of a stack that shares the UAVs out in order"""


def of_teams(generator: Generators) -> Sequence[torch.Generator | None]:
    """The generator of each team."""
    return generator if isinstance(generator, Sequence) else [generator]


_LARGE = 2**17
"""numbers of one UAV between two layers, half a megabyte"""


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
        generators = of_teams(generator)
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

    def each(self) -> list[Layer]:
        """One layer per UAV, [batch, inputs] -> [batch, outputs]."""
        uavs = zip(self.weight.unbind(0), self.bias.squeeze(1).unbind(0), strict=True)
        return [lambda x, w=weight, b=bias: torch.addmm(b, x, w) for weight, bias in uavs]


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

    def each(self) -> list[Layer]:
        """One layer per UAV, [batch, features] -> the same."""
        norm = nn.functional.layer_norm
        uavs = (of_uav.squeeze(1).unbind(0) for of_uav in (self.weight, self.bias))
        each = zip(*uavs, strict=True)
        return [lambda x, w=weight, b=bias: norm(x, w.shape, w, b) for weight, bias in each]


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
        self.uavs, self.widest = uavs, max(hidden)
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

    def by_batch(self, x: Tensor | list[Tensor], shape: torch.Size) -> Tensor:
        """The other way: [uavs, batch, features], or its parts, -> [*shape, features]."""
        x = torch.stack(x) if isinstance(x, list) else x
        return x.unflatten(0, (-1, shape[-1])).transpose(1, 2).reshape(*shape, x.shape[-1])

    def apply_all(
        self,
        network: Callable[..., Tensor],
        layers: Sequence[StackedLinear | StackedLayerNorm],
        x: Tensor,
        *more: Tensor | list[Tensor],
    ) -> Tensor | list[Tensor]:
        """All UAVs' networks on their inputs, [uavs, batch, features] each.

        At once; but on a CPU one after another where the numbers of all would not stay in its
        cache from one layer to the next. Then a list, and `more` may be such lists.

        Args:
            network: of one UAV or of a stack: layers, then inputs.
            layers: what `network` is given.
            x, more: what it is applied to.
        """
        if x.is_cuda or x.shape[1] * self.widest < _LARGE:
            return network(*layers, x, *more)
        each = zip(*(layer.each() for layer in layers), x, *more, strict=True)
        return [network(*one) for one in each]


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
        layers = self.first, self.first_norm, self.second, self.second_norm, self.action
        action = self.apply_all(_action, layers, self.by_uav(observation))
        return self.by_batch(action, observation.shape[:-1])


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
        self._shared: dict[tuple, tuple[Tensor, Tensor | list[Tensor]]] | None = None

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """float32 [..., uavs, features] and [..., uavs, actions] -> [..., uavs, 1]."""
        hidden = self._hidden(observation)
        value = self.apply_all(_value, (self.action, self.value), self.by_uav(action), hidden)
        return self.by_batch(value, observation.shape[:-1])

    @contextmanager
    def sharing(self) -> Iterator[None]:
        """Within, what the action has no part in is computed once for the same observation.

        DDPG asks a critic for the value of two actions at each observation of a batch: the one
        that was taken, in the critic's loss, and the actor's, in the actor's loss. Nothing may
        write to observations or weights meanwhile.
        """
        self._shared = {}
        try:
            yield
        finally:
            self._shared = None

    def _hidden(self, observation: Tensor) -> Tensor | list[Tensor]:
        """The second layer before the action is added, [uavs, batch, features] or its parts."""
        layers = self.first, self.first_norm, self.second, self.second_norm
        if self._shared is None:
            return self.apply_all(_trunk, layers, self.by_uav(observation))
        weight = self.first.weight
        key = observation.data_ptr(), observation.shape, weight.data_ptr()
        if key not in self._shared or weight.requires_grad:
            hidden = self.apply_all(_trunk, layers, self.by_uav(observation))
            # With the observation, so that its memory is not another's before the end.
            self._shared[key] = observation, hidden
            return hidden
        # Asked for by who learns nothing here, such as the actor's loss.
        _, hidden = self._shared[key]
        return [one.detach() for one in hidden] if isinstance(hidden, list) else hidden.detach()


# In place of what a layer made: nothing else needs it, not even its own gradient.


def _trunk(first: Layer, first_norm: Layer, second: Layer, second_norm: Layer, x: Tensor) -> Tensor:
    x = first_norm(first(x)).relu_()
    return second_norm(second(x))


def _action(
    first: Layer, first_norm: Layer, second: Layer, second_norm: Layer, last: Layer, x: Tensor
) -> Tensor:
    x = _trunk(first, first_norm, second, second_norm, x).relu_()
    return last(x).tanh_()


def _value(from_action: Layer, last: Layer, action: Tensor, hidden: Tensor) -> Tensor:
    return last((hidden + from_action(action)).relu_())
