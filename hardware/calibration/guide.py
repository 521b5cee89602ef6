"""What to do next while the board is being waved: told from the corners so far, before anything is calibrated."""

from __future__ import annotations

import numpy as np

from estimation.calibration.lens_fit import LEAST, focal_of, focal_terms, homography, poses
from estimation.se3 import Array
from hardware.calibration.coverage import GRID, Coverage, covered, lacking, looks_of, parts_of
from perception.boards.board import Board
from perception.boards.collection import CornerTable

TOGETHER = 40  # frame sets that two cameras or more should have seen the board in
PLAUSIBLE = (0.3, 20.0)  # focal length, in longer sides of the picture; otherwise one side is taken
MOVED = 0.02  # share by which the focal length changes before all views are looked at again: half a degree of tilt


class Guide:
    """Remembers what each camera has seen; asked at any time what is still missing."""

    def __init__(self, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], board: Board) -> None:
        self.names, self.sizes, self._board = names, sizes, board
        self._seen = [_Seen(size) for size in sizes]
        self.together = 0

    def remember(self, table: CornerTable) -> None:
        """Take in what was found earlier."""
        for instant in np.unique(table.instant):
            rows = np.flatnonzero(table.instant == instant)
            self.add({int(table.camera[row]): table.pixels[row] for row in rows})

    def add(self, seen: dict[int, Array]) -> None:
        """Take in one frame set: corners (P, 2) px by camera, nan where not seen."""
        self.together += len(seen) > 1 or len(self.names) == 1
        for camera, pixels in seen.items():
            if np.isfinite(pixels[:, 0]).sum() >= LEAST:
                self._seen[camera].add(self._board, pixels)

    def coverage(self, camera: int) -> Coverage:
        """The coverage of one camera so far, by a focal length that suits all its views."""
        return self._seen[camera].coverage()

    def missing(self) -> tuple[str, ...]:
        """What to do next, the most needed first; nothing where enough was seen."""
        said = [one for c, name in enumerate(self.names) for one in lacking(name, self.coverage(c))]
        words = [text for _, text in sorted(said, key=lambda one: -one[0])]
        if self.together < TOGETHER:
            words.append(f"hold the board where two cameras see it, {TOGETHER - self.together} frame sets more")
        return tuple(words)


class _Seen:
    """What one camera has seen: a view costs the same however many there were before, unless the lens looks new."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._parts, self._terms = np.zeros(GRID[::-1]), np.zeros(3)
        self._planes: list[Array] = []  # (3, 3) of each view
        self._looks: list[Array] = []  # (3,) of each view that was looked at, by `_focal`
        self._focal = float("nan")  # px

    def add(self, board: Board, pixels: Array) -> None:
        """Take in a view's corners (P, 2) px, nan where not seen."""
        known, middle = np.isfinite(pixels[:, 0]), (np.array(self._size) - 1) / 2
        plane = homography(board.corners[known, :2], pixels[known] - middle)
        self._planes.append(plane)
        self._parts += parts_of(pixels, self._size)
        self._terms += focal_terms(plane[None])

    def coverage(self) -> Coverage:
        """The coverage so far."""
        longest = max(self._size)
        f = focal_of(self._terms)
        if not PLAUSIBLE[0] * longest < f < PLAUSIBLE[1] * longest:
            f = float(longest)
        if not abs(f / self._focal - 1) <= MOVED:
            self._focal, self._looks = f, []
        if fresh := self._planes[len(self._looks) :]:
            self._looks += [*looks_of(poses(np.stack(fresh), np.full(len(fresh), self._focal)))]
        return covered(self._parts, np.array(self._looks).reshape(-1, 3))
