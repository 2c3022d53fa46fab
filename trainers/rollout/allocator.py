"""Settings of the C library's memory allocator."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT = 2**30


def keep_freed_memory() -> bool:
    """Lets the process keep freed blocks of up to a gigabyte instead of returning them.

    An update frees and allocates blocks of some megabytes dozens of times. Returned to the system,
    each is handed out again page by page, filled with zeros. The setting is process-wide.

    Returns:
        Whether it was applied; only glibc's allocator has this setting.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _KEPT) and mallopt(_M_TRIM_THRESHOLD, _KEPT))
