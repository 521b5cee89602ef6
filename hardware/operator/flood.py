"""A page gone wild, on purpose: more windows than there may be, each saying as much as it can, none showing anything.

What they say is what a broken or hostile page would: that something was shown, wishes under a turn that never was, and
garbage. A stop is not among it, as a stop is followed whoever asks for it.
"""

from __future__ import annotations

import asyncio
import json
import math

import aiohttp

from hardware.live.fault_injection import FloodCount
from hardware.live.injected import Begun
from hardware.operator.window import REFUSED
from hardware.process.clock import WallClock
from hardware.process.faults import Fault
from hardware.process.system import settle

WINDOWS = 12  # more than the page lets in at once
SAID = (json.dumps({"shown": 1}), json.dumps({"ask": "resume", "turn": 0, "tag": 1}), '{"ask":')
LOOK = 0.01  # s between looks whether it is to begin
AGAIN = 0.05  # s until a window that was closed comes back: a reload takes longer
NICENESS = 5  # as the page's own process: a browser is another program


def flood_process(address: str, fault: Fault, begun: Begun, count: FloodCount) -> None:
    """Flood the page at `address` while the fault lasts, its instants counted from `begun`."""
    settle("flood", nice=NICENESS)
    asyncio.run(flood(address, fault, begun, count))


async def flood(address: str, fault: Fault, begun: Begun, count: FloodCount) -> None:
    """The same, as part of a loop."""
    clock = WallClock()
    while not clock.now() - begun.instant >= fault.start:  # nan before printing began
        await asyncio.sleep(LOOK)
    lasts = fault.duration if math.isfinite(fault.duration) else None
    async with aiohttp.ClientSession(headers={"Origin": "/".join(address.split("/", 3)[:3])}) as session:
        windows = [asyncio.create_task(_window(session, address + "socket", count)) for _ in range(WINDOWS)]
        await asyncio.wait(windows, timeout=lasts)
        for each in windows:
            each.cancel()


async def _window(session: aiohttp.ClientSession, address: str, count: FloodCount) -> None:
    while True:
        try:
            async with session.ws_connect(address, max_msg_size=0) as socket:
                await _pour(socket, count)
                if socket.close_code == REFUSED:
                    count.add(closed=1)
                else:
                    count.add(refused=1)
        except (aiohttp.ClientError, ConnectionError):
            count.add(refused=1)
        await asyncio.sleep(AGAIN)


async def _pour(socket: aiohttp.ClientWebSocketResponse, count: FloodCount) -> None:
    """Talk until the other end has had enough."""
    hearing = asyncio.create_task(_listen(socket))
    try:
        while not hearing.done():
            for said in SAID:
                await socket.send_str(said)
            count.add(messages=len(SAID))
            await asyncio.sleep(0)
    except asyncio.CancelledError:
        hearing.cancel()
        raise
    except ConnectionError:
        pass  # it is being closed: the code says why
    await hearing


async def _listen(socket: aiohttp.ClientWebSocketResponse) -> None:
    async for _ in socket:
        pass
