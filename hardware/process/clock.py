"""The clock, the only file that knows what time it is; when ticks are due, how late they come, how even the machine is.

Cameras give a pose each 33 ms. Ticks that run freely beside them leave each pose waiting for half a tick on average.
Locked to the poses, a tick comes shortly after its pose, or as soon as the pose is there; planner and guard get the
instant at which its move will begin, which is even as long as the arm's queue holds. The arm does a tick's move in
`tick` s. The time between two ticks may be a little longer, never shorter, as the arm's queue would fill up. So a
locked tick is one per cent shorter than its share of the time between two poses (`tick_in_step`), which leaves room to
correct the phase.

A virtual machine, which shares its memory with others, may take ten times as long for the same work for some tens of
milliseconds. Neither load nor priority shows that, and no priority helps: `measure_evenness` times the same small work
again and again.

`WallClock` and `SimClock` are interchangeable. numpy is loaded where it is needed: the command line has no time for it.
"""

from __future__ import annotations

import cmath
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from estimation.se3 import Array


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


TICK_SHORTENING = 0.01  # share of a tick by which it is shorter: 10 ms of phase are gained in a second
EASE_RANGE = 0.001, 0.03  # least and greatest share by which the time between two ticks is longer than one
PHASE_GAIN = 0.05  # share of the phase that is made good in a tick
PHASE_MEMORY = 0.1  # share of a new arrival in the mean phase: ten arrivals, a third of a second
MIN_PHASE_LENGTH = 0.5  # length of the mean phase from which arrivals count as regular: half a tick of spread gives 0.6
TARGET_LEAD = 0.25  # share of a tick by which a pose is to come before its tick, as tracking sometimes takes longer
MAX_GAP_INTERVALS = 5.0  # mean intervals between two poses, beyond which it is a new beginning
MAX_EARLY_SHARE = 0.5  # share of a tick by which a tick may be made before it is due, where its pose is there


def tick_in_step(longest: float, interval: float, shortest: float) -> float:
    """The tick, s, of which a whole number goes into the `interval`, s, between two poses, or the other way round.

    No tick is longer than `longest`, s; where that makes it less than `shortest`, s, it is `longest`: out of step.
    """
    if not interval > 0:
        return longest
    share = interval * (1 - TICK_SHORTENING)
    tick = share / math.ceil(share / longest) if share > longest else share * math.floor(longest / share)
    return tick if tick >= shortest else longest


