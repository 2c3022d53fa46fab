"""No communication: methods 1 and 2 of the paper."""

from typing import ClassVar

from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase

from emberlink.comm.base import CommModule
from emberlink.envs.utils.validation import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class NoCommConfig:
    """No settings."""


class NoComm(CommModule):
    """Leaves the observations unchanged: 6 numbers per UAV (paper, section IV.C)."""

    config_type: ClassVar[type] = NoCommConfig
    every_step = False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict
