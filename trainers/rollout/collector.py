"""Collects transitions with TorchRL's Collector, from any step of a run."""

from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import Transform, TransformedEnv, step_mdp

from emberlink.policies.state import primer_of


class ResumableCollector:
    """Yields the rollouts of TorchRL's Collector, whose next input can be saved and restored.

    Exact resuming needs this input (observations, communication, state of the policy), which is
    not in the state of TorchRL's collector.

    Args:
        env: batch of environments with communication; the policy's state is added to it.
        decisions: decisions of the batch of environments in the whole run.
        rollout: decisions of a rollout; divides the decisions of an episode.
    """

    def __init__(
        self, env: TransformedEnv, policy: TensorDictModuleBase, *, decisions: int, rollout: int
    ):
        self.decisions, self.rollout, self.made = decisions, rollout, 0
        primer: Any = primer_of(policy)
        if not primer.primers.is_empty():
            env.append_transform(primer)
        self._resets = _Resets()
        env.append_transform(self._resets)
        self._collector = Collector(
            env,
            policy,
            frames_per_batch=env.batch_size.numel() * rollout,
            total_frames=-1,  # `made` counts, from where the run was resumed
            use_buffers=False,  # a rollout is the caller's, and needs no copy
            return_same_td=True,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self._last: Any = None
        """the last time step of the last rollout"""

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields rollouts, batch size [environments, rollout]."""
        rollouts = iter(self._collector)
        while self.made < self.decisions:
            rollout = next(rollouts)
            self.made += self.rollout
            self._last = rollout[:, -1]
            yield rollout

    @property
    def carried(self) -> TensorDictBase:
        """The input of the next decision, between two rollouts."""
        first = self._resets.last
        if self._last is None or self._last["next", "done"].any():  # all environments end together
            return first
        following: Any = step_mdp(self._last)
        return following.select(*first.keys(True, True))

    def restore(self, carried: TensorDictBase, made: int) -> None:
        """Continues from an earlier value of `carried`, after some decisions of the run."""
        self._resets.instead = carried
        self._collector.reset()
        self._last, self.made = None, made


class _Resets(Transform):
    """Keeps the last reset, and replaces the next one by another TensorDict if told to."""

    def __init__(self) -> None:
        super().__init__()
        self.last: Any = None
        self.instead: TensorDictBase | None = None

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.instead is not None:
            tensordict_reset, self.instead = tensordict_reset.update(self.instead), None
        self.last = tensordict_reset.clone()
        return tensordict_reset
