"""The page over HTTP: its few files, its web sockets, and a stop for windows that have no socket (owns aiohttp)."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Callable, Sequence
from importlib.resources import files
from socket import socket as Listener

from aiohttp import web

from hardware.operator.board import Board
from hardware.operator.broadcast import text
from hardware.operator.gate import Gate, answer_headers
from hardware.operator.link import OperatorLink
from hardware.operator.settings import Limits, OperatorSettings
from hardware.operator.shared_state import Wish
from hardware.operator.window import Window
from hardware.process.clock import WallClock

LOOK = 0.04  # s: how soon what the run puts out is seen
STRANGERS = 32  # connections that are no windows: a browser keeps six
FULL = 1013  # close code: try again later
KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class OperatorServer:
    """One run's page."""

    def __init__(self, link: OperatorLink, settings: OperatorSettings, port: int, limits: Limits) -> None:
        self._link, self._settings, self._limits, self._clock = link, settings, limits, WallClock()
        self._gate, self._headers = Gate(settings, port), answer_headers(settings, port)
        self._windows: dict[Window, asyncio.BaseTransport | None] = {}
        self._files = page_files()
        self.board = Board(link)

    def application(self) -> web.Application:
        """Everything behind the gate."""
        made = web.Application(middlewares=[self._guard], client_max_size=self._limits.message)
        made.add_routes(
            [
                web.get("/{token}/socket", self._socket),
                web.post("/{token}/stop", self._stop),
                web.get("/{token}/{name:[a-z_.]*}", self._file),
            ]
        )
        return made

    async def look(self, connections: Callable[[], Sequence[web.RequestHandler]]) -> None:
        """Keep the board up to date for ever, and connections few. connections: all there are, the oldest first."""
        while True:
            self._link.requests.windows = len(self._windows)
            self.board.refused = sum(self._gate.refused.values())
            self.board.look(self._clock.now(), bool(self._windows))
            own = set(self._windows.values())
            for handler in [each for each in connections() if each.transport not in own][:-STRANGERS]:
                handler.force_close()
            await asyncio.sleep(LOOK)

    def last_look(self) -> None:
        """Show what the run said last, and that it is gone."""
        self.board.look(self._clock.now(), False)
        self._link.requests.windows = 0
        self.board.gone = True

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        changes = request.method != "GET" or "Upgrade" in request.headers
        token = request.path.partition("/")[2].partition("/")[0]
        if reason := self._gate.refusal(token, request.headers, changes):
            return web.Response(status=403, text=f"refused: {reason}\n", headers=self._own_headers())
        try:
            answer = await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.reason}\n", headers=self._own_headers())
        return answer

    def _own_headers(self) -> dict[str, str]:
        return {**self._headers, "Server": "stillbed"}

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"] or self._settings.page
        if name not in self._files:
            raise web.HTTPNotFound
        kind = KINDS[name.rsplit(".", 1)[1]]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8", headers=self._own_headers())

    async def _stop(self, request: web.Request) -> web.StreamResponse:
        number = self._link.requests.ask(Wish.STOP, 0)
        return web.Response(text=f"{number}\n", headers=self._own_headers())

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(max_msg_size=self._limits.message, compress=False, timeout=1.0)
        socket.headers.update(self._own_headers())
        await socket.prepare(request)
        if len(self._windows) >= self._limits.windows:
            await socket.send_str(text(kind="full", windows=len(self._windows)))
            await socket.close(code=FULL, message=b"too many windows")
            return socket
        window = Window(socket, self.board, self._link.requests, self._limits, self._clock)
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
    link: OperatorLink, settings: OperatorSettings, listener: Listener, ended: asyncio.Event, limits: Limits
) -> None:
    """Serve until `ended` is set; windows are told then."""
    server = OperatorServer(link, settings, listener.getsockname()[1], limits)
    runner = web.AppRunner(server.application(), access_log=None, keepalive_timeout=10.0, shutdown_timeout=0.5)
    await runner.setup()
    await web.SockSite(runner, listener, ssl_context=_encryption(settings)).start()
    assert runner.server is not None
    handlers = runner.server
    looking = asyncio.create_task(server.look(lambda: handlers.connections))
    done = asyncio.create_task(ended.wait())
    await asyncio.wait({looking, done}, return_when=asyncio.FIRST_COMPLETED)
    server.last_look()
    server.board.tell()
    await asyncio.sleep(FAREWELL)
    await runner.cleanup()
    if looking.done():
        looking.result()  # what ended it
    looking.cancel()


FAREWELL = 0.2  # s for the windows to be told


def _encryption(settings: OperatorSettings) -> ssl.SSLContext | None:
    if settings.certificate is None:
        return None
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    made.load_cert_chain(settings.certificate, settings.key)
    return made
