"""The arm's answers compared with its queue's model: measured lag, deviation from its path, whether it is at rest.

Without answers all of this is unknown. Answers have no checksum, so a single one proves nothing: the deviation is the
smaller one of the last two answers, which one garbled answer cannot raise.

The lag is estimated as long as the arm answers. A backlog in the arm's queue, as after a stall, only adds to the delay,
until the queue runs empty. So the lag is taken from the quickest tenth of the last stretches of motion; the rest of a
delay is a backlog, and counts as motion in flight.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from estimation.se3 import Array
from hardware.arm.driver import Reply, ReplyKind
from hardware.arm.profile import LinkSettings
from hardware.arm.protocol import unit
from hardware.arm.queue import ArmQueue

MIN_ANSWERS = 3  # answers before their absence is a fault: noise that looks like an answer comes alone
SPEED_SPAN = 0.05  # s over which the set-point's speed is computed; the slowest answer period of a public driver
LAG_BLOCK = 1600.0  # (mm/s)^2, sum of a stretch of motion: four answers at 20 mm/s, whose rounding gives 1 to 2 ms
MAX_LAG_BLOCKS = 64  # remembered: 10 to 15 s of motion at 20 mm/s
QUICK_SHARE = 0.1  # of the stretches: the quickest ones, assumed to be without backlog
LAG_SPREAD = 0.006  # s: a stretch later than the quickest by more has a backlog; a few times the rounding
REST_TOLERANCE = 0.15, float(np.deg2rad(0.015))  # mm and rad between answers of an arm at rest: one count of rounding
ANSWER_ROUNDING = 0.5001 * np.repeat([unit(ReplyKind.PLACE), unit(ReplyKind.TOOL)], 3)  # mm and rad, by which it rounds
ON_WAY_TOLERANCE = 0.07  # mm, of an answer from the path: a little more than its rounding; a wider one detects later
REPEATED_LATE_SHARE = 0.6  # of the slack: an arm that is too slow exceeds it twice before it exceeds all of it once
MAX_MISSED_ANSWERS = 3  # answers: noise spoils one of them now and then, and the next may come late
REST_TIME = 0.2  # s without motion after which the arm is at rest: four of the slowest answers
RECALL_REST_TIME = 0.04  # s, the same after its queue was called back: two of the slowest answers that agree
MIN_LAG_SPEED = 2.0  # mm/s below which an answer says nothing about the lag
MIN_LAG_INFORMATION = 100.0  # (mm/s)^2, sum from which the lag counts as known: one answer at 10 mm/s


@dataclass(slots=True)
class _AnsweredAxes:
    """The last answer about one half of the axes: X Y Z, mm, or A B C, rad."""

    values: Array | None = None  # (3,)
    stamp: float = -math.inf  # s
    before: float = 0.0  # deviation of the answer before
    off: float = 0.0  # deviation, confirmed by two answers
    first: Array | None = None  # (3,) the first answer since the arm rests here
    since: float = math.inf  # s, when that came

    def take(self, values: Array, deviation: float, still: float, now: float) -> None:
        if self.first is None or np.abs(values - self.first).max() > still:
            self.first, self.since = values, now
        self.off = min(deviation, self.before)
        self.values, self.stamp, self.before = values, now, deviation


@dataclass(slots=True)
class ArmFeedback:
    """The answers so far, compared with the queue's model.

    A single answer that lies on the way of the last second gives the delay: a garbled one hardly ever lies there.
    """

    settings: LinkSettings
    late: float  # s that the arm is behind its set-point, by its profile
    count: int = 0  # answered places
    behind: float = 0.0  # s, delay of the last answer on the way, beyond the lag
    lasting: float = 0.0  # s, the smaller delay of the last two, once the lag is known
    _period: float = math.nan  # s between places, smoothed
    _place: _AnsweredAxes = field(default_factory=_AnsweredAxes)
    _turn: _AnsweredAxes = field(default_factory=_AnsweredAxes)
    _delays: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=2))  # s: when, and how late
    _sums: tuple[float, float] = (0.0, 0.0)  # of the open stretch: (mm/s)^2 s and (mm/s)^2
    _stretches: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=MAX_LAG_BLOCKS))

    def take(self, reply: Reply, queue: ArmQueue, now: float) -> None:
        """Take an answer of `now`, s, in machine axes."""
        if reply.kind is ReplyKind.PLACE:
            place = reply.values
            gap = now - self._place.stamp
            if math.isfinite(gap):
                self._period = gap if math.isnan(self._period) else self._period + 0.1 * (gap - self._period)
            self.count += 1
            self._place.take(place, self._deviation(place, slice(0, 3), queue, now), REST_TOLERANCE[0], now)
            self._time(place, queue, now)
            if self.behind <= self.settings.slack:
                self._learn(place, queue, now)
        elif reply.kind is ReplyKind.TOOL:
            off = self._deviation(reply.values, slice(3, 6), queue, now)
            self._turn.take(reply.values, off, REST_TOLERANCE[1], now)

    @property
    def lag(self) -> float:
        """Measured delay from set-point to answer, s, without the backlog of the arm's queue; NaN until known."""
        if not self._stretches:
            product, square = self._sums
            return product / square if square >= MIN_LAG_INFORMATION else math.nan
        lags = sorted(product / square for product, square in self._stretches)
        quickest = lags[int(QUICK_SHARE * (len(lags) - 1))]
        typical = [lag for lag in lags if lag <= quickest + LAG_SPREAD]
        return sum(typical) / len(typical)

    def backlog(self, queue: ArmQueue, now: float) -> float:
        """Seconds of motion that the arm has left beyond the model's, by its last two answers; 0 or more.

        An answer is about an earlier place; the time in which the model was idle since then is subtracted. Apart from
        rounding, the estimate is never too large; 0 while the lag is unknown.
        """
        if len(self._delays) < 2 or math.isnan(lag := self.lag):
            return 0.0
        return max(0.0, min(_backlog_left(delay - lag, stamp - delay, queue, now) for stamp, delay in self._delays))

    @property
    def off(self) -> float:
        """Distance, mm, of the arm from its path; 0 until two answers agree on more."""
        return self._place.off

    @property
    def rate(self) -> float:
        """Places a second, NaN until known."""
        return 1 / self._period if self._period > 0 else math.nan

    def axes(self, now: float) -> Array | None:
        """The answered axes (6,), mm and rad; None where they are older than `silence`."""
        stale = now - min(self._place.stamp, self._turn.stamp) > self.settings.silence
        return None if stale else self.last

    @property
    def last(self) -> Array | None:
        """The last answered axes (6,), however old; None without."""
        place, turn = self._place.values, self._turn.values
        return None if place is None or turn is None else np.concatenate([place, turn])

    def stands(self, known: Array | None, now: float) -> Array | None:
        """Axes (6,) of an arm at rest by its answers: `known` (6,), as far as their rounding allows.

        None where it does not answer.
        """
        answer = self.axes(now)
        if answer is None or known is None or not near(answer, known):
            return answer
        return np.clip(known, answer - ANSWER_ROUNDING, answer + ANSWER_ROUNDING)

    def still(self, now: float) -> bool:
        """Whether it is at rest by its answers; True for an arm that does not answer."""
        fresh = [part for part in (self._place, self._turn) if now - part.stamp <= self.settings.silence]
        return all(now - part.since >= REST_TIME for part in fresh)

    def settled(self, since: float) -> bool:
        """Whether answers agree that it is at rest, the newest of them from later than `since`, s, plus the lag."""
        place, turn = self._place, self._turn
        recent = min(place.stamp, turn.stamp) >= since + self.late
        return recent and place.stamp - place.since >= RECALL_REST_TIME and turn.stamp - turn.since >= RECALL_REST_TIME

    def answered(self, since: float) -> bool:
        """Whether a place has come that the arm gave after `since`, s."""
        return self._place.stamp >= since

    def moved(self, since: float) -> bool:
        """Whether a place that came after `since`, s, was another than the one before."""
        return self.count > 0 and self._place.since > since

    def restless(self, since: float) -> bool:
        """Whether an answer that came after `since`, s, was another than the one before, in place or angles."""
        return any(part.first is not None and part.since > since for part in (self._place, self._turn))

    def forgive(self) -> None:
        """Reset deviations and delays: the arm counts as at its set-point."""
        self.behind = self.lasting = 0.0
        self._delays.clear()
        for part in (self._place, self._turn):
            part.off = part.before = 0.0

    def doubt(self, now: float) -> str:
        """Why the arm may not be at its set-point; "" where it answers from there, or never answered."""
        if self.count < MIN_ANSWERS:
            return ""
        limit_silence = min(self.settings.silence, max(MAX_MISSED_ANSWERS * self._period, self.settings.slack))
        if (silence := now - self._place.stamp) > limit_silence:
            return f"the arm has not answered for {silence:.2f} s, limit {limit_silence:.2g} s"
        slack, repeated = self.settings.slack, REPEATED_LATE_SHARE * self.settings.slack
        for delay, limit, suffix in ((self.behind, slack, ""), (self.lasting, repeated, " twice in a row")):
            if delay > limit:
                text = f"the arm is {1000 * delay:.0f} ms later on its way than its lag"
                return f"{text}, limit {1000 * limit:g} ms{suffix}"
        if self.off > self.settings.off:
            return f"the arm is {self.off:.1f} mm off its way, limit {self.settings.off:g} mm"
        if (turn := self._turn.off) > self.settings.off_turn:
            limit = np.rad2deg(self.settings.off_turn)
            return f"the arm is turned {np.rad2deg(turn):.1f} degrees off its way, limit {limit:g} degrees"
        return ""

    def restart(self) -> None:
        """Forget all answers: the device was unplugged, or the operator gave the arm's axes."""
        self.count, self.behind, self.lasting, self._period, self._sums = 0, 0.0, 0.0, math.nan, (0.0, 0.0)
        self._stretches.clear()
        self._delays.clear()
        self._place, self._turn = _AnsweredAxes(), _AnsweredAxes()

    def _deviation(self, values: Array, axes: slice, queue: ArmQueue, now: float) -> float:
        """Distance of an answer (3,) from the range of the set-point over the lag and the slack, mm or rad."""
        low, high = queue.bounds(now - self.late - self.settings.slack, now)
        bounds = zip(values.tolist(), low[axes], high[axes], strict=True)
        return math.hypot(*(max(a - v, v - b, 0.0) for v, a, b in bounds))

    def _time(self, place: Array, queue: ArmQueue, now: float) -> None:
        """Measure how long ago the set-point was at the answered place."""
        passage = queue.passed(place.tolist(), ON_WAY_TOLERANCE, now)
        if math.isnan(passage):
            passage = queue.passed(place.tolist(), REST_TOLERANCE[0], now)
        if not math.isnan(passage):
            behind = now - passage - (self.late if math.isnan(self.lag) else max(self.late, self.lag))
            self.lasting = 0.0 if math.isnan(self.lag) else min(behind, self.behind)
            self.behind = behind

    def _learn(self, place: Array, queue: ArmQueue, now: float) -> None:
        """Least squares for the lag of a stretch: the set-point leads the answer by its speed times the lag."""
        set_point, earlier = (np.asarray(queue.at(t)[:3]).tolist() for t in (now, now - SPEED_SPAN))
        speed = [(a - b) / SPEED_SPAN for a, b in zip(set_point, earlier, strict=True)]
        lead = [a - p for a, p in zip(set_point, place.tolist(), strict=True)]
        speed_norm = math.hypot(*speed)
        if speed_norm < MIN_LAG_SPEED or self._place.before > self.settings.off:
            self._delays.clear()
            return
        product = sum(v * e for v, e in zip(speed, lead, strict=True))
        square = sum(v * v for v in speed)
        self._delays.append((now, product / square - float(ANSWER_ROUNDING[0]) / speed_norm))
        self._sums = self._sums[0] + product, self._sums[1] + square
        if self._sums[1] >= LAG_BLOCK:
            self._stretches.append(self._sums)
            self._sums = 0.0, 0.0


def _backlog_left(behind: float, since: float, queue: ArmQueue, now: float) -> float:
    """Seconds of motion left at `now`, s, of an arm `behind` s late at the set-point of `since`, s; 0 if rounding."""
    return behind - queue.idle(since, now) if behind > LAG_SPREAD else 0.0


def near(answered: Array | None, axes: Array | None) -> bool:
    """Whether an answer (6,) is `axes` (6,), mm and rad, to rounding."""
    if answered is None or axes is None:
        return False
    difference = np.abs(answered - axes)
    return bool(difference[:3].max() <= REST_TOLERANCE[0] and difference[3:].max() <= REST_TOLERANCE[1])
