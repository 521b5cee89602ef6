"""The board before live cameras: corners are found while it is being waved, and it is said where to hold it next.

What was found is kept when it is interrupted, and the next run goes on from there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from estimation import se3
from estimation.calibration.lens_model import matrix_of
from estimation.camera_calibration.board_motion import REACH
from estimation.errors import InputError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.calibration.collect import KEEP, THREADS, Row, joined
from hardware.calibration.corners import VERSION, read_corners, write_corners
from hardware.calibration.guide import Guide
from hardware.calibration.material import Material
from hardware.calibration.waving_page import WavingPage
from hardware.cameras.feed import Place
from hardware.cameras.named import places_without_rig, sources_named
from hardware.cameras.sources import CameraSource
from hardware.cameras.state import LiveHealth, Phase
from hardware.files.rig_file import NEAREST_RIG, ImageSource, read_rig
from hardware.operator.shared_state import Wish
from hardware.process.clock import Clock
from hardware.process.progress import Progress
from perception.boards.board import Board
from perception.boards.collection import empty_table
from perception.boards.corners import CornerFinder
from perception.frames import FrameSet, Image

OPENING = 15.0  # s until every camera has shown a picture
LOOK = 0.5  # s between looks whether time is up
AGAIN = 2 * REACH  # s put between what earlier runs saw and this one: the board has not moved smoothly since
PICTURES = 5  # kept of each camera, the newest ones


@dataclass(frozen=True, slots=True, eq=False)
class Devices:
    """The cameras that are to be calibrated. rig: where they stood before, None for cameras that have none yet."""

    places: tuple[Place, ...]
    sources: tuple[CameraSource, ...]
    rig: Rig | None
    lens_sigma: Sequence[Array | None]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras."""
        return tuple(place.name for place in self.places)


def devices_named(which: Sequence[str]) -> Devices:
    """Cameras named as `stillbed cameras` has them, or those of one rig.toml; offsets known so far are left out."""
    rig, sources = sources_named(which)
    if rig is None:
        return Devices(places_without_rig(len(which)), sources, None, [None] * len(which))
    places = tuple(Place(i, camera.name, camera.size) for i, camera in enumerate(rig.cameras))
    return Devices(places, sources, rig, read_rig(which[0]).lens_sigma)


class Watched(Protocol):
    """What is asked of live cameras."""

    def next_set(self, until: float) -> FrameSet | None:
        """Wait for a set newer than the last one until the instant `until`, s."""
        ...

    def health(self) -> LiveHealth:
        """How every camera fares now."""
        ...


class Waving:
    """Takes frame sets in; holds the corners so far, the newest pictures and what is still missing."""

    def __init__(self, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], board: Board, store: Path) -> None:
        self._store, self._key = store, _key(names, sizes, board)
        known = read_corners(store, self._key)
        self._table = empty_table(board, len(names)) if known is None else known
        self._finders = [CornerFinder(board) for _ in names]
        self._rows: list[Row] = []
        self._done, self._saved = self._table.done, self._table.done
        self._late: float | None = None if len(self._table) else 0.0  # s, from the cameras' stamps to those kept
        self.seen: dict[int, Array] = {}  # corners (P, 2) px of the newest set by camera, nan where not seen
        self.guide = Guide(names, sizes, board)
        self.guide.remember(self._table)
        self.pictures: list[list[Image]] = [[] for _ in names]

    @property
    def done(self) -> int:
        """Frame sets looked at, those of earlier runs included."""
        return self._done

    def add(self, pool: ThreadPoolExecutor, one: FrameSet) -> None:
        """Look for the board in one frame set."""
        if self._late is None:
            self._late = float(self._table.stamp.max()) + AGAIN - min(frame.stamp for frame in one.frames)
        found = list(pool.map(lambda frame: self._finders[frame.camera](frame.image), one.frames))
        for frame, corners in zip(one.frames, found, strict=True):
            self._rows.append(Row(frame.camera, self._done, frame.stamp + self._late, corners))
            self.pictures[frame.camera] = [*self.pictures[frame.camera][1 - PICTURES :], frame.image]
        self.seen = {f.camera: c.pixels for f, c in zip(one.frames, found, strict=True) if c.count}
        self.guide.add(self.seen)
        self._done += 1
        if self._done - self._saved >= KEEP:
            self.save()

    def save(self) -> None:
        """Write down what was found."""
        self._table, self._rows = joined(self._table, self._rows, self._done), []
        write_corners(self._store, self._key, self._table)
        self._saved = self._done

    def material(self, devices: Devices, sizes: tuple[tuple[int, int], ...]) -> Material:
        """What was found, once it is saved, to be calibrated from."""
        rig = devices.rig if devices.rig is not None else _stand_in(devices.names, sizes)
        images = [ImageSource("source", source.identity.text) for source in devices.sources]
        title = ", ".join(source.identity.shown for source in devices.sources)
        given = devices.rig is not None
        return Material(title, rig, given, images, devices.lens_sigma, self._table, lambda c: self.pictures[c])


