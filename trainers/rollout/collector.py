"""Collects transitions by stepping the environments with the exploring policy."""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from emberlink.policies.state import primer_of


class RolloutLoop:
    """Yields rollouts as TorchRL's Collector does, and shows the input of the next step.

    Exact resuming needs this input; TorchRL's collector neither returns nor takes it.

    Args:
        env: batch of environments with communication; the policy's state is added to it.
        policy: actors with exploration noise.
        total_steps: steps of the batch of environments in the whole run.
        rollout_steps: steps of a rollout.
    """

    def __init__(
        self,
        env: TransformedEnv,
        policy: TensorDictModuleBase,
        *,
        total_steps: int,
        rollout_steps: int,
    ):
        self.env, self.policy = env, policy
        self.total_steps, self.rollout_steps, self.step = total_steps, rollout_steps, 0
        primer: Any = primer_of(policy)
        if not primer.primers.is_empty():
            env.append_transform(primer)
        self.carried: TensorDictBase = env.reset()
        """the input of the next step: observations, communication, state of the policy"""
        self._keys = list(self.carried.keys(True, True))

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields rollouts, batch size [environments, rollout_steps]."""
        while self.step < self.total_steps:
            with torch.no_grad():
                steps: Any = [self._advance() for _ in range(self.rollout_steps)]
            first, *others = steps
            for later in others:  # a held action has no logarithm of its probability
                for key in set(first.keys(True, True)).difference(later.keys(True, True)):
                    later.set(key, torch.zeros_like(first.get(key)))
            self.step += self.rollout_steps
            rollout: Any = torch.stack(steps, 1)
            yield rollout

    def restore(self, carried: TensorDictBase, step: int) -> None:
        """Continues from an earlier value of `carried`, at a step of the run."""
        self.carried, self.step = carried, step

    def _advance(self) -> TensorDictBase:
        stepped, following = self.env.step_and_maybe_reset(self.policy(self.carried))
        self.carried = following.select(*self._keys)
        return stepped
