"""Windows that do as they should, windows that do not, and a run that notices neither."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from ctypes import c_double
from dataclasses import replace
from multiprocessing.sharedctypes import RawValue
from typing import Any

import aiohttp
import numpy as np
import pytest
from aiohttp import WSMsgType
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.live import fault_injection as flood
from hardware.live.fault_injection import FloodCount
from hardware.operator.process import OperatorPage
from hardware.operator.server import MAX_DROPPED_MESSAGES
from hardware.operator.settings import OperatorSettings, WindowLimits
from hardware.operator.shared_state import OTHER_REQUEST_SLOTS, CameraPicture, OperatorLink, PagePictures
from hardware.operator.view import Wish
from hardware.process.clock import WallClock
from hardware.process.faults import Fault, FaultKind, FaultPart
from tests.operator_page import Served, full_view, served

CALM = WindowLimits(stale=30.0, patience=30.0)


class Socket:
    """A window as a program: `next` is the next message of a kind, with a view if it is a view."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse, acknowledges: bool = True) -> None:
        self.socket, self._acknowledges = socket, acknowledges

    async def next(self, kind: str = "view") -> dict[str, Any]:
        while True:
            message = await self.socket.receive(30)
            if message.type is WSMsgType.BINARY:
                said = {"kind": "pictures", "size": len(message.data)}
            elif message.type is WSMsgType.TEXT:
                said = json.loads(message.data)
            else:
                raise ConnectionError(f"{message.type} {self.socket.close_code}")
            empty = said.get("view", "") is None  # it opened before anything was to be seen
            if "bundle" in said and (self._acknowledges or empty):
                await self.socket.send_str(json.dumps({"shown": said["bundle"]}))
            if said["kind"] == kind and not empty:
                return said

    async def ask(self, wish: Wish, turn: int, tag: int = 1) -> None:
        await self.socket.send_str(json.dumps({"ask": wish, "turn": turn, "tag": tag}))

    async def closed(self) -> int | None:
        """The code with which it is closed."""
        while (await self.socket.receive(30)).type not in (WSMsgType.CLOSE, WSMsgType.CLOSED, WSMsgType.ERROR):
            pass
        return self.socket.close_code


@asynccontextmanager
async def window(address: str, acknowledges: bool = True) -> AsyncIterator[Socket]:
    origin = address.rsplit("/", 2)[0]
    headers = {"Origin": origin}
    async with aiohttp.ClientSession() as session, session.ws_connect(address + "socket", headers=headers) as socket:
        yield Socket(socket, acknowledges)


def test_two_windows_show_the_same_and_a_request_of_either_arrives_with_the_turn_it_was_shown() -> None:
    async def both(page: Served) -> None:
        async with window(page.address) as first, window(page.address) as second:
            views = [(await each.next())["view"] for each in (first, second)]
            assert views[0] == views[1] and views[0]["turn"] == 7
            await first.ask(Wish.PAUSE, 7)
            await second.ask(Wish.STOP, 7)
            assert (await first.next("asked"))["number"] and (await second.next("asked"))["number"]

    with served(CALM) as page:
        page.put(full_view(turn=7))
        asyncio.run(both(page))
        assert [request.wish for request in page.taken()] == [Wish.STOP]


def test_a_window_that_shows_an_older_turn_cannot_let_the_run_go_on_but_can_stop_it() -> None:
    async def ask(page: Served) -> list[str]:
        async with window(page.address) as stale:
            await stale.next()
            words = []
            for wish in (Wish.RESUME, Wish.START, Wish.HOME, Wish.PAUSE, Wish.STOP):
                await stale.ask(wish, 6)
                words.append((await stale.next("asked"))["words"])
            return words

    with served(CALM) as page:
        page.put(full_view(turn=7))
        words = asyncio.run(ask(page))
        assert all("changed" in each for each in words[:3]) and words[3:] == ["", ""]


