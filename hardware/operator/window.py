"""One window: sent the newest whenever it has shown what it was sent before, and heard at any time.

Hearing never waits for sending, so that a window which shows nothing any more can still stop the run.
"""

from __future__ import annotations

import asyncio
from collections import deque

from aiohttp import WSMsgType, web

from hardware.operator.board import Board
from hardware.operator.broadcast import text
from hardware.operator.settings import Limits
from hardware.operator.shared_state import ALWAYS, RequestLine, Wish, refusal
from hardware.operator.words import Allowance, Ask, Shown, parsed
from hardware.process.clock import Clock

PULSE = 0.25  # s: so often a window is told how old everything is, even if nothing is new
FLOOD = 400  # messages beyond what is allowed, after which a window is closed
REFUSED = 1008  # close codes of RFC 6455: policy violation


class Window:
    """Serves one web socket until either side ends it."""

    def __init__(
        self, socket: web.WebSocketResponse, board: Board, requests: RequestLine, limits: Limits, clock: Clock
    ) -> None:
        self._socket, self._board, self._requests, self._limits, self._clock = socket, board, requests, limits, clock
        self._messages, self._asks = Allowance(limits.messages, clock.now()), Allowance(limits.asks, clock.now())
        self._replies: deque[str] = deque(maxlen=16)
        self._bundle, self._shown = 0, asyncio.Event()
        self.malformed = self.dropped = 0

    async def run(self) -> None:
        """Send and hear."""
        sending = asyncio.create_task(self._send())
        try:
            await self._hear()
        finally:
            sending.cancel()

    async def _hear(self) -> None:
        async for message in self._socket:
            said = parsed(message.data) if message.type is WSMsgType.TEXT else None
            if isinstance(said, Ask) and said.wish is Wish.STOP:
                self._ask(said)
            elif not self._messages.take(self._clock.now()):
                self.dropped += 1
            elif isinstance(said, Ask):
                self._ask(said)
            elif isinstance(said, Shown):
                if said.bundle == self._bundle:
                    self._shown.set()
            else:
                self.malformed += 1
            if self.malformed > self._limits.malformed or self.dropped > FLOOD:
                await self._close(b"too many messages, or none that make sense")

    def _ask(self, ask: Ask) -> None:
        number, words = None, self._refusal(ask)
        if not words and (number := self._requests.ask(ask.wish, ask.turn)) is None:
            words = "the run has not yet taken what was asked before"
        self._replies.append(text(kind="asked", tag=ask.tag, wish=ask.wish, number=number, words=words))
        self._board.tell()

    def _refusal(self, ask: Ask) -> str:
        """Why it is not even handed on; the run looks at it again, and knows better."""
        if ask.wish is Wish.STOP:
            return ""
        now, view = self._clock.now(), self._board.view
        if not self._asks.take(now):
            return "that was too fast: ask again"
        if view is None or self._board.age(now) > self._limits.stale:
            return "" if ask.wish in ALWAYS else "nothing is heard from the run"
        return refusal(ask.wish, ask.turn, view.offers, view.turn)

    async def _send(self) -> None:
        try:
            await self._send_all()
        except (TimeoutError, ConnectionError, asyncio.IncompleteReadError):
            await self._close(b"nothing was shown for too long")

    async def _send_all(self) -> None:
        board, scene, pictures = self._board, "", b""
        await self._put(board.course_text())
        while True:
            news = board.news
            self._bundle, self._shown = self._bundle + 1, asyncio.Event()
            if board.scene_text is not scene:
                scene = board.scene_text
                await self._put(scene)
            if board.pictures_bytes is not pictures:
                pictures = board.pictures_bytes
                await self._put(pictures)
            while self._replies:
                await self._put(self._replies.popleft())
            await self._put(self._status())
            await asyncio.wait_for(self._shown.wait(), self._limits.patience)
            if not self._replies:
                await _within(news, PULSE)

    def _status(self) -> str:
        age = self._board.age(self._clock.now())
        kind, stale = "gone" if self._board.gone else "view", self._limits.stale
        head = text(kind=kind, bundle=self._bundle, age=age, stale=stale, refused=self._board.refused)
        return f'{head[:-1]},"view":{self._board.view_text}}}'

    async def _put(self, message: str | bytes) -> None:
        if message:
            sent = self._socket.send_str(message) if isinstance(message, str) else self._socket.send_bytes(message)
            await asyncio.wait_for(sent, self._limits.patience)

    async def _close(self, why: bytes) -> None:
        await asyncio.wait_for(self._socket.close(code=REFUSED, message=why), self._limits.patience)


async def _within(news: asyncio.Event, seconds: float) -> None:
    try:
        await asyncio.wait_for(news.wait(), seconds)
    except TimeoutError:
        return
