"""What method 4 could do if learning were perfect at what its bonus asks for."""

from typing import ClassVar

from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.base import Scripted


class FollowTarget(Scripted):
    """Flies straight at the target that the network agrees on, altitude included."""

    recipe: ClassVar[str | None] = "consensus"

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.in_keys.append(keys.TARGET)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.fly(tensordict, tensordict.get(keys.TARGET))
