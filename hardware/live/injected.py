"""Faults that a run before a simulated world is given on purpose: processes killed and stopped, the disk full.

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

from hardware.faults import Fault, Kind, Part
from hardware.live.crew import Crew

STRUCK = {Part.TRACKING: "tracking", Part.MOTION: "motion", Part.ARM: "arm", Part.DISK: "recorder"}  # processes


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


class Injector:
    """Does what the faults say to the processes of a run when it is due, and what ends them afterwards."""

    def __init__(self, faults: Sequence[Fault], crew: Crew, record: Path, begun: Begun) -> None:
        self._crew, self._record, self._begun = crew, record, begun
        self._due: list[tuple[float, Fault, Callable[[Fault], None]]] = []
        for fault in faults:
            if fault.part in STRUCK:
                self._due.append((fault.start, fault, self._strike))
                self._due.append((fault.end, fault, self._end))

    def look(self, now: float) -> list[Fault]:
        """Do what is due at `now`, s; the faults that began."""
        due = [each for each in self._due if now - self._begun.instant >= each[0]]
        self._due = [each for each in self._due if each not in due]
        for _, fault, act in due:
            act(fault)
        return [fault for _, fault, act in due if act == self._strike]

    def _strike(self, fault: Fault) -> None:
        if fault.part is Part.DISK:
            self._limit(self._record.stat().st_size)
        elif fault.kind is Kind.HANG:
            self._send(fault, signal.SIGSTOP)
        else:
            self._send(fault, signal.SIGKILL if fault.kind is Kind.KILL else signal.SIGTERM)

    def _end(self, fault: Fault) -> None:
        if fault.part is Part.DISK:
            self._limit(resource.RLIM_INFINITY)
        elif fault.kind is Kind.HANG:
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
