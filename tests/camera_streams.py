"""Cameras for the tests of live cameras: pictures, a local HTTP stream that can fail, and a list that is a camera."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

from hardware.cameras.capture import Control
from hardware.cameras.sources import CameraSource, Identity, SourceKind
from hardware.process.clock import Clock, WallClock
from perception.frames import Image

SIZE = (160, 120)
CLOCK = WallClock()


def picture(number: int) -> Image:
    """A picture (120, 160, 3) of grain that no other number has."""
    return np.random.default_rng(number).integers(60, 200, (SIZE[1], SIZE[0], 3)).astype(np.uint8)


BLACK = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)


@dataclass
class HttpCamera:
    """What a camera on the network sends: `picture_of` a frame's number, bytes as they are; a test changes it."""

    fps: float = 40.0
    picture_of: Callable[[int], Image | bytes] = picture
    online: bool = True
    stalled: bool = False
    url: str = ""
    sent: list[float] = field(default_factory=list)

    @property
    def source(self) -> CameraSource:
        return CameraSource(Identity(SourceKind.STREAM, self.url))

    def part(self) -> bytes:
        seen = self.picture_of(len(self.sent))
        data = seen if isinstance(seen, bytes) else cv2.imencode(".jpg", seen)[1].tobytes()
        self.sent.append(CLOCK.now())
        return b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data) + data + b"\r\n"


@contextmanager
def served(*cameras: HttpCamera) -> Iterator[None]:
    """Serve cameras as multipart/x-mixed-replace, one below each path."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            camera = cameras[int(self.path[1:])]
            if not camera.online:
                self.send_error(503)
                return
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            due = CLOCK.now()
            while camera.online:
                if not camera.stalled:
                    self.wfile.write(camera.part())
                due = max(due + 1 / camera.fps, CLOCK.now())
                CLOCK.wait_until(due)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.handle_error = lambda *_: None
    for i, camera in enumerate(cameras):
        camera.url = f"http://127.0.0.1:{server.server_port}/{i}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield
    finally:
        for camera in cameras:
            camera.online = False
        server.shutdown()
        server.server_close()


@dataclass(frozen=True)
class Shot:
    """One frame of a listed camera. arrival: s. position: s, as the driver tells it. image: None, undecodable."""

    arrival: float
    position: float = math.nan
    image: Image | None = None


class ListedCapture:
    """A list that is a camera: each frame comes at its arrival; after the last one the camera has gone."""

    exact, incomplete, transport = False, False, None

    def __init__(self, shots: Sequence[Shot], clock: Clock, clocked: bool, controls: tuple[Control, ...] = ()) -> None:
        self._shots, self._clock, self._controls = iter(shots), clock, controls
        self._shot = Shot(0.0)
        self.ends, self.clocked, self.released = False, clocked, False

    def grab(self) -> bool:
        found = next(self._shots, None)
        if found is None:
            return False
        self._clock.wait_until(found.arrival)
        self._shot = found
        return True

    def position(self) -> float:
        return self._shot.position

    def retrieve(self) -> Image | None:
        return self._shot.image

    def lock(self) -> tuple[Control, ...]:
        return self._controls

    def release(self) -> None:
        self.released = True
