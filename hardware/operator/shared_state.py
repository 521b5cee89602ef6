"""What a run and its operator's page share in memory: the newest view, pictures and scene, and a line of requests.

Neither side ever waits: a full line refuses what comes, wishes that lead towards rest have places that nothing else
takes, and a stop has one of its own that cannot be full. A page that is killed while it writes leaves nothing behind
that the run would stumble over. Path and nozzle are drawn by the browser, which knows the cameras from the scene: a
picture carries only the pose of its instant.
"""

from __future__ import annotations

import struct
from ctypes import Structure, c_bool, c_uint64
from dataclasses import dataclass, field, replace
from enum import StrEnum
from multiprocessing.sharedctypes import RawArray, RawValue
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.files.region_table import Corners
from hardware.operator.view import (
    CALMING_WISHES,
    CameraView,
    MoveRequest,
    OperatorView,
    Wish,
)
from hardware.process.system import SharedLatest
from planning.path import Path

REQUEST_SLOTS = 16  # requests that wait; the run takes them every few ms and a hand gives a few in a second
OTHER_REQUEST_SLOTS = 8  # of them for what does not lead towards rest: a flood of such requests leaves room for a pause
PICTURES_CAPACITY = 1 << 22  # bytes: three pictures of 640 px and fine near ones take 1 MB with all that lies over them
MAX_PATH_POINTS, MAX_TRIANGLES = 4000, 1500  # what a browser without a graphics card draws ten times a second
OUTLINE_CAPACITY = 1 << 15  # bytes: four times a window's longest message
SHEET_CAPACITY = 1 << 22  # bytes: pictures of six cameras, 1280 px at most
SCENE_CAPACITY = 1 << 21  # bytes: ten times what these limits allow
_BODY = struct.Struct("=QQBddd")  # number, turn, wish, move: mm, mm, degrees
_RECORD = struct.Struct("=QQBdddI")  # the same, and its check sum
_LAST, _STOP, _WRITTEN, _TAKEN = range(4)  # last number given, last stop, records written and taken
_WISHES = tuple(Wish)

Polygons = tuple[tuple[str, Corners], ...]  # px, by camera's name


@dataclass(frozen=True, slots=True)
class OperatorRequest:
    """A wish of an operator."""

    number: int  # counts up over all windows
    wish: Wish
    turn: int  # of the view that the operator saw when asking
    move: MoveRequest | None = None  # of Wish.MOVE, and of no other
    outline: Polygons = ()  # of Wish.OUTLINE alone; none where it was lost as another one came


class RequestLine:
    """The line of requests in shared memory: one page asks, one run takes."""

    def __init__(self) -> None:
        self._counts: Any = RawArray(c_uint64, 4)  # each is written whole, or not at all
        self._records: Any = RawArray("B", REQUEST_SLOTS * _RECORD.size)
        self._stops_seen = 0

    def ask(self, wish: Wish, turn: int, move: MoveRequest | None = None) -> int | None:
        """Number of the request; None where the line is full: for CALMING_WISHES later, for a stop never.

        move: of Wish.MOVE.
        """
        number = self.next_number
        if wish is Wish.STOP:
            self._counts[_LAST] = number
            self._counts[_STOP] = number
            return number
        written = self._counts[_WRITTEN]
        if written - self._counts[_TAKEN] >= (REQUEST_SLOTS if wish in CALMING_WISHES else OTHER_REQUEST_SLOTS):
            return None
        shift = (0.0, 0.0, 0.0) if move is None else (move.x_mm, move.y_mm, move.turn_deg)
        body = (number, turn, _WISHES.index(wish), *shift)
        _RECORD.pack_into(self._records, _slot_offset(written), *body, _check_sum(*body))
        self._counts[_LAST] = number
        self._counts[_WRITTEN] = written + 1
        return number

    def take(self) -> list[OperatorRequest]:
        """The requests since the last call, in order; a stop stands alone, as what came with it is void."""
        waiting = list(self._waiting())
        stop = self._counts[_STOP]
        if stop != self._stops_seen:
            self._stops_seen = stop
            return [OperatorRequest(stop, Wish.STOP, 0)]
        return waiting

    @property
    def next_number(self) -> int:
        """The number that the next request will have."""
        return int(self._counts[_LAST]) + 1

    @property
    def last_stop(self) -> int:
        """Number of the last stop, 0 before the first; any process that holds the line may watch it."""
        return int(self._counts[_STOP])

    def _waiting(self) -> list[OperatorRequest]:
        taken, written, requests = self._counts[_TAKEN], self._counts[_WRITTEN], []
        while taken < written:
            *body, check = _RECORD.unpack_from(self._records, _slot_offset(taken))
            if check != _check_sum(*body):
                break  # the count was seen before the record: the next look finds it whole
            number, turn, index, *shift = body
            wish = _WISHES[index]
            move = MoveRequest(*shift) if wish is Wish.MOVE else None
            requests.append(OperatorRequest(number, wish, turn, move))
            taken += 1
        self._counts[_TAKEN] = taken
        return requests