def own_interval(intervals: Sequence[float]) -> float:
    """The cameras' own time between frame sets, s, from the `intervals` between sets that came; NaN of none.

    Where a set was lost on the way, the time to the next is a multiple: of a busy beginning that can be most of them.
    """
    if not intervals:
        return math.nan
    from statistics import median  # which a command line does not need for its help

    quartile = sorted(intervals)[len(intervals) // 4]  # a quarter came one after the other, or nothing can be told
    return median(each / max(round(each / quartile), 1) for each in intervals) if quartile > 0 else math.nan


class TickSchedule:
    """The instants of ticks of `tick` s that run freely, a share of `ease` apart beyond that. due: s, the next one."""

    def __init__(self, tick: float, ease: float, now: float) -> None:
        self.tick, self.due = tick, now
        self._ease = ease

    def opens(self, fresh: bool) -> float:
        """When the next tick may be made, s. fresh: whether a pose is there of which none was made."""
        return self.due

    def advance(self, now: float) -> int:
        """The tick that was due is made, and it is `now`, s; how many are left out, as their time has passed."""
        period = self._period()
        missed = max(int((now - self.due) / period) - 1, 0)
        self.due += (1 + missed) * period
        return missed

    def _period(self) -> float:
        return self.tick * (1 + self._ease)


class PoseLockedSchedule(TickSchedule):
    """The instants of ticks that follow the arrival of poses where these come regularly, and run freely where not."""

    def __init__(self, tick: float, ease: float, now: float) -> None:
        super().__init__(tick, ease, now)
        self._mean = 0j  # of the arrivals' phases, each on the unit circle
        self._last, self._interval = -math.inf, tick

    def opens(self, fresh: bool) -> float:
        """When the next tick may be made: when it is due, or somewhat before where no newer pose will come for it."""
        return self.due - (MAX_EARLY_SHARE * self.tick if fresh and self._last + self._interval > self.due else 0.0)

    def arrived(self, at: float) -> None:
        """A pose has come at `at`, s."""
        if at - self._last < MAX_GAP_INTERVALS * self._interval:
            self._interval += PHASE_MEMORY * (at - self._last - self._interval)
        elif math.isfinite(self._last):
            self._interval = at - self._last
        self._last = at
        phase = cmath.exp(2j * math.pi * (self.due - at) / self.tick)
        self._mean += PHASE_MEMORY * (phase - self._mean)

    @property
    def lead(self) -> float:
        """By how much poses come before their tick, s, from 0 to a tick; NaN where they come irregularly."""
        if abs(self._mean) < MIN_PHASE_LENGTH:
            return math.nan
        return self.tick * ((cmath.phase(self._mean) / (2 * math.pi)) % 1.0)

    def _period(self) -> float:
        if math.isnan(lead := self.lead):
            return super()._period()
        ahead = (TARGET_LEAD - lead / self.tick + 0.5) % 1.0 - 0.5  # share of a tick by which ticks come too soon
        low, high = EASE_RANGE
        return self.tick * (1 + min(max(TICK_SHORTENING + PHASE_GAIN * ahead, low), high))


LATENESS_BIN, LATENESS_BINS = 1e-4, 1000  # s of a bin, and how many: a tenth of a second
TAIL_STEP, TAIL_BINS = 1.02, 600  # ratio of two bins beyond that, and how many: good to 2 % up to 10^5 times as far


class Histogram:
    """Counts of values from 0 on, of lateness, s, unless said otherwise. most: the largest value.

    counts: of even bins; the last one counts all that is larger, which is counted by itself in bins that become wider,
    so that a percentile is never cut off where the even bins end.
    """

    def __init__(self, width: float = LATENESS_BIN, bins: int = LATENESS_BINS) -> None:
        """width: of an even bin."""
        import numpy as np

        self.width, self.counts = width, np.zeros(bins, np.int64)
        self.count, self.most = 0, 0.0
        self._tail = np.zeros(TAIL_BINS, np.int64)  # of what lies in the last even bin and beyond
        self._end = (bins - 1) * width  # where that begins

    def add(self, value: float) -> None:
        """Count a value."""
        index = min(int(max(value, 0.0) / self.width), len(self.counts) - 1)
        self.counts[index] += 1
        if index == len(self.counts) - 1:
            step = math.log(max(value / self._end, 1.0)) / math.log(TAIL_STEP) if self._end > 0 else 0.0
            self._tail[min(int(step), TAIL_BINS - 1)] += 1
        self.count += 1
        self.most = max(self.most, value)

    def percentile(self, share: float) -> float:
        """What `share` percent of the values do not exceed, rounded up to a bin, `most` at most; NaN of none."""
        import numpy as np

        if not self.count:
            return math.nan
        rank, summed = max(share / 100 * self.count, 1.0), np.cumsum(self.counts)
        index = int(np.searchsorted(summed, rank))
        if index < len(self.counts) - 1:
            return (index + 1) * self.width
        below = int(summed[-2]) if len(summed) > 1 else 0
        step = int(np.searchsorted(np.cumsum(self._tail), rank - below))
        return min(self._end * TAIL_STEP ** (step + 1), self.most)

    @property
    def summary(self) -> dict[str, float]:
        """Median, 95 % and largest; NaN of none."""
        most = self.most if self.count else math.nan
        return {"p50": self.percentile(50), "p95": self.percentile(95), "max": most}


PROBE_CALLS = 20  # of each kind in a piece of work: a quarter of a millisecond, a fraction of a tick of the motion
SLOW_RATIO = 3.0  # times the usual


@dataclass(frozen=True, slots=True)
class Evenness:
    """How evenly this machine works: the time that equal pieces of work take."""

    usual: float  # s, median of the pieces
    largest: float  # s
    slow: float  # share of the time spent in pieces that took more than SLOW_RATIO usual ones

    def __str__(self) -> str:
        """In words."""
        usual, largest = 1000 * self.usual, 1000 * self.largest
        share = f"{100 * self.slow:.1f} %"
        return f"{usual:.2f} ms of work took {largest:.0f} ms at the worst; {share} of the time work was slow"


def measure_evenness(clock: Clock, pieces: int) -> Evenness:
    """Do so many pieces of work, one after the other. The process should have nothing else to do."""
    import numpy as np

    rng = np.random.default_rng(0)
    small, batch = rng.random((6, 6)) + 6 * np.eye(6), rng.random((50, 4, 4))
    durations = np.empty(pieces)
    for k in range(pieces):
        start = clock.now()
        for _ in range(PROBE_CALLS):
            np.linalg.inv(small)
            batch @ batch
            np.concatenate([small, small])
        durations[k] = clock.now() - start
    return evenness_from_times(durations)


def evenness_from_times(durations: Array) -> Evenness:
    """The evenness of pieces with `durations` (N,), s."""
    import numpy as np

    usual, total = float(np.median(durations)), float(durations.sum())
    slow = float(durations[durations > SLOW_RATIO * usual].sum())
    return Evenness(usual, float(durations.max()), slow / total if total > 0 else 0.0)
