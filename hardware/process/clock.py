"""The clock: the only file that knows what time it is. `WallClock` and `SimClock` are interchangeable."""

from __future__ import annotations

import math
import os
import time
from typing import Protocol


def utc_now() -> float:
    """The time of day: s since 1970, UTC, or what SOURCE_DATE_EPOCH says, by which two runs give the same bytes."""
    try:
        return float(os.environ["SOURCE_DATE_EPOCH"])
    except (KeyError, ValueError):
        return time.time()


class Clock(Protocol):
    """What loops need of time: now, in s, and to wait."""

    def now(self) -> float:
        """Instant, s; never goes back."""
        ...

    def wait_until(self, instant: float) -> None:
        """Return once `now()` is at least `instant`, s; at once if it already is."""
        ...


class WallClock:
    """The machine's monotonic clock, which camera drivers stamp by as well."""

    def now(self) -> float:
        """Instant, s since an arbitrary one."""
        return time.monotonic()

    def wait_until(self, instant: float) -> None:
        """Sleep until `instant`, s."""
        while (left := instant - time.monotonic()) > 0:
            time.sleep(left)


class CpuClock:
    """The calling thread's processor time: what its work costs, however busy the machine is with others'."""

    def now(self) -> float:
        """Instant, s since an arbitrary one."""
        return time.thread_time()


class ProcessorClock:
    """This process's processor time in all its threads: what work costs, however busy the machine is with others'."""

    def now(self) -> float:
        """Instant, s since an arbitrary one."""
        return time.process_time()


class SimClock:
    """A clock that moves only when it is waited for."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Instant, s."""
        return self._now

    def wait_until(self, instant: float) -> None:
        """Move on to `instant`, s, at once."""
        assert not math.isnan(instant)
        self._now = max(self._now, instant)


class WatchedClock:
    """A clock that remembers. begun: its first instant, s, None before. longest: s that nobody looked at it."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.begun: float | None = None
        self.longest, self._last = 0.0, math.inf

    def now(self) -> float:
        """Instant, s."""
        now = self._clock.now()
        self.begun = now if self.begun is None else self.begun
        self.longest, self._last = max(self.longest, now - self._last), now
        return now

    def wait_until(self, instant: float) -> None:
        """Wait until `instant`, s."""
        self._clock.wait_until(instant)
