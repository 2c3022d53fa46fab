"""A scripted policy that follows the targets of method 4."""

from typing import ClassVar

from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.base import Scripted


class FollowTarget(Scripted):
    """Flies straight to the target that the consensus module gives, altitude included.

    It is the policy that earns the most heading bonus, and so shows the best that method 4 could
    learn from the bonus alone.
    """

    recipe: ClassVar[str | None] = "consensus"
    hears: ClassVar[bool] = True

    def __init__(self, env: WildfireEnv):
        super().__init__(env)
        self.in_keys.append(keys.TARGET)

    def bytes_sent(self, tensordict: TensorDictBase) -> None:
        """Returns None: the consensus module sends the messages."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.fly(tensordict, tensordict.get(keys.TARGET))
