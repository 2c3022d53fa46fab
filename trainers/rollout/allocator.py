"""Configures the C library's memory allocator."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT = 2**30


def keep_freed_memory() -> bool:
    """Makes the process keep freed blocks of up to 1 GiB instead of returning them to the system.

    An update frees and allocates blocks of some megabytes dozens of times. The system zeroes each
    returned page before it can be used again. The setting is process-wide.

    Returns:
        Whether the setting was applied; only glibc supports it.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _KEPT) and mallopt(_M_TRIM_THRESHOLD, _KEPT))
