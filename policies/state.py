"""Declares the state that a policy carries from step to step, as TorchRL's GRUModule does.

A tensor is read under its key and written under ("next", key), from where `step_mdp` moves it.
Keys and sizes are declared in `in_keys`, `out_keys` and a primer, so that ParallelEnv, collectors
and `torch.export` keep the state.
"""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError

Key = tuple[str, str]


class Stateful(TensorDictModuleBase):
    """A part of a policy that carries tensors of UAVs, float32 [..., uavs, size], 0 at step 0.

    Args:
        uavs: number of UAVs.
        carries: key -> size of what this part itself carries.
        reads, writes: its other keys.
    """

    def __init__(self, uavs: int, carries: dict[Any, int], reads: Sequence[Any], writes: list[Any]):
        super().__init__()
        self.uavs, self.carries = uavs, carries
        state: list[Any] = [keys.STEP, *carries] if carries else []
        self.in_keys = list(dict.fromkeys([*reads, *state]))
        self.out_keys = [*writes, *map(written, carries)]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns a transform that adds the state to an environment, 0 after each reset."""
        return primer_of(self)

    def state(self, tensordict: TensorDictBase, key: Key) -> Tensor:
        """Returns a tensor of the state, 0 where an episode begins.

        Raises:
            UserError: the TensorDict lacks it, after the first step of an episode.
        """
        value, began = tensordict.get(key, None), tensordict.get(keys.STEP) == 0
        if value is not None:
            return value.masked_fill(began[..., None, None], 0.0)
        if not began.all():
            raise UserError(
                f"the policy carries {key} from step to step, and the TensorDict lacks it after "
                "the first step: append policy.make_tensordict_primer() to the environment, and "
                "carry it with step_mdp"
            )
        shape = *began.shape, self.uavs, self.carries[key]
        return torch.zeros(shape, dtype=torch.float32, device=began.device)


def written(key: Key) -> Any:
    """Returns the key under which the next value of a state is written."""
    return ("next", *key)


def primer_of(policy: nn.Module) -> TensorDictPrimer:
    """Returns a transform that adds the state of all parts of a policy to an environment."""
    parts = [part for part in policy.modules() if isinstance(part, Stateful)]
    specs: dict[str, Any] = {
        name: Unbounded(torch.Size((part.uavs, size)), dtype=torch.float32)
        for part in parts
        for (_, name), size in part.carries.items()
    }
    agents = {keys.AGENTS: Composite(specs, shape=torch.Size([parts[0].uavs]))} if specs else {}
    return TensorDictPrimer(Composite(agents), expand_specs=True)
