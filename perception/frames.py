"""Images with their stamps, the print head as the arm reports it, and frames of one instant grouped by stamp, live or
over a recording.

Must not import OpenCV: the motion process needs the tool's profile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array

Image = NDArray[np.uint8]
StampedBy = Literal["", "driver", "stream", "arrival"]  # source of a live frame's stamp; "" of a recorded one


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of one camera."""

    camera: int  # number in the rig
    stamp: float  # s, middle of the exposure
    image: Image  # (H, W) grey or (H, W, 3) BGR
    by: StampedBy = ""

    def __repr__(self) -> str:
        h, w = self.image.shape[:2]
        return f"Frame(camera {self.camera} at {self.stamp:.3f} s, {w} x {h} px)"


@dataclass(frozen=True, slots=True, eq=False)
class PrintHead:
    """Pose and state of the print head, by the arm."""

    base_from_nozzle: Array  # (4, 4) mm, z from the tip up into the head
    extruding: bool  # whether ink flows


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """The frames of one instant, at most one per camera, in the rig's order; a camera may be missing."""

    stamp: float  # s
    frames: tuple[Frame, ...]
    head: PrintHead | None = None  # at that instant, with an arm

    def __repr__(self) -> str:
        return f"FrameSet(cameras {', '.join(str(frame.camera) for frame in self.frames)} at {self.stamp:.3f} s)"


@dataclass(frozen=True, slots=True, eq=False)
class Roi:
    """Region of interest: where the surface is in one image."""

    camera: int  # number in the rig
    stamp: float  # s
    polygon: Array  # (N, 2) px, may reach beyond the image
    found: bool = False  # by a network, which may be wrong; else by an operator or a mark


@dataclass(frozen=True, slots=True, eq=False)
class OutlinedPicture:
    """One camera's picture, and the outline of the wound in it."""

    camera: int  # number in the rig
    stamp: float  # s, of the outline
    taken: float  # s, stamp of the picture
    image: Image  # (H, W) grey or (H, W, 3) BGR
    polygon: Array  # (N, 2) px, round the wound
    by: str  # author of the outline: "operator"


ROI_LEAD = 0.1  # s before a region's stamp, from which it is used: more than the offset of free-running cameras
ROI_SLACK = 1e-3  # s of margin by which the first frame set of a region is later than that


def region_since(roi: Roi, stamp: float) -> Roi:
    """The region with a stamp such that it is used from the frame set at `stamp`, s, on, and not before."""
    return replace(roi, stamp=stamp + ROI_LEAD - ROI_SLACK)


