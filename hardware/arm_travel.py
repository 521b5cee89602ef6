"""The link's own moves, home and back to where a stop caught the arm: slow, in small steps, lifted where they cross.

Where the arm stands is known to a fraction of a millimetre only. At a feed made for a step of a micrometre, that
fraction would take the arm a minute, with all that is sent meanwhile behind it. So a travel never asks for less than
its speed: it begins with a step to where the arm should be, and moves and turns one after the other, each at its feed.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from estimation.se3 import Array
from hardware.protocol import G1


def travel(start: Array, goal: Array, speed: float, turning: float, tick: float) -> Iterator[G1]:
    """Steps of a tick at most: to `start` (6,), mm and rad, straight to the place of `goal` (6,), then its angles.

    speed: mm/s. turning: rad/s. The last step ends at the goal exactly.
    """
    yield G1(start, speed)
    yield from _moved(start, goal, speed, tick)
    yield from _turned(np.concatenate([goal[:3], start[3:]]), goal, turning, tick)


def lifted(start: Array, goal: Array, speed: float, turning: float, tick: float) -> Iterator[G1]:
    """The same by way of above: up first if the goal is higher, across and turned, and down last: never low across."""
    height = max(start[2], goal[2])
    above = np.array([*goal[:2], height, *goal[3:]])
    lift = np.array([*start[:2], height, *start[3:]])
    yield G1(start, speed)
    yield from _moved(start, lift, speed, tick)
    yield from travel(lift, above, speed, turning, tick)
    yield from _moved(above, goal, speed, tick)


def _moved(start: Array, goal: Array, speed: float, tick: float) -> Iterator[G1]:
    """Steps to the place of `goal`, with the angles of `start`."""
    way = goal[:3] - start[:3]
    count = int(np.ceil(np.linalg.norm(way) / (speed * tick) - 1e-9))
    for k in range(1, count + 1):
        place = goal[:3] if k == count else start[:3] + k / count * way
        yield G1(np.concatenate([place, start[3:]]), speed)


def _turned(start: Array, goal: Array, turning: float, tick: float) -> Iterator[G1]:
    """Steps to the angles of `goal`, on the spot; their feed counts degrees."""
    way = goal[3:] - start[3:]
    count = int(np.ceil(np.linalg.norm(way) / (turning * tick) - 1e-9))
    for k in range(1, count + 1):
        yield G1(
            np.concatenate([goal[:3], goal[3:] if k == count else start[3:] + k / count * way]), np.rad2deg(turning)
        )


class OwnMoves:
    """What the link moves by itself.

    step: the next one, None without. goal: (6,) to go to after a recall, before anything else. halted: a recall was
    sent, and the way to the goal has not begun.
    """

    def __init__(self) -> None:
        self.step: G1 | None = None
        self.goal: Array | None = None
        self.halted = False
        self._steps: Iterator[G1] = iter(())
        self._broken: Iterator[G1] = iter(())  # off by a recall

    def start(self, steps: Iterator[G1]) -> None:
        """Make these the next steps."""
        self._steps = steps
        self.step, self.halted = next(steps, None), False

    def take(self) -> G1:
        """The next step, once."""
        step = self.step
        assert step is not None
        self.step = next(self._steps, None)
        return step

    def break_off(self, goal: Array) -> None:
        """What was sent last, to `goal` (6,), was called back; a second time that is not where it has to go."""
        if self.goal is None:
            rest = self._steps if self.step is None else chain([self.step], self._steps)
            self.goal, self._broken = goal, rest
        self.start(iter(()))
        self.halted = True

    def resume(self) -> None:
        """The goal is reached: go on with what was broken off."""
        self.goal = None
        self.start(self._broken)

    def drop(self) -> None:
        """Forget all."""
        self.goal, self._broken = None, iter(())
        self.start(iter(()))
