"""What all windows show: the newest of everything that the run has put out, written once for all of them."""

from __future__ import annotations

import asyncio
from collections import deque
from math import nan

from hardware.operator.broadcast import pictures_bytes, scene_text, text, text_of
from hardware.operator.link import OperatorLink
from hardware.operator.pictures import Pictures
from hardware.operator.scene import Scene
from hardware.operator.view import Activity, MotionView, OperatorView
from hardware.operator.waving import WavingView

KEPT = 60.0  # s of the error's course: a few breaths, and what led to the present hold
ROWS = 1200  # of it: at 20 views per second, which is more than the board looks


class Board:
    """Reads the link, never writes to it. view: the newest, None before the first. gone: the run has ended.

    refused: requests that were turned away.
    """

    def __init__(self, link: OperatorLink) -> None:
        self._link = link
        self._scene: Scene | None = None
        self._pictures: Pictures | None = None
        self._since = nan
        self._course: deque[tuple[float, float, float, float, bool]] = deque(maxlen=ROWS)
        self.view: OperatorView | WavingView | None = None
        self.gone, self.refused = False, 0
        self.view_text, self.scene_text, self.pictures_bytes = "null", "", b""
        self.news = asyncio.Event()  # set, and replaced, when there is something new

    def look(self, now: float, watched: bool) -> None:
        """Take what is new at `now`, s; pictures only where they are watched."""
        view = self._link.views.get()
        new = view is not None and (self.view is None or view.stamp > self.view.stamp)
        if view is not None and new:
            self.view, self.view_text, self._since = view, text_of(view), now
            self._note(view.stamp, view.motion if isinstance(view, OperatorView) else None)
        if (scene := self._link.scene.get()) is not self._scene and scene is not None:
            self._scene, self.scene_text, new = scene, scene_text(scene), True
        if watched and (pictures := self._link.pictures.get()) is not self._pictures and pictures is not None:
            self._pictures, self.pictures_bytes, new = pictures, pictures_bytes(pictures), True
        if new:
            self.tell()

    def tell(self) -> None:
        """Wake all windows."""
        self.news.set()
        self.news = asyncio.Event()

    def age(self, now: float) -> float:
        """For how long, s, the newest view has been the newest; NaN before the first."""
        return now - self._since

    def course_text(self) -> str:
        """The error's course so far, for a window that was not there."""
        return text(kind="course", rows=list(self._course))

    def _note(self, stamp: float, motion: MotionView | None) -> None:
        if motion is None:
            return
        held = motion.activity is Activity.HOLDING
        self._course.append((stamp, motion.error, motion.true_error, motion.limit, held))
        while stamp - self._course[0][0] > KEPT:
            self._course.popleft()