def test_a_slow_window_is_shown_the_newest_and_what_came_between_is_left_out() -> None:
    async def look(page: Served) -> None:
        async with window(page.address, acknowledges=False) as slow:
            first = await slow.next()
            for stamp in range(2, 60):
                page.put(full_view(float(stamp)))
                await asyncio.sleep(0.01)
            await slow.socket.send_str(json.dumps({"shown": first["bundle"]}))
            assert (await slow.next())["view"]["stamp"] > 40

    with served(CALM) as page:
        page.put(full_view(1.0))
        asyncio.run(look(page))


def test_pictures_and_scene_come_once_and_not_again_until_they_change() -> None:
    async def look(page: Served) -> list[int]:
        async with window(page.address) as one:
            sizes = [(await one.next("pictures"))["size"]]
            page.put(full_view(2.0))
            await one.next()
            page.link.pictures.put(replace(pictures, stamp=2.0, pictures=(*pictures.pictures, *pictures.pictures)))
            sizes.append((await one.next("pictures"))["size"])
            return sizes

    with served(CALM) as page:
        pictures = PagePictures(1.0, (CameraPicture("camera0", bytes(3000)),), np.eye(4))
        page.put(full_view())
        page.link.pictures.put(pictures)
        small, large = asyncio.run(look(page))
        assert large - small >= 3000


def test_a_window_that_shows_nothing_can_stop_the_run_and_is_closed_in_the_end() -> None:
    async def stuck(page: Served) -> int | None:
        async with window(page.address, acknowledges=False) as one:
            await one.next()
            await one.ask(Wish.STOP, 0)
            return await one.closed()

    with served(replace(CALM, patience=0.5)) as page:
        page.put(full_view())
        assert asyncio.run(stuck(page)) == 1008
        assert [request.wish for request in page.taken()] == [Wish.STOP]


def test_when_nothing_is_heard_from_the_run_only_what_leads_to_rest_is_handed_on() -> None:
    async def ask(page: Served) -> list[str]:
        async with window(page.address) as one:
            words = []
            for wish in (Wish.RESUME, Wish.PAUSE, Wish.STOP):
                await one.ask(wish, 1)
                words.append((await one.next("asked"))["words"])
            return words

    with served(replace(CALM, stale=0.2)) as page:
        page.put(full_view())
        time.sleep(0.5)
        assert asyncio.run(ask(page)) == ["nothing is heard from the run", "", ""]


def test_a_view_that_is_not_newer_than_the_last_one_does_not_make_the_page_younger() -> None:
    async def age(page: Served) -> float:
        async with window(page.address) as one:
            for _ in range(4):
                page.put(full_view(1.0))
                age = (await one.next())["age"]
            return float(age)

    with served(CALM) as page:
        page.put(full_view(1.0))
        assert asyncio.run(age(page)) > 0.5


def test_one_window_too_many_is_told_so_and_can_still_stop() -> None:
    async def crowd(page: Served) -> tuple[int | None, int]:
        async with window(page.address) as one, window(page.address) as two:
            await one.next()
            await two.next()
            async with window(page.address) as third:
                assert (await third.next("full"))["windows"] == 2
                code = await third.closed()
            origin = f"http://{page.host}"
            async with aiohttp.ClientSession() as session:
                answer = await session.post(page.address + "stop", headers={"Origin": origin})
            return code, answer.status

    with served(replace(CALM, windows=2)) as page:
        page.put(full_view())
        assert asyncio.run(crowd(page)) == (1013, 200)
        assert [request.wish for request in page.taken()] == [Wish.STOP]


FLOODS = {
    "sense": json.dumps({"shown": 1}),
    "requests": json.dumps({"ask": "resume", "turn": 1, "tag": 1}),
    "garbage": '{"ask":',
    "too long": "x" * (WindowLimits().message + 1),
}


