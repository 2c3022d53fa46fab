"""What a communication module is, and the adaptor that puts one on an environment."""

from typing import Any, ClassVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.buffers import Buffers


class CommModule(Buffers, TensorDictModuleBase):
    """Rewrites the UAVs' observations from what they can hear of each other.

    A subclass in a file of its own, `comm/<name>.py`, is a new way to communicate: its file name
    is its name. It keeps no state of its own; what it must remember from step to step it writes
    under `memory_keys`, and finds it there at the next step.

    Args:
        world: the environment's constants.
        config: an instance of `config_type`.
    """

    config_type: ClassVar[type]
    """a pydantic dataclass: the settings that stand under `comm` in a recipe's YAML"""
    memory_keys: ClassVar[tuple[tuple[str, str], ...]] = ()
    """what is handed from one step to the next; all of it is in `specs`"""

    def __init__(self, world: WildfireConfig, config: Any):
        super().__init__()
        self.world, self.config = world, config
        own: list[Any] = [keys.OBSERVATION]
        self.in_keys, self.out_keys = own, own

    def specs(self, observation: Composite) -> Composite:
        """The observation spec of the environment with everything that `forward` writes."""
        return observation

    def start(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the memory that an episode begins with."""
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rewrites ("agents", "observation"), and the memory, of one moment."""
        raise NotImplementedError

    def shaping(self, before: TensorDictBase, after: TensorDictBase) -> Tensor | None:
        """What is added to the reward of the step between two moments, float32 [..., n], if any.

        Args:
            before: the moment on which the UAVs acted, as rewritten.
            after: the moment after the step, not yet rewritten.
        """
        return None


class Communication(Transform):
    """Puts a communication module on an environment.

    A transform and no part of the policy, so that the next observation, from which the value is
    bootstrapped, is rewritten exactly as the first is.
    """

    def __init__(self, module: CommModule):
        super().__init__()
        self.module = module

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.module(self.module.start(tensordict_reset))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        bonus = self.module.shaping(tensordict, next_tensordict)
        if bonus is not None:
            reward = next_tensordict.get(keys.REWARD) + bonus.unsqueeze(-1)
            next_tensordict.set(keys.REWARD, reward)
        for key in self.module.memory_keys:
            next_tensordict.set(key, tensordict.get(key))
        return self.module(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return self.module.specs(observation_spec.clone())
