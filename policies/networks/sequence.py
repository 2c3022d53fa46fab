"""Networks with a memory, which map sequences of observations."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from emberlink.policies.networks.encoders import ObservationEncoder
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.layers import StackedLinear
from emberlink.policies.networks.memory.base import MEMORIES
from emberlink.policies.networks.messages import MESSAGES, Messages
from emberlink.policies.settings import PolicyConfig

FIRST_LOG_STD = -0.5
"""initial logarithm of the standard deviation of the actions"""

FIRE = (1, 2)
"""cells of the true map that a critic reads, the share of each kind: seen and unseen fire"""
COARSE = 10
"""largest number of squares along a side of the map in which a critic reads these shares"""


class SequenceNetwork(nn.Module):
    """An encoder, a memory, hidden layers with a tanh each, and a linear map.

    Initial weights are orthogonal, the last map's scaled by `gain`.

    Args:
        uavs: number of UAVs.
        observations: shape of each tensor of an observation, per UAV: [features], [channels, W, W]
            or [pictures, channels, S, S].
        outputs: number of outputs per UAV.
        hidden: units of the hidden layers.
        policy: the memory, and whether the index of a UAV is an input.
        gain: factor of the weights of the last map.
        share_parameters: whether the UAVs share their weights.
        speaks: whether the UAVs say the messages of `policy`, if it has any. What a UAV hears is
            then an input of its memory, and the links, bool [..., uavs, uavs], are the last tensor
            of an observation.
        lag: decisions from saying a message to hearing it. The messages in flight, with the links
            of the decision at which they were said, are carried like a memory: gradients flow
            through them within a sequence, and those that begin it are constants.
        start: see `layers.Start`.
    """

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        outputs: int,
        hidden: Sequence[int],
        *,
        policy: PolicyConfig,
        gain: float,
        share_parameters: bool = True,
        speaks: bool = False,
        lag: int = 0,
        **start: Any,
    ):
        super().__init__()
        self.grouping = Grouping(uavs, shared=share_parameters)
        self.agent_index = policy.agent_index
        first, *others = observations
        shapes = [(first[0] + uavs * policy.agent_index,), *others]
        groups = self.grouping.groups
        self.encoder = ObservationEncoder(groups, shapes, **start)
        speaks = speaks and policy.message != "none"
        inputs = self.encoder.features + policy.message_size * speaks
        self.memory = MEMORIES.find(policy.memory)(groups, inputs, policy, **start)
        inputs, self.hidden = self.memory.features, nn.ModuleList()
        for units in hidden:
            self.hidden.append(StackedLinear(groups, inputs, units, gain=math.sqrt(2), **start))
            inputs = units
        self.output = StackedLinear(groups, inputs, outputs, gain=gain, **start)
        self.messages, flying = None, 0
        if speaks:
            inputs = self.encoder.features + self.memory.size
            scheme = MESSAGES.find(policy.message)
            self.messages = scheme(self.grouping, inputs, policy.message_size, **start)
            flying = lag * (self.messages.numbers + uavs)
        self.size = self.memory.size + flying
        """numbers per UAV that are carried from decision to decision; they are 0 before the first:
        the state of the memory, and the messages and links in flight"""

    def forward(self, state: Tensor, *observations: Tensor) -> tuple[Tensor, Tensor]:
        """Maps sequences of decisions.

        Args:
            state: before the first decision, [rows, uavs, size].
            observations: [rows, decisions, uavs, ...] each.

        Returns:
            Outputs, [rows, decisions, uavs, outputs], and the state after the last decision.
        """
        rows, decisions, uavs = observations[0].shape[:3]
        batch, split, join = torch.Size((rows, uavs)), self.grouping.split, self.grouping.join
        first, *others = observations if self.messages is None else observations[:-1]
        first = self.grouping.with_index(first) if self.agent_index else first
        arranged = [split(x.transpose(1, 2), batch) for x in (first, *others)]
        each = arranged[0].shape[1:3]
        encoded = self.encoder([x.flatten(1, 2) for x in arranged]).unflatten(1, each)
        before, flying = state.split([self.memory.size, self.size - self.memory.size], -1)
        before = split(before.contiguous(), batch)
        if self.messages is None:
            x, after = self.memory(encoded, before)
        else:
            given = self.messages, encoded, before, flying, observations[-1]
            x, after, flying = self._converse(*given)
        x = x.flatten(1, 2)
        for layer in self.hidden:
            x = layer(x).tanh()
        output = self.output(x).unflatten(1, each)
        joined = join(output.flatten(2), batch).unflatten(-1, (decisions, -1))
        return joined.transpose(1, 2), torch.cat((join(after, batch), flying), -1)

    def step(self, observations: Sequence[Tensor], state: Tensor | None) -> tuple[Tensor, Tensor]:
        """Maps the observations of one decision.

        Args:
            observations: [*batch, uavs, ...] each.
            state: [*batch, uavs, size], from the decision before; None for an empty state.

        Returns:
            Outputs, [*batch, uavs, outputs], and the new state, [*batch, uavs, size].
        """
        *batch, uavs = observations[0].shape[:-1]
        rows = math.prod(batch)
        size = rows, uavs, self.size
        before = self.output.weight.new_zeros(size) if state is None else state.reshape(size)
        each = [x.reshape(rows, 1, *x.shape[len(batch) :]) for x in observations]
        output, after = SequenceNetwork.forward(self, before, *each)
        return output.reshape(*batch, uavs, -1), after.reshape(*batch, uavs, self.size)

    def _converse(
        self, messages: Messages, encoded: Tensor, state: Tensor, flying: Tensor, hears: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Runs the memory decision by decision, since a UAV may say what it has heard before.

        Args:
            encoded: [groups, rows, decisions, features].
            state: of the memory, [groups, rows, size].
            flying: [envs, uavs, lag * (numbers + uavs)], of the decisions before, the oldest first:
                the message of a UAV, and whether it hears each other one.
            hears: bool [envs, decisions, uavs, uavs].
        """
        features = []
        for now, links in zip(encoded.unbind(2), hears.unbind(1), strict=True):
            mine = torch.cat((now, state), -1)
            said = *messages.speak(mine, links.shape[:2]), links
            if flying.shape[-1]:
                sizes = [part.shape[-1] for part in said]
                sent = torch.cat((flying, *said), -1).split((sum(sizes), flying.shape[-1]), -1)
                (message, key, link), flying = sent[0].split(sizes, -1), sent[1]
                said = message, key, link > 0
            heard = messages(mine, *said)
            x, state = self.memory(torch.cat((now, heard), -1).unsqueeze(2), state)
            features.append(x)
        return torch.cat(features, 2), state, flying

    def empty_state(self, rows: int) -> Tensor:
        """Returns the state before the first decision, [rows, uavs, size]."""
        return self.output.weight.new_zeros(rows, self.grouping.uavs, self.size)


