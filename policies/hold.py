"""Holds each action for several steps in an environment that is stepped one by one.

Training holds actions within the environment, see `WildfireEnv.hold`.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from emberlink.envs import keys
from emberlink.policies.state import Stateful, written

HELD = (keys.AGENTS, "held")
"""float32 [..., 3]: the action of the last decision, carried from step to step"""


class Held(Stateful):
    """Lets a policy decide at every k-th step of an episode and repeats its actions in between.

    State that the policy carries, such as a memory or noise, changes only at decisions.
    Environments may be at different steps.

    Args:
        policy: writes ("agents", "action").
        steps: steps for which an action is held.
    """

    def __init__(self, policy: Any, steps: int, uavs: int):
        super().__init__(uavs, {HELD: 3}, policy.in_keys, policy.out_keys)
        self.policy, self.steps = policy, steps
        self._inner: list[Any] = [key[1:] for key in policy.out_keys if key[0] == "next"]

    @property
    def module(self) -> nn.Module:
        """The networks of the policy."""
        return self.policy.module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        decides = tensordict.get(keys.STEP) % self.steps == 0
        before = {key: tensordict.get(key, None) for key in self._inner}
        held = self.state(tensordict, HELD)
        if not torch.compiler.is_compiling() and not decides.any():  # no networks
            for key, old in before.items():
                tensordict.set(written(key), old)
            return tensordict.set(written(HELD), held).set(keys.ACTION, held)
        acted = self.policy(tensordict)
        for key, old in before.items():
            if old is not None:
                acted.set(written(key), _choose(decides, acted.get(written(key)), old))
        action = _choose(decides, acted.get(keys.ACTION), held)
        return acted.set(written(HELD), action).set(keys.ACTION, action)


def held(policy: TensorDictModuleBase, steps: int, uavs: int) -> Any:
    """Returns a policy whose actions are held for a number of steps; itself for one step."""
    return policy if steps == 1 else Held(policy, steps, uavs)


def _choose(decides: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Returns new values where environments decide, else old ones, [*batch, ...] each."""
    return torch.where(decides.view(*decides.shape, *[1] * (new.ndim - decides.ndim)), new, old)
