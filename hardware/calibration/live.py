"""Calibration with live cameras: corners are collected while the board is waved, and a page says where to hold it.

An interrupted run keeps its corners, and the next one goes on from there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from estimation import se3
from estimation.calibration.lens_model import lens_matrix
from estimation.calibration.rig_fit import MAX_INSTANT_GAP
from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.calibration.corners import (
    CORNER_THREADS,
    CORNERS_VERSION,
    MIN_COMMON_SETS,
    MIN_DEPTH_RATIO,
    MIN_PART_CORNERS,
    MIN_TILT_SHARE,
    CornerSearch,
    CoverageGuide,
)
from hardware.calibration.inputs import CalibrationInput
from hardware.cameras.feed import CameraPhase, CameraPlace, LiveHealth
from hardware.cameras.live import places_without_rig, sources_named
from hardware.cameras.sources import CameraSource
from hardware.files.rig_file import MIN_RIG_SPAN, ImageSource, read_rig
from hardware.operator.process import CameraShot, StatusPage
from hardware.operator.shared_state import WavingCamera, WavingStage, WavingView
from hardware.operator.view import Wish
from hardware.process.clock import Clock
from hardware.process.progress import Progress
from perception.boards.board import Board, CornerTable
from perception.frames import FrameSet, Image

OPENING_TIMEOUT = 15.0  # s until every camera has shown a picture
WAVING_POLL = 0.5  # s between checks of the time
RUN_GAP = 2 * MAX_INSTANT_GAP  # s put between the corners of two runs: the board's motion is not interpolated there
RECENT_PICTURES = 5  # of each camera


class WavingPage(StatusPage):
    """The page beside a live calibration, as a context."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock, "waving.html")
        self._view = WavingView(0.0, 1, WavingStage.WAVE, offers=(Wish.END,))

    def __enter__(self) -> WavingPage:
        self.page.tend(self.clock.now())
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, KeyboardInterrupt):
            self.enter(WavingStage.STOPPED, "the corners are kept; the same command goes on from there")
        elif error is not None:
            self.enter(WavingStage.FAILED, str(error))
        self.close()

    def show(self, guide: CoverageGuide, hints: tuple[str, ...], looked: int, seen: Mapping[int, Array]) -> None:
        """Show the guide's state. looked: frame sets so far. seen: corners (P, 2) px of the newest one, by camera."""
        cameras = tuple(_camera(guide, c, seen.get(c)) for c in range(len(guide.names)))
        together = min(guide.together / MIN_COMMON_SETS, 1.0)
        self._put(replace(self._view, hints=hints, cameras=cameras, together=together, looked=looked))

    def picture(self, names: tuple[str, ...], one: FrameSet, seen: Mapping[int, Array]) -> None:
        """Show the pictures of a frame set with their corners (P, 2) px, nan where not seen."""
        nothing = np.zeros((0, 2))
        corners = {c: pixels[np.isfinite(pixels[:, 0])] for c, pixels in seen.items()}
        shots = [CameraShot(names[f.camera], f.image, tracks=corners.get(f.camera, nothing)) for f in one.frames]
        self.thumbnailer.offer(one.stamp, shots)

    def enter(self, stage: WavingStage, *lines: str) -> None:
        """Enter a stage in which nothing can be requested any more."""
        self._put(replace(self._view, turn=self._view.turn + 1, stage=stage, words=lines, hints=(), offers=()))

    def poll(self) -> Wish | None:
        """STOP or END if a window has requested it; keeps the page alive."""
        wishes = self.wishes(self._view)
        return wishes[-1] if wishes else None

    def _put(self, view: WavingView) -> None:
        self._view = replace(view, stamp=self.clock.now())
        self.link.views.put(self._view)


def _camera(guide: CoverageGuide, camera: int, pixels: Array | None) -> WavingCamera:
    covered = guide.coverage(camera)
    parts, tilts = np.minimum(covered.parts / MIN_PART_CORNERS, 1.0), np.minimum(covered.tilts / MIN_TILT_SHARE, 1.0)
    depth = float(np.clip((covered.depth - 1) / (MIN_DEPTH_RATIO - 1), 0, 1))
    corners = 0 if pixels is None else int(np.isfinite(pixels[:, 0]).sum())
    rows = tuple(tuple(map(float, row)) for row in parts)
    return WavingCamera(guide.names[camera], guide.sizes[camera], corners, rows, tuple(map(float, tilts)), depth)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationCameras:
    """The cameras to calibrate."""

    places: tuple[CameraPlace, ...]
    sources: tuple[CameraSource, ...]
    rig: Rig | None  # their present calibration, if any
    lens_sigma: Sequence[Array | None]  # of the given lenses, (9,) per camera or None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(place.name for place in self.places)


def devices_named(which: Sequence[str]) -> CalibrationCameras:
    """Cameras named as for `stillbed cameras`, or those of one rig.toml, without their clock offsets."""
    rig, sources = sources_named(which)
    if rig is None:
        return CalibrationCameras(places_without_rig(len(which)), sources, None, [None] * len(which))
    places = tuple(CameraPlace(i, camera.name, camera.size) for i, camera in enumerate(rig.cameras))
    return CalibrationCameras(places, sources, rig, read_rig(which[0]).lens_sigma)


class LiveSource(Protocol):
    """Live cameras, as far as a calibration uses them."""

    def next_set(self, until: float) -> FrameSet | None:
        """Wait for a set newer than the last one until the instant `until`, s."""

    def health(self) -> LiveHealth:
        """The state of every camera."""


