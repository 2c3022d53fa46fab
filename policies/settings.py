"""The settings of the policies that hold for all learners."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.validation import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PolicyConfig:
    """Stores the settings of a policy's memory and of the interval between its decisions."""

    memory: str = "none"
    """name of a file in policies/networks/memory: none or gru"""
    units: Annotated[int, Field(ge=1, le=8192)] = 64
    """units of the memory `gru`"""
    hold: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """steps for which an action is held; divides the horizon"""
    agent_index: bool = False
    """whether the networks also read which of the UAVs they act for"""
