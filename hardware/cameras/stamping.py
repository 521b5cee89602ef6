"""When a frame was exposed: by its driver's time stamp, its stream's, or its arrival, with a phase-locked loop.

A device that stamps by a clock of its own has that clock mapped to the machine's.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from perception.frames import StampedBy

PLL_BEATS = 30  # beats by which phase and period are smoothed: a second of a webcam
# of a period after the expected beat: later, a beat is skipped rather than late (2 %, sigma 5 of 33 ms)
SKIP_AFTER = 0.6
MIN_BEAT_GAP = 0.4  # of a period after the last beat: a sooner instant is no beat
PAUSE_BEATS = 10  # without an instant, after which the phase starts again
PERIOD_INSTANTS = 10  # from which a period is estimated
CHANGE_INSTANTS = 20  # from which a change of the period is detected
PERIOD_CHANGE = 0.25  # relative: twice the error of the median of so many steps with sigma 7 of 33 ms
MAX_PULL, PULL_AFTER_BEATS = 2.0, 10  # bound of one residual in RMS jitters (Huber), once so many beats are known
MIN_PERIOD = 0.004  # s: no camera is faster; a backlog comes faster
MAX_DRIVER_LAG = 1.0  # s: four buffers of 4 Hz; an older driver stamp is by another clock
DELAY_WINDOW = 60  # frames whose least delay is taken for the transport's: two seconds of a webcam
EARLIEST_ONE_IN = 10  # frames arrive sooner than the transport delay that is assumed without any stamps
MAX_DELAY_CHANGE = 0.01  # s between the least delays of both halves of the window: the stream's clock runs as ours
CLOCK_BIN, CLOCK_BINS = 1.0, 60  # s, of which the surest reading is kept; so many, as temperature changes a rate
DRIFT_BINS = 5  # from which a device clock's rate is estimated; before, it is as ours
MAX_DRIFT = 2e-4  # of a quartz: 50 ppm each, aged and warm; more is no rate but a change of load
MIN_ARRIVALS = 10  # of which the earliest is believed: one may be late by what else the machine does
CLOCK_STEP = 1.0  # s: a reading farther off says that the device's clock was set anew


@dataclass(frozen=True, slots=True)
class Beat:
    """An instant on the steady beat."""

    steady: float  # s, without jitter
    count: int  # periods since the last beat; 0: no new beat


class PhaseLockedLoop:
    """Follows instants (s) of a steady period, some off by up to half of it, some missing.

    The gains are those of a line fit through all beats, fixed from PLL_BEATS beats on (Brookner, Tracking and Kalman
    Filtering Made Easy, 1.3). A lasting change of the period is adopted.
    """

    def __init__(self, period: float | None = None) -> None:
        """period: s; None: estimated from the first PERIOD_INSTANTS instants, which are passed on as they are."""
        self.period, self.missed = period, 0
        self._beats = 0  # that determine the phase
        self._known = PERIOD_INSTANTS if period else 0  # so many more determine the period
        self._grid, self._off = -np.inf, 0.0
        self._instants: deque[float] = deque(maxlen=CHANGE_INSTANTS)

    @property
    def jitter(self) -> float:
        """RMS distance of the instants from the steady beat, s."""
        return float(np.sqrt(self._off))

    def __call__(self, instant: float) -> Beat:
        """Take the next instant, s, not before the last one; steady instants never decrease either."""
        if self.period and self._instants and instant - self._instants[-1] > PAUSE_BEATS * self.period:
            self._beats = 0
        self._instants.append(instant)
        if self._is_due(self.period) and self._find():
            return Beat(self._grid, 1)
        if self.period is None or self._beats == 0:
            self._grid, self._beats = max(instant, self._grid), 1
            return Beat(self._grid, 1)
        return self._follow(instant, self.period)

    def _is_due(self, period: float | None) -> bool:
        """Whether the period is to be estimated: for the first time, or as most of the last steps agree on another."""
        if period is None:
            return len(self._instants) >= PERIOD_INSTANTS
        if len(self._instants) < CHANGE_INSTANTS:
            return False
        steps = np.diff(self._instants)
        median = max(float(np.median(steps)), MIN_PERIOD)
        alike = np.mean(np.abs(steps - median) < PERIOD_CHANGE / 2 * median) > 0.5
        return bool(alike) and abs(median / period - 1) > PERIOD_CHANGE

    def _find(self) -> bool:
        """Fit a line through the last instants, numbered by their median step; False if there is none."""
        instants = np.array(self._instants)[-PERIOD_INSTANTS:]
        steps = np.diff(instants)
        counts = np.append(0, np.cumsum(np.round(steps / max(float(np.median(steps)), MIN_PERIOD))))
        if np.ptp(instants) < MIN_PERIOD * (PERIOD_INSTANTS - 1) or counts[-1] == 0:
            return False
        slope, start = np.polyfit(counts, instants - instants[0], 1)
        self.period, self._beats, self._known = float(slope), PERIOD_INSTANTS, 0
        self._grid = max(self._grid, float(instants[0] + start + slope * counts[-1]))
        return True

    def _follow(self, instant: float, period: float) -> Beat:
        lead = (instant - self._grid) / period
        if lead < MIN_BEAT_GAP:
            return Beat(self._grid, 0)
        count = max(1, int(np.ceil(lead - SKIP_AFTER)))
        off = self._bounded(instant - self._grid - count * period)
        k = min(self._beats, PLL_BEATS)
        instants = min(self._beats + self._known, PLL_BEATS)
        self._grid += count * period + off * 2 * (2 * k + 1) / ((k + 1) * (k + 2))
        self.period = period + off / count * 6 / ((instants + 1) * (instants + 2))
        self._off += (off * off - self._off) / k
        self._beats, self.missed = self._beats + 1, self.missed + count - 1
        return Beat(self._grid, count)

    def _bounded(self, off: float) -> float:
        """A residual, s, with Huber's bound: a delayed instant does not move the phase."""
        limit = MAX_PULL * self.jitter + 1e-4 if self._beats > PULL_AFTER_BEATS else np.inf
        return float(np.clip(off, -limit, limit))


