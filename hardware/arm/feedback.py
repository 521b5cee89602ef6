"""What the arm answers, set beside what it was told: measured lag, how far off its way it is, whether it has arrived.

An answer need not come; then all of this stays unknown. Answers have no check sum, so one alone proves nothing: what
counts is the smaller of the last two deviations, which a single garbled answer cannot raise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from estimation.se3 import Array
from hardware.arm.queue import ArmQueue, Axes
from hardware.link_settings import LinkSettings
from hardware.replies import Reply, ReplyKind, unit

ENOUGH = 3  # answers before their absence means anything, as noise that looks like one comes alone
SPAN = 0.05  # s over which the set-point's speed is taken, and the slowest answers of a public driver come
FORGET = 0.98  # of the lag's sums with each answer: two or three seconds of them
STILL = 0.15, float(np.deg2rad(0.015))  # mm and rad between answers of an arm at rest: one count of rounding
HALF = 0.5001 * np.repeat([unit(ReplyKind.PLACE), unit(ReplyKind.TOOL)], 3)  # mm and rad, by which it rounds
NEAR = 0.07  # mm by which rounding puts an answer beside its way at most, and a little: what is wider tells late
TWICE = 0.6  # of the slack, which an arm that goes too slowly passes in two answers before one passes all of it
MISSED = 3  # answers: noise spoils one of them now and then, and the next may come late
RESTS = 0.2  # s after which it counts as at rest: four of the slowest answers
SETTLED = 0.04  # s after which one that was called back does: two of the slowest answers that agree
MOVING = 2.0  # mm/s below which an answer says nothing about the lag
KNOWN = 100.0  # (mm/s)^2 in all, after which the lag is told: one answer at 10 mm/s


@dataclass(slots=True)
class _Part:
    """The last answer about one half of the axes: X Y Z, or A B C."""

    values: Array | None = None
    stamp: float = -math.inf
    before: float = 0.0  # deviation of the answer before
    off: float = 0.0  # deviation, confirmed by two answers
    first: Array | None = None  # answer from where it still is
    since: float = math.inf  # when that came

    def take(self, values: Array, deviation: float, still: float, now: float) -> None:
        if self.first is None or np.abs(values - self.first).max() > still:
            self.first, self.since = values, now
        self.off = min(deviation, self.before)
        self.values, self.stamp, self.before = values, now, deviation


@dataclass(slots=True)
class ArmEcho:
    """Answers so far. late: s that the arm is known to be behind its set-point. count: of places.

    behind: an answer that is on the way of the last second tells it by itself: what is garbled is hardly ever there.
    lasting: the less of it and of what the answer before told, once the lag is known.
    """

    settings: LinkSettings
    late: float
    count: int = 0
    behind: float = 0.0  # s that the last answer on its way was later there than its lag
    lasting: float = 0.0  # s
    _period: float = math.nan  # s between places, smoothed
    _place: _Part = field(default_factory=_Part)
    _turn: _Part = field(default_factory=_Part)
    _sums: tuple[float, float] = (0.0, 0.0)

    def take(self, reply: Reply, queue: ArmQueue, origin: Array, now: float) -> None:
        """An answer that came at `now`, s. origin: (3,) mm, from which the arm counts its place."""
        if reply.kind is ReplyKind.PLACE:
            place = reply.values + origin
            gap = now - self._place.stamp
            if math.isfinite(gap):
                self._period = gap if math.isnan(self._period) else self._period + 0.1 * (gap - self._period)
            self.count += 1
            self._place.take(place, self._deviation(place, slice(0, 3), queue, now), STILL[0], now)
            self._time(place, queue, now)
            if self.behind <= self.settings.slack:
                self._learn(place, queue, now)
        elif reply.kind is ReplyKind.TOOL:
            self._turn.take(reply.values, self._deviation(reply.values, slice(3, 6), queue, now), STILL[1], now)

    @property
    def lag(self) -> float:
        """Measured s from set-point to answer; NaN until known."""
        product, square = self._sums
        return product / square if square >= KNOWN else math.nan

    @property
    def off(self) -> float:
        """Distance, mm, of the arm from its way; 0 until two answers say otherwise."""
        return self._place.off

    @property
    def rate(self) -> float:
        """Places a second, NaN until known."""
        return 1 / self._period if self._period > 0 else math.nan

    def axes(self, now: float) -> Array | None:
        """The answered axes (6,), mm and rad; None where they are older than a silence."""
        place, turn = self._place, self._turn
        if place.values is None or turn.values is None or now - min(place.stamp, turn.stamp) > self.settings.silence:
            return None
        return np.concatenate([place.values, turn.values])

    def stands(self, known: Array | None, now: float) -> Array | None:
        """Where an arm at rest is (6,), by its answers: where it is `known` to be (6,) as far as rounding allows.

        None where it does not answer.
        """
        answered = self.axes(now)
        if answered is None or known is None or not near(answered, known):
            return answered
        return np.clip(known, answered - HALF, answered + HALF)

    def still(self, now: float) -> bool:
        """Whether its answers say that it is at rest; an arm that does not answer says nothing against it."""
        fresh = [part for part in (self._place, self._turn) if now - part.stamp <= self.settings.silence]
        return all(now - part.since >= RESTS for part in fresh)

    def settled(self, since: float) -> bool:
        """Whether answers agree that it is at rest, of which the newest was given after `since`, s, and its lag."""
        place, turn = self._place, self._turn
        late = min(place.stamp, turn.stamp) >= since + self.late
        return late and place.stamp - place.since >= SETTLED and turn.stamp - turn.since >= SETTLED

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
        """Where it stands is its place from now on: what was said against it no longer counts."""
        self.behind = self.lasting = 0.0
        for part in (self._place, self._turn):
            part.off = part.before = 0.0

    def doubt(self, now: float) -> str:
        """Why the arm may not be where it should be; "" if it answers from there, or never answered."""
        if self.count < ENOUGH:
            return ""
        quiet = min(self.settings.silence, max(MISSED * self._period, self.settings.slack))
        if (since := now - self._place.stamp) > quiet:
            return f"the arm has not answered for {since:.2f} s, limit {quiet:.2g} s"
        slack = self.settings.slack
        for late, limit, often in (self.behind, slack, ""), (self.lasting, TWICE * slack, " twice in a row"):
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
        """Forget what was answered before: a device was away, or the arm was told where it stands."""
        self.count, self.behind, self.lasting, self._period, self._sums = 0, 0.0, 0.0, math.nan, (0.0, 0.0)
        self._place, self._turn = _Part(), _Part()

    def _deviation(self, values: Array, axes: slice, queue: ArmQueue, now: float) -> float:
        """How far an answer (3,) is from where the set-point was since the arm could be there."""
        low, high = queue.bounds(now - self.late - self.settings.slack, now)
        return _beyond(values.tolist(), low[axes], high[axes])

    def _time(self, place: Array, queue: ArmQueue, now: float) -> None:
        """How late the arm is where it answers from."""
        passed = queue.passed(place.tolist(), NEAR, now)
        if math.isnan(passed):
            passed = queue.passed(place.tolist(), STILL[0], now)
        if not math.isnan(passed):
            behind = now - passed - (self.late if math.isnan(self.lag) else max(self.late, self.lag))
            self.lasting = 0.0 if math.isnan(self.lag) else min(behind, self.behind)
            self.behind = behind

    def _learn(self, place: Array, queue: ArmQueue, now: float) -> None:
        """Fit the lag: the set-point's lead over the answer is its speed times that."""
        ahead, before = (np.asarray(queue.at(t)[:3]).tolist() for t in (now, now - SPAN))
        speed = [(a - b) / SPAN for a, b in zip(ahead, before, strict=True)]
        lead = [a - p for a, p in zip(ahead, place.tolist(), strict=True)]
        if math.hypot(*speed) < MOVING or self.off > self.settings.off:
            return
        product = sum(v * e for v, e in zip(speed, lead, strict=True))
        square = sum(v * v for v in speed)
        self._sums = FORGET * self._sums[0] + product, FORGET * self._sums[1] + square


def near(answered: Array | None, axes: Array | None) -> bool:
    """Whether an arm answers from `axes` (6,), mm and rad, to rounding."""
    if answered is None or axes is None:
        return False
    away = np.abs(answered - axes)
    return bool(away[:3].max() <= STILL[0] and away[3:].max() <= STILL[1])


def _beyond(values: Sequence[float], low: Axes, high: Axes) -> float:
    return math.hypot(*(max(a - v, v - b, 0.0) for v, a, b in zip(values, low, high, strict=True)))
