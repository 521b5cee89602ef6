"""Work for each camera at the same time: OpenCV and compiled loops leave the interpreter free."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

CAMERAS = 3  # that a rig usually has; more of them wait for each other
_THREADS = ThreadPoolExecutor(CAMERAS, thread_name_prefix="camera")


def side_by_side(function: Callable[..., Result], *arguments: Iterable[object]) -> list[Result]:
    """As list(map(function, *arguments)); the function must not call this itself."""
    return list(_THREADS.map(function, *arguments))
