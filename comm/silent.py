"""No communication: methods 1 and 2 of the paper."""

from typing import ClassVar

from emberlink.envs import keys
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase

from .base import CommModule


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class SilentConfig:
    """There is nothing to set."""


class Silent(CommModule):
    """Leaves every UAV with its own 6 numbers (paper, section IV.C)."""

    config_type: ClassVar[type] = SilentConfig
    in_keys: ClassVar = [keys.OBSERVATION]
    out_keys: ClassVar = [keys.OBSERVATION]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict
