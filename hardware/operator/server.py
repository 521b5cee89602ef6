"""The page over HTTP: its few files, its web sockets, and a stop for windows without a socket (owns aiohttp).

A window is sent the newest view whenever it has acknowledged the one before. Receiving never waits for sending, so a
window that no longer shows anything can still stop the run.
"""

from __future__ import annotations

import asyncio
import ssl
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from socket import socket as Listener
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from estimation.errors import InputError
from estimation.rig import Camera, Rig
from hardware.files.region_table import BY_KEY, RegionBy, check_region, region_from_table
from hardware.operator.broadcast import (
    ENCODERS,
    Broadcast,
    RateLimiter,
    RegionMessage,
    RequestMessage,
    ShownMessage,
    parse_message,
    text,
)
from hardware.operator.settings import AccessControl, OperatorSettings, WindowLimits, response_headers
from hardware.operator.shared_state import OperatorLink, Polygons
from hardware.operator.view import CALMING_WISHES, CHANGED_TEXT, RunStage, Wish, refusal
from hardware.process.clock import WallClock

STATUS_PULSE = 0.25  # s: so often a window is sent how old everything is, even if nothing is new
LINK_POLL_PERIOD = 0.04  # s: how soon what the run puts out is noticed
HURRY_PERIOD, HURRY_TIME = 0.005, 0.3  # s: how soon, and for how long, after something was asked: a stop is followed
SHUTDOWN_DELAY = 0.2  # s in which the windows show that the run is gone
MAX_DROPPED_MESSAGES = 400  # messages beyond what is allowed, after which a window is closed
MAX_OTHER_CONNECTIONS = 32  # connections that are no windows: a browser keeps six
CONTENT_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}

FINE_STAGES = (RunStage.FIND, RunStage.CONFIRM, RunStage.READY)  # in which the path's place is judged by the pictures
REPORT_NAME = "report"  # no file of the page, but the run's

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class WindowSession:
    """Serves one web socket until either side ends it."""

    def __init__(
        self, socket: web.WebSocketResponse, newest: Broadcast, link: OperatorLink, limits: WindowLimits
    ) -> None:
        self._socket, self._broadcast, self._link, self._limits = socket, newest, link, limits
        self._clock = WallClock()
        now = self._clock.now()
        self._message_limiter, self._request_limiter = RateLimiter(limits.messages, now), RateLimiter(limits.asks, now)
        self._replies: deque[str] = deque(maxlen=16)
        self._bundle, self._shown = 0, asyncio.Event()
        self.malformed = self.dropped = 0

    async def run(self) -> None:
        """Send and receive."""
        sending = asyncio.create_task(self._send())
        try:
            await self._receive()
        finally:
            sending.cancel()

    async def _receive(self) -> None:
        async for message in self._socket:
            parsed = parse_message(message.data) if message.type is WSMsgType.TEXT else None
            if isinstance(parsed, RequestMessage) and parsed.wish is Wish.STOP:
                self._ask(parsed)
            elif not self._message_limiter.take(self._clock.now()):
                self.dropped += 1
            elif isinstance(parsed, RequestMessage):
                self._ask(parsed)
            elif isinstance(parsed, RegionMessage):
                self._draw(parsed)
            elif isinstance(parsed, ShownMessage):
                if parsed.bundle == self._bundle:
                    self._shown.set()
            else:
                self.malformed += 1
            if self.malformed > self._limits.malformed or self.dropped > MAX_DROPPED_MESSAGES:
                await self._close(b"too many messages, or none that make sense")

    def _ask(self, request: RequestMessage) -> None:
        number, reason, outline = None, self._refusal(request), Polygons()
        if not reason and request.outline is not None:
            outline, reason = self._polygons(request.outline)
        if not reason and (number := self._link.ask(request.wish, request.turn, request.move, outline)) is None:
            reason = "the run has not yet taken what was asked before"
        self._broadcast.request_event.set()
        self._reply(request.tag, request.wish, number, reason)

    def _draw(self, message: RegionMessage) -> None:
        """Hand a drawn region to the run, or say why not."""
        reason = self._refusal(message)
        if not reason:
            polygons, reason = self._polygons(message.region)
            if not reason:
                self._link.regions.put(polygons)
        self._reply(message.tag, "region", None, reason)

    def _polygons(self, drawn: dict[str, Any]) -> tuple[Polygons, str]:
        """What was drawn on the pictures, checked; or why it makes no sense."""
        try:
            return drawn_region(drawn, self._broadcast.cameras), ""
        except InputError as error:
            return (), f"{error.what} = {error.got}, allowed {error.allowed}"

    def _reply(self, tag: int, wish: str, number: int | None, reason: str) -> None:
        self._replies.append(text(kind="asked", tag=tag, wish=wish, number=number, words=reason))
        self._broadcast.wake()

    def _refusal(self, message: RequestMessage | RegionMessage) -> str:
        """Why a message is not even handed on, "" if it is; the run decides again, by newer knowledge."""
        wish = message.wish if isinstance(message, RequestMessage) else None
        if wish is Wish.STOP:
            return ""
        now, view = self._clock.now(), self._broadcast.view
        if not self._request_limiter.take(now):
            return "that was too fast: ask again"
        if view is None or self._broadcast.age(now) > self._limits.stale:
            return "" if wish in CALMING_WISHES else "nothing is heard from the run"
        if wish is not None:
            return refusal(wish, message.turn, view.offers, view.turn)
        if not getattr(view, "draws", False):
            return "no region is asked for now"
        return CHANGED_TEXT if message.turn != view.turn else ""

    async def _send(self) -> None:
        try:
            await self._send_all()
        except (TimeoutError, ConnectionError, asyncio.IncompleteReadError):
            await self._close(b"nothing was shown for too long")

    async def _send_all(self) -> None:
        newest, shown = self._broadcast, dict[str, str | bytes]()
        await self._put(newest.history_text())
        while True:
            news = newest.news
            self._bundle, self._shown = self._bundle + 1, asyncio.Event()
            for name in ENCODERS:
                if (part := newest.encoded.get(name, "")) is not shown.get(name):
                    shown[name] = part
                    await self._put(part)
            while self._replies:
                await self._put(self._replies.popleft())
            await self._put(self._status())
            await asyncio.wait_for(self._until_shown(), self._limits.patience)
            if not self._replies:
                with suppress(TimeoutError):
                    await asyncio.wait_for(news.wait(), STATUS_PULSE)

    async def _until_shown(self) -> None:
        """Wait until the window has shown the bundle; a new turn, such as a stop, is sent at once all the same."""
        shown_task, turn = asyncio.create_task(self._shown.wait()), getattr(self._broadcast.view, "turn", 0)
        try:
            while not shown_task.done():
                news = asyncio.create_task(self._broadcast.news.wait())
                await asyncio.wait({shown_task, news}, return_when=asyncio.FIRST_COMPLETED)
                news.cancel()
                if not shown_task.done() and turn != (turn := getattr(self._broadcast.view, "turn", 0)):
                    await self._put(self._status())
        finally:
            shown_task.cancel()

    def _status(self) -> str:
        age = self._broadcast.age(self._clock.now())
        kind, stale = "gone" if self._broadcast.gone else "view", self._limits.stale
        head = text(kind=kind, bundle=self._bundle, age=age, stale=stale, refused=self._broadcast.refused)
        return f'{head[:-1]},"view":{self._broadcast.view_text}}}'

    async def _put(self, message: str | bytes) -> None:
        if message:
            sending = self._socket.send_str(message) if isinstance(message, str) else self._socket.send_bytes(message)
            await asyncio.wait_for(sending, self._limits.patience)

    async def _close(self, reason: bytes) -> None:
        closing = self._socket.close(code=WSCloseCode.POLICY_VIOLATION, message=reason)
        await asyncio.wait_for(closing, self._limits.patience)


def drawn_region(region: dict[str, Any], cameras: Sequence[Camera]) -> Polygons:
    """The region in a window's message, checked as that of a session.toml is; InputError."""
    source = "the page"
    settings = region_from_table(source, {BY_KEY: RegionBy.POLYGON.value} | region)
    if settings.by is not RegionBy.POLYGON or not settings.polygons:
        raise InputError(source, "region", "no corners", "corners in two cameras or more")
    check_region(source, settings, Rig(tuple(cameras)))
    return settings.polygons


