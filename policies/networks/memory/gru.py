"""A gated recurrent unit (Cho et al. 2014, EMNLP)."""

from typing import Any

import torch
from torch import Tensor

from emberlink.policies.networks.layers import StackedLinear, orthogonal_weights
from emberlink.policies.networks.memory.base import Memory
from emberlink.policies.settings import PolicyConfig


class GRU(Memory):
    """Applies a linear map with a tanh, then a GRU, with `policy.units` units each.

    A GRU of torch has the weights of one group. Several groups are computed together, one decision
    after another; on a CPU, this takes less than half of the time of one group after another.
    """

    def __init__(self, groups: int, inputs: int, config: PolicyConfig, **start: Any):
        super().__init__(groups, inputs, config)
        units = self.features = self.size = config.units
        self.input = StackedLinear(groups, inputs, units, gain=1.0, **start)
        self.input_weight = orthogonal_weights(groups, 3 * units, units, gain=1.0, **start)
        self.state_weight = orthogonal_weights(groups, 3 * units, units, gain=1.0, **start)
        self.input_bias = torch.nn.Parameter(torch.zeros_like(self.input_weight[:, :, 0]))
        self.state_bias = torch.nn.Parameter(torch.zeros_like(self.input_bias))

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        x = self.input(x.flatten(1, 2)).unflatten(1, x.shape[1:3]).tanh()
        return self._one_group(x, state) if len(x) == 1 else self._groups(x, state)

    def _one_group(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        weights = self.input_weight, self.state_weight, self.input_bias, self.state_bias
        train = torch.is_grad_enabled()  # cuDNN computes gradients in this mode alone
        # [rows, decisions, units]: one layer, biases, no dropout, one direction
        of_group = [weight[0] for weight in weights]
        output, after = torch.gru(x[0], state, of_group, True, 1, 0.0, train, False, True)
        return output[None], after

    def _groups(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        rows, units = x.shape[1], self.size
        by_decision = x.transpose(1, 2).flatten(1, 2)
        from_inputs = torch.baddbmm(self.input_bias[:, None], by_decision, self.input_weight.mT)
        states = []
        for from_input in from_inputs.unflatten(1, (-1, rows)).unbind(1):
            from_state = torch.baddbmm(self.state_bias[:, None], state, self.state_weight.mT)
            both = from_input[..., : 2 * units] + from_state[..., : 2 * units]
            reset, keep = both.sigmoid().chunk(2, -1)
            new = from_input[..., 2 * units :].addcmul(reset, from_state[..., 2 * units :]).tanh()
            state = torch.lerp(new, state, keep)
            states.append(state)
        return torch.stack(states, 2), state
