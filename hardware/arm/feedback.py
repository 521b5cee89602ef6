"""The arm's answers compared with its queue's model: measured lag, distance from its way, whether it is at rest.

An arm that does not answer leaves all of this unknown. Answers have no checksum, so a single one proves nothing: the
deviation is the smaller one of the last two answers, which one garbled answer cannot raise.

The lag is learned as long as the arm answers. What piles up in the arm's queue, as after a stall, only ever makes it
later, until the queue runs empty. So the lag is what the quickest tenth of the last stretches of motion say; the rest
of a delay is a backlog, and counts as motion that is under way.
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

MIN_ANSWERS = 3  # answers before their absence means anything, as noise that looks like one comes alone
SPEED_SPAN = 0.05  # s over which the set-point's speed is taken, and the slowest answers of a public driver come
LAG_BLOCK = 1600.0  # (mm/s)^2, sum of a stretch of motion: four answers at 20 mm/s, whose rounding gives 1 to 2 ms
MAX_LAG_BLOCKS = 64  # remembered: 10 to 15 s of motion at 20 mm/s
QUICK_SHARE = 0.1  # of the stretches: a motion without backlog is known by so many
LAG_SPREAD = 0.006  # s: a stretch that is later than the quick ones by more has a backlog; some times the rounding
REST_TOLERANCE = 0.15, float(np.deg2rad(0.015))  # mm and rad between answers of an arm at rest: one count of rounding
ANSWER_ROUNDING = 0.5001 * np.repeat([unit(ReplyKind.PLACE), unit(ReplyKind.TOOL)], 3)  # mm and rad, by which it rounds
ON_WAY_TOLERANCE = 0.07  # mm: a little more than rounding puts an answer beside its way; a wider one detects later
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
        """Measured s from set-point to answer, without what the arm's queue has piled up; NaN until known."""
        if not self._stretches:
            product, square = self._sums
            return product / square if square >= MIN_LAG_INFORMATION else math.nan
        lags = sorted(product / square for product, square in self._stretches)
        quick = lags[int(QUICK_SHARE * (len(lags) - 1))]
        near = [lag for lag in lags if lag <= quick + LAG_SPREAD]
        return sum(near) / len(near)

    def backlog(self, queue: ArmQueue, now: float) -> float:
        """Seconds of motion that the arm has yet to do beside what the model says, by its last two answers; 0 or more.

        An answer tells of a place of some time ago; what the arm has made good since, while the model had nothing to
        do, is taken off. It is never taken for more than it is, as far as rounding goes; 0 while the lag is not known.
        """
        if len(self._delays) < 2 or math.isnan(lag := self.lag):
            return 0.0
        return max(0.0, min(_left(delay - lag, stamp - delay, queue, now) for stamp, delay in self._delays))

    @property
    def off(self) -> float:
        """Distance, mm, of the arm from its way; 0 until two answers say otherwise."""
        return self._place.off

    @property
    def rate(self) -> float:
        """Places a second, NaN until known."""
        return 1 / self._period if self._period > 0 else math.nan

    def axes(self, now: float) -> Array | None:
        """The answered axes (6,), mm and rad; None where they are older than `silence`."""
        place, turn = self._place, self._turn
        if place.values is None or turn.values is None or now - min(place.stamp, turn.stamp) > self.settings.silence:
            return None
        return np.concatenate([place.values, turn.values])

    @property
    def last(self) -> Array | None:
        """The last answered axes (6,), however old; None without."""
        place, turn = self._place.values, self._turn.values
        return None if place is None or turn is None else np.concatenate([place, turn])

    def stands(self, known: Array | None, now: float) -> Array | None:
        """Where an arm at rest is (6,), by its answers: where it is `known` to be (6,) as far as rounding allows.

        None where it does not answer.
        """
        answered = self.axes(now)
        if answered is None or known is None or not near(answered, known):
            return answered
        return np.clip(known, answered - ANSWER_ROUNDING, answered + ANSWER_ROUNDING)

    def still(self, now: float) -> bool:
        """Whether its answers say that it is at rest; an arm that does not answer says nothing against it."""
        fresh = [part for part in (self._place, self._turn) if now - part.stamp <= self.settings.silence]
        return all(now - part.since >= REST_TIME for part in fresh)

    def settled(self, since: float) -> bool:
        """Whether answers agree that it rests, the newest of them given after `since`, s, and the lag."""
        place, turn = self._place, self._turn
        late = min(place.stamp, turn.stamp) >= since + self.late
        return late and place.stamp - place.since >= RECALL_REST_TIME and turn.stamp - turn.since >= RECALL_REST_TIME

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
        """Forget deviations and delays: it counts as standing where it should."""
        self.behind = self.lasting = 0.0
        self._delays.clear()
        for part in (self._place, self._turn):
            part.off = part.before = 0.0

    def doubt(self, now: float) -> str:
        """Why the arm may not be where it should be; "" where it answers from there, or never answered."""
        if self.count < MIN_ANSWERS:
            return ""
        quiet = min(self.settings.silence, max(MAX_MISSED_ANSWERS * self._period, self.settings.slack))
        if (since := now - self._place.stamp) > quiet:
            return f"the arm has not answered for {since:.2f} s, limit {quiet:.2g} s"
        slack, repeated = self.settings.slack, REPEATED_LATE_SHARE * self.settings.slack
        for late, limit, often in ((self.behind, slack, ""), (self.lasting, repeated, " twice in a row")):
            if late > limit:
                words = f"the arm is {1000 * late:.0f} ms later on its way than its lag"
                return f"{words}, limit {1000 * limit:g} ms{often}"
        if self.off > self.settings.off:
            return f"the arm is {self.off:.1f} mm off its way, limit {self.settings.off:g} mm"
        if (turn := self._turn.off) > self.settings.off_turn:
            limit = np.rad2deg(self.settings.off_turn)
            return f"the arm is turned {np.rad2deg(turn):.1f} degrees off its way, limit {limit:g} degrees"
        return ""

    def restart(self) -> None:
        """Forget all answers: the device was away, or the operator said where the arm stands."""
        self.count, self.behind, self.lasting, self._period, self._sums = 0, 0.0, 0.0, math.nan, (0.0, 0.0)
        self._stretches.clear()
        self._delays.clear()
        self._place, self._turn = _AnsweredAxes(), _AnsweredAxes()

    def _deviation(self, values: Array, axes: slice, queue: ArmQueue, now: float) -> float:
        """How far an answer (3,) is from where the set-point was since the arm could be there."""
        low, high = queue.bounds(now - self.late - self.settings.slack, now)
        ends = zip(values.tolist(), low[axes], high[axes], strict=True)
        return math.hypot(*(max(a - v, v - b, 0.0) for v, a, b in ends))

    def _time(self, place: Array, queue: ArmQueue, now: float) -> None:
        """How long ago the set-point was where the arm answers from."""
        passed = queue.passed(place.tolist(), ON_WAY_TOLERANCE, now)
        if math.isnan(passed):
            passed = queue.passed(place.tolist(), REST_TOLERANCE[0], now)
        if not math.isnan(passed):
            behind = now - passed - (self.late if math.isnan(self.lag) else max(self.late, self.lag))
            self.lasting = 0.0 if math.isnan(self.lag) else min(behind, self.behind)
            self.behind = behind

    def _learn(self, place: Array, queue: ArmQueue, now: float) -> None:
        """Least squares of the lag of a stretch: the set-point leads the answer by its speed times the lag."""
        ahead, before = (np.asarray(queue.at(t)[:3]).tolist() for t in (now, now - SPEED_SPAN))
        speed = [(a - b) / SPEED_SPAN for a, b in zip(ahead, before, strict=True)]
        lead = [a - p for a, p in zip(ahead, place.tolist(), strict=True)]
        fast = math.hypot(*speed)
        if fast < MIN_LAG_SPEED or self._place.before > self.settings.off:
            self._delays.clear()
            return
        product = sum(v * e for v, e in zip(speed, lead, strict=True))
        square = sum(v * v for v in speed)
        self._delays.append((now, product / square - float(ANSWER_ROUNDING[0]) / fast))
        self._sums = self._sums[0] + product, self._sums[1] + square
        if self._sums[1] >= LAG_BLOCK:
            self._stretches.append(self._sums)
            self._sums = 0.0, 0.0


def _left(behind: float, since: float, queue: ArmQueue, now: float) -> float:
    """Seconds of work left at `now`, s, to an arm that was so far behind at the set-point of `since`; 0 if rounding."""
    return behind - queue.idle(since, now) if behind > LAG_SPREAD else 0.0


def near(answered: Array | None, axes: Array | None) -> bool:
    """Whether an answer (6,) is `axes` (6,), mm and rad, to rounding."""
    if answered is None or axes is None:
        return False
    away = np.abs(answered - axes)
    return bool(away[:3].max() <= REST_TOLERANCE[0] and away[3:].max() <= REST_TOLERANCE[1])
