"""Which frames of several cameras belong to one instant: grouping by stamp, online or over a whole recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol, TypeVar

import numpy as np

from estimation.se3 import Array
from perception.frames import Frame, FrameSet

DEFAULT_PERIOD = 1 / 30  # s: the rate of the thesis's cameras, where no camera has two frames to tell its own
TOLERANCE_PERIODS = 0.5  # see `pairing_tolerance`


class Stamped(Protocol):
    """Anything that a camera (its number in the rig) took at a stamp (s)."""

    @property
    def camera(self) -> int:
        """Number of the camera in the rig."""
        ...

    @property
    def stamp(self) -> float:
        """Instant, s, on the clock that all cameras share."""
        ...


S = TypeVar("S", bound=Stamped)


def frame_period(stamps: Sequence[Array]) -> float:
    """Frame period, s: the smallest of the cameras' median steps; stamps holds one rising (N,) array per camera.

    The median forgives a camera fewer than half of its frames, the minimum one that drops more or runs slower.
    """
    steps = [float(np.median(np.diff(s))) for s in stamps if len(s) > 1]
    return min(steps, default=DEFAULT_PERIOD)


def pairing_tolerance(period: float) -> float:
    """Largest spread, s, of the stamps of one set: half a frame period.

    Cameras that fire together every `period` with jitter of up to j either way spread by at most 2 j within an
    instant and leave at least period - 2 j to the next one. A limit that tells the two apart lies between, and
    the half does so for every j below a quarter of the period: no other limit bears more.
    """
    return TOLERANCE_PERIODS * period


def pair(items: Iterable[S], tolerance: float, cameras: int) -> Iterator[tuple[S, ...]]:
    """Sets of items, each in the rig's order, from items in order of stamp; every item comes out exactly once.

    A set ends when it holds all `cameras`, when a camera would come a second time, or when an item is more than
    `tolerance` (s) younger than the set's first. So it is given out as early as can be known, and no set looks ahead.
    """
    current: dict[int, S] = {}
    first = 0.0
    for item in items:
        if current and (item.camera in current or item.stamp - first > tolerance):
            yield _in_rig_order(current)
            current = {}
        if not current:
            first = item.stamp
        current[item.camera] = item
        if len(current) == cameras:
            yield _in_rig_order(current)
            current = {}
    if current:
        yield _in_rig_order(current)


def _in_rig_order(by_camera: dict[int, S]) -> tuple[S, ...]:
    return tuple(by_camera[camera] for camera in sorted(by_camera))


def mean_stamp(items: Sequence[Stamped]) -> float:
    """Mean of the stamps, s, taken about the first so that a large epoch costs no digits."""
    first = items[0].stamp
    return first + sum(item.stamp - first for item in items) / len(items)


def frame_set(frames: Sequence[Frame]) -> FrameSet:
    """The frames of one instant as a set, at the mean of their stamps."""
    return FrameSet(mean_stamp(frames), tuple(sorted(frames, key=lambda f: f.camera)))