@dataclass(frozen=True, slots=True)
class ClockReading:
    """A device's clock beside ours."""

    device: float  # s, by the device, since its first reading
    ahead: float  # s, ours less the device's
    doubt: float  # s, by which that may be too much: half a round trip, or inf where only an arrival is known


class DeviceClock:
    """Maps a device's stamps to our clock: offset and rate, by arrivals that come late or by readings there and back.

    An arrival is late by an unknown delay of at least 0, so the line runs below all of them (Moon, Skelly and Towsley,
    Estimation and Removal of Clock Skew, 1999): what is constant of the delay stays in it. A reading there and back
    bounds the offset on both sides; once there are any, arrivals no longer count.
    """

    def __init__(self) -> None:
        self._begin, self._bins, self._line = 0, deque[ClockReading](maxlen=CLOCK_BINS), (0.0, 0.0)
        self._latched, self._count = False, 0

    @property
    def drift(self) -> float:
        """By how much our clock runs faster than the device's, of 1; nan before it is known."""
        return self._line[1] if len(self._bins) >= DRIFT_BINS else math.nan

    @property
    def doubt(self) -> float:
        """Half the shortest round trip of the last minute, s; nan where the device's clock cannot be read."""
        return min(one.doubt for one in self._bins) if self._latched else math.nan

    def arrived(self, device: int, arrival: float) -> None:
        """Take a stamp, ns by the device, of what arrived at `arrival`, s by us."""
        if not self._latched:
            self._take(device, arrival, math.inf)

    def latched(self, device: int, sent: float, received: float) -> None:
        """Take a reading, ns, of the device's clock that was asked for and answered at instants of ours, s."""
        if not self._latched:
            self._bins.clear()
        self._latched = True
        self._take(device, (sent + received) / 2, (received - sent) / 2)

    def __call__(self, device: int) -> float:
        """Our instant, s, of a device's stamp, ns; nan before enough is known of its clock."""
        return self._mapped(device) if self._latched or self._count >= MIN_ARRIVALS else math.nan

    def _mapped(self, device: int) -> float:
        device_seconds = (device - self._begin) / 1e9
        return device_seconds + self._line[0] + self._line[1] * device_seconds

    def _take(self, device: int, ours: float, doubt: float) -> None:
        if self._bins and abs(self._mapped(device) - ours) > CLOCK_STEP:
            self._bins.clear()
        if not self._bins:
            self._begin, self._count = device, 0
        self._count += 1
        device_seconds = (device - self._begin) / 1e9
        reading = ClockReading(device_seconds, ours - device_seconds, doubt)
        if self._bins and device_seconds < self._bins[-1].device // CLOCK_BIN * CLOCK_BIN + CLOCK_BIN:
            if self._surer(reading, self._bins[-1]):
                self._bins[-1] = reading
                self._line = self._bounded(reading)
        else:
            self._bins.append(reading)
            self._line = self._fit()

    def _surer(self, new: ClockReading, old: ClockReading) -> bool:
        if self._latched:
            return new.doubt < old.doubt
        return self._excess(new) < self._excess(old)

    def _excess(self, reading: ClockReading) -> float:
        """How far a reading lies above the line, s."""
        return reading.ahead - self._line[0] - self._line[1] * reading.device

    def _bounded(self, reading: ClockReading) -> tuple[float, float]:
        """The line, lowered to an arrival that is below it; of readings there and back, fitted anew."""
        if self._latched:
            return self._fit()
        return self._line[0] + min(0.0, self._excess(reading)), self._line[1]

    def _fit(self) -> tuple[float, float]:
        """Offset, s, and rate of the line through, or below, the readings."""
        x, y = (np.array([getattr(one, key) for one in self._bins]) for key in ("device", "ahead"))
        slope = 0.0
        if len(self._bins) >= DRIFT_BINS:
            slope = float(np.polyfit(x, y, 1)[0]) if self._latched else _lower_slope(x, y)
        slope = float(np.clip(slope, -MAX_DRIFT, MAX_DRIFT))
        residual = y - slope * x
        return float(np.median(residual) if self._latched else residual.min()), slope


