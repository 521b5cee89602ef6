"""Loops over tracks that are compiled (numba): dozens of short numpy calls a frame cost more than what they compute.

The types are stated, so that a loop is compiled once, when its module is first imported, and kept beside it for the
runs to come. The interpreter is free while one runs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar, cast

from numba import njit

NEW: tuple[Literal["C"], Literal["W"]] = "C", "W"  # np.require's words for the layout that compiled functions take

Function = TypeVar("Function", bound=Callable[..., object])


REORDERED = {"reassoc", "contract", "nsz"}  # sums may be taken in parts, the same ones every time; nan stays nan


def compiled(signature: str, reordered: bool = False) -> Callable[[Function], Function]:
    """Compile a function for the given types; arrays must be contiguous and writable, as new ones are.

    reordered: long sums may be taken several terms at a time, which is many times faster. Runs on one machine give the
    same bits; another kind of processor may round otherwise.
    """

    def decorate(function: Function) -> Function:
        fast = REORDERED if reordered else False
        return cast(Function, njit(signature, cache=True, nogil=True, error_model="numpy", fastmath=fast)(function))

    return decorate
