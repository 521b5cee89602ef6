"""An operator's page for tests: the server in a thread of this process, and views put by hand."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from aiohttp import web_app

from estimation.pose import TrackState
from hardware.operator.server import serve
from hardware.operator.settings import OperatorSettings, WindowLimits
from hardware.operator.shared_state import OperatorLink, OperatorRequest
from hardware.operator.view import (
    Activity,
    CameraView,
    Check,
    CheckVerdict,
    LatencyView,
    MotionView,
    OperatorView,
    ProgressView,
    RunStage,
    TrackingView,
    Wish,
)
from tests.browser import Browser, Page

LIVE = 'document.body.dataset.news === "live"'
OFFERED = tuple(wish for wish in Wish if wish is not Wish.STOP)


def full_view(stamp: float = 1.0, turn: int = 1, stage: RunStage = RunStage.PRINT, **changed: Any) -> OperatorView:
    """A view with something in every place."""
    pose = np.eye(4)
    tracking = TrackingView(TrackState.TRACKING, "three cameras agree", 0.018, 0.052, pose, np.diag([1e-3] * 3), 182)
    motion = MotionView(
        Activity.PRINTING, "", 0.21, 0.5, 0.19, 0.031, 0.05, pose, "armed", 6.0, error_age=0.0, sigma=0.12
    )
    made = OperatorView(
        stamp,
        turn,
        stage,
        offers=OFFERED,
        checks=(
            Check("arm", CheckVerdict.FAIL, "does not answer", "Switch it on."),
            Check("path", CheckVerdict.PASS, "fine"),
        ),
        tracking=tracking,
        motion=motion,
        progress=ProgressView(1203.4, 3420, 0.352, 754.0, (690.0, 850.0), 0.87, 3, 12),
        latency=LatencyView(0.0142, 0.0271, 0.035),
        cameras=tuple(CameraView(f"camera{k}", CheckVerdict.PASS, 29.9, 60) for k in range(3)),
    )
    return replace(made, **changed)


class Served:
    """The page being served. address: to open. It can be ended and begun again on the same port, as its process is."""

    def __init__(self, limits: WindowLimits | None = None, page: str = "index.html") -> None:
        self.link, self.settings = OperatorLink(), OperatorSettings(page=page)
        self._limits = limits or WindowLimits(stale=30.0, patience=30.0)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.host = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self.address = f"http://{self.host}/{self.settings.token}/"
        self.begin()

    def begin(self) -> None:
        """Serve."""
        self._loop, self._ended = asyncio.new_event_loop(), asyncio.Event()
        serving = serve(self.link, self.settings, self.listener.dup(), self._ended, self._limits)
        runner = asyncio.Runner(loop_factory=lambda: self._loop)

        def run() -> None:
            with runner:  # which ends the tasks that are left: they hold the link and its memory
                runner.run(serving)

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End serving, and tell the windows."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(10)
        assert not self._thread.is_alive()
        web_app._cached_build_middleware.cache_clear()  # holds the server, and with it a dozen files of the link

    def put(self, view: OperatorView) -> None:
        """Show a view."""
        self.link.views.put(view)

    def taken(self, count: int = 1, timeout: float = 10.0) -> list[OperatorRequest]:
        """The requests that come until there are `count`."""
        found, end = [], time.monotonic() + timeout
        while len(found) < count and time.monotonic() < end:
            found += self.link.requests.take()
            time.sleep(0.005)
        return found


@contextmanager
def served(limits: WindowLimits | None = None) -> Iterator[Served]:
    """The page, ended afterwards."""
    made = Served(limits)
    try:
        yield made
    finally:
        made.end()
        made.listener.close()


class Run:
    """A run whose views are put by hand, each newer than the last; `page` is a window of it."""

    def __init__(self, browser: Browser, limits: WindowLimits | None = None) -> None:
        self.served, self._browser, self._stamp = Served(limits), browser, 0.0
        self.view = full_view()
        self.pages: list[Page] = []

    def show(self, **changed: object) -> OperatorView:
        """Put the view, changed, one turn on if the turn was not told."""
        self._stamp += 1.0
        turn = changed.pop("turn", self.view.turn + 1)
        self.view = replace(self.view, stamp=self._stamp, turn=turn, **changed)
        self.served.put(self.view)
        for page in self.pages:
            page.until(f"{LIVE} && document.body.dataset.turn === '{turn}'")
        return self.view

    def open(self, size: tuple[int, int] = (1024, 768)) -> Page:
        """A window that shows the newest view."""
        page = self._browser.page(self.served.address, size)
        page.until(f"{LIVE} && document.body.dataset.turn === '{self.view.turn}'")
        self.pages.append(page)
        return page

    def close(self) -> None:
        for page in self.pages:
            page.close()
        self.served.end()
        self.served.listener.close()