class GaussianNetwork(SequenceNetwork):
    """Maps observations to the means of actions; their standard deviations are weights.

    Arguments as for `SequenceNetwork`.
    """

    def __init__(self, *args: Any, device: torch.device | str | None = None, **more: Any):
        super().__init__(*args, gain=0.01, speaks=True, device=device, **more)
        actions = self.output.bias.shape[-1]
        shape = self.grouping.groups, 1, actions
        self.log_std = nn.Parameter(
            torch.full(shape, FIRST_LOG_STD, dtype=torch.float32, device=device)
        )

    def forward(self, state: Tensor, *observations: Tensor) -> tuple[Tensor, Tensor]:
        """Returns means and standard deviations of sequences, see `SequenceNetwork`."""
        mean, _ = super().forward(state, *observations)
        batch = torch.Size((mean.shape[0], mean.shape[2]))
        return mean, self.std(batch).unsqueeze(1).expand_as(mean)

    def std(self, batch: torch.Size) -> Tensor:
        """Returns the standard deviations of a batch [*batch, uavs], [*batch, uavs, actions]."""
        rows = math.prod(batch) // self.grouping.groups
        return self.grouping.join(self.log_std.exp().expand(-1, rows, -1), batch)


class TeamNetwork(nn.Module):
    """Maps the observations of a whole team, and the true map, to an output per UAV.

    Args:
        uavs: number of UAVs.
        observations: shape of each tensor of an observation, per UAV.
        low, high: corners of the box, cells.
        grid: cells of the map along x and y; None without a map.
        more: `hidden`, `policy`, `gain`, `device` and `generator` of `SequenceNetwork`.
    """

    middle: Tensor
    half_width: Tensor

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        low: Sequence[float],
        high: Sequence[float],
        *,
        grid: Sequence[int] | None = None,
        **more: Any,
    ):
        super().__init__()
        first, *windows = observations
        self.square = 0 if grid is None else -(-max(grid) // COARSE)
        """cells along a side of a square of the map"""
        coarse = math.prod(-(-side // self.square) for side in grid) if grid else 0
        features = uavs * (first[0] + 3) + len(FIRE) * coarse
        shapes = [(features,), *((uavs * n, *sides) for n, *sides in windows)]
        self.network = SequenceNetwork(1, shapes, uavs, **more)
        corners = torch.tensor([low, high], dtype=torch.float32, device=more.get("device"))
        self.register_buffer("middle", corners.mean(0), persistent=False)
        self.register_buffer("half_width", (corners[1] - corners[0]) / 2 + 1e-6, persistent=False)

    def empty_state(self, rows: int) -> Tensor:
        """Returns the state before the first decision, [rows, 1, size]."""
        return self.network.empty_state(rows)

    def forward(self, state: Tensor, position: Tensor, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Maps sequences of decisions.

        Args:
            state: of the memory before the first decision, [rows, 1, size].
            position: float32 [rows, decisions, uavs, 3], cells.
            inputs: the tensors of the observation, [rows, decisions, uavs, ...], and the map if
                there is one, uint8 [rows, decisions, X, Y].

        Returns:
            Outputs, [rows, decisions, uavs, 1], and the state after the last decision.
        """
        first, *windows = inputs[:-1] if self.square else inputs
        vectors = torch.cat((first, (position - self.middle) / self.half_width), -1).flatten(2)
        if self.square:
            fire = torch.stack([inputs[-1] == kind for kind in FIRE], 2).flatten(0, 1).float()
            fire = nn.functional.avg_pool2d(fire, self.square, ceil_mode=True)
            vectors = torch.cat((vectors, fire.view(*vectors.shape[:2], -1)), -1)
        team = [vectors, *(x.flatten(2, 3) for x in windows)]
        output, after = self.network(state, *(x.unsqueeze(2) for x in team))
        return output.transpose(2, 3), after
