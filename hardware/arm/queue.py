"""Dead reckoning of the arm by a model of its queue: commands under way, the set-point, and whether more may be sent.

The arm need not answer; the model is then the only source of its place (thesis 6.2: home, plus all commands). A frame
takes its time on the wire, then waits for the commands before it. A move goes straight from the last target at its
feed; one of less than MIN_TRAVEL along X Y Z turns, and its feed is in degrees/s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from hardware.arm.driver import G1, G4, ArmDriver
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.protocol import FRAME_LENGTH
from planning.command import MIN_TRAVEL

Axes = tuple[float, ...]  # X Y Z A B C, mm and rad: six floats, quicker than an array of six
MAX_QUEUED_COMMANDS = 64  # remembered: more than a second of them at 50 frames/s
WIRE_ROUNDING_BYTES = 1e-3


@dataclass(frozen=True, slots=True)
class QueuedCommand:
    """The way of the set-point that one command in the queue makes."""

    start: float  # s
    end: float  # s
    source: Axes
    target: Axes

    def at(self, instant: float) -> Axes:
        """The set-point at `instant`, s; held before and after."""
        if instant >= self.end or instant <= self.start:
            return self.target if instant >= self.end else self.source
        share = (instant - self.start) / (self.end - self.start)
        return tuple(a + share * (b - a) for a, b in zip(self.source, self.target, strict=True))


class ArmQueue:
    """The commands that the arm has yet to do, and its set-point; every frame that is sent is entered.

    wire_free: s, when all bytes given out so far are on the wire.
    """

    def __init__(self, axes: Sequence[float], frame_time: float, now: float) -> None:
        """axes: (6,) where the arm stands. frame_time: s of one frame on the wire."""
        self._frame_time = frame_time
        self.wire_free = now
        self._commands: deque[QueuedCommand] = deque(maxlen=MAX_QUEUED_COMMANDS)
        self.stand(axes, now)

    @property
    def target(self) -> Axes:
        """Where the last command ends."""
        return self._commands[-1].target

    def stand(self, axes: Sequence[float], now: float) -> None:
        """Nothing is queued, and the arm stands at `axes` (6,)."""
        place = tuple(float(a) for a in axes)
        assert len(place) == 6 and all(map(math.isfinite, place))
        self._commands.append(QueuedCommand(now, now, place, place))

    def duration(self, instruction: G1 | G4) -> float:
        """Seconds that an instruction takes after all those before it. G1: in machine axes."""
        if isinstance(instruction, G4):
            return instruction.duration
        displacement = [float(b) - a for a, b in zip(self.target, instruction.axes, strict=True)]
        length, turn = math.hypot(*displacement[:3]), math.hypot(*displacement[3:])
        return length / instruction.feed if length > MIN_TRAVEL or not turn else math.degrees(turn) / instruction.feed

    def add(self, instruction: G1 | G4, now: float, left: float = 1.0) -> None:
        """The last byte of an instruction was given out at `now`, s. left: share of its frame that went just then."""
        duration, source = self.duration(instruction), self.target
        self.occupy(now, left)
        start = max(self.wire_free, self._commands[-1].end)
        target = source if isinstance(instruction, G4) else tuple(float(a) for a in instruction.axes)
        self._commands.append(QueuedCommand(start, start + duration, source, target))

    def occupy(self, now: float, share: float) -> None:
        """A share of a frame's bytes was given out at `now`, s."""
        self.wire_free = max(self.wire_free, now) + share * self._frame_time

    def stop(self) -> None:
        """A frame that stops the arm was given out: the arm rests where the set-point is when that arrives."""
        if self._commands[-1].end <= self.wire_free:
            return  # it rests already
        arrival, place = self.wire_free, self.at(self.wire_free)
        while self._commands and self._commands[-1].end > arrival:
            command = self._commands.pop()
            if command.start < arrival:
                self._commands.append(QueuedCommand(command.start, arrival, command.source, place))
        self.stand(place, arrival)

    def in_flight(self, now: float) -> float:
        """Seconds until all that was given out is done."""
        return max(self._commands[-1].end - now, self.wire_free - now, 0.0)

    def in_flight_with(self, duration: float, now: float) -> float:
        """The same if a command of `duration` s were given out at `now`."""
        return max(max(self.wire_free, now) + self._frame_time, self._commands[-1].end) + duration - now

    def idle(self, since: float, until: float) -> float:
        """Seconds between two instants, s, no more than a second ago, in which no command is being done."""
        overlaps = (command for command in self._commands if command.end > since and command.start < until)
        return until - since - sum(min(overlap.end, until) - max(overlap.start, since) for overlap in overlaps)

    def frames(self, now: float) -> int:
        """Commands that are not done, those on the wire included."""
        return sum(command.end > now for command in self._commands)

    def at(self, instant: float) -> Axes:
        """The set-point (6,) at `instant`, s, no more than a second ago."""
        index = bisect_right(self._commands, instant, key=lambda command: command.start) - 1
        return self._commands[max(index, 0)].at(instant)

    def ways(self, since: float) -> list[QueuedCommand]:
        """The commands that end after `since`, s, in order: of the last second and of the queue."""
        return [command for command in self._commands if command.end > since]

    def passed(self, place: Sequence[float], still: float, until: float) -> float:
        """When X Y Z of the set-point were last within `still` mm of a place (3,), s; NaN if not of late."""
        later = until
        for command in reversed(self._commands):
            if command.end <= later and _share(command.target, command.target, place, still, 1.0) is not None:
                return later
            if command.start < min(later, command.end):
                length = command.end - command.start
                max_share = min((later - command.start) / length, 1.0)
                if (share := _share(command.source, command.target, place, still, max_share)) is not None:
                    return command.start + share * length
            later = min(later, command.start)
        return math.nan

    def bounds(self, since: float, until: float) -> tuple[Axes, Axes]:
        """Least and greatest set-point of each axis between two instants, s."""
        knots = [self.at(since), self.at(until)]
        for command in reversed(self.ways(since)):
            endpoints = (command.start, command.source), (command.end, command.target)
            knots += [place for instant, place in endpoints if since <= instant <= until]
        return tuple(map(min, *knots)), tuple(map(max, *knots))


