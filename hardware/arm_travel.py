"""The link's own moves, home and back to where a stop caught the arm: slow, in small steps, lifted where they cross."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimation.se3 import Array
from hardware.protocol import G1
from planning.command import TURNING


def travel(start: Array, goal: Array, speed: float, turning: float, tick: float) -> Iterator[G1]:
    """Steps of one tick each, in a straight line from `start` to `goal`, both (6,) mm and rad; none where they are one.

    speed: mm/s. turning: rad/s. The last step ends at the goal exactly.
    """
    way = goal - start
    length, turn = float(np.linalg.norm(way[:3])), float(np.linalg.norm(way[3:]))
    count = int(np.ceil(max(length / speed, turn / turning) / tick))
    for k in range(1, count + 1):
        step = way / count
        size = float(np.linalg.norm(step[:3]))
        amount = size if size > TURNING else float(np.rad2deg(np.linalg.norm(step[3:])))
        yield G1(goal if k == count else start + k * step, max(amount / tick, 1e-3))


def lifted(start: Array, goal: Array, speed: float, turning: float, tick: float) -> Iterator[G1]:
    """Steps that go up first if the goal is higher, then across, and down last: never low across."""
    height = max(start[2], goal[2])
    above_start = np.array([*start[:2], height, *start[3:]])
    above_goal = np.array([*goal[:2], height, *goal[3:]])
    for a, b in ((start, above_start), (above_start, above_goal), (above_goal, goal)):
        yield from travel(a, b, speed, turning, tick)
