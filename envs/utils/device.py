"""Checks the name of a device."""

import torch

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown


def check_device(name: str) -> str:
    """Checks that a device is available and returns its name.

    Raises:
        UserError: it is not available; the message lists the available devices.
    """
    present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    available = device is not None and (
        str(device) == "cpu" or (device.type == "cuda" and (device.index or 0) < len(present) - 1)
    )
    if not available:
        raise UserError(f"device={shown(name)} is not available; known: {', '.join(present)}")
    return name
