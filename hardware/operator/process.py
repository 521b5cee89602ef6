"""The run's side of what shows it: the process of the operator's page, thumbnails for that, and Foxglove's server.

Offering a frame set costs a comparison or two. Thumbnails are made a few times a second while a window is open, in a
thread of their own with OpenCV's calls outside of Python's lock; sets that come meanwhile are dropped.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import socket
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimation.errors import InputError, StillbedError
from estimation.se3 import Array
from hardware.operator.settings import LOOPBACK, OperatorSettings, WindowLimits, allowed_hosts, check_settings
from hardware.operator.shared_state import (
    CameraPicture,
    OperatorLink,
    PagePictures,
    PageStatus,
    RecordingView,
    WavingView,
)
from hardware.operator.view import Wish, refusal
from hardware.process.clock import Clock, WallClock
from hardware.process.system import NICE_LEVEL, SPAWN, SharedLatest, ask_to_go_first, blocked_sigint, step_back
from perception.frames import Image

if TYPE_CHECKING:
    from hardware.recording.recorder import PublishedMessage

RESTART_AFTER = 1.0  # s between two starts of a page that died
REPORT_FETCH_TIME, REPORT_POLL_PERIOD = 1.0, 0.02  # s
LAST_VIEW_TIME = 0.5  # s for windows to receive the last view
EXIT_TIMEOUT = 0.5  # s for the page's process: 0.2 in which its windows show that the run is gone, and to close them
THUMBNAIL_WIDTH = 640  # px: three side by side fill a screen
THUMBNAIL_QUALITY = 75  # 35 kB each; the path's edges are drawn by the browser and do not suffer
CROP_WIDTH = 480  # px, of the part around the wound: seldom more than the camera has there
FINE_CROP_WIDTH, FINE_QUALITY = 1920, 90  # of the same where beads of a millimetre are judged: as the camera has it
CROP_MARGIN = 1.4  # of that part around outline and tracks: breathing stays inside
MIN_CROP_POINTS = 8  # points that say where the wound is
THUMBNAIL_PERIOD = 0.2  # s: breathing looks smooth, and 3 % of a core is not missed

FOXGLOVE_BACKLOG = 60  # messages that wait for a slow client, 0.2 s of them; then the oldest is dropped
REPEAT_PERIOD = 2.0  # s after which what seldom comes is served again, for clients that came since
SELDOM = ("/tf_static", "/path", "/scan", "/landmarks", "/camera_info")  # ends of such topics

Crop = tuple[int, int, int, int]  # x, y, width, height px


class OperatorPage:
    """The page's process, which is started again whenever it has died: the port stays with the run.

    process: that serves, None before it is started.
    """

    def __init__(self, link: OperatorLink, settings: OperatorSettings) -> None:
        """Binds the port; OSError where it is taken, InputError where the settings would let others in."""
        self._link, self._settings = link, check_settings(settings)
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        self._listener = socket.create_server((settings.host, settings.port), family=family, backlog=32)
        self.process: BaseProcess | None = None
        self._started = float("-inf")

    @property
    def address(self) -> str:
        """To be opened in a browser, from the beginning on; whoever has it can operate the run."""
        port = self._listener.getsockname()[1]
        names = [*self._settings.names, self._settings.host]
        own = f"[{names[0]}]" if ":" in names[0] else names[0]
        assert f"{own}:{port}" in allowed_hosts(self._settings, port)
        return f"{self._settings.scheme}://{own}:{port}/{self._settings.token}/"

    def tend(self, now: float) -> bool:
        """Start the process if it does not run, at most once a second; whether it was started. now: s."""
        if (self.process is not None and self.process.is_alive()) or now - self._started < RESTART_AFTER:
            return False
        self._started = now
        arguments = (self._link, self._settings, self._listener)
        self.process = SPAWN.Process(target=operator_process, args=arguments, name="operator's page", daemon=True)
        with blocked_sigint():
            self.process.start()
        return True

    def hand_out_report(self) -> None:
        """Wait until each open window has taken the report of the run that is over, for REPORT_FETCH_TIME at most."""
        clock, status = WallClock(), self._link.status
        until = clock.now() + REPORT_FETCH_TIME
        while status.reports < status.windows and clock.now() < until:
            clock.wait_until(clock.now() + REPORT_POLL_PERIOD)

    def close(self) -> None:
        """End the process and give the port back."""
        if self.process is not None:
            if self._link.status.windows:  # else nobody sees that the run is gone
                self.process.terminate()
                self.process.join(EXIT_TIMEOUT)
            self.process.kill()
            self.process.join()
            self.process = None
        self._listener.close()


def operator_process(link: OperatorLink, settings: OperatorSettings, listener: socket.socket) -> None:
    """The body of the process: serve the page until SIGTERM or until the run is gone. Ctrl-C is for the run alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _lead_session()
    for name in ("aiohttp", "asyncio"):  # what strangers send is theirs: it is counted, and not written on the terminal
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    asyncio.run(_serve_until_end(link, settings, listener))


