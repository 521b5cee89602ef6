"""The heap of a process that runs for hours."""

from __future__ import annotations

import ctypes
from collections.abc import Callable


def give_back() -> None:
    """Give free pages of the heap back to the system, where the C library knows how (glibc's malloc_trim).

    A bundle adjustment takes megabytes for a moment, and what is allocated meanwhile and stays keeps them from being
    given back: in 40,000 frame sets, of which none leaves more than it found, a process was measured to grow by 11 MB.
    """
    trim: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
