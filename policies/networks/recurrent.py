"""The actor and critic of `stacked` with a memory between the encoder and the hidden layers.

The critic's memory reads observations alone, and the action is an input behind it, so the values
of other actions need no second pass. Actor and critic have separate memories (Ni, Eysenbach and
Salakhutdinov 2022, ICML).
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from emberlink.policies.networks.stacked import (
    StackedActor,
    StackedCritic,
    StackedNetwork,
    apply_layers,
    to_action,
    to_features,
    to_value,
)


class _Remembering(StackedNetwork):
    """The common part: it maps sequences of observations, [batch, uavs, decisions, ...]."""

    def recall(self, observations: Sequence[Tensor], missing: Tensor, burn_in: int) -> Tensor:
        """Returns the memory's features of the decisions after the burn-in.

        The memory is empty before the burn-in, and has no gradient in it (Kapturowski et al. 2019,
        ICLR).

        Args:
            observations: [batch, uavs, decisions, ...] each.
            missing: int64 [batch, uavs], the first decisions of a burn-in that are not part of it.
            burn_in: decisions of the burn-in.

        Returns:
            [groups, rows, decisions - burn_in, features].
        """
        batch = missing.shape
        following = self._encode([x[:, :, burn_in:] for x in observations], batch)
        state = self._empty(following)
        if burn_in:
            with torch.no_grad():
                past = self._encode([x[:, :, :burn_in] for x in observations], batch)
                state = self._prepare(past, self.grouping.split(missing, batch), state)
        return self.memory(following, state)[0]

    def _prepare(self, past: Tensor, missing: Tensor, state: Tensor) -> Tensor:
        """Returns the state after a burn-in.

        Args:
            past: the encoder's features, [groups, rows, decisions, features].
            missing: see `recall`; [groups, rows].
            state: of an empty memory, [groups, rows, size].
        """
        for decision, x in enumerate(past.split(1, 2)):
            _, state = self.memory(x, state)
            state = state.masked_fill((missing > decision).unsqueeze(-1), 0.0)
        return state

    def _encode(self, observations: Sequence[Tensor], batch: torch.Size) -> Tensor:
        """Returns the encoder's features, [groups, rows, decisions, features].

        Args:
            observations: [*batch, decisions, ...] each.
            batch: [..., uavs] or [..., teams * uavs].
        """
        dims = len(batch)
        if self._team:
            observations = [self.grouping.of_team(x, dims + 1, dims - 1) for x in observations]
        if self._indexed:
            first = self.grouping.with_index(observations[0].transpose(dims - 1, dims))
            observations = [first.transpose(dims - 1, dims), *observations[1:]]
        tensors = [self.grouping.split(x, batch) for x in observations]
        rows, decisions = tensors[0].shape[1:3]
        encoded = self.encoder([x.flatten(1, 2) for x in tensors])
        return encoded.unflatten(1, (rows, decisions))

    def _empty(self, encoded: Tensor) -> Tensor:
        return encoded.new_zeros(*encoded.shape[:2], self.memory.size)

    def _map(self, function: Callable[..., Tensor], layers: Sequence, x: Tensor) -> list[Tensor]:
        return apply_layers(function, layers, self._parts(x.flatten(1, 2)))

    def _join_sequences(self, parts: list[Tensor], batch: torch.Size, decisions: int) -> Tensor:
        """Joins the parts of a result: [*batch, decisions, features]."""
        x = parts[0] if parts[0].ndim == 3 else torch.stack(parts)
        joined = self.grouping.join(x.unflatten(1, (-1, decisions)).flatten(2), batch)
        return joined.unflatten(-1, (decisions, -1))


class RecurrentActor(StackedActor, _Remembering):
    """Maps sequences of observations to actions in [-1, 1]."""

    def forward(
        self, observations: Sequence[Tensor], missing: Tensor, burn_in: int, decisions: int
    ) -> Tensor:
        """Returns the actions of the last decisions, [batch, uavs, decisions, actions].

        Args:
            observations, missing, burn_in: see `recall`.
            decisions: number of the last decisions.
        """
        x = self.recall(observations, missing, burn_in)[:, :, -decisions:]
        return self._act(x, missing.shape)

    def step(self, observations: Sequence[Tensor], state: Tensor | None) -> tuple[Tensor, Tensor]:
        """Maps the observations of one decision.

        Args:
            observations: [*batch, uavs, ...] each.
            state: [*batch, uavs, size], from the decision before; None for an empty memory.

        Returns:
            Actions, [*batch, uavs, actions], and the new state, [*batch, uavs, size].
        """
        batch = observations[0].shape[: -self._dims]
        encoded = self._encode([x.unsqueeze(len(batch)) for x in observations], batch)
        before = self._empty(encoded) if state is None else self.grouping.split(state, batch)
        x, after = self.memory(encoded, before)
        return self._act(x, batch).squeeze(-2), self.grouping.join(after, batch)

    def _act(self, x: Tensor, batch: torch.Size) -> Tensor:
        parts = self._map(to_action, [*self._hidden_layers(), self.action], x)
        return self._join_sequences(parts, batch, x.shape[2])


class RecurrentCritic(StackedCritic, _Remembering):
    """Maps sequences of observations, and actions, to values."""

    def forward(
        self, observations: Sequence[Tensor], missing: Tensor, burn_in: int, action: Tensor
    ) -> Tensor:
        """Returns the values of the last decisions, [batch, uavs, decisions, 1].

        Args:
            observations, missing, burn_in: see `recall`.
            action: [batch, uavs, decisions, actions], of the last decisions.
        """
        batch, decisions = missing.shape, action.shape[2]

        def compute(observations: Sequence[Tensor]) -> list[Tensor]:
            x = self.recall(observations, missing, burn_in)[:, :, -decisions:]
            return self._map(to_features, self._hidden_layers(), x)

        first: Any = self.first
        features = self._cache.get(observations, first.weight, compute)
        actions = self._parts(self.grouping.split(action, batch).flatten(1, 2))
        values = apply_layers(to_value, [self.action, self.value], actions, features)
        return self._join_sequences(values, batch, decisions)
