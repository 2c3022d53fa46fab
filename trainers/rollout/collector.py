"""Collects transitions with TorchRL's collector, or on a GPU without synchronisation."""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type, step_mdp

from emberlink.envs import keys
from emberlink.trainers.rollout.cuda_graphs import graphed


def make_collector(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    horizon: int,
    total_steps: int,
    rollout_steps: int = 1,
) -> "ResumableCollector | LockstepCollector":
    """Returns a collector of rollouts, batch size [environments, rollout_steps].

    Args:
        env: batch of environments with communication.
        policy: actors with exploration noise.
        horizon: steps of an episode.
        total_steps: steps of the batch of environments in the whole run.
        rollout_steps: steps of a rollout; must divide the horizon.
    """
    if torch.device(env.device or "cpu").type == "cuda":
        return LockstepCollector(
            env, policy, horizon=horizon, total_steps=total_steps, rollout_steps=rollout_steps
        )
    return ResumableCollector(env, policy, total_steps=total_steps, rollout_steps=rollout_steps)


class ResumableCollector(Collector):
    """TorchRL's collector with access to the TensorDict of the next step.

    Exact resuming needs this TensorDict, which TorchRL does not include in the collector's state.
    Arguments are those of `make_collector`.
    """

    def __init__(
        self, env: EnvBase, policy: TensorDictModuleBase, *, total_steps: int, rollout_steps: int
    ):
        envs = env.batch_size.numel()
        super().__init__(
            env,
            policy,
            frames_per_batch=envs * rollout_steps,
            total_frames=total_steps * envs,
            device=env.device,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        _add_policy_state(self._carrier, env, policy)

    @property
    def carried(self) -> TensorDictBase:
        """The input of the next step without the action: observations, communication, noise."""
        return self._carrier.exclude(keys.ACTION)

    def restore(self, carried: TensorDictBase, step: int) -> None:
        """Continues from an earlier value of `carried`, at a step of the run."""
        self._carrier = carried
        self._frames = step * carried.numel()


def _add_policy_state(
    tensordict: TensorDictBase, env: EnvBase, policy: TensorDictModuleBase
) -> None:
    """Adds zeros for the tensors that the policy carries from step to step, such as its noise."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        acted = policy(tensordict.copy())
    for key in set(policy.out_keys) - set(env.action_keys):
        tensordict.set(key, torch.zeros_like(acted.get(key)))


class LockstepCollector:
    """Yields rollouts as TorchRL's Collector does, but never synchronises with the device.

    All environments are reset together and all episodes last for the horizon, so the ends of
    episodes are known without reading a tensor. A rollout is valid until the next one is yielded.
    Arguments are those of `make_collector`.
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
        _add_policy_state(self._td, env, policy)
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
        """The input of the next step without the action: observations, communication, noise."""
        return self._td.exclude(keys.ACTION)

    def restore(self, carried: TensorDictBase, step: int) -> None:
        """Continues from an earlier value of `carried`, at a step of the run.

        Tensors are written in place, because a CUDA graph reads them at their address.
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