def _lead_session() -> None:
    """Be a session of one's own, with a large share of the processor where that is granted: a stop waits for no turn.

    Not all of it, as in real time, since strangers can keep this process busy. Linux shares among sessions first.
    """
    with suppress(OSError):
        os.setsid()
        Path("/proc/self/autogroup").write_text(str(NICE_LEVEL), encoding="ascii")
    ask_to_go_first()


async def _serve_until_end(link: OperatorLink, settings: OperatorSettings, listener: socket.socket) -> None:
    from hardware.operator.server import serve  # aiohttp is for this process alone

    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, ended.set)
    if (parent := multiprocessing.parent_process()) is not None:
        sentinel = parent.sentinel

        def on_parent_exit() -> None:
            loop.remove_reader(sentinel)
            ended.set()

        loop.add_reader(sentinel, on_parent_exit)
    await serve(link, settings, listener, ended, WindowLimits())


@dataclass(frozen=True, slots=True, eq=False)
class CameraShot:
    """One camera's picture as it is offered; outline and tracks as in CameraPicture."""

    camera: str
    image: Image  # (H, W) or (H, W, 3) BGR, which must not change any more
    outline: tuple[Array, ...] = ()
    tracks: Array = field(default_factory=lambda: np.zeros((0, 2)))


class Thumbnailer:
    """Makes thumbnails in a thread; those larger than their place are left out."""

    def __init__(self, pictures: SharedLatest[PagePictures], status: PageStatus, near: bool = True) -> None:
        """near: whether the part around outline and tracks is shown as well."""
        self._pictures, self._status, self._clock, self._near = pictures, status, WallClock(), near
        self._due = float("-inf")
        self._crops: dict[str, Crop] = {}
        self._thread = ThreadPoolExecutor(1, "live pictures", step_back)
        self._job: Future[None] | None = None  # the last one

    def offer(self, stamp: float, shots: Sequence[CameraShot], base_from_surface: Array | None = None) -> bool:
        """Whether the shots of one instant (s) will be shown; never waits. base_from_surface: (4, 4) mm then."""
        now, busy = self._clock.now(), self._job is not None and not self._job.done()
        if busy or now < self._due or not self._status.windows:
            return False
        self._due = now + THUMBNAIL_PERIOD
        self._job = self._thread.submit(self._make, stamp, shots, base_from_surface)
        self._job.add_done_callback(Future.result)  # an error in it is logged
        return True

    def close(self) -> None:
        """End the thread."""
        self._thread.shutdown()

    def _make(self, stamp: float, shots: Sequence[CameraShot], base_from_surface: Array | None) -> None:
        pictures = PagePictures(stamp, tuple(map(self._picture, shots)), base_from_surface)
        with suppress(InputError):  # larger than their place: the next ones may be smaller
            self._pictures.put(pictures)

    def _picture(self, shot: CameraShot) -> CameraPicture:
        from hardware.files.images import small_jpeg  # OpenCV is for the process that has the images

        crop = crop_around(shot, self._crops.get(shot.camera)) if self._near else None
        whole, near = small_jpeg(shot.image, THUMBNAIL_WIDTH, THUMBNAIL_QUALITY), b""
        if crop is not None:
            self._crops[shot.camera] = crop
            x, y, width, height = crop
            size = (FINE_CROP_WIDTH, FINE_QUALITY) if self._status.fine else (CROP_WIDTH, THUMBNAIL_QUALITY)
            near = small_jpeg(shot.image[y : y + height, x : x + width], *size)
        return CameraPicture(shot.camera, whole, shot.outline, shot.tracks, near, crop)


