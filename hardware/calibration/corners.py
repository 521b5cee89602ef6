"""Corners of a recording, stored so that an interrupted search goes on; and the coverage of the cameras by the board.

Coverage: which parts of each picture, which tilts and which depths the board has had. `CoverageGuide` says what is
missing while the board is still being waved, before anything is calibrated.
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.calibration.camera_rig import Calibration
from estimation.calibration.lens_fit import MIN_PLANE_CORNERS, focal_from_terms, focal_terms, homography, poses
from estimation.se3 import Array
from hardware.files.session import Session
from hardware.process.progress import ProgressReport, write_atomically
from perception.boards.board import Board, BoardCorners, CornerFinder, CornerTable, empty_table
from perception.frames import Image

CORNERS_VERSION = 3  # of the corner search, whose stored results are valid for this version only
SAVE_EVERY_SETS = 50  # some seconds of work
CORNER_THREADS = 2  # search the pictures of one set at once
COVERAGE_GRID = (4, 3)  # parts of a picture, across and down
PART_NAMES = (("left", "left of the middle", "right of the middle", "right"), ("top", "middle", "bottom"))
MIN_PART_CORNERS = 20  # in each part
MIN_TILT = np.radians(15)  # of a tilted board; a smaller tilt does not show the focal length
MIN_TILT_SHARE = 0.08  # of the views with each tilt
TILT_NAMES = ("its left side nearer", "its right side nearer", "its top nearer", "its bottom nearer")
MIN_DEPTH_RATIO = 1.3  # of far and near views, on which the focal length depends
DEPTH_PERCENTILES = (10, 90)  # of the distances, that count as near and far
MIN_COMMON_SETS = 40  # frame sets in which two cameras or more see the board
FOCAL_LIMITS = (0.3, 20.0)  # of a focal length in longer sides of the picture; outside, one side is assumed
FOCAL_CHANGE = 0.02  # relative change of the focal length that makes all poses new: half a degree of tilt


def content_key(session: Session, board: Board) -> str:
    """Hash of all that the corners depend on: the recording's bytes, the board and the search's version."""
    digest = hashlib.sha256(f"{CORNERS_VERSION} {board}".encode())
    beside = {"roi.toml", "truth.tum", "reference.tum", "reference_async.tum", "rig.toml", "head.csv"}
    inside = (p for p in session.path.rglob("*") if p.is_file() and p.name not in beside and p.suffix != ".npz")
    for path in [session.path] if session.path.is_file() else sorted(inside):
        digest.update(path.name.encode())
        with path.open("rb") as stream:
            hashlib.file_digest(stream, lambda: digest)  # into the one that has been begun
    return digest.hexdigest()


def read_corners(path: Path, key: str) -> CornerTable | None:
    """The stored corners of exactly this recording and board; None where the file has none."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                return None
            parts = {f.name: stored[f.name] for f in fields(CornerTable)}
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return None  # damaged; RuntimeError: a flag that no zip of ours has
    return CornerTable(**{**parts, "done": int(parts["done"])})


def write_corners(path: Path, key: str, table: CornerTable) -> None:
    """Store the corners atomically."""

    def write(part: Path) -> None:
        with part.open("wb") as stream:  # to a name that does not end in .npz numpy would add that
            np.savez_compressed(stream, key=np.array(key), **{f.name: getattr(table, f.name) for f in fields(table)})

    write_atomically(path, write)


@dataclass(frozen=True, slots=True, eq=False)
class CornerRow:
    """The corners of one picture."""

    camera: int
    instant: int
    stamp: float  # s, by the camera's own clock
    corners: BoardCorners


class CornerSearch:
    """Searches a board in frame sets, one after the other; what is stored of an interrupted search is taken up again.

    table: the corners up to the last `save`. done: number of frame sets searched by now. store: the file, or None.
    """

    def __init__(self, board: Board, cameras: int, store: Path | None, key: str) -> None:
        self._store, self._key = store, key
        stored = None if store is None else read_corners(store, key)
        self.table = empty_table(board, cameras) if stored is None else stored
        self.done = self.table.done
        self._finders = [CornerFinder(board) for _ in range(cameras)]
        self._rows: list[CornerRow] = []

    def add(self, pool: ThreadPoolExecutor, pictures: Sequence[tuple[int, float, Image]]) -> list[BoardCorners]:
        """Search one frame set: of each picture the camera, its stamp (s, by the camera's own clock) and the image."""
        corners = list(pool.map(lambda one: self._finders[one[0]](one[2]), pictures))
        views = zip(pictures, corners, strict=True)
        self._rows += [CornerRow(camera, self.done, stamp, own) for (camera, stamp, _), own in views]
        self.done += 1
        if self.done - self.table.done >= SAVE_EVERY_SETS:
            self.save()
        return corners

    def save(self) -> None:
        """Take the new corners into the table, and store it."""
        self.table, self._rows = append_rows(self.table, self._rows, self.done), []
        if self._store is not None:
            write_corners(self._store, self._key, self.table)


