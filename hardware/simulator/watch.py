"""watch.html: what the cameras see while the run goes on, with the path carried along, on a page that renews itself."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig, pixels_from_points
from estimation.se3 import Array
from perception.frames import FrameSet, Image

EVERY = 0.5  # s of the run between two pictures
WIDE, NARROW = (960, 540), (480, 270)  # px: the first camera's picture, and the others'
QUALITY = 85
CLOSE = 400  # px of the picture that fill a tile's width once the line's place is known
LINE = (255, 200, 90)  # BGR
COLOURS = {  # BGR, as the report's states
    TrackState.INITIALISING: (160, 160, 160),
    TrackState.TRACKING: (90, 190, 70),
    TrackState.DEGRADED: (40, 170, 240),
    TrackState.COASTING: (50, 110, 240),
    TrackState.LOST: (60, 60, 220),
}
PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>{refresh}
<style>body{{margin:0;padding:1.2rem;background:#14171a;color:#e6e9ec;font:16px/1.5 system-ui,sans-serif}}
h1{{font-size:1.15rem;font-weight:600;margin:0 0 .6rem}}img{{max-width:100%;border-radius:8px;display:block}}
dl{{display:flex;flex-wrap:wrap;gap:.3rem 2rem;margin:.9rem 0}}dt{{color:#9aa4ad;font-size:.8rem}}dd{{margin:0}}
a{{color:#7fc4ff}}</style><h1>{title}</h1><img src="watch.jpg?{number}" alt="what the cameras see">
<dl>{facts}</dl>{foot}</html>
"""


class Watch:
    """Writes watch.jpg and watch.html into a folder, at most every EVERY s of the run."""

    def __init__(self, folder: Path, rig: Rig, title: str) -> None:
        self._folder, self._rig, self._title = folder, rig, title
        self._number, self._next = 0, -np.inf
        self._facts: list[tuple[str, str]] = []

    @property
    def page(self) -> Path:
        """Where the page is."""
        return self._folder / "watch.html"

    def show(self, frames: FrameSet, pose: SurfacePose, line: Array | None, facts: Sequence[tuple[str, str]]) -> None:
        """The newest frames, pose and printed line (N, 3), mm, surface frame of the pose; facts: name and value."""
        if pose.stamp < self._next:
            return
        self._next = pose.stamp + EVERY
        self._number += 1
        self._facts = [("state", pose.state.value + (f": {pose.reason}" if pose.reason else "")), *facts]
        picture = self._montage(frames, pose, line)
        cv2.imwrite(str(self._folder / "watch.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        self._write('<meta http-equiv="refresh" content="1">', "<p>This page renews itself while the run goes on.</p>")

    def finish(self, verdict: str) -> None:
        """The run is over: the page stands still and leads to the report."""
        self._write("", f'<p>{escape(verdict)} <a href="report.html">The report</a></p>')

    def _write(self, refresh: str, foot: str) -> None:
        facts = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in self._facts)
        title = escape(self._title)
        text = PAGE.format(title=title, refresh=refresh, number=self._number, facts=facts, foot=foot)
        self.page.write_text(text, encoding="utf-8")

    def _montage(self, frames: FrameSet, pose: SurfacePose, line: Array | None) -> Image:
        """The first camera large, the others in a column beside it; dark where a camera is missing."""
        others = max(len(self._rig) - 1, 1)
        height = max(WIDE[1], others * NARROW[1])
        canvas = np.full((height, WIDE[0] + NARROW[0], 3), 24, np.uint8)
        for camera in range(len(self._rig)):
            (w, h), x, y = (WIDE, 0, 0) if camera == 0 else (NARROW, WIDE[0], (camera - 1) * NARROW[1])
            tile = canvas[y : y + h, x : x + w]
            images = [f.image for f in frames.frames if f.camera == camera]
            if images:
                self._draw(tile, images[0], camera, pose, line)
            self._label(tile, self._rig.cameras[camera].name if images else "no picture")
        cv2.rectangle(canvas, (0, 0), (canvas.shape[1] - 1, height - 1), COLOURS[pose.state], 6)
        return canvas

    def _draw(self, tile: Image, image: Image, camera: int, pose: SurfacePose, line: Array | None) -> None:
        """The picture on its tile, brought close to the line where the pose says that it lies, and the line on it."""
        width, (h, w) = image.shape[1], tile.shape[:2]
        pixels = self._pixels(camera, pose, line)
        zoom, corner = (
            (w / width, np.zeros(2)) if pixels is None else (w / CLOSE, pixels.mean(0) - [CLOSE / 2, CLOSE * h / w / 2])
        )
        move = np.array([[zoom, 0, -zoom * corner[0]], [0, zoom, -zoom * corner[1]]])
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        cv2.warpAffine(colour, move, (w, h), dst=tile, flags=cv2.INTER_LINEAR)
        if pixels is not None:
            corners = [np.rint(16 * zoom * (pixels - corner)).astype(np.int32).reshape(-1, 1, 2)]
            cv2.polylines(tile, corners, False, LINE, 1, cv2.LINE_AA, 4)

    def _pixels(self, camera: int, pose: SurfacePose, line: Array | None) -> Array | None:
        """Where the camera sees the line (N, 2) px, None where that is not known."""
        if line is None or not pose.state.measured:
            return None
        pixels, depth = pixels_from_points(
            self._rig.cameras[camera], se3.transform_points(pose.base_from_surface, line)
        )
        return pixels if (depth > 1).all() else None

    def _label(self, tile: Image, text: str) -> None:
        for colour, width in (((20, 20, 20), 4), ((240, 240, 240), 1)):
            cv2.putText(tile, text, (16, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA)