def _slot_offset(count: int) -> int:
    return (count % REQUEST_SLOTS) * _RECORD.size


def _check_sum(*body: float) -> int:
    return crc32(_BODY.pack(*body))


class PageStatus(Structure):
    """What the page's process says of itself; each figure is written whole, or not at all.

    windows: how many show the page; without any, no pictures need be made.
    fine: whether near pictures are wanted pixel by pixel, as something is judged by them.
    reports: how often the report of a run that is over was handed out.
    """

    _fields_ = (("windows", c_uint64), ("fine", c_bool), ("reports", c_uint64))


@dataclass(frozen=True, slots=True, eq=False)
class CameraPicture:
    """One camera's picture; all pixels count in the camera's own size."""

    camera: str
    jpeg: bytes  # of any size
    outline: tuple[Array, ...] = ()  # of the wound, polygons (K, 2) px of the image as it is
    tracks: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (M, 2) px, undistorted as in Observations
    near: bytes = b""  # JPEG of the part `crop` around outline and tracks, b"" without any
    crop: tuple[int, int, int, int] | None = None  # x, y, width, height px


@dataclass(frozen=True, slots=True, eq=False)
class PagePictures:
    """The pictures of one instant."""

    stamp: float  # s
    pictures: tuple[CameraPicture, ...]
    base_from_surface: Array | None = None  # (4, 4) mm at that instant, None while it is unknown


@dataclass(frozen=True, slots=True)
class CorrectedOutline:
    """The wound's outline as an operator corrected it; checked by the page as a region is."""

    number: int  # of the request that it belongs to
    polygons: Polygons


@dataclass(frozen=True, slots=True, eq=False)
class LaidDrawing:
    """What a look found of S pieces of bead, surface frame."""

    pieces: Array  # (S, 2, 3) mm, from, to
    share: Array  # (S,) of the planned; NaN where it was not seen


@dataclass(frozen=True, slots=True, eq=False)
class PageScene:
    """What stands still in the view: cameras, and path and surface in the surface frame. Sent when it changes."""

    cameras: tuple[Camera, ...]
    path: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (K, 3) mm, places in order
    checkpoint: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # (K,) their numbers
    extrude: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))  # (K,) whether on the way to each
    surface: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (V, 3) mm
    triangles: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))  # (T, 3), or none known
    scan: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))  # (L, 2, 3) mm, lines of the scan
    layer: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # (K,) of each of the places
    laid: LaidDrawing | None = None  # what the last look found


def scene_from(
    rig: Rig,
    path: Path | None = None,
    surface: Array | None = None,
    triangles: NDArray[np.int64] | None = None,
    scan: Array | None = None,
) -> PageScene:
    """The scene, thinned to what a browser draws with ease.

    surface: (V, 3) mm, triangles: (T, 3), scan: (L, 2, 3) mm, lines of it; all in the surface frame.
    """
    empty = PageScene(rig.cameras)
    drawn = empty.checkpoint if path is None else _drawn_checkpoints(path)
    points = empty.surface if surface is None else np.asarray(surface, float)
    corners = empty.triangles if triangles is None else np.asarray(triangles, np.int64)
    if len(corners) > MAX_TRIANGLES:
        points, corners = coarser_mesh(points, corners, MAX_TRIANGLES)
    elif not len(corners) and len(points) > MAX_TRIANGLES:
        points = points[np.linspace(0, len(points) - 1, MAX_TRIANGLES).astype(np.int64)]
    lines = empty.scan if scan is None else scan
    if path is None:
        return PageScene(rig.cameras, surface=points, triangles=corners, scan=lines)
    places = path.surface_from_nozzle[drawn, :3, 3]
    return PageScene(rig.cameras, places, drawn, path.extrude[drawn], points, corners, lines, path.layer[drawn])


