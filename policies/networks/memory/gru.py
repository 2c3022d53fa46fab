"""A gated recurrent unit (Cho et al. 2014, EMNLP)."""

import torch
from torch import Tensor

from emberlink.policies.networks.layers import Generators, StackedLinear, orthogonal_weights
from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.settings import PolicyConfig


class GRU(Memory):
    """Applies a linear map with a tanh, then torch's GRU, with `policy.units` units each.

    A GRU of torch has the weights of one group, so several groups are computed one after another.
    """

    def __init__(
        self,
        groups: int,
        inputs: int,
        config: PolicyConfig,
        *,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__(groups, inputs, config)
        units = self.features = self.size = config.units
        start = {"gain": 1.0, "device": device, "generator": generator}
        self.input = StackedLinear(groups, inputs, units, **start)
        self.input_weight = orthogonal_weights(groups, 3 * units, units, **start)
        self.state_weight = orthogonal_weights(groups, 3 * units, units, **start)
        zeros = torch.zeros(groups, 3 * units, dtype=torch.float32, device=device)
        self.input_bias = torch.nn.Parameter(zeros)
        self.state_bias = torch.nn.Parameter(zeros.clone())

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        x = self.input(x.flatten(1, 2)).unflatten(1, x.shape[1:3]).tanh()
        weights = self.input_weight, self.state_weight, self.input_bias, self.state_bias
        train = torch.is_grad_enabled()  # cuDNN computes gradients in this mode alone
        outputs, states = [], []
        for sequence, before, *of_group in zip(x, state, *weights, strict=True):
            # [rows, decisions, units]: one layer, biases, no dropout, one direction
            output, after = torch.gru(
                sequence, before[None], of_group, True, 1, 0.0, train, False, True
            )
            outputs.append(output)
            states.append(after[0])
        return torch.stack(outputs), torch.stack(states)