class OperatorServer:
    """The page of one run."""

    def __init__(self, link: OperatorLink, settings: OperatorSettings, port: int, limits: WindowLimits) -> None:
        self._link, self._settings, self._limits, self._clock = link, settings, limits, WallClock()
        self._access = AccessControl(settings, port)
        self._headers = {**response_headers(settings, port), "Server": "stillbed"}
        self._windows: dict[WindowSession, asyncio.BaseTransport | None] = {}
        self._files = page_files()
        self.broadcast, self._fast_poll_until = Broadcast(link), 0.0

    def application(self) -> web.Application:
        """The routes, all behind the check of requests."""
        application = web.Application(middlewares=[self._guard], client_max_size=self._limits.message)
        application.router.add_get("/{token}/socket", self._socket)
        application.router.add_post("/{token}/stop", self._stop)
        application.router.add_get("/{token}/{name:[a-z_.]*}", self._file)
        return application

    async def update(self, connections: Callable[[], Sequence[web.RequestHandler]]) -> None:
        """Take what the run puts out, for ever, and keep connections few. connections: all, the oldest first."""
        while True:
            self._link.status.windows = len(self._windows)
            self._link.status.fine = getattr(self.broadcast.view, "stage", None) in FINE_STAGES
            self.broadcast.refused = sum(self._access.refused.values())
            self.broadcast.update(self._clock.now(), bool(self._windows))
            sockets = set(self._windows.values())
            for handler in [each for each in connections() if each.transport not in sockets][:-MAX_OTHER_CONNECTIONS]:
                handler.force_close()
            await self._wait(self._clock.now())

    async def _wait(self, now: float) -> None:
        asked = self.broadcast.request_event
        if asked.is_set():
            asked.clear()
            self._fast_poll_until = now + HURRY_TIME
        if now < self._fast_poll_until:
            await asyncio.sleep(HURRY_PERIOD)
            return
        with suppress(TimeoutError):
            await asyncio.wait_for(asked.wait(), LINK_POLL_PERIOD)

    @property
    def windows(self) -> int:
        """How many windows are open."""
        return len(self._windows)

    def last_update(self) -> None:
        """Show the run's last view, and that it is gone."""
        self.broadcast.update(self._clock.now(), False)
        self._link.status.windows = 0
        self.broadcast.gone = True

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        changes = request.method != "GET" or "Upgrade" in request.headers
        token = request.path.partition("/")[2].partition("/")[0]
        if reason := self._access.refusal(token, request.headers, changes):
            return web.Response(status=403, text=f"refused: {reason}\n", headers=self._headers)
        try:
            return await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.reason}\n", headers=self._headers)

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"] or self._settings.page
        if name == REPORT_NAME:
            return self._report()
        if name not in self._files:
            raise web.HTTPNotFound
        kind = CONTENT_TYPES[name.rsplit(".", 1)[1]]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8", headers=self._headers)

    def _report(self) -> web.StreamResponse:
        """The report of a run that is over, to be saved: the policy for what is shown here allows it no style."""
        result = getattr(self.broadcast.view, "result", None)
        if result is None or not result.report or not (file := Path(result.report)).is_file():
            raise web.HTTPNotFound
        self._link.status.reports += 1
        headers = self._headers | {"Content-Disposition": "attachment"}
        return web.Response(body=file.read_bytes(), content_type="text/html", charset="utf-8", headers=headers)

    async def _stop(self, request: web.Request) -> web.StreamResponse:
        number = self._link.requests.ask(Wish.STOP, 0)
        self.broadcast.request_event.set()
        return web.Response(text=f"{number}\n", headers=self._headers)

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(max_msg_size=self._limits.message, compress=False, timeout=1.0)
        socket.headers.update(self._headers)
        await socket.prepare(request)
        if len(self._windows) >= self._limits.windows:
            await socket.send_str(text(kind="full", windows=len(self._windows)))
            await socket.close(code=WSCloseCode.TRY_AGAIN_LATER, message=b"too many windows")
            return socket
        window = WindowSession(socket, self.broadcast, self._link, self._limits)
        self._windows[window] = request.transport
        try:
            await window.run()
        finally:
            del self._windows[window]
        return socket


def page_files() -> dict[str, bytes]:
    """The page's files by name."""
    return {each.name: each.read_bytes() for each in (files("hardware") / "operator" / "page").iterdir()}


async def serve(
    link: OperatorLink, settings: OperatorSettings, listener: Listener, ended: asyncio.Event, limits: WindowLimits
) -> None:
    """Serve until `ended` is set; then the windows show that the run is gone."""
    server = OperatorServer(link, settings, listener.getsockname()[1], limits)
    runner = web.AppRunner(server.application(), access_log=None, keepalive_timeout=10.0, shutdown_timeout=0.5)
    await runner.setup()
    await web.SockSite(runner, listener, ssl_context=_ssl_context(settings)).start()
    assert runner.server is not None
    handlers = runner.server
    update_task = asyncio.create_task(server.update(lambda: handlers.connections))
    ended_task = asyncio.create_task(ended.wait())
    await asyncio.wait({update_task, ended_task}, return_when=asyncio.FIRST_COMPLETED)
    server.last_update()
    server.broadcast.wake()
    if server.windows:
        await asyncio.sleep(SHUTDOWN_DELAY)
    await runner.cleanup()
    if update_task.done():
        update_task.result()  # what ended it
    update_task.cancel()


def _ssl_context(settings: OperatorSettings) -> ssl.SSLContext | None:
    if settings.certificate is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(settings.certificate, settings.key)
    return context
