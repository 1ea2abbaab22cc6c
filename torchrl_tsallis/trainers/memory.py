"""Keeping freed memory in the process, which stacked training on a CPU needs."""

from __future__ import annotations

import ctypes
import sys

from torchrl_tsallis._checks import check_number

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # of malloc.h


def keep_freed_memory(megabytes: int = 256) -> bool:
    """Tells glibc to keep memory that is freed, rather than to give it back to the system and ask for it anew.

    By default a tensor of some megabytes is new memory each time, whose page faults cost more than what is computed in
    it. The setting is one of the whole process, so that nothing in this package makes it unasked.

    Args:
        megabytes: how much is asked for at once, and kept at least.

    Returns:
        Whether the setting was made; False where the C library is not glibc.

    Examples:
        >>> keep_freed_memory() in (True, False)
        True
    """
    check_number("megabytes", megabytes, low=0, high=2**11 - 1, integer=True)
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    # 32 MB is the largest threshold that glibc takes; larger tensors stay mapped one by one.
    settings = ((_MMAP_THRESHOLD, 2**25), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, megabytes * 2**20))
    return all(mallopt(name, value) == 1 for name, value in settings)