def whole_pictures(sizes: Sequence[tuple[int, int]], stamp: float) -> tuple[Roi, ...]:
    """Every camera's whole picture as a region. sizes: (W, H) px by camera."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    return tuple(Roi(camera, stamp, corners * size) for camera, size in enumerate(sizes))


def of_whole_pictures(roi: Sequence[Roi], sizes: Sequence[tuple[int, int]]) -> bool:
    """Whether regions, if any, contain the whole pictures, and so do not specify the surface."""
    for region in roi:
        low, high = region.polygon.min(0), region.polygon.max(0)
        if (low > 0).any() or (high < sizes[region.camera]).any() or len(region.polygon) != 4:
            return False
    return True


def region_polygons(roi: Sequence[Roi], frames: FrameSet, sizes: Sequence[tuple[int, int]]) -> dict[int, Array] | str:
    """The region of interest (N, 2) px in each image of the set, by camera, or why there is none yet.

    Without regions: the whole images. sizes: (W, H) px by camera.
    """
    roi = roi or whole_pictures(sizes, frames.stamp)
    start = max(r.stamp for r in roi)
    if frames.stamp < start - ROI_LEAD:
        return f"waiting for the region of interest at {start:.3f} s"
    cameras = {f.camera for f in frames.frames}
    return {r.camera: r.polygon for r in sorted(roi, key=lambda r: r.camera) if r.camera in cameras}


COMPARED_ROW_STEP = 16  # rows: noise makes two pictures differ in the first rows compared


class DuplicateFilter:
    """Remembers the last picture of each camera."""

    def __init__(self) -> None:
        self._last: dict[int, Image] = {}

    def __call__(self, camera: int, image: Image) -> bool:
        """Whether a camera's image (H, W) differs from its last one in a single bit.

        A sensor's noise never repeats. A picture without noise, of a scene at rest, counts as repeated too: it cannot
        be distinguished from that of a camera that hangs.
        """
        last = self._last.get(camera)
        self._last[camera] = image
        if last is None or not np.array_equal(last[::COMPARED_ROW_STEP], image[::COMPARED_ROW_STEP]):
            return True
        return not np.array_equal(last, image)


Result = TypeVar("Result")

MAX_THREADS = 3  # cameras of a usual rig; more threads would wait for each other
_POOL = ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="camera")


def parallel_map(function: Callable[..., Result], *arguments: Iterable[object]) -> list[Result]:
    """As list(map(function, *arguments)); the function must not call `parallel_map`.

    The calling thread makes the first call: a submitted one may wait for a core.
    """
    calls = list(zip(*arguments, strict=True))
    futures = [_POOL.submit(function, *call) for call in calls[1:]]
    return [*(function(*first) for first in calls[:1]), *(call.result() for call in futures)]


# Height above the tip and radius, mm: a luer needle of half an inch on a 5 ml cartridge in its holder.
SYRINGE = np.array([[0, 0.5], [12.7, 0.5], [13.6, 2.5], [23, 3.6], [27, 4.8], [50, 4.8], [58, 8], [96, 8]], float)


def check_profile(where: object, what: str, profile: Array) -> None:
    """InputError unless a profile (K, 2) of [height, radius], mm, is that of a tool."""
    well_shaped = profile.ndim == 2 and profile.shape[1:] == (2,) and len(profile) > 1
    if not (well_shaped and np.isfinite(profile).all() and (np.diff(profile[:, 0]) > 0).all() and (profile >= 0).all()):
        allowed = "two or more [height, radius] in mm, none negative, heights rising"
        raise InputError(where, what, profile.tolist(), allowed)


DEFAULT_PERIOD = 1 / 30  # s, of the thesis's cameras: for recordings in which no camera has two frames
TOLERANCE_PERIODS = 0.5  # see `pairing_tolerance`
DELAY_SAMPLES = 5  # frames of a camera: its usual delay is their median delay from the first frame of their sets
SILENT_PERIODS = 5.0  # without a frame, after which no set waits for a camera: four lost frames in a row are rare


class Stamped(Protocol):
    """An item of a camera at a stamp."""

    @property
    def camera(self) -> int:
        """Number of the camera in the rig."""

    @property
    def stamp(self) -> float:
        """Instant, s, on the clock that all cameras share."""


StampedItem = TypeVar("StampedItem", bound=Stamped)


def frame_period(stamps: Sequence[Array]) -> float:
    """Frame period, s: the smallest of the cameras' median steps; stamps holds one rising (N,) array per camera.

    The median tolerates the loss of fewer than half of a camera's frames, the minimum a camera that loses more or runs
    slower.
    """
    return min((float(np.median(np.diff(s))) for s in stamps if len(s) > 1), default=DEFAULT_PERIOD)


def pairing_tolerance(period: float) -> float:
    """Largest spread, s, of the stamps of one set: half a frame period.

    Cameras that fire together every `period` with jitter of up to +-j spread by at most 2 j within an instant, and the
    next one follows after at least period - 2 j. A limit must lie between the two. Half a period does for every j below
    a quarter of the period; no other limit tolerates more.
    """
    return TOLERANCE_PERIODS * period


def pair(items: Iterable[StampedItem], tolerance: float, cameras: int) -> Iterator[tuple[StampedItem, ...]]:
    """Sets of items, each in the rig's order, from items in order of stamp; every item is in exactly one set.

    A set ends when it has all `cameras`, before a camera's second item, and before an item more than `tolerance` (s)
    later than the set's first. It is yielded as early as possible, without looking ahead.
    """
    current: dict[int, StampedItem] = {}
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


def _in_rig_order(by_camera: dict[int, StampedItem]) -> tuple[StampedItem, ...]:
    return tuple(by_camera[camera] for camera in sorted(by_camera))


def mean_stamp(items: Sequence[Stamped]) -> float:
    """Mean of the stamps, s, computed relative to the first so that a large epoch costs no digits."""
    first = items[0].stamp
    return first + sum(item.stamp - first for item in items) / len(items)


def frame_set(frames: Sequence[Frame]) -> FrameSet:
    """The frames of one instant as a set, at the mean of their stamps."""
    return FrameSet(mean_stamp(frames), tuple(sorted(frames, key=lambda f: f.camera)))


class Pairing:
    """Frame sets from live frames, which arrive in any order between cameras, some late, some never.

    A set is complete when every active camera is in it or has since delivered a later frame. An incomplete set is
    output `patience` s after the arrival of its first frame. The patience is half a period. A camera's usual delay is
    added if longer, at most one period: else the frames of a camera that is always late would never be used. A camera
    silent for SILENT_PERIODS is not waited for.

    Sets are output in order of stamp; a frame too late for that is dropped and counted in `late`. The frames of one
    camera are assumed to arrive in order.
    """

    def __init__(self, cameras: int, period: float) -> None:
        """cameras: number of them in the rig. period: s, of their frames."""
        self.late = 0
        self.retime(period)
        self._open_sets: list[_OpenSet] = []  # oldest first
        self._last_stamp = [-math.inf] * cameras
        self._last_arrival: list[float | None] = [None] * cameras  # s
        self._last_set: _OpenSet | None = None  # the last output
        self._delays: list[deque[float]] = [deque(maxlen=DELAY_SAMPLES) for _ in range(cameras)]  # s, see `_add_delay`

    def retime(self, period: float) -> None:
        """The cameras' frames come every `period` s from now on."""
        self.patience = pairing_tolerance(period)
        self._period, self._tolerance, self._silence_limit = period, pairing_tolerance(period), SILENT_PERIODS * period

    def add(self, frame: Frame, now: float) -> list[FrameSet]:
        """The sets to output after the arrival of a frame; now: s, rising from call to call."""
        self._last_stamp[frame.camera], self._last_arrival[frame.camera] = frame.stamp, now
        last = self._last_set
        belongs_to_last = last is not None and last.accepts(frame, self._tolerance)
        if last is not None and (belongs_to_last or frame.stamp <= last.last):
            self.late += 1
            if belongs_to_last:
                self._add_delay(frame.camera, now - last.arrival)
        else:
            self._insert(frame, now)
        return self.due(now)

    def due(self, now: float) -> list[FrameSet]:
        """The sets that are complete or past their deadline at `now`, s."""
        self._last_arrival = [now if arrival is None else arrival for arrival in self._last_arrival]
        # a finished set is output with all before it, so that stamps rise
        count = max((i for i, group in enumerate(self._open_sets, 1) if self._is_finished(group, now)), default=0)
        out, self._open_sets = self._open_sets[:count], self._open_sets[count:]
        if out:
            self._last_set = out[-1]
        return [frame_set(list(group.frames.values())) for group in out]

    def _add_delay(self, camera: int, delay: float) -> None:
        """Add a frame's delay, s, from the first one of its set; a camera's usual delay is their median."""
        self._delays[camera].append(delay)
        usual = [float(np.median(d)) for d in self._delays if len(d) == DELAY_SAMPLES]
        longest = min(max(usual, default=0.0), self._period)
        self.patience = self._tolerance + (longest if longest > self._tolerance else 0.0)

    def _insert(self, frame: Frame, now: float) -> None:
        for i, group in enumerate(self._open_sets):
            in_order = all(frame.stamp < later.last for later in self._open_sets[i + 1 :])
            if in_order and group.accepts(frame, self._tolerance):
                group.frames[frame.camera] = frame
                self._add_delay(frame.camera, now - group.arrival)
                return
        if any(group.first <= frame.stamp <= group.last for group in self._open_sets):  # within another set
            self.late += 1
            return
        self._open_sets.append(_OpenSet(now, now + self.patience, {frame.camera: frame}))
        self._open_sets.sort(key=lambda group: group.first)

    def _is_finished(self, group: _OpenSet, now: float) -> bool:
        missing = [camera for camera in range(len(self._last_stamp)) if camera not in group.frames]
        return now >= group.deadline or not any(self._may_come(group, camera, now) for camera in missing)

    def _may_come(self, group: _OpenSet, camera: int, now: float) -> bool:
        arrival = self._last_arrival[camera]
        alive = arrival is not None and now - arrival <= self._silence_limit
        return alive and self._last_stamp[camera] < group.first + self._tolerance


@dataclass(slots=True)
class _OpenSet:
    """An incomplete set."""

    arrival: float  # s, when its first frame came
    deadline: float  # s, of its output
    frames: dict[int, Frame]  # by camera

    @property
    def first(self) -> float:
        return min(frame.stamp for frame in self.frames.values())

    @property
    def last(self) -> float:
        return max(frame.stamp for frame in self.frames.values())

    def accepts(self, frame: Frame, tolerance: float) -> bool:
        """Whether a frame belongs to the set: of a new camera, with all stamps within `tolerance`, s."""
        near = max(frame.stamp, self.last) - min(frame.stamp, self.first) <= tolerance
        return near and frame.camera not in self.frames