@pytest.mark.parametrize("what", FLOODS)
def test_a_window_that_floods_is_closed_and_another_one_is_served_all_the_while(what: str) -> None:
    async def flood(page: Served) -> int | None:
        async with window(page.address) as other, window(page.address, acknowledges=False) as bad:
            await other.next()
            for _ in range(3000):
                if (
                    bad.socket.closed
                    or bad.socket._writer.transport is None
                    or bad.socket._writer.transport.is_closing()
                ):
                    break
                try:
                    await bad.socket.send_str(FLOODS[what])
                except (ConnectionError, aiohttp.ClientError):
                    break
            await other.ask(Wish.PAUSE, 1)
            assert (await other.next("asked"))["words"] == ""
            return await bad.closed()

    with served(CALM) as page:
        page.put(full_view())
        code = asyncio.run(flood(page))
        assert code in ((1009, 1006) if what == "too long" else (1008,))
        wishes = [request.wish for request in page.taken()]
        assert wishes.count(Wish.PAUSE) == 1 and wishes.count(Wish.RESUME) <= OTHER_REQUEST_SLOTS


def test_a_flood_of_stops_is_one_stop_after_another_and_nothing_else() -> None:
    async def flood(page: Served) -> None:
        async with window(page.address) as one:
            for _ in range(500):
                await one.ask(Wish.STOP, 0)
            page.put(full_view(2.0))
            await one.next("asked")

    with served(CALM) as page:
        page.put(full_view())
        asyncio.run(flood(page))
        assert {request.wish for request in page.taken()} == {Wish.STOP}


def test_a_flood_of_windows_is_turned_away_and_another_is_served_all_the_while(monkeypatch: pytest.MonkeyPatch) -> None:
    count, begun = RawValue(FloodCount), RawValue(c_double, math.nan)
    begun.value = WallClock().now()
    poured = Fault(FaultPart.PAGE, FaultKind.FLOOD, 0.0, 60.0)
    monkeypatch.setattr(flood, "RECONNECT_AFTER", 0.01)

    async def both(page: Served) -> None:
        async with window(page.address) as one:
            await one.next()
            flooding = asyncio.create_task(flood.flood(page.address, poured, begun, count))
            while not (count.closed and count.refused):
                await asyncio.sleep(0.01)
            await one.ask(Wish.PAUSE, 7)
            assert (await one.next("asked"))["words"] == ""
            flooding.cancel()

    with served(CALM) as page:
        page.put(full_view(turn=7))
        asyncio.run(both(page))
        assert count.messages > MAX_DROPPED_MESSAGES
        assert [request.wish for request in page.taken()] == [Wish.PAUSE]  # what was asked under no turn is not asked


GARBAGE = st.binary(max_size=400) | st.text(max_size=200)


@settings(max_examples=15)
@given(st.lists(GARBAGE, min_size=25, max_size=60))
def test_garbage_asks_for_nothing_and_ends_only_the_window_it_comes_from(rubbish: list[bytes | str]) -> None:
    async def pour(page: Served) -> int | None:
        async with window(page.address) as one:
            for each in rubbish:
                await (one.socket.send_bytes(each) if isinstance(each, bytes) else one.socket.send_str(each))
            return await one.closed()

    assert asyncio.run(pour(GARBAGED)) == 1008
    assert GARBAGED.link.requests.take() == [] and GARBAGED.link.requests.last_stop == 0


GARBAGED = Served(CALM)  # one for all examples


def test_a_page_that_is_killed_comes_back_at_its_address_and_the_run_does_not_wait_for_it() -> None:
    clock, link = WallClock(), OperatorLink()
    page = OperatorPage(link, OperatorSettings())
    page.tend(clock.now())
    try:
        link.views.put(full_view())
        assert asyncio.run(first_view(page.address)) == 1
        killed = page.process.pid
        os.kill(page.process.pid, signal.SIGINT)  # Ctrl-C goes to the whole group: the run decides what it means
        os.kill(page.process.pid, signal.SIGKILL)
        page.process.join(5)
        begun = time.monotonic()
        for turn in range(2, 102):
            link.views.put(full_view(float(turn), turn))
            link.requests.take()
        assert time.monotonic() - begun < 1.0
        while not page.tend(clock.now()):
            time.sleep(0.05)
        assert page.process.pid != killed
        assert asyncio.run(first_view(page.address)) == 101
    finally:
        page.close()


async def first_view(address: str) -> int:
    async with window(address) as one:
        return int((await one.next())["view"]["turn"])