def collect_corners(session: Session, board: Board, store: Path | None, report: ProgressReport) -> CornerTable:
    """The corners of all pictures. store: the file for them, or None. InputError where a picture is missing."""
    search = CornerSearch(board, len(session.rig), store, content_key(session, board) if store is not None else "")
    with closing(session.open_reader()) as reader, ThreadPoolExecutor(CORNER_THREADS) as pool:
        try:
            for refs in session.sets[search.done :]:
                search.add(pool, [(ref.camera, ref.camera_stamp, reader.read(ref)) for ref in refs])
                report(search.done, len(session.sets))
        finally:  # Ctrl-C included
            search.save()
    return search.table


def append_rows(table: CornerTable, rows: list[CornerRow], done: int) -> CornerTable:
    """The table with further pictures; done: number of instants searched by now."""
    looked, views = table.looked.copy(), [row for row in rows if row.corners.count]
    np.add.at(looked, [row.camera for row in rows], 1)
    strangers = np.array([*table.strangers, *(i for r in rows for i in r.corners.strangers)], np.int64)
    return replace(
        table,
        looked=looked,
        strangers=strangers,
        done=done,
        camera=np.append(table.camera, [r.camera for r in views]).astype(np.int64),
        instant=np.append(table.instant, [r.instant for r in views]).astype(np.int64),
        stamp=np.append(table.stamp, [r.stamp for r in views]),
        pixels=np.concatenate([table.pixels, *(r.corners.pixels[None] for r in views)]),
        sigma=np.append(table.sigma, [r.corners.sigma for r in views]),
        blur=np.append(table.blur, [r.corners.blur for r in views]),
        marker=np.append(table.marker, [r.corners.marker for r in views]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class BoardCoverage:
    """The board's coverage of one camera."""

    parts: Array  # (rows, columns) number of corners in each part of the picture
    tilts: Array  # (4,) share of the views with each tilt
    depth: float  # ratio of the far views' distance to the near ones', 1 without views


def coverage_from_parts(parts: Array, orientations: Array) -> BoardCoverage:
    """Coverage by numbers of corners in the parts (rows, columns) and the board's orientations (V, 3)."""
    if not len(orientations):
        return BoardCoverage(parts, np.zeros(4), 1.0)
    across, up, depth = orientations.T
    tilted = [across < -MIN_TILT, across > MIN_TILT, up < -MIN_TILT, up > MIN_TILT]
    nearest, farthest = np.percentile(depth, DEPTH_PERCENTILES)
    return BoardCoverage(parts, np.array([t.mean() for t in tilted]), float(farthest / nearest))


def board_orientations(camera_from_board: Array) -> Array:
    """Orientations (V, 3) of poses (V, 4, 4): turn of the board across and up, rad, and its distance, mm."""
    back = camera_from_board[:, :3, 2]  # normal of the board's back, camera frame
    across, up = np.arctan2(back[:, 0], back[:, 2]), np.arctan2(back[:, 1], back[:, 2])
    return np.stack([across, up, camera_from_board[:, 2, 3]], 1)


def parts_of(pixels: Array, size: tuple[int, int]) -> Array:
    """Numbers (rows, columns) of pixels (..., 2), nan where not seen, in the parts of a picture of `size` (W, H) px."""
    at = pixels[np.isfinite(pixels[..., 0])]
    w, h = size
    return np.asarray(np.histogram2d(at[:, 1], at[:, 0], bins=COVERAGE_GRID[::-1], range=((0, h), (0, w)))[0])


def coverage(calibration: Calibration, camera: int) -> BoardCoverage:
    """The coverage of one camera."""
    views, state = calibration.views, calibration.fit.state
    rows = views.camera == camera
    camera_from_board = se3.inverse(state.base_from_camera[camera]) @ state.base_from_board[views.instant[rows]]
    return coverage_from_parts(parts_of(views.pixels[rows], views.sizes[camera]), board_orientations(camera_from_board))


def missing_coverage(name: str, covered: BoardCoverage) -> list[tuple[float, str]]:
    """What one camera still needs: how much of it is missing, 0 to 1, and a text."""
    out: list[tuple[float, str]] = []
    sparse = np.argwhere(covered.parts < MIN_PART_CORNERS)
    if len(sparse):
        places = [f"{PART_NAMES[1][row]} {PART_NAMES[0][column]}" for row, column in sparse[:3]]
        suffix = f" and {len(sparse) - 3} other parts" if len(sparse) > 3 else ""
        text = f"{name}: hold the board in its picture's {', '.join(places)}{suffix}"
        out.append((len(sparse) / covered.parts.size, text))
    missing = [TILT_NAMES[k] for k in np.flatnonzero(covered.tilts < MIN_TILT_SHARE)]
    if missing:
        out.append((len(missing) / 4, f"{name}: tilt the board by 30 degrees: {', '.join(missing)}"))
    if covered.depth < MIN_DEPTH_RATIO:
        share = 1 - (covered.depth - 1) / (MIN_DEPTH_RATIO - 1)
        out.append((share, f"{name}: hold the board nearer to it, and farther away"))
    return out


def _hints(names: Sequence[str], coverage_of_camera: Callable[[int], BoardCoverage]) -> list[str]:
    """What all cameras still need, the worst first."""
    missing = [one for c, name in enumerate(names) for one in missing_coverage(name, coverage_of_camera(c))]
    return [text for _, text in sorted(missing, key=lambda one: -one[0])]


def coverage_hints(calibration: Calibration) -> tuple[str, ...]:
    """What to do next, the worst first; nothing where all is covered."""
    return tuple(_hints(calibration.views.names, lambda camera: coverage(calibration, camera)))


class CoverageGuide:
    """Accumulates what each camera has seen, and says what is still missing."""

    def __init__(self, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], board: Board) -> None:
        self.names, self.sizes, self._board = names, sizes, board
        self._cameras = [_CameraCoverage(size) for size in sizes]
        self.together = 0  # frame sets in which two cameras saw the board

    def remember(self, table: CornerTable) -> None:
        """Add stored corners."""
        for instant in np.unique(table.instant):
            rows = np.flatnonzero(table.instant == instant)
            self.add({int(table.camera[row]): table.pixels[row] for row in rows})

    def add(self, corners: dict[int, Array]) -> None:
        """Add one frame set: corners (P, 2) px by camera, nan where not seen."""
        self.together += len(corners) > 1 or len(self.names) == 1
        for camera, pixels in corners.items():
            if np.isfinite(pixels[:, 0]).sum() >= MIN_PLANE_CORNERS:
                self._cameras[camera].add(self._board, pixels)

    def coverage(self, camera: int) -> BoardCoverage:
        """The coverage of one camera so far, by a focal length from all its views."""
        return self._cameras[camera].coverage()

    def missing(self) -> tuple[str, ...]:
        """What to do next, the most needed first; nothing where enough was seen."""
        hints = _hints(self.names, self.coverage)
        if self.together < MIN_COMMON_SETS:
            hints.append(f"hold the board where two cameras see it, {MIN_COMMON_SETS - self.together} frame sets more")
        return tuple(hints)


class _CameraCoverage:
    """The views of one camera. A new view has constant cost, unless the focal length changes."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._parts, self._terms = np.zeros(COVERAGE_GRID[::-1]), np.zeros(3)
        self._planes: list[Array] = []  # (3, 3) of each view
        self._orientations: list[Array] = []  # (3,) of the views so far, by `_focal`
        self._focal = float("nan")  # px

    def add(self, board: Board, pixels: Array) -> None:
        """Add a view's corners (P, 2) px, nan where not seen."""
        known, middle = np.isfinite(pixels[:, 0]), (np.array(self._size) - 1) / 2
        plane = homography(board.corners[known, :2], pixels[known] - middle)
        self._planes.append(plane)
        self._parts += parts_of(pixels, self._size)
        self._terms += focal_terms(plane[None])

    def coverage(self) -> BoardCoverage:
        """The coverage so far."""
        longest = max(self._size)
        f = focal_from_terms(self._terms)
        if not FOCAL_LIMITS[0] * longest < f < FOCAL_LIMITS[1] * longest:
            f = float(longest)
        if not abs(f / self._focal - 1) <= FOCAL_CHANGE:
            self._focal, self._orientations = f, []
        if fresh := self._planes[len(self._orientations) :]:
            self._orientations += [*board_orientations(poses(np.stack(fresh), np.full(len(fresh), self._focal)))]
        return coverage_from_parts(self._parts, np.array(self._orientations).reshape(-1, 3))
