"""The link's own moves: slow steps home or back to the path, and the recovery of an arm that does not follow.

The arm's place is known to a fraction of a millimetre only. At a feed computed for a step of a micrometre, that
fraction would take the arm a minute, and all frames sent meanwhile would wait. So an own move begins with a step to
where the arm should be, never asks for less than its speed, and moves and turns one after the other.

The arm's answers show that it stalls, misses frames, or was sent astray by a garbled frame. Its queue is then called
back, so that it comes to rest. A short trial step towards its goal, behind a pause, is repeated until the answers show
that it has begun; axes are absolute, so a step sent twice goes no farther. The moves that were called back are
not done: the sender goes on from where the arm came to rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from estimation.se3 import Array
from hardware.arm.driver import G1, Pause
from hardware.arm.feedback import REST_TOLERANCE, ArmFeedback, near

POSITION, ANGLES = slice(0, 3), slice(3, 6)  # of axes (6,)


def travel_steps(start: Array, goal: Array, speed: float, turning: float, tick: float) -> Iterator[G1]:
    """Steps of a tick at most: to `start` (6,), mm and rad, straight to the place of `goal` (6,), then its angles.

    speed: mm/s. turning: rad/s. The last step ends at the goal exactly.
    """
    yield G1(start, speed)
    yield from _steps(start, goal, POSITION, speed * tick, speed)
    turned = np.concatenate([goal[:3], start[3:]])
    yield from _steps(turned, goal, ANGLES, turning * tick, float(np.rad2deg(turning)))  # on the spot: degrees/s


def lifted_travel_steps(start: Array, goal: Array, speed: float, turning: float, tick: float) -> Iterator[G1]:
    """The same, never low across: up first if the goal is higher, then across and turned, down last."""
    height = max(start[2], goal[2])
    above = np.array([*goal[:2], height, *goal[3:]])
    lift = np.array([*start[:2], height, *start[3:]])
    yield G1(start, speed)
    yield from _steps(start, lift, POSITION, speed * tick, speed)
    yield from travel_steps(lift, above, speed, turning, tick)
    yield from _steps(above, goal, POSITION, speed * tick, speed)


def _steps(start: Array, goal: Array, part: slice, longest: float, feed: float) -> Iterator[G1]:
    """Even steps of `longest`, mm or rad, at most, from `start` (6,) until that part of the axes is that of `goal`."""
    way = goal[part] - start[part]
    count = int(np.ceil(np.linalg.norm(way) / longest - 1e-9))
    for k in range(1, count + 1):
        axes = start.copy()
        axes[part] = goal[part] if k == count else start[part] + k / count * way
        yield G1(axes, feed)


class OwnMoves:
    """The link's own moves. step: the next one, None without. last: the step that was the last move sent."""

    def __init__(self, speed: float, turning: float, tick: float) -> None:
        """speed: mm/s. turning: rad/s. tick: s of a step at most."""
        self._rates = speed, turning, tick
        self.step: G1 | None = None
        self.last: G1 | None = None
        self._steps: Iterator[G1] = iter(())

    def go(self, start: Array, goal: Array, lift: bool = False, then: Iterable[G1] = ()) -> None:
        """Step from `start` (6,) to `goal` (6,), mm and rad, and then take the steps `then`. lift: by way of above."""
        self._begin(chain((lifted_travel_steps if lift else travel_steps)(start, goal, *self._rates), then))

    def take(self) -> G1:
        """The next step, which is then done with."""
        step = self.step
        assert step is not None
        self.step, self.last = next(self._steps, None), step
        return step

    def break_off(self) -> Iterator[G1] | None:
        """Drop and return the steps that are left; None where the last move sent was no step.

        The last one sent is among them, as none of it may have gone out; sent twice it goes no farther.
        """
        known = [step for step in (self.last, self.step) if step is not None]
        rest = chain(known, self._steps) if known else None
        self.drop()
        return rest

    def drop(self) -> None:
        """Forget all."""
        self._begin(iter(()))
        self.last = None

    def _begin(self, steps: Iterator[G1]) -> None:
        self._steps = steps
        self.step = next(steps, None)


MAX_CREEP = 10.0  # mm, from where it was last seen: farther off, somebody has moved it since, as home
MIN_TRIAL_STEP = 2 * REST_TOLERANCE[0]  # mm that answers tell from no step
TRIAL_START_TIME = 0.01  # s of a step, beyond the lag, after which answers from its start mean that it did not begin