def _share(source: Axes, target: Axes, place: Sequence[float], still: float, max_share: float) -> float | None:
    """The last share of a segment, up to `max_share`, at which X Y Z are `still` or less from a place (3,), or None."""
    first, last = 0.0, max_share
    for a, b, p in zip(source[:3], target[:3], place, strict=True):
        if a == b:
            if abs(p - a) > still:
                return None
            continue
        crossings = (p - still - a) / (b - a), (p + still - a) / (b - a)
        first, last = max(first, min(crossings)), min(last, max(crossings))
    return last if first <= last else None


@dataclass(frozen=True, slots=True, eq=False)
class FlowControl:
    """The limits of one arm's link: what is on the wire, in the port and in the arm's queue."""

    profile: ArmProfile
    settings: LinkSettings

    @property
    def flight(self) -> float:
        """Seconds that may be under way, wire included: the flight, or on a slow line one frame and its move.

        Either way a tick, of 50 ms at most, is all that is added to what the arm's queue holds.
        """
        slow = self.profile.frame_time * (1 + WIRE_ROUNDING_BYTES / FRAME_LENGTH) + self.profile.tick
        return max(self.settings.flight if self.profile.flight is None else self.profile.flight, slow)

    def full(self, driver: ArmDriver, queue: ArmQueue, duration: float, now: float, backlog: float = 0.0) -> str:
        """Why a frame of `duration` s must wait; "" where it need not. backlog: s that the arm is behind the model."""
        if (blocked := driver.blocked_for(now)) is not None:
            return f"the port has taken no bytes for {blocked:.3f} s"
        frame_time = self.profile.frame_time
        on_wire = max(queue.wire_free - now, 0.0) / frame_time * FRAME_LENGTH if frame_time else 0.0
        if on_wire > WIRE_ROUNDING_BYTES:
            return f"{on_wire:.0f} bytes are on the wire: a stop would wait for two frames"
        waiting = driver.waiting() - on_wire
        if waiting > FRAME_LENGTH:
            return f"{waiting:.0f} bytes wait in the port"
        if (count := queue.frames(now)) >= self.settings.frames:
            return f"{count} frames are under way, limit {self.settings.frames}"
        if queue.in_flight_with(duration, now) + backlog > self.flight:
            return f"{1000 * (queue.in_flight(now) + backlog):.0f} ms are under way, limit {1000 * self.flight:g} ms"
        return ""

    def excess(self, instruction: G1 | G4, queue: ArmQueue, now: float) -> str:
        """Why the arm is stopped rather than sent this; "" where it may be sent."""
        limit = self.profile.limits.feed
        if isinstance(instruction, G1) and instruction.feed > limit * (1 + 1e-6):
            return f"feed of {instruction.feed:g} mm/s, limit {limit:g}"
        flight = queue.in_flight_with(queue.duration(instruction), now)
        if flight > self.flight:
            return f"{1000 * flight:.1f} ms would be under way, limit {1000 * self.flight:g} ms"
        return ""
