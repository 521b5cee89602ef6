"""Work whose result comes into force a fixed number of frame sets after it was asked for, wherever it is done."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any, Generic, TypeVar

T = TypeVar("T")

DELAY = 3  # frame sets between the asking and the taking over, at least
READY = 0.3  # s that an adjustment may take, which is 0.2 s of a core: what is not ready by then is waited for


def sets_until_ready(interval: float) -> int:
    """The frame sets, `interval` s apart, in which a job is done on a machine that has other things to do too."""
    return max(math.ceil(READY / interval - 1e-6), DELAY) if interval > 0 else DELAY


class Deferred(Generic[T]):
    """One job at a time, in an executor or, without one, here when it is due: what follows from it is the same.

    delay: frame sets from the next asking on until what comes of it counts.
    """

    def __init__(self, executor: Executor | None = None, delay: int = DELAY) -> None:
        """executor: it may die."""
        self._executor, self.delay = executor, delay
        self._job: tuple[Callable[..., T | None], tuple[Any, ...]] | None = None
        self._future: Future[T | None] | None = None
        self._count = self._due = 0

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return self._job is not None

    def forget(self) -> None:
        """What is under way is no longer wanted."""
        self._job = self._future = None

    def ask(self, function: Callable[..., T | None], *arguments: Any) -> None:
        """Begin a job; function and arguments must survive pickling. Only when not busy."""
        assert self._job is None
        self._job, self._due = (function, arguments), self._count + self.delay
        self._future = None if self._executor is None else self._executor.submit(function, *arguments)

    def poll(self) -> T | None:
        """The result that is due now, if any; to be called once a frame set."""
        self._count += 1
        if self._job is None or self._count < self._due:
            return None
        (function, arguments), future = self._job, self._future
        self.forget()
        try:
            return function(*arguments) if future is None else future.result()
        except BrokenExecutor:  # slower here, but the same
            self._executor = None
            return function(*arguments)
