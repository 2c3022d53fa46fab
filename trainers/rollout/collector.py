"""Collects transitions of all environments, step by step."""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type, step_mdp

from emberlink.envs import keys

from .cuda_graphs import graphed


class StepCollector:
    """Yields rollouts as TorchRL's Collector does, but never waits for the device.

    All environments begin together and every episode lasts for the horizon, so the ends of episodes
    are known without reading a tensor. The TensorDict that the next step begins with can be read
    and replaced, which resuming bit for bit needs. A yielded rollout is valid until the next one.

    Args:
        env: environments side by side, with their communication.
        policy: the actors with exploration noise.
        horizon: steps of an episode.
        total_steps: steps of all environments, in the whole run.
        rollout_steps: steps in a yielded rollout; divides the horizon.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        *,
        horizon: int,
        total_steps: int,
        rollout_steps: int = 1,
    ):
        self.env, self.policy, self.horizon = env, policy, horizon
        self.total_steps, self.rollout_steps = total_steps, rollout_steps
        self.step = 0
        self._td: TensorDictBase = env.reset()
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            acted = policy(self._td.copy())
        for key in set(policy.out_keys) - set(env.action_keys):
            self._td.set(key, torch.zeros_like(acted.get(key)))
        self._advance = graphed(self._step, env.device or "cpu")

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields rollouts, batch size [environments, rollout_steps]."""
        while self.step < self.total_steps:
            if self.rollout_steps == 1:
                yield self._collect().unsqueeze(-1)
            else:
                steps: Any = [self._collect().clone() for _ in range(self.rollout_steps)]
                rollout: Any = torch.stack(steps, dim=1)
                yield rollout

    @property
    def carried(self) -> TensorDictBase:
        """The input of the next step but its action: observations, communication and noise."""
        return self._td.exclude(keys.ACTION)

    def restore(self, carried: TensorDictBase, step: int) -> None:
        """Continues from a TensorDict that `carried` gave, after so many steps of the run.

        The tensors are written in place, because a recorded CUDA graph reads them where they are.
        """
        self._td.update_(carried)
        self.step = step

    def _collect(self) -> TensorDictBase:
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            stepped = self._advance()
        self.step += 1
        if self.step % self.horizon == 0:
            self._td.update_(self.env.reset())
        return stepped

    def _step(self) -> TensorDictBase:
        stepped = self.env.step(self.policy(self._td.clone()))
        self._td.update_(step_mdp(stepped, keep_other=True))
        return stepped