def _drawn_checkpoints(path: Path) -> NDArray[np.int64]:
    """Numbers of the checkpoints that are drawn: all, or evenly thinned ones and each where extrusion changes."""
    count = len(path)
    even = np.linspace(0, count - 1, min(count, MAX_PATH_POINTS)).astype(np.int64)
    if count <= MAX_PATH_POINTS:
        return even
    changes = np.flatnonzero(np.diff(path.extrude.astype(np.int8)))
    ends = np.concatenate([changes, changes + 1])
    return np.unique(np.concatenate([even, ends[: MAX_PATH_POINTS // 2]]))


def coarser_mesh(points: Array, triangles: NDArray[np.int64], most: int) -> tuple[Array, NDArray[np.int64]]:
    """The surface with the corners in each cell of a cube grid drawn together; as fine as `most` triangles allow."""
    low, high = points.min(axis=0), points.max(axis=0)
    cell = float((high - low).max()) / np.sqrt(most)
    while True:
        _, group = np.unique(np.floor((points - low) / cell).astype(np.int64), axis=0, return_inverse=True)
        group = group.reshape(-1)
        merged = group[triangles]
        distinct = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
        coarse = np.unique(np.sort(merged[distinct], axis=1), axis=0)
        if len(coarse) <= most:
            break
        cell *= 1.2
    middles = np.stack([np.bincount(group, points[:, k]) for k in range(3)], axis=1) / np.bincount(group)[:, None]
    return middles, coarse


@dataclass(frozen=True, slots=True, eq=False)
class ScanDrawing:
    """A scan as it is drawn, in its own frame."""

    lines: Array  # (L, 2, 3) mm, from where to where
    points: Array  # (V, 3) mm
    triangles: NDArray[np.int64]  # (T, 3)


class RecordingStage(StrEnum):
    """Where a recording is."""

    RECORD = "record"
    ENDED = "ended"  # what is on the disk is whole
    FAILED = "failed"  # what was written before is kept


@dataclass(frozen=True, slots=True)
class RecordingView:
    """The state of a recording without an arm."""

    stamp: float  # s
    turn: int
    stage: RecordingStage
    seconds: float  # of it so far
    size: int  # bytes on the disk
    sets: int  # frame sets taken
    dropped: int  # of them, for which the recorder had no room
    cameras: tuple[CameraView, ...] = ()
    words: str = ""  # what ended it
    offers: tuple[Wish, ...] = ()
    draws: bool = False  # whether a region may be drawn now


class WavingStage(StrEnum):
    """Where a calibration is."""

    WAVE = "wave"  # the board is looked for
    SOLVE = "solve"  # enough was seen: lenses and places are computed
    PASSED = "passed"
    FAILED = "failed"  # not good enough, or not to be calibrated from this
    STOPPED = "stopped"  # the corners are kept


@dataclass(frozen=True, slots=True)
class WavingCamera:
    """One camera's views of the board so far."""

    name: str
    size: tuple[int, int]  # (W, H) px of its picture
    corners: int  # in the newest picture
    parts: tuple[tuple[float, ...], ...]  # of the picture, row by row: 0 to 1 of the corners that each should have
    tilts: tuple[float, ...]  # left, right, top, bottom nearer: 0 to 1 of the views that should be tilted so
    depth: float  # 0 to 1 of how much nearer than the far views the near ones should be


@dataclass(frozen=True, slots=True)
class WavingView:
    """The state of a calibration."""

    stamp: float  # s
    turn: int
    stage: WavingStage
    hints: tuple[str, ...] = ()  # what to do next, the most needed first
    cameras: tuple[WavingCamera, ...] = ()
    together: float = 0.0  # 0 to 1 of the frame sets in which two cameras should have seen the board
    looked: int = 0  # frame sets looked at
    words: tuple[str, ...] = ()  # the result
    offers: tuple[Wish, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class OperatorLink:
    """All that joins a run and its page, handed to each process that takes part when it is started.

    Of `views`, `pictures`, `sheet` and `scene` each has one process that puts; the page gets. It puts `regions`,
    `outlines` and `status`. `sheet`: the pictures in which the wound was looked for, each whole and with the outline
    found there.
    """

    views: SharedLatest[OperatorView | WavingView | RecordingView] = field(default_factory=SharedLatest)
    pictures: SharedLatest[PagePictures] = field(default_factory=lambda: SharedLatest(PICTURES_CAPACITY))
    sheet: SharedLatest[PagePictures] = field(default_factory=lambda: SharedLatest(SHEET_CAPACITY))
    scene: SharedLatest[PageScene] = field(default_factory=lambda: SharedLatest(SCENE_CAPACITY))
    scan: SharedLatest[ScanDrawing] = field(default_factory=lambda: SharedLatest(SCENE_CAPACITY))  # for the scene
    laid: SharedLatest[LaidDrawing] = field(default_factory=lambda: SharedLatest(SCENE_CAPACITY))  # for the scene
    requests: RequestLine = field(default_factory=RequestLine)
    status: PageStatus = field(default_factory=lambda: RawValue(PageStatus))
    regions: SharedLatest[Polygons] = field(default_factory=SharedLatest)  # checked against the scene's cameras
    outlines: SharedLatest[CorrectedOutline] = field(default_factory=lambda: SharedLatest(OUTLINE_CAPACITY))

    def ask(self, wish: Wish, turn: int, move: MoveRequest | None = None, outline: Polygons = ()) -> int | None:
        """As `RequestLine.ask`; outline: of Wish.OUTLINE."""
        if wish is Wish.OUTLINE:
            self.outlines.put(CorrectedOutline(self.requests.next_number, outline))
        return self.requests.ask(wish, turn, move)

    def take(self) -> list[OperatorRequest]:
        """As `RequestLine.take`, each outline with its request."""
        return [self._with_outline(each) if each.wish is Wish.OUTLINE else each for each in self.requests.take()]

    def _with_outline(self, request: OperatorRequest) -> OperatorRequest:
        newest = self.outlines.get()
        own = newest is not None and newest.number == request.number
        return replace(request, outline=newest.polygons) if newest is not None and own else request