def _key(names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], board: Board) -> str:
    return hashlib.sha256(f"live {VERSION} {names} {sizes} {board}".encode()).hexdigest()


def _stand_in(names: tuple[str, ...], sizes: tuple[tuple[int, int], ...]) -> Rig:
    """Cameras of which only names and sizes are known."""
    cameras = []
    for number, (name, size) in enumerate(zip(names, sizes, strict=True)):
        lens = [max(size), max(size), (size[0] - 1) / 2, (size[1] - 1) / 2]
        place = se3.make(np.eye(3), np.array([NEAREST_RIG * number, 0.0, 0.0]))
        cameras.append(Camera(name, size, matrix_of([*lens, 0, 0, 0, 0, 0]), np.zeros(5), place))
    return Rig(tuple(cameras))


def watch(
    live: Watched,
    devices: Devices,
    board: Board,
    store: Path,
    seconds: float | None,
    clock: Clock,
    progress: Progress,
    page: WavingPage | None = None,
) -> Material:
    """Watch until enough was seen, for `seconds` at most (None: without end), or until the files end.

    What was found is in `store` then, also where it is interrupted. page: shows it, and may ask to stop
    (KeyboardInterrupt) or to be content. InputError names a camera that shows nothing.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        sizes, first = _sizes(live, clock)
        waving = Waving(devices.names, sizes, board, store)
        end = float("inf") if seconds is None else clock.now() + seconds
        try:
            for one in first:
                waving.add(pool, one)
            missing = waving.guide.missing()
            while missing and clock.now() < end and not _ended(live):
                newest = live.next_set(min(end, clock.now() + LOOK))
                if newest is not None:
                    waving.add(pool, newest)
                    missing = waving.guide.missing()
                progress.note = missing[0] if missing else "enough"
                progress(waving.done, 0)
                if page is not None and _shown(page, waving, missing, newest):
                    break
        finally:  # Ctrl-C included
            waving.save()
    return waving.material(devices, sizes)


def _shown(page: WavingPage, waving: Waving, missing: tuple[str, ...], newest: FrameSet | None) -> bool:
    """Show the state on the page; whether somebody there is content. KeyboardInterrupt where somebody wants to stop."""
    if newest is not None:
        page.picture(waving.guide.names, newest, waving.seen)
    page.show(waving.guide, missing, waving.done, waving.seen)
    wish = page.wished()
    if wish is Wish.STOP:
        raise KeyboardInterrupt
    return wish is Wish.END


def _ended(live: Watched) -> bool:
    return all(camera.phase is Phase.ENDED for camera in live.health().cameras)


def _sizes(live: Watched, clock: Clock) -> tuple[tuple[tuple[int, int], ...], list[FrameSet]]:
    """Each camera's picture (W, H) px, and the frame sets that came until all were known."""
    end, sets = clock.now() + OPENING, []
    while any(camera.newest is None for camera in live.health().cameras):
        if clock.now() >= end:
            silent = next(camera for camera in live.health().cameras if camera.newest is None)
            raise InputError(f"camera {silent.name}", "pictures", "none", f"one within {OPENING:g} s: {silent.trouble}")
        one = live.next_set(clock.now() + LOOK)
        if one is not None:
            sets.append(one)
    pictures = [camera.newest for camera in live.health().cameras]
    return tuple((int(p.shape[1]), int(p.shape[0])) for p in pictures if p is not None), sets