class WavingRecorder:
    """Collects corners from frame sets, with the newest pictures and the coverage so far."""

    def __init__(self, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], board: Board, store: Path) -> None:
        key = hashlib.sha256(f"live {CORNERS_VERSION} {names} {sizes} {board}".encode()).hexdigest()
        self.search = CornerSearch(board, len(names), store, key)
        stored = self.search.table
        self._late: float | None = None if len(stored) else 0.0  # s, added to the cameras' stamps
        self.corners: dict[int, Array] = {}  # corners (P, 2) px of the newest set by camera, nan where not seen
        self.guide = CoverageGuide(names, sizes, board)
        self.guide.remember(stored)
        self.pictures: list[list[Image]] = [[] for _ in names]

    def add(self, pool: ThreadPoolExecutor, one: FrameSet) -> None:
        """Search the board in one frame set."""
        if self._late is None:
            self._late = float(self.search.table.stamp.max()) + RUN_GAP - min(frame.stamp for frame in one.frames)
        each = self.search.add(pool, [(frame.camera, frame.stamp + self._late, frame.image) for frame in one.frames])
        for frame in one.frames:
            self.pictures[frame.camera] = [*self.pictures[frame.camera][1 - RECENT_PICTURES :], frame.image]
        self.corners = {f.camera: c.pixels for f, c in zip(one.frames, each, strict=True) if c.count}
        self.guide.add(self.corners)

    def material(self, devices: CalibrationCameras, sizes: tuple[tuple[int, int], ...]) -> CalibrationInput:
        """The calibration's input besides the corners."""
        calibrated = devices.rig is not None
        rig = _placeholder_rig(devices.names, sizes) if devices.rig is None else devices.rig
        images = [ImageSource("source", source.identity.text) for source in devices.sources]
        title = ", ".join(source.identity.shown for source in devices.sources)
        return CalibrationInput(title, rig, calibrated, images, devices.lens_sigma, lambda c: self.pictures[c])


def _placeholder_rig(names: tuple[str, ...], sizes: tuple[tuple[int, int], ...]) -> Rig:
    """Cameras of which only names and sizes are known."""
    cameras = []
    for number, (name, size) in enumerate(zip(names, sizes, strict=True)):
        lens = [max(size), max(size), (size[0] - 1) / 2, (size[1] - 1) / 2]
        place = se3.make(np.eye(3), np.array([MIN_RIG_SPAN * number, 0.0, 0.0]))
        cameras.append(Camera(name, size, lens_matrix([*lens, 0, 0, 0, 0, 0]), np.zeros(5), place))
    return Rig(tuple(cameras))


def watch(
    live: LiveSource,
    devices: CalibrationCameras,
    board: Board,
    store: Path,
    seconds: float | None,
    clock: Clock,
    progress: Progress,
    page: WavingPage | None = None,
) -> tuple[CalibrationInput, CornerTable]:
    """Collect corners until the coverage suffices, for `seconds` at most (None: without end), or until the files end.

    The corners are then in `store`, also after an interrupt. page: shows the progress; its user may stop
    (KeyboardInterrupt) or end. InputError names a camera that delivers nothing.
    """
    with ThreadPoolExecutor(CORNER_THREADS) as pool:
        sizes, first = _sizes(live, clock)
        waving = WavingRecorder(devices.names, sizes, board, store)
        end = float("inf") if seconds is None else clock.now() + seconds
        try:
            for one in first:
                waving.add(pool, one)
            missing = waving.guide.missing()
            while missing and clock.now() < end and not _all_ended(live):
                newest = live.next_set(min(end, clock.now() + WAVING_POLL))
                if newest is not None:
                    waving.add(pool, newest)
                    missing = waving.guide.missing()
                progress.note = missing[0] if missing else "enough"
                progress(waving.search.done, 0)
                if page is not None and _update_page(page, waving, missing, newest):
                    break
        finally:  # Ctrl-C included
            waving.search.save()
    return waving.material(devices, sizes), waving.search.table


def _update_page(page: WavingPage, waving: WavingRecorder, missing: tuple[str, ...], newest: FrameSet | None) -> bool:
    """Show the progress on the page; True if its user ends the collection, KeyboardInterrupt if he stops it."""
    if newest is not None:
        page.picture(waving.guide.names, newest, waving.corners)
    page.show(waving.guide, missing, waving.search.done, waving.corners)
    wish = page.poll()
    if wish is Wish.STOP:
        raise KeyboardInterrupt
    return wish is Wish.END


def _all_ended(live: LiveSource) -> bool:
    return all(camera.phase is CameraPhase.ENDED for camera in live.health().cameras)


def _sizes(live: LiveSource, clock: Clock) -> tuple[tuple[tuple[int, int], ...], list[FrameSet]]:
    """Each camera's picture (W, H) px, and the frame sets that came until all were known."""
    end, sets = clock.now() + OPENING_TIMEOUT, []
    while any(camera.newest is None for camera in live.health().cameras):
        if clock.now() >= end:
            silent = next(camera for camera in live.health().cameras if camera.newest is None)
            allowed = f"one within {OPENING_TIMEOUT:g} s: {silent.trouble}"
            raise InputError(f"camera {silent.name}", "pictures", "none", allowed)
        one = live.next_set(clock.now() + WAVING_POLL)
        if one is not None:
            sets.append(one)
    pictures = [camera.newest for camera in live.health().cameras]
    return tuple((int(p.shape[1]), int(p.shape[0])) for p in pictures if p is not None), sets
