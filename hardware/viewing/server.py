"""The viewer over HTTP: its few files, the session once, and what is known at any of its instants when it is asked for.

Behind the same gate as the operator's page: this machine only, a token in the address, nothing from outside.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable
from importlib.resources import files

import numpy as np
from aiohttp import web

from estimation.errors import StillbedError
from hardware.offline.viewer import PictureBook, Playback
from hardware.operator.broadcast import pictures_bytes, scene_text, text
from hardware.operator.gate import Gate, answer_headers
from hardware.operator.server import KINDS, page_files
from hardware.operator.settings import OperatorSettings

SHARED = ("camera.js", "lens.js", "panes.js", "scene.js", "words.js", "page.css", "icon.svg")  # of the operator's page
UNREADABLE = 422  # an answer that says why, to a question that was understood

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ViewServer:
    """One session's viewer."""

    def __init__(self, playback: Playback, settings: OperatorSettings, port: int) -> None:
        self._playback, self._book = playback, PictureBook(playback)
        self._gate, self._headers = Gate(settings, port), {**answer_headers(settings, port), "Server": "stillbed"}
        own = {each.name: each.read_bytes() for each in (files("hardware") / "offline" / "viewer_page").iterdir()}
        self._files = {**{name: page_files()[name] for name in SHARED}, **own}
        self._session = session_text(playback)

    def application(self) -> web.Application:
        """Everything behind the gate."""
        made = web.Application(middlewares=[self._guard])
        made.add_routes(
            [
                web.get("/{token}/session", self._whole),
                web.get("/{token}/at/{k:[0-9]{1,9}}", self._instant),
                web.get("/{token}/pictures/{k:[0-9]{1,9}}", self._pictures),
                web.get("/{token}/{name:[a-z_.]*}", self._file),
            ]
        )
        return made

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        token = request.path.partition("/")[2].partition("/")[0]
        if reason := self._gate.refusal(token, request.headers, request.method != "GET"):
            return web.Response(status=403, text=f"refused: {reason}\n", headers=self._headers)
        try:
            return await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.reason}\n", headers=self._headers)
        except StillbedError as error:
            return web.Response(status=UNREADABLE, text=str(error), headers=self._headers)

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"] or "view.html"
        if name not in self._files:
            raise web.HTTPNotFound
        kind = KINDS[name.rsplit(".", 1)[1]]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8", headers=self._headers)

    async def _whole(self, _: web.Request) -> web.StreamResponse:
        return web.Response(text=self._session, content_type="application/json", headers=self._headers)

    async def _instant(self, request: web.Request) -> web.StreamResponse:
        said = instant_text(self._playback, self._number(request))
        return web.Response(text=said, content_type="application/json", headers=self._headers)

    async def _pictures(self, request: web.Request) -> web.StreamResponse:
        k = self._number(request)
        body = await asyncio.to_thread(lambda: pictures_bytes(self._book(k)))
        return web.Response(body=body, content_type="application/octet-stream", headers=self._headers)

    def _number(self, request: web.Request) -> int:
        k = int(request.match_info["k"])
        if k >= len(self._playback):
            raise web.HTTPNotFound
        return k


def session_text(playback: Playback) -> str:
    """What does not change with time: the scene, and where the surface is all along."""
    truth = playback.session.truth
    whole = text(
        title=playback.session.path.name,
        source=playback.source,
        damage=playback.session.damage,
        truth="" if truth is None else "truth" if truth.exact else "reference",
        stamps=np.round(playback.stamps - playback.stamps[0], 4),
        first=float(playback.stamps[0]),
        places=[None if np.isnan(place[0]) else np.round(place, 4) for place in playback.places],
        states=["" if pose is None else pose.state for pose in playback.poses],
        off=playback.off,
    )
    return f'{whole[:-1]},"scene":{scene_text(playback.scene)}}}'


def instant_text(playback: Playback, k: int) -> str:
    """What is known at frame set k."""
    return text(
        k=k,
        tracking=playback.tracking(k),
        motion=playback.motion(k),
        fraction=playback.fraction[k],
        off=playback.off[k],
    )


async def serve(playback: Playback, settings: OperatorSettings, listener: socket.socket) -> None:
    """Serve until cancelled."""
    server = ViewServer(playback, settings, listener.getsockname()[1])
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        await web.SockSite(runner, listener).start()
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()