@dataclass(frozen=True, slots=True, eq=False)
class RecalledMoves:
    """Where the arm is after moves were called back, for the sender of the next ones; (6,) each, mm and rad."""

    place: Array  # where the arm came to rest
    stands: Array  # where it is by now, at most a part of a trial step farther; the next move begins there

    @property
    def rows(self) -> Array:
        """Both (2, 6)."""
        return np.stack([self.place, self.stands])


class AbortRecovery:
    """The recovery of one arm: its queue was called back, until the arm is known to obey again.

    why: for a person.
    goal: (6,) mm and rad, where the arm had been sent; None while nothing is called back.
    since: s, when it was called back.
    place: (6,) where the arm first came to rest; None until it has.
    rest: the steps left of an own move; None where moves of a motion were called back.
    stepped: s, when the last trial step was sent; None where none is. stood: (6,) where that step began.
    obeys: whether the arm is known to move again.
    undone: whether moves of a motion were called back, and a stop came before the motion was informed.
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
        self._last: Array | None = None  # (6,) where it was last seen before its device was gone

    @property
    def waits(self) -> bool:
        """Whether the arm has yet to come to rest, and no trial step was sent since."""
        return self.goal is not None and self.stepped is None and not self.obeys

    def begin(self, why: str, goal: Array, rest: Iterator[G1] | None, now: float) -> None:
        """What was sent, to `goal` (6,), is called back at `now`, s."""
        self.drop()
        self.why, self.goal, self.since, self.rest = why, goal, now, rest

    def drop(self) -> None:
        """Nothing is called back any more."""
        self.goal = self.place = self.stood = self.rest = self.stepped = None
        self.why, self.obeys, self.undone = "", False, False

    def break_off(self, last: Array | None = None) -> None:
        """A stop, or the device is gone, `last` (6,) seen there: what was called back stays undone."""
        undone = self.undone or (self.goal is not None and self.rest is None)
        self.drop()
        self.undone, self._last = undone, self._last if last is None else last

    def resume(self, place: Array) -> None:
        """The arm is armed again, at rest at `place` (6,): the sender is to learn that moves are undone."""
        if self.undone:
            last, self._last = self._last, None
            moved_away = last is not None and np.linalg.norm((place - last)[:3]) > MAX_CREEP
            self.place, self.obeys = last if moved_away else place, True

    def next(self, feedback: ArmFeedback, target: Array, now: float) -> tuple[G1 | Pause, ...]:
        """What to send to an arm that has nothing under way and, by dead reckoning, stands at `target` (6,)."""
        answered = feedback.axes(now)
        if self.stepped is None:
            return self._rested(feedback, target, now) if feedback.settled(self.since) else ()
        if near(answered, target) or is_underway(answered, self.stood, target):
            self._obey(feedback)
        elif feedback.answered(self.stepped + self._lag + TRIAL_START_TIME):
            if near(answered, self.stood):  # it did not begin: once more, behind a pause
                self.stepped = now
                return Pause(), G1(target, self._speed)
            self.since, self.stepped, self.stood = now, None, None
            return (Pause(),)
        return ()

    def _rested(self, feedback: ArmFeedback, stands: Array, now: float) -> tuple[G1, ...]:
        """The arm rests: the trial step, unless the arm has moved since, or its goal is too near for one."""
        feedback.forgive()
        self.stood, self.place = stands, stands if self.place is None else self.place
        assert self.goal is not None
        way = self.goal[:3] - stands[:3]
        length = float(np.linalg.norm(way))
        if feedback.moved(self.since) or (length <= MIN_TRIAL_STEP and feedback.still(now)):
            self._obey(feedback)
        elif length > MIN_TRIAL_STEP:
            self.stepped = now
            share = min(self._longest * self._speed / length, 1.0)
            return (G1(np.concatenate([stands[:3] + share * way, stands[3:]]), self._speed),)
        return ()

    def _obey(self, feedback: ArmFeedback) -> None:
        self.obeys = True
        feedback.forgive()


def is_underway(answered: Array | None, start: Array | None, end: Array) -> bool:
    """Whether the answer is from between `start` (6,) and `end` (6,), mm and rad, and no longer from the start."""
    if answered is None or start is None or near(answered, start):
        return False
    return near(answered, np.clip(answered, np.minimum(start, end), np.maximum(start, end)))
