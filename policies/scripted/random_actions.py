"""A scripted policy of random actions."""

from tensordict import TensorDictBase

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.policies.scripted.base import Scripted


class RandomActions(Scripted):
    """Draws every component of every action uniformly from [-1, 1]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.get(keys.POSITION).shape
        unit = counter_rng.uniform(
            self.step_key(tensordict, Use.SCRIPTED_ACTION), shape[-2] * shape[-1]
        )
        return tensordict.set(keys.ACTION, (2 * unit - 1).view(shape))
