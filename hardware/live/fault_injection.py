"""Faults injected into a run before a simulated world: processes killed, stopped or slowed, a full disk, a page flood.

Faults of cameras are injected where the pictures are shown (session_player.py). Instants count from the begin of
printing. The flood is that of a broken or hostile page: too many windows, each sending as fast as it can: false
acknowledgements, requests under a turn that never was, and garbage. It sends no stop, which is always followed.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import resource
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from ctypes import Structure, c_double, c_uint64
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from typing import TYPE_CHECKING

from hardware.live.ipc import ProcessGroup
from hardware.process.clock import WallClock
from hardware.process.faults import Fault, FaultKind, FaultPart
from hardware.process.system import set_up_process

if TYPE_CHECKING:
    import aiohttp


FAULT_PROCESSES = {FaultPart(name): name for name in ("tracking", "motion", "arm")} | {FaultPart.DISK: "recorder"}
FLOOD_PROCESS = "flood"  # name of the processes that flood the page
SLOWDOWN_PERIOD = 0.2  # s in which a slow process runs for its share: a few looks of the run's
FLOOD_WINDOWS = 12  # more than the page lets in at once
FLOOD_MESSAGES = (json.dumps({"shown": 1}), json.dumps({"ask": "resume", "turn": 0, "tag": 1}), '{"ask":')
START_POLL_PERIOD = 0.01  # s between looks whether it is to begin
RECONNECT_AFTER = 0.05  # s until a window that was closed comes back: a reload takes longer
BROWSER_NICENESS = 5  # as the page's own process: a browser is another program


class FloodCount(Structure):
    """Counts of a flood of the page: messages sent, windows closed for what they sent, windows not let in."""

    _fields_ = (("messages", c_uint64), ("closed", c_uint64), ("refused", c_uint64))

    def __str__(self) -> str:
        return f"{self.messages} messages sent, {self.closed} windows closed for it, {self.refused} not let in"


def flood_process(address: str, fault: Fault, start: c_double, count: FloodCount) -> None:
    """The body of a process: flood the page at `address` while the fault lasts."""
    set_up_process("flood", nice=BROWSER_NICENESS)
    asyncio.run(flood(address, fault, start, count))


async def flood(address: str, fault: Fault, start: c_double, count: FloodCount) -> None:
    """Flood the page as part of an event loop."""
    import aiohttp  # for this process alone

    clock = WallClock()
    while not clock.now() - start.value >= fault.start:  # nan before printing began
        await asyncio.sleep(START_POLL_PERIOD)
    lasts = fault.duration if math.isfinite(fault.duration) else None
    async with aiohttp.ClientSession(headers={"Origin": "/".join(address.split("/", 3)[:3])}) as session:
        windows = [asyncio.create_task(_window(session, address + "socket", count)) for _ in range(FLOOD_WINDOWS)]
        await asyncio.wait(windows, timeout=lasts)
        for each in windows:
            each.cancel()


async def _window(session: aiohttp.ClientSession, address: str, count: FloodCount) -> None:
    import aiohttp

    while True:
        try:
            async with session.ws_connect(address, max_msg_size=0) as socket:
                await _send_flood(socket, count)
                if socket.close_code == aiohttp.WSCloseCode.POLICY_VIOLATION:
                    count.closed += 1
                else:
                    count.refused += 1
        except (aiohttp.ClientError, ConnectionError):
            count.refused += 1
        await asyncio.sleep(RECONNECT_AFTER)


async def _send_flood(socket: aiohttp.ClientWebSocketResponse, count: FloodCount) -> None:
    """Send until the other end closes."""
    listening = asyncio.create_task(_listen(socket))
    try:
        while not listening.done():
            for message in FLOOD_MESSAGES:
                await socket.send_str(message)
            count.messages += len(FLOOD_MESSAGES)
            await asyncio.sleep(0)
    except asyncio.CancelledError:
        listening.cancel()
        raise
    except ConnectionError:
        pass  # it is being closed: the code says why
    await listening


async def _listen(socket: aiohttp.ClientWebSocketResponse) -> None:
    async for _ in socket:
        pass


class FaultInjector:
    """Injects faults into the processes of a run when they are due, and ends them afterwards."""

    def __init__(
        self, faults: Sequence[Fault], processes: ProcessGroup, record: Path, start: c_double, page: str = ""
    ) -> None:
        """page: its address. The processes that flood it start at once, as loading their libraries takes a while."""
        self._processes, self._record, self._start = processes, record, start
        self._flooded, self._floods = RawValue(FloodCount), list[Fault]()
        self._slow: dict[Fault, bool] = {}  # what is slow now, and whether it runs
        self._due: list[tuple[float, Fault, Callable[[Fault], None]]] = []
        for fault in faults:
            if fault.part is FaultPart.PAGE:
                processes.start(
                    f"{FLOOD_PROCESS} {len(self._floods)}", flood_process, (page, fault, start, self._flooded)
                )
                self._floods.append(fault)
            if fault.part in (*FAULT_PROCESSES, FaultPart.PAGE):
                self._due.append((fault.start, fault, self._begin))
                self._due.append((fault.end, fault, self._end))

    def update(self, now: float) -> list[str]:
        """Begin and end what is due at `now`, s; lines for the log."""
        elapsed = now - self._start.value
        due = [each for each in self._due if elapsed >= each[0]]
        self._due = [each for each in self._due if each not in due]
        for _, fault, act in due:
            act(fault)
        for fault, runs in self._slow.items():
            if ((elapsed - fault.start) % SLOWDOWN_PERIOD < fault.share * SLOWDOWN_PERIOD) is not runs:
                self._send(fault, signal.SIGSTOP if runs else signal.SIGCONT)
                self._slow[fault] = not runs
        begun = [str(fault) for _, fault, act in due if act == self._begin]
        flooded = any(fault.kind is FaultKind.FLOOD and act == self._end for _, fault, act in due)
        return [*begun, *([f"page flood is over: {self._flooded}"] if flooded else [])]

    def close(self) -> None:
        """End what slows or floods: a process that is stopped cannot end by itself."""
        for fault in list(self._slow):
            self._end(fault)
        for k in range(len(self._floods)):
            self._processes.kill(f"{FLOOD_PROCESS} {k}")

    def _begin(self, fault: Fault) -> None:
        if fault.part is FaultPart.DISK:
            self._limit(self._record.stat().st_size)
        elif fault.kind is FaultKind.SLOW:
            self._slow[fault] = True
        elif fault.kind is FaultKind.HANG:
            self._send(fault, signal.SIGSTOP)
        elif fault.part is not FaultPart.PAGE:
            self._send(fault, signal.SIGKILL if fault.kind is FaultKind.KILL else signal.SIGTERM)

    def _end(self, fault: Fault) -> None:
        if fault.part is FaultPart.DISK:
            self._limit(resource.RLIM_INFINITY)
        elif fault.kind in (FaultKind.HANG, FaultKind.SLOW):
            self._slow.pop(fault, None)
            self._send(fault, signal.SIGCONT)

    def _limit(self, size: int) -> None:
        """Let no file of the recorder grow beyond `size` bytes, which fails as a full disk does, with another errno."""
        member = self._processes.members["recorder"]
        if member.pid is not None and member.is_alive():
            hard = resource.prlimit(member.pid, resource.RLIMIT_FSIZE)[1]
            resource.prlimit(member.pid, resource.RLIMIT_FSIZE, (size, hard))

    def _send(self, fault: Fault, number: signal.Signals) -> None:
        member = self._processes.members.get(FAULT_PROCESSES[fault.part])
        if member is not None and member.pid is not None and member.is_alive():
            with suppress(ProcessLookupError):
                os.kill(member.pid, number)
