"""Holds each action for several steps."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from emberlink.envs import keys

HELD = (keys.AGENTS, "held")
"""float32 [..., 3]: the action of the last decision, carried from step to step"""


class Held(TensorDictModuleBase):
    """Lets a policy decide at every k-th step of an episode and repeats its actions in between.

    State that the policy carries, such as a memory or noise, changes only at decisions.
    Environments may be at different steps.

    Args:
        policy: writes ("agents", "action").
        steps: steps for which an action is held.
    """

    def __init__(self, policy: TensorDictModuleBase, steps: int):
        super().__init__()
        self.policy, self.steps = policy, steps
        reads: list[Any] = list(dict.fromkeys([*policy.in_keys, keys.STEP]))
        writes: list[Any] = [*policy.out_keys, HELD]
        self.in_keys, self.out_keys = reads, writes

    @property
    def module(self) -> nn.Module:
        """The networks of the policy."""
        module: Any = self.policy
        return module.module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        decides = tensordict.get(keys.STEP) % self.steps == 0
        held = tensordict.get(HELD, None)
        if held is None:
            decides = torch.ones_like(decides)
        elif not decides.is_cuda and not decides.any():  # on a GPU, the question would wait for it
            return tensordict.set(keys.ACTION, held)
        carried = {key: tensordict.get(key, None) for key in self.out_keys if key != keys.ACTION}
        acted = self.policy(tensordict)
        acted.set(HELD, acted.get(keys.ACTION))
        for key, before in carried.items():
            if before is not None:
                acted.set(key, _choose(decides, acted.get(key), before))
        return acted.set(keys.ACTION, acted.get(HELD))


def hold(policy: TensorDictModuleBase, steps: int) -> Any:
    """Returns a policy whose actions are held for a number of steps; itself for one step."""
    return policy if steps == 1 else Held(policy, steps)


def decisions(rollout: TensorDictBase, steps: int) -> TensorDictBase:
    """Returns a rollout with one transition per decision.

    A transition leads from the step of a decision to that of the next one; its reward is the sum
    over the steps in between.

    Args:
        rollout: batch size [environments, decisions * steps]; begins with a decision.
        steps: steps for which an action is held.
    """
    if steps == 1:
        return rollout
    first: Any = rollout[:, ::steps]
    last: Any = rollout.get("next")[:, steps - 1 :: steps]
    reward: Tensor = rollout.get(("next", *keys.REWARD)).unflatten(1, (-1, steps)).sum(2)
    return first.copy().set("next", last.copy().set(keys.REWARD, reward))


def _choose(decides: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Returns new values where environments decide, else old ones, [*batch, ...] each."""
    return torch.where(decides.view(*decides.shape, *[1] * (new.ndim - decides.ndim)), new, old)
