"""When the ticks of a motion are due: evenly, or in step with the poses that they are made of.

Cameras give a pose each 33 ms; ticks that run freely beside them leave each pose lying for half a tick on average. In
step, the pose comes shortly before the tick that is made of it, and a tick may be made as soon as its pose is there:
planner and guard still get the instant at which it was due, so that the arm's motion stays even.

The arm does a tick's move in `tick`; the time between two ticks may be a little longer, never shorter, as the arm's
queue would fill up. So a tick that is to be in step has to be a hundredth shorter than its share of the time between
two poses (`tick_in_step`): phase is gained and lost within that.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from statistics import median

MARGIN = 0.01  # share of a tick by which it is shorter: 10 ms of phase are gained in a second
EASE = 0.001, 0.03  # least and greatest share by which the time between two ticks is longer than one
GAIN = 0.05  # share of the phase that is made good in a tick
MEMORY = 0.1  # share of a new arrival in the mean phase: ten arrivals, a third of a second
STEADY = 0.5  # length of the mean phase from which arrivals count as regular: half a tick of spread gives 0.6
LEAD = 0.25  # share of a tick by which a pose is to come before its tick: what tracking takes longer now and then
LONGEST = 5.0  # mean intervals between two poses, beyond which it is a new beginning
EARLY = 0.5  # share of a tick by which a tick may be made before it is due, where its pose is there


def tick_in_step(longest: float, interval: float, shortest: float) -> float:
    """The tick, s, of which a whole number goes into the `interval`, s, between two poses, or the other way round.

    No tick is longer than `longest`, s; where that makes it less than `shortest`, s, it is `longest`: out of step.
    """
    if not interval > 0:
        return longest
    share = interval * (1 - MARGIN)
    tick = share / math.ceil(share / longest) if share > longest else share * math.floor(longest / share)
    return tick if tick >= shortest else longest


def own_interval(between: Sequence[float]) -> float:
    """The time, s, between two frame sets as cameras make them, from those between the sets that came; NaN of none.

    Where a set was lost on the way, the time to the next is a multiple: of a busy beginning that can be most of them.
    """
    if not between:
        return math.nan
    least = sorted(between)[len(between) // 4]  # a quarter came one after the other, or nothing can be told
    return median(each / max(round(each / least), 1) for each in between) if least > 0 else math.nan


class Rhythm:
    """The instants of ticks of `tick` s that run freely, a share of `ease` apart beyond that. due: s, the next one."""

    def __init__(self, tick: float, ease: float, now: float) -> None:
        self.tick, self.due = tick, now
        self._ease = ease

    def opens(self, fresh: bool) -> float:
        """When the next tick may be made, s. fresh: whether a pose is there of which none was made."""
        return self.due

    def made(self, now: float) -> int:
        """The tick that was due is made, and it is `now`, s; how many are left out, as their time has passed."""
        period = self._period()
        missed = max(int((now - self.due) / period) - 1, 0)
        self.due += (1 + missed) * period
        return missed

    def _period(self) -> float:
        return self.tick * (1 + self._ease)


class InStep(Rhythm):
    """The instants of ticks that follow the arrival of poses where these come regularly, and run freely where not."""

    def __init__(self, tick: float, ease: float, now: float) -> None:
        super().__init__(tick, ease, now)
        self._mean = 0j  # of the arrivals' phases, each on the unit circle
        self._last, self._interval = -math.inf, tick

    def opens(self, fresh: bool) -> float:
        """When the next tick may be made: when it is due, or somewhat before where no newer pose will come for it."""
        return self.due - (EARLY * self.tick if fresh and self._last + self._interval > self.due else 0.0)

    def arrived(self, at: float) -> None:
        """A pose has come at `at`, s."""
        if at - self._last < LONGEST * self._interval:
            self._interval += MEMORY * (at - self._last - self._interval)
        elif math.isfinite(self._last):
            self._interval = at - self._last
        self._last = at
        phase = cmath.exp(2j * math.pi * (self.due - at) / self.tick)
        self._mean += MEMORY * (phase - self._mean)

    @property
    def lead(self) -> float:
        """By how much poses come before their tick, s, from 0 to a tick; NaN where they come irregularly."""
        if abs(self._mean) < STEADY:
            return math.nan
        return self.tick * ((cmath.phase(self._mean) / (2 * math.pi)) % 1.0)

    def _period(self) -> float:
        if math.isnan(lead := self.lead):
            return super()._period()
        ahead = (LEAD - lead / self.tick + 0.5) % 1.0 - 0.5  # share of a tick by which ticks come too soon
        low, high = EASE
        return self.tick * (1 + min(max(MARGIN + GAIN * ahead, low), high))
