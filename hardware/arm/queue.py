"""The arm's queue as it must be by what was sent: a model in virtual time, and the dead reckoning that it gives.

The arm's answers need not come, so this is all that is always known (thesis 6.2: home, plus what was commanded). A
frame takes its time on the wire, then waits for those before it; a move goes straight from the last target at its
feed. A move of less than TURNING along X Y Z turns, and its feed counts degrees/s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from hardware.arm.protocol import G1, G4
from planning.command import TURNING

Axes = tuple[float, ...]  # X Y Z A B C, mm and rad: six floats, quicker than an array of six
REMEMBERED = 64  # stretches, more than a second of them at 50 frames/s


@dataclass(frozen=True, slots=True)
class Stretch:
    """One command in the queue: from `start` to `end`, both s, between two places."""

    start: float
    end: float
    source: Axes
    target: Axes

    def at(self, instant: float) -> Axes:
        """The set-point at `instant`, s; held before and after."""
        if instant >= self.end or instant <= self.start:
            return self.target if instant >= self.end else self.source
        share = (instant - self.start) / (self.end - self.start)
        return tuple(a + share * (b - a) for a, b in zip(self.source, self.target, strict=True))


class ArmQueue:
    """What the arm has yet to do, and where its set-point is; it is told of every frame that has been sent."""

    def __init__(self, axes: Sequence[float], frame_time: float, now: float) -> None:
        """axes: (6,) where the arm stands. frame_time: s of one frame on the wire."""
        self._frame_time = frame_time
        self._wire = now
        self._stretches: deque[Stretch] = deque(maxlen=REMEMBERED)
        self.stand(axes, now)

    @property
    def target(self) -> Axes:
        """Where the last command ends."""
        return self._stretches[-1].target

    @property
    def wire_free(self) -> float:
        """When all bytes given out so far are on the wire, s."""
        return self._wire

    def stand(self, axes: Sequence[float], now: float) -> None:
        """Nothing is queued, and the arm stands at `axes` (6,)."""
        place = tuple(float(a) for a in axes)
        assert len(place) == 6 and all(map(math.isfinite, place))
        self._stretches.append(Stretch(now, now, place, place))

    def duration(self, instruction: G1 | G4) -> float:
        """Seconds that the arm will be busy with an instruction, after all those before it. G1: in machine axes."""
        if isinstance(instruction, G4):
            return instruction.duration
        way = [float(b) - a for a, b in zip(self.target, instruction.axes, strict=True)]
        length, turn = math.hypot(*way[:3]), math.hypot(*way[3:])
        return length / instruction.feed if length > TURNING or not turn else math.degrees(turn) / instruction.feed

    def add(self, instruction: G1 | G4, now: float, left: float = 1.0) -> None:
        """An instruction was given out whole at `now`, s. left: share of its frame that went then, the rest before."""
        duration, source = self.duration(instruction), self.target
        self.occupy(now, left)
        start = max(self._wire, self._stretches[-1].end)
        target = source if isinstance(instruction, G4) else tuple(float(a) for a in instruction.axes)
        self._stretches.append(Stretch(start, start + duration, source, target))

    def occupy(self, now: float, share: float) -> None:
        """A share of a frame's bytes was given out at `now`, s."""
        self._wire = max(self._wire, now) + share * self._frame_time

    def stop(self) -> None:
        """A frame that stops the arm was given out: it rests where the set-point is when that arrives."""
        if self._stretches[-1].end <= self._wire:
            return  # it rests already
        arrival, place = self._wire, self.at(self._wire)
        while self._stretches and self._stretches[-1].end > arrival:
            cut = self._stretches.pop()
            if cut.start < arrival:
                self._stretches.append(Stretch(cut.start, arrival, cut.source, place))
        self.stand(place, arrival)

    def in_flight(self, now: float) -> float:
        """Seconds until all that was given out is done."""
        return max(self._stretches[-1].end - now, self._wire - now, 0.0)

    def in_flight_with(self, duration: float, now: float) -> float:
        """The same if a command of `duration` s were given out at `now`."""
        return max(max(self._wire, now) + self._frame_time, self._stretches[-1].end) + duration - now

    def frames(self, now: float) -> int:
        """Commands that are not done, those on the wire included."""
        count = 0
        for stretch in reversed(self._stretches):
            if stretch.end <= now:
                break
            count += 1
        return count

    def at(self, instant: float) -> Axes:
        """The set-point (6,) at `instant`, s, no more than a second ago."""
        index = bisect_right(self._stretches, instant, key=lambda stretch: stretch.start) - 1
        return self._stretches[max(index, 0)].at(instant)

    def ways(self, since: float) -> list[Stretch]:
        """What ends after `since`, s, in order: of the last second, and of what is queued."""
        return [stretch for stretch in self._stretches if stretch.end > since]

    def passed(self, place: Sequence[float], still: float, until: float) -> float:
        """When X Y Z of the set-point last were within `still` mm of a place (3,) each, s; NaN if not of late."""
        after = until
        for stretch in reversed(self._stretches):
            if stretch.end <= after and _share(stretch.target, stretch.target, place, still, 1.0) is not None:
                return after
            if stretch.start < min(after, stretch.end):
                length = stretch.end - stretch.start
                most = min((after - stretch.start) / length, 1.0)
                if (share := _share(stretch.source, stretch.target, place, still, most)) is not None:
                    return stretch.start + share * length
            after = min(after, stretch.start)
        return math.nan

    def bounds(self, since: float, until: float) -> tuple[Axes, Axes]:
        """Least and greatest set-point of each axis between two instants, s."""
        knots = [self.at(since), self.at(until)]
        for stretch in reversed(self._stretches):
            if stretch.end <= since:
                break
            ends = (stretch.start, stretch.source), (stretch.end, stretch.target)
            knots += [place for instant, place in ends if since <= instant <= until]
        return tuple(map(min, *knots)), tuple(map(max, *knots))


def _share(source: Axes, target: Axes, place: Sequence[float], still: float, most: float) -> float | None:
    """The last share of a straight way, up to `most`, at which X Y Z are `still` or less from a place (3,), or None."""
    first, last = 0.0, most
    for a, b, p in zip(source[:3], target[:3], place, strict=True):
        if a == b:
            if abs(p - a) > still:
                return None
            continue
        ends = (p - still - a) / (b - a), (p + still - a) / (b - a)
        first, last = max(first, min(ends)), min(last, max(ends))
    return last if first <= last else None
