"""A stop is said again: the frame that stops the arm may be lost or garbled on the line like any other."""

from __future__ import annotations

import math
from collections import deque

from hardware.arm.feedback import ArmEcho

AGAIN = 0.09  # s: a frame on the wire, the lag, the way to rest, and the slowest answer of a public driver
REMEMBERED = 1000  # stops
BLIND = 3  # times, to an arm that does not answer


class Insistence:
    """When an arm that was told to stop is to be told so again.

    stops: the instants, s, at which each stop was decided, and at which it was on the wire. active: whether a stop was
    decided since the arm was last known to obey.
    """

    def __init__(self) -> None:
        self.stops: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)
        self._told, self._left = -math.inf, 0
        self._decided: float | None = None
        self.active = False

    def begin(self, now: float) -> None:
        """A stop is decided at `now`, s, if none is that has yet to go out; the arm is told for the first time."""
        self._told, self._left, self.active = now, BLIND, True
        self._decided = now if self._decided is None else self._decided

    def heard(self, on_wire: float) -> None:
        """A frame that stops the arm is on the wire at `on_wire`, s."""
        if self._decided is not None:
            self.stops.append((self._decided, on_wire))
        self._decided = None

    def drop(self) -> None:
        """The arm obeys again, or the device is gone: what was decided needs no telling, or cannot be told."""
        self._decided, self.active = None, False

    def pending(self, echo: ArmEcho, now: float) -> bool:
        """Whether it may not have been heard: it is too soon to say, the arm moves, or is to be told blindly."""
        soon, blind = now - self._told < AGAIN, echo.axes(now) is None and self._left > 0
        return self.active and (soon or blind or not echo.still(now))

    def due(self, echo: ArmEcho, now: float) -> bool:
        """Whether to tell it again: AGAIN after it was told it still moves by its answers, or there are none."""
        if not self.active or now - self._told < AGAIN:
            return False
        if not echo.restless(self._told + AGAIN):
            if echo.axes(now) is not None or self._left == 0:
                return False
            self._left -= 1
        self._told = now
        return True
