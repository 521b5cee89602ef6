"""The link's own moves, home and back to where a stop caught the arm: slow, in small steps, lifted where they cross.

Where the arm stands is known to a fraction of a millimetre only. At a feed made for a step of a micrometre, that
fraction would take the arm a minute, with all that is sent meanwhile behind it. So a travel never asks for less than
its speed: it begins with a step to where the arm should be, and moves and turns one after the other, each at its feed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain

import numpy as np

from estimation.se3 import Array
from hardware.arm.protocol import G1


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
    """What the link moves by itself. step: the next one, None without. last: the step that was the last move sent."""

    def __init__(self, speed: float, turning: float, tick: float) -> None:
        """speed: mm/s. turning: rad/s. tick: s of a step at most."""
        self._rates = speed, turning, tick
        self.step: G1 | None = None
        self.last: G1 | None = None
        self._steps: Iterator[G1] = iter(())

    def go(self, start: Array, goal: Array, lift: bool = False, then: Iterable[G1] = ()) -> None:
        """From `start` (6,) to `goal` (6,), mm and rad, are the next steps, and `then` those. lift: by way of above."""
        self._begin(chain((lifted if lift else travel)(start, goal, *self._rates), then))

    def take(self) -> G1:
        """The next step, once."""
        step = self.step
        assert step is not None
        self.step, self.last = next(self._steps, None), step
        return step

    def break_off(self) -> Iterator[G1] | None:
        """The steps that come no more, as what was sent last is called back; None where that was not a step's way.

        The last one is among them, as none of it may have gone out; given twice it goes no farther.
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
