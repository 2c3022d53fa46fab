"""Where freed memory goes."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT = 2**30


def keep_freed_memory() -> bool:
    """Lets the process keep blocks of up to a gigabyte that it frees, instead of giving them back.

    An update frees and takes blocks of some megabytes dozens of times; given back, each is handed
    out anew page by page, zeroed. It changes the whole process.

    Returns:
        Whether it could be done: glibc's allocator alone has it.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _KEPT) and mallopt(_M_TRIM_THRESHOLD, _KEPT))
