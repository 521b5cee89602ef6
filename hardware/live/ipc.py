"""The processes of a run: started, watched, and ended; each in a process group of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from hardware.held_interrupt import held_interrupt

CONTEXT = multiprocessing.get_context("spawn")  # a forked child would have loaded all that its parent has
LAST_WORDS = 10.0  # s that a process gets to close its files, on a busy machine


@dataclass(slots=True)
class Crew:
    """Processes by name."""

    members: dict[str, BaseProcess] = field(default_factory=dict)

    def start(self, name: str, body: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        """Start a process. Ends of pipes among its arguments are its own from now on."""
        process = CONTEXT.Process(target=body, args=arguments, name=name)
        with held_interrupt():
            process.start()
        self.members[name] = process
        for argument in arguments:
            for end in argument if isinstance(argument, list) else [argument]:
                if isinstance(end, Connection):
                    end.close()

    def alive(self, name: str) -> bool:
        """Whether a process was started and has not ended."""
        member = self.members.get(name)
        return member is not None and member.is_alive()

    def dead(self) -> list[str]:
        """Names of those that have ended."""
        return [name for name, member in self.members.items() if not member.is_alive()]

    def ending(self, name: str) -> str:
        """How a process ended, in words."""
        code = self.members[name].exitcode
        if code is None:
            return "runs"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"

    def sentinels(self) -> list[int]:
        """What becomes ready once a process ends."""
        return [member.sentinel for member in self.members.values() if member.is_alive()]

    def end(self, name: str, patience: float = LAST_WORDS) -> None:
        """Wait `patience` s for a process to end, ask it to, and then end it, with all that it has started."""
        member = self.members.get(name)
        if member is None:
            return
        member.join(0 if not member.is_alive() else patience)
        if member.is_alive():
            member.terminate()
            member.join(LAST_WORDS)
        self.kill(name)

    def kill(self, name: str) -> None:
        """End a process and its group at once, whatever it does."""
        member = self.members.get(name)
        if member is None or member.pid is None:
            return
        if member.is_alive():
            member.kill()
            member.join()
        with suppress(OSError):
            os.killpg(member.pid, signal.SIGKILL)
