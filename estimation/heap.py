"""The heap of a process that runs for hours."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

TRIM_THRESHOLD, MMAP_THRESHOLD, MOST_ARENAS = -1, -3, -8  # as glibc's mallopt numbers what it is told


def give_back() -> None:
    """Give free pages of the heap back to the system, where the C library knows how (glibc's malloc_trim).

    A bundle adjustment takes megabytes for a moment, and what is allocated meanwhile and stays keeps them from being
    given back: in 40,000 frame sets, of which none leaves more than it found, a process was measured to grow by 11 MB.
    """
    trim: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_pages(room: int) -> None:
    """Keep up to `room` bytes of freed pages for what comes next, where the C library knows how (glibc's mallopt).

    A process that fills and frees the same few buffers again and again is else given fresh pages each time, which the
    system has to clear: half of what writing pictures costs.
    """
    _tell(MMAP_THRESHOLD, room)
    _tell(TRIM_THRESHOLD, room)


def share_pages() -> None:
    """Have threads that are begun from now on take their memory from one heap, where the C library knows how.

    Else each has a heap of its own (glibc), and each of them keeps what it needed most at any time: 26 MB of tracking
    three cameras, a part of it touched again only within hours, which looks like a leak.
    """
    _tell(MOST_ARENAS, 1)


def _tell(what: int, value: int) -> None:
    tell: Callable[[int, int], int] | None = getattr(ctypes.CDLL(None), "mallopt", None)
    if tell is not None:
        tell(what, value)
