"""Loops over tracks that are compiled (numba): dozens of short numpy calls a frame cost more than what they compute.

The types are stated, so that a loop is compiled once, when its module is first imported, and kept beside it for the
runs to come. The interpreter is free while one runs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(signature: str) -> Callable[[Function], Function]:
    """Compile a function for the given types; arrays must be contiguous and writable, as new ones are."""

    def decorate(function: Function) -> Function:
        return cast(Function, njit(signature, cache=True, nogil=True, error_model="numpy")(function))

    return decorate
