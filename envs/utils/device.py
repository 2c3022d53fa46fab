"""Checks the name of a device."""

import torch

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown


def check_device(name: str) -> str:
    """Returns the name of a device that this machine has.

    Raises:
        UserError: the machine does not have it; the message lists the devices that it has.
    """
    present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    there = device is not None and (
        str(device) == "cpu" or (device.type == "cuda" and (device.index or 0) < len(present) - 1)
    )
    if not there:
        raise UserError(f"device={shown(name)} is not there; known: {', '.join(present)}")
    return name
