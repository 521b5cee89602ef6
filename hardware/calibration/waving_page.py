"""The page beside a calibration before live cameras: shows what the guide says, and takes Stop and Enough."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import TracebackType

import numpy as np

from estimation.se3 import Array
from hardware.calibration.coverage import DEEP, HELD, SHARE
from hardware.calibration.guide import TOGETHER, Guide
from hardware.operator.link import OperatorLink
from hardware.operator.process import OperatorPage
from hardware.operator.settings import OperatorSettings
from hardware.operator.shared_state import Wish, refusal
from hardware.operator.taker import PictureTaker, Shot
from hardware.operator.view import Answer
from hardware.operator.waving import WavingCamera, WavingStage, WavingView
from hardware.process.clock import Clock
from perception.frames import FrameSet

NOBODY = WavingView(0.0, 1, WavingStage.WAVE)
READ = 0.5  # s that the last view stays up before the page goes, so that windows have it


class WavingPage:
    """Opened as a context; `address` is what to open in a browser. Nothing here waits for it."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._link = clock, OperatorLink()
        self._page = OperatorPage(self._link, OperatorSettings(page="waving.html"))
        self._taker = PictureTaker(self._link.pictures, self._link.requests, near=False)
        self._view = NOBODY
        self.address = self._page.address

    def __enter__(self) -> WavingPage:
        self._page.tend(self._clock.now())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, KeyboardInterrupt):
            self.tell(WavingStage.STOPPED, "the corners are kept; the same command goes on from there")
        elif error is not None:
            self.tell(WavingStage.FAILED, str(error))
        if self._link.requests.windows:
            self._clock.wait_until(self._clock.now() + READ)
        self._taker.close()
        self._page.close()

    def show(self, guide: Guide, hints: tuple[str, ...], looked: int, seen: Mapping[int, Array]) -> None:
        """The guide's state. looked: frame sets so far. seen: corners (P, 2) px of the newest one, by camera."""
        cameras = tuple(_camera(guide, c, seen.get(c)) for c in range(len(guide.names)))
        together = min(guide.together / TOGETHER, 1.0)
        self._put(replace(self._view, hints=hints, cameras=cameras, together=together, looked=looked))

    def picture(self, names: tuple[str, ...], one: FrameSet, seen: Mapping[int, Array]) -> None:
        """The pictures of a frame set with the corners (P, 2) px, nan where not seen, that were found in them."""
        nothing = np.zeros((0, 2))
        found = {c: pixels[np.isfinite(pixels[:, 0])] for c, pixels in seen.items()}
        shots = [Shot(names[f.camera], f.image, tracks=found.get(f.camera, nothing)) for f in one.frames]
        self._taker.offer(one.stamp, shots)

    def tell(self, stage: WavingStage, *words: str) -> None:
        """Go on to a stage in which nothing is asked any more."""
        self._put(replace(self._view, turn=self._view.turn + 1, stage=stage, words=words, hints=()))

    def wished(self) -> Wish | None:
        """STOP or END where a window has asked for it; keeps the page alive."""
        self._page.tend(self._clock.now())
        wish = None
        for request in self._link.requests.take():
            why = refusal(request.wish, request.turn, self._offers(), self._view.turn)
            self._put(replace(self._view, answer=Answer(request.number, request.wish, not why, why)))
            wish = wish if why else request.wish
        return wish

    def _offers(self) -> tuple[Wish, ...]:
        return (Wish.END,) if self._view.stage is WavingStage.WAVE else ()

    def _put(self, view: WavingView) -> None:
        self._view = view  # whose stage says what is offered
        self._view = replace(view, stamp=self._clock.now(), offers=self._offers())
        self._link.views.put(self._view)


def _camera(guide: Guide, camera: int, pixels: Array | None) -> WavingCamera:
    held = guide.coverage(camera)
    parts, tilts = np.minimum(held.parts / HELD, 1.0), np.minimum(held.tilts / SHARE, 1.0)
    depth = float(np.clip((held.depth - 1) / (DEEP - 1), 0, 1))
    corners = 0 if pixels is None else int(np.isfinite(pixels[:, 0]).sum())
    rows = tuple(tuple(map(float, row)) for row in parts)
    return WavingCamera(guide.names[camera], guide.sizes[camera], corners, rows, tuple(map(float, tilts)), depth)
