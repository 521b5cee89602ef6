"""What was called back from an arm that does not follow, until it is known to obey again.

An arm that stalls, that frames do not reach or that a garbled one sent astray is told by its answers. What it has
queued is called back, so that it rests; where it rests, its answers tell. One short step towards where it had been
sent, given again with a pause before it for as long as nothing comes of it, tells when it obeys again: axes are
absolute, so a step given twice goes no farther than one. As soon as it has begun whoever sends may go on, from the end
of it: what was called back was not done, and is to be done from where the arm came to rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from hardware.arm.feedback import STILL, ArmEcho, near
from hardware.arm.protocol import G1, Pause

TOLD = 2 * STILL[0]  # mm of a step that answers tell from none
STARTED = 0.01  # s of a step, its lag aside, after which an answer from where it began says that it did not begin


@dataclass(frozen=True, slots=True, eq=False)
class Recalled:
    """What whoever sends must know before anything more is sent. place: (6,) mm and rad, where the arm came to rest.

    stands: (6,) where it is by now, or a part of a step before, and the next move begins.
    """

    place: Array
    stands: Array

    @property
    def rows(self) -> Array:
        """Both (2, 6)."""
        return np.stack([self.place, self.stands])


class Recall:
    """One arm's. goal: (6,) mm and rad, where it had been sent, None while nothing is called back.

    why: for a person. since: s, when it was called back. place: (6,) where it first came to rest, None until it has.
    rest: of a travel that was broken off, None where a motion was. stepped: s, when the last step was given, None where
    none is, and stood: (6,) where it began. obeys: whether the arm is known to move again. undone: whether a motion's
    moves were called back, and a stop came before it was told so.
    """

    def __init__(self, longest: float, speed: float, lag: float) -> None:
        """longest: s of a step, and speed: mm/s. lag: s that the arm is later at a command's axes than one tick."""
        self._longest, self._speed, self._lag = longest, speed, lag
        self.why = ""
        self.goal: Array | None = None
        self.since = 0.0
        self.place: Array | None = None
        self.rest: Iterator[G1] | None = None
        self.stepped: float | None = None
        self.obeys = self.undone = False
        self.stood: Array | None = None

    @property
    def waits(self) -> bool:
        """Whether it is waited for that the arm comes to rest, and nothing was asked of it since."""
        return self.goal is not None and self.stepped is None and not self.obeys

    def begin(self, why: str, goal: Array, rest: Iterator[G1] | None, now: float) -> None:
        """What was sent, to `goal` (6,), is called back at `now`, s."""
        self.drop()
        self.why, self.goal, self.since, self.rest = why, goal, now, rest

    def drop(self) -> None:
        """Nothing is called back any more."""
        self.goal = self.place = self.stood = self.rest = self.stepped = None
        self.why, self.obeys, self.undone = "", False, False

    def break_off(self) -> None:
        """It ends in a stop, or the device is gone: what was called back stays undone."""
        undone = self.undone or (self.goal is not None and self.rest is None)
        self.drop()
        self.undone = undone

    def resume(self, place: Array) -> None:
        """The arm obeys again, from rest at `place` (6,): whoever sends is to be told what is undone."""
        if self.undone:
            self.place, self.obeys = place, True

    def next(self, echo: ArmEcho, target: Array, now: float) -> tuple[G1 | Pause, ...]:
        """What is to be sent to an arm with nothing under way, which by what is known stands at `target` (6,)."""
        answered = echo.axes(now)
        if self.stepped is None:
            return self._rested(echo, target, now) if echo.settled(self.since) else ()
        if near(answered, target) or underway(answered, self.stood, target):
            self._obey(echo)
        elif echo.answered(self.stepped + self._lag + STARTED):
            if near(answered, self.stood):  # nothing came of it: once more, after what may have come instead
                self.stepped = now
                return Pause(), G1(target, self._speed)
            self.since, self.stepped, self.stood = now, None, None
            return (Pause(),)
        return ()

    def _rested(self, echo: ArmEcho, stands: Array, now: float) -> tuple[G1, ...]:
        """It rests: the step, unless it has moved since it was called back, or no step could be told."""
        echo.forgive()
        self.stood, self.place = stands, stands if self.place is None else self.place
        assert self.goal is not None
        way = self.goal[:3] - stands[:3]
        length = float(np.linalg.norm(way))
        if echo.moved(self.since) or (length <= TOLD and echo.still(now)):
            self._obey(echo)
        elif length > TOLD:
            self.stepped = now
            share = min(self._longest * self._speed / length, 1.0)
            return (G1(np.concatenate([stands[:3] + share * way, stands[3:]]), self._speed),)
        return ()

    def _obey(self, echo: ArmEcho) -> None:
        self.obeys = True
        echo.forgive()


def underway(answered: Array | None, start: Array | None, end: Array) -> bool:
    """Whether an arm that went from `start` (6,) to `end` (6,), mm and rad, has left and answers from between them."""
    if answered is None or start is None or near(answered, start):
        return False
    return near(answered, np.clip(answered, np.minimum(start, end), np.maximum(start, end)))
