"""A stop is said again: the frame that stops the arm may be lost or garbled on the line like any other."""

from __future__ import annotations

import math

from hardware.arm_echo import ArmEcho

AGAIN = 0.1  # s: a frame on the wire, the lag, the way to rest, and the slowest answer of a public driver
BLIND = 3  # times, to an arm that does not answer


class Insistence:
    """When an arm that was told to stop is to be told so again."""

    def __init__(self) -> None:
        self._told, self._left = -math.inf, 0

    def begin(self, now: float) -> None:
        """It is told for the first time, at `now`, s."""
        self._told, self._left = now, BLIND

    def due(self, echo: ArmEcho, now: float) -> bool:
        """Whether to tell it again: AGAIN after it was told it still moves by its answers, or there are none."""
        if now - self._told < AGAIN:
            return False
        if echo.axes(now) is not None:
            if not echo.restless(self._told + AGAIN):
                return False
        elif self._left > 0:
            self._left -= 1
        else:
            return False
        self._told = now
        return True
