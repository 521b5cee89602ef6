"""Faults that a run before a simulated world is given on purpose: processes killed and stopped, a full disk, a flood.

What strikes cameras happens where the pictures are shown (feed.py). Instants count from the begin of printing.
"""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from typing import Any

from hardware.live.fault_injection import FloodCount
from hardware.live.ipc import Crew
from hardware.process.faults import Fault, Kind, Part

STRUCK = {Part.TRACKING: "tracking", Part.MOTION: "motion", Part.ARM: "arm", Part.DISK: "recorder"}  # processes
FLOOD = "flood"  # processes that flood the page
PERIOD = 0.2  # s in which what is slow runs for its share: a few looks of the run's, and less than a pose may be old


class Begun:
    """When printing began, where every process of a run can see it. instant: s, NaN before."""

    def __init__(self) -> None:
        self._memory: Any = RawArray("d", [float("nan")])

    @property
    def instant(self) -> float:
        """When printing began, s."""
        return float(self._memory[0])

    @instant.setter
    def instant(self, value: float) -> None:
        self._memory[0] = value


def flood(page: str, fault: Fault, begun: Begun, count: FloodCount) -> None:
    """Flood the page at that address when the fault says so; the body of a process."""
    from hardware.operator.flood import flood_process  # aiohttp is for that process alone

    flood_process(page, fault, begun, count)


class Injector:
    """Does what the faults say to the processes of a run when it is due, and what ends them afterwards."""

    def __init__(self, faults: Sequence[Fault], crew: Crew, record: Path, begun: Begun, page: str = "") -> None:
        """page: its address; whoever is to flood it gets ready at once, as loading what that takes has its time."""
        self._crew, self._record, self._begun = crew, record, begun
        self._flooded, self._floods = FloodCount(), list[Fault]()
        self._slow: dict[Fault, bool] = {}  # what is slow now, and whether it runs
        self._due: list[tuple[float, Fault, Callable[[Fault], None]]] = []
        for fault in faults:
            if fault.part is Part.PAGE:
                crew.start(f"{FLOOD} {len(self._floods)}", flood, (page, fault, begun, self._flooded))
                self._floods.append(fault)
            if fault.part in (*STRUCK, Part.PAGE):
                self._due.append((fault.start, fault, self._strike))
                self._due.append((fault.end, fault, self._end))

    def look(self, now: float) -> list[str]:
        """Do what is due at `now`, s; what began and what came of a flood, in words."""
        elapsed = now - self._begun.instant
        due = [each for each in self._due if elapsed >= each[0]]
        self._due = [each for each in self._due if each not in due]
        for _, fault, act in due:
            act(fault)
        for fault, runs in self._slow.items():
            if ((elapsed - fault.start) % PERIOD < fault.share * PERIOD) is not runs:
                self._send(fault, signal.SIGSTOP if runs else signal.SIGCONT)
                self._slow[fault] = not runs
        said = [str(fault) for _, fault, act in due if act == self._strike]
        flooded = any(fault.kind is Kind.FLOOD and act == self._end for _, fault, act in due)
        return [*said, *([f"page flood is over: {self._flooded}"] if flooded else [])]

    def close(self) -> None:
        """Nothing is slow or flooded any more: a process that stands still cannot end by itself."""
        for fault in list(self._slow):
            self._end(fault)
        for k in range(len(self._floods)):
            self._crew.kill(f"{FLOOD} {k}")

    def _strike(self, fault: Fault) -> None:
        if fault.part is Part.DISK:
            self._limit(self._record.stat().st_size)
        elif fault.kind is Kind.SLOW:
            self._slow[fault] = True
        elif fault.kind is Kind.HANG:
            self._send(fault, signal.SIGSTOP)
        elif fault.part is not Part.PAGE:
            self._send(fault, signal.SIGKILL if fault.kind is Kind.KILL else signal.SIGTERM)

    def _end(self, fault: Fault) -> None:
        if fault.part is Part.DISK:
            self._limit(resource.RLIM_INFINITY)
        elif fault.kind in (Kind.HANG, Kind.SLOW):
            self._slow.pop(fault, None)
            self._send(fault, signal.SIGCONT)

    def _limit(self, size: int) -> None:
        """Let no file of the recorder grow beyond so many bytes: what a full disk says is said in another word."""
        member = self._crew.members["recorder"]
        if member.pid is not None and member.is_alive():
            hard = resource.prlimit(member.pid, resource.RLIMIT_FSIZE)[1]
            resource.prlimit(member.pid, resource.RLIMIT_FSIZE, (size, hard))

    def _send(self, fault: Fault, number: signal.Signals) -> None:
        member = self._crew.members.get(STRUCK[fault.part])
        if member is not None and member.pid is not None and member.is_alive():
            with suppress(ProcessLookupError):
                os.kill(member.pid, number)
