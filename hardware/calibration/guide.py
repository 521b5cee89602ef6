"""What to do next while the board is being waved: told from the corners so far, before anything is calibrated."""

from __future__ import annotations

import numpy as np

from estimation.camera_calibration.homography import LEAST, focal, homography, poses
from estimation.se3 import Array
from hardware.calibration.coverage import Coverage, coverage_of, lacking
from perception.boards.board import Board
from perception.boards.collection import CornerTable

TOGETHER = 40  # frame sets that two cameras or more should have seen the board in
PLAUSIBLE = (0.3, 20.0)  # focal length, in longer sides of the picture; otherwise one side is taken


class Guide:
    """Remembers what each camera has seen; asked at any time what is still missing."""

    def __init__(self, names: tuple[str, ...], sizes: tuple[tuple[int, int], ...], board: Board) -> None:
        self._names, self._sizes, self._board = names, sizes, board
        self._pixels: list[list[Array]] = [[] for _ in names]
        self._planes: list[list[Array]] = [[] for _ in names]
        self._together = 0

    def remember(self, table: CornerTable) -> None:
        """Take in what was found earlier."""
        for instant in np.unique(table.instant):
            rows = np.flatnonzero(table.instant == instant)
            self.add({int(table.camera[row]): table.pixels[row] for row in rows})

    def add(self, seen: dict[int, Array]) -> None:
        """Take in one frame set: corners (P, 2) px by camera, nan where not seen."""
        self._together += len(seen) > 1 or len(self._names) == 1
        for camera, pixels in seen.items():
            known = np.isfinite(pixels[:, 0])
            if known.sum() >= LEAST:
                middle = (np.array(self._sizes[camera]) - 1) / 2
                self._pixels[camera].append(pixels)
                self._planes[camera].append(homography(self._board.corners[known, :2], pixels[known] - middle))

    def coverage(self, camera: int) -> Coverage:
        """The coverage of one camera so far, by a focal length that suits all its views."""
        size, pixels = self._sizes[camera], self._pixels[camera]
        if not pixels:
            return coverage_of(np.zeros((0, 1, 2)), size, np.zeros((0, 4, 4)))
        planes = np.stack(self._planes[camera])
        f = focal(planes)
        if not PLAUSIBLE[0] * max(size) < f < PLAUSIBLE[1] * max(size):
            f = float(max(size))
        return coverage_of(np.stack(pixels), size, poses(planes, np.full(len(planes), f)))

    def missing(self) -> tuple[str, ...]:
        """What to do next, the most needed first; nothing where enough was seen."""
        said = [one for c, name in enumerate(self._names) for one in lacking(name, self.coverage(c))]
        words = [text for _, text in sorted(said, key=lambda one: -one[0])]
        if self._together < TOGETHER:
            words.append(f"hold the board where two cameras see it, {TOGETHER - self._together} frame sets more")
        return tuple(words)