class StatusPage:
    """The page beside a command that moves no arm; `address` is for the browser. Nothing but `close` waits for it."""

    def __init__(self, clock: Clock, file: str) -> None:
        self.clock, self.link = clock, OperatorLink()
        self.page = OperatorPage(self.link, OperatorSettings(page=file))
        self.thumbnailer = Thumbnailer(self.link.pictures, self.link.status, near=False)
        self.address = self.page.address

    def wishes(self, view: RecordingView | WavingView) -> list[Wish]:
        """What windows have asked for and may ask for under this view: STOP and END; keeps the page alive."""
        self.page.tend(self.clock.now())
        requests = self.link.requests.take()
        return [each.wish for each in requests if not refusal(each.wish, each.turn, view.offers, view.turn)]

    def close(self) -> None:
        """End the page, once its windows had time for the last view."""
        if self.link.status.windows:
            self.clock.wait_until(self.clock.now() + LAST_VIEW_TIME)
        self.thumbnailer.close()
        self.page.close()


def crop_around(shot: CameraShot, present: Crop | None) -> Crop | None:
    """The part of an image around outline and tracks, of its own proportions; None where that is all of it.

    present: what was shown before; it stays while all is in it and not much less would do, so that the view rests.
    """
    points = np.concatenate([*shot.outline, shot.tracks])
    if len(points) < MIN_CROP_POINTS:
        return present
    low, high = np.percentile(points, [2, 98], axis=0)  # single tracks may lie anywhere
    height, width = shot.image.shape[:2]
    needed = CROP_MARGIN * max(high[0] - low[0], (high[1] - low[1]) * width / height, width / 8)
    if present is not None and needed > present[2] / 2 and _holds(present, low, high):
        return present
    if needed >= width:
        return None
    size = np.array([round(needed), round(needed * height / width)])
    corner = np.clip(np.round((low + high - size) / 2), 0, [width, height] - size).astype(int)
    return int(corner[0]), int(corner[1]), int(size[0]), int(size[1])


def _holds(crop: Crop, low: Array, high: Array) -> bool:
    corner, size = np.array(crop[:2]), np.array(crop[2:])
    return bool((low >= corner).all() and (high <= corner + size).all())


class FoxgloveServer:
    """Serves what is recorded to Foxglove on this machine, as it is written.

    Clients listen; nothing that they send counts. The library's threads have this process's low priority. A client that
    reads slowly loses messages, nobody else does.
    """

    def __init__(self, port: int) -> None:
        import foxglove  # the extra [foxglove]

        self._library, self._context = foxglove, foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="stillbed",
                host=LOOPBACK,
                port=port,
                capabilities=[],  # what a client wants to publish, set or call is refused
                context=self._context,
                message_backlog_size=FOXGLOVE_BACKLOG,
            )
        except Exception as error:  # the library's own, of a port that was taken since it was looked at
            raise StillbedError(f"record.foxglove_port: {port} cannot be used: {error}; another port, or 0") from error
        self._channels: dict[str, foxglove.Channel] = {}
        self._seldom: dict[str, PublishedMessage] = {}
        self._clock, self._repeated = WallClock(), 0.0

    def publish(self, message: PublishedMessage) -> None:
        """Serve a message; now and then those that seldom come as well."""
        self._send(message)
        if message.topic.endswith(SELDOM):
            self._seldom[message.topic] = message
        if (now := self._clock.now()) > self._repeated + REPEAT_PERIOD:
            self._repeated = now
            for each in self._seldom.values():
                self._send(each)

    def _send(self, message: PublishedMessage) -> None:
        from hardware.recording.ros_messages import definition

        if message.topic not in self._channels:
            schema, encoding = None, "json"
            if message.name is not None:
                text = definition(message.name).encode()
                schema, encoding = self._library.Schema(name=message.name, encoding="ros2msg", data=text), "cdr"
            channel = self._library.Channel(
                message.topic, schema=schema, message_encoding=encoding, context=self._context
            )
            self._channels[message.topic] = channel
        self._channels[message.topic].log(message.data, log_time=message.log_time)

    def close(self) -> None:
        """End the service."""
        self._server.stop()
