"""The settings of the policies that hold for all learners."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.validation import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PolicyConfig:
    """Stores the settings of a policy's memory, its messages, and the time between decisions."""

    memory: str = "none"
    """name of a file in policies/networks/memory: none or gru"""
    units: Annotated[int, Field(ge=1, le=8192)] = 64
    """units of the memory `gru`"""
    message: str = "none"
    """name of a scheme of messages that are learned (policies/networks/messages.py): none, mean or
    attention"""
    message_size: Annotated[int, Field(ge=1, le=1024)] = 16
    """numbers of a learned message, of 8 bits each"""
    hold: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """steps for which an action is held; divides the horizon"""
    agent_index: bool = False
    """whether the networks also read which of the UAVs they act for"""