def _lower_slope(x: Array, y: Array) -> float:
    """Slope of the edge of the lower hull of points (N,), (N,) below their middle; x rises."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1 and (y[hull[-1]] - y[hull[-2]]) * (x[i] - x[hull[-2]]) >= (y[i] - y[hull[-2]]) * (
            x[hull[-1]] - x[hull[-2]]
        ):
            hull.pop()
        hull.append(i)
    vertex = next(k for k in range(1, len(hull)) if k == len(hull) - 1 or x[hull[k]] >= x.mean())
    a, b = hull[vertex - 1], hull[vertex]
    return float((y[b] - y[a]) / (x[b] - x[a]))


@dataclass(frozen=True, slots=True)
class FrameStamp:
    """When a frame was exposed."""

    stamp: float  # s, middle of the exposure
    steady: float  # s, the same without jitter, for pairing; of an exact stamp itself
    by: StampedBy
    lag: float  # s, from stamp to arrival
    fresh: bool  # False for a frame of a backlog, whose instant is unknown


class FrameStamper:
    """Stamps one camera's frames. period: s, None if unknown."""

    def __init__(self, period: float | None = None) -> None:
        self.exposure = 0.0  # s, 0: unknown
        self._by: StampedBy = "arrival"
        self._delays: deque[float] = deque(maxlen=DELAY_WINDOW)  # s, behind the stream's clock
        self._late: deque[float] = deque(maxlen=DELAY_WINDOW)  # s, behind the steady beat
        self.pll = PhaseLockedLoop(period)

    def __call__(self, arrival: float, position: float, clocked: bool, exact: bool = False) -> FrameStamp:
        """Stamp the frame that arrived at `arrival` (s).

        position: s, the source's own stamp (nan: none). clocked: whether that may be by the machine's own clock. exact:
        whether it then has no jitter, so that a camera that exposes off its beat does so.
        """
        by, instant = self._source(arrival, position, clocked)
        if by != self._by:
            self._by, self.pll = by, PhaseLockedLoop(self.pll.period)
        beat = self.pll(instant)
        if by == "arrival":
            self._late.append(arrival - beat.steady)
            instant = min(arrival, beat.steady + sorted(self._late)[len(self._late) // EARLIEST_ONE_IN])
        middle = self.exposure / 2
        fresh = by != "arrival" or beat.count > 0
        steady = instant if by == "arrival" or exact else beat.steady
        return FrameStamp(instant - middle, steady - middle, by, arrival - instant + middle, fresh)

    def _source(self, arrival: float, position: float, clocked: bool) -> tuple[StampedBy, float]:
        if clocked and 0 <= arrival - position <= MAX_DRIVER_LAG:
            return "driver", position
        if clocked or math.isnan(position):
            return "arrival", arrival
        self._delays.append(arrival - position)
        return ("stream", position + min(self._delays)) if self._keeps_time() else ("arrival", arrival)

    def _keeps_time(self) -> bool:
        """Whether the stream's clock runs as ours: its least delay does not change."""
        delays, half = list(self._delays), DELAY_WINDOW // 2
        return len(delays) == DELAY_WINDOW and abs(min(delays[:half]) - min(delays[half:])) <= MAX_DELAY_CHANGE
