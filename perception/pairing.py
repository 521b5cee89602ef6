"""Which frames of several cameras belong to one instant: grouping by stamp, as they arrive or over a recording."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from estimation.se3 import Array
from perception.frames import Frame, FrameSet

DEFAULT_PERIOD = 1 / 30  # s: the rate of the thesis's cameras, where no camera has two frames to tell its own
TOLERANCE_PERIODS = 0.5  # see `pairing_tolerance`
USUAL = 5  # frames of a camera, of whose delays behind the first one of their sets the median is usual
SILENT_PERIODS = 5.0  # without a frame, after which no set waits for a camera: four lost in a row are rare


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


class Pairing:
    """Frame sets from frames as they arrive: in any order between cameras, some late, some never.

    A set is given out as soon as no frame that is still to come can belong to it: it holds every camera that is alive,
    or each one that it lacks has since delivered a younger frame. What is never to come is waited for `patience`
    after the set's first arrival, and a camera silent for SILENT_PERIODS no longer at all. That is half a period, and
    where a camera's frames usually come later, its usual delay more, a period at most: stamps need not tell when a
    camera exposed, and one that is always too late would never be seen at all. Sets come out in order of stamp; a frame
    that is too late for that is left out and counted in `late`. The frames of one camera are taken to arrive in order.
    """

    def __init__(self, cameras: int, period: float) -> None:
        """cameras: in the rig. period: s, of its frames."""
        self.late = 0
        self.retime(period)
        self._open: list[_Open] = []  # oldest first
        self._newest = [-math.inf] * cameras  # stamp
        self._heard: list[float | None] = [None] * cameras  # s, arrival
        self._given: _Open | None = None
        self._delays: list[deque[float]] = [deque(maxlen=USUAL) for _ in range(cameras)]  # s, behind the set's first

    def retime(self, period: float) -> None:
        """The cameras' frames come every `period` s from now on."""
        self.patience = pairing_tolerance(period)
        self._period, self._tolerance, self._silent = period, pairing_tolerance(period), SILENT_PERIODS * period

    def add(self, frame: Frame, now: float) -> list[FrameSet]:
        """The sets that can be given out once a frame has arrived; now: s, rising from call to call."""
        self._newest[frame.camera], self._heard[frame.camera] = frame.stamp, now
        if self._given is not None and self._given.should_have_held(frame, self._tolerance):
            self.late += 1
            if self._given.takes(frame, self._tolerance):
                self._learn(frame.camera, now - self._given.arrived)
        else:
            self._place(frame, now)
        return self.due(now)

    def due(self, now: float) -> list[FrameSet]:
        """The sets that need not or must not be waited for any longer at `now`, s."""
        self._heard = [now if heard is None else heard for heard in self._heard]
        count = 0
        for i, group in enumerate(self._open, 1):
            if self._is_finished(group, now):
                count = i  # and all before it, so that stamps rise
        out, self._open = self._open[:count], self._open[count:]
        if out:
            self._given = out[-1]
        return [frame_set(list(group.frames.values())) for group in out]

    def _learn(self, camera: int, delay: float) -> None:
        """A frame came `delay` s after the first one of its set; what comes within half a period is waited for anyway.

        A delay of most of the last frames is a camera's way to be; a single one is a hiccup.
        """
        self._delays[camera].append(delay)
        usual = [float(np.median(d)) for d in self._delays if len(d) == USUAL]
        longest = min(max(usual, default=0.0), self._period)
        self.patience = self._tolerance + (longest if longest > self._tolerance else 0.0)

    def _place(self, frame: Frame, now: float) -> None:
        for i, group in enumerate(self._open):
            rises = all(frame.stamp < later.last for later in self._open[i + 1 :])
            if rises and group.takes(frame, self._tolerance):
                group.frames[frame.camera] = frame
                self._learn(frame.camera, now - group.arrived)
                return
        if any(group.first <= frame.stamp <= group.last for group in self._open):  # amid a set that it is no part of
            self.late += 1
            return
        self._open.append(_Open(now, now + self.patience, {frame.camera: frame}))
        self._open.sort(key=lambda group: group.first)

    def _is_finished(self, group: _Open, now: float) -> bool:
        return now >= group.until or not any(
            self._may_come(group, camera, now) for camera in range(len(self._newest)) if camera not in group.frames
        )

    def _may_come(self, group: _Open, camera: int, now: float) -> bool:
        heard = self._heard[camera]
        alive = heard is not None and now - heard <= self._silent
        return alive and self._newest[camera] < group.first + self._tolerance


@dataclass(slots=True)
class _Open:
    """A set that is being gathered. arrived: s, when its first frame came. until: s, waited for. frames: by camera."""

    arrived: float
    until: float
    frames: dict[int, Frame]

    @property
    def first(self) -> float:
        return min(frame.stamp for frame in self.frames.values())

    @property
    def last(self) -> float:
        return max(frame.stamp for frame in self.frames.values())

    def takes(self, frame: Frame, tolerance: float) -> bool:
        """Whether a frame belongs here: its camera is not there yet, and no two stamps are further than `tolerance`."""
        near = max(frame.stamp, self.last) - min(frame.stamp, self.first) <= tolerance
        return near and frame.camera not in self.frames

    def should_have_held(self, frame: Frame, tolerance: float) -> bool:
        """Whether a frame belongs here or is older."""
        return frame.stamp <= self.last or self.takes(frame, tolerance)
