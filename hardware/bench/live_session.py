"""One `stillbed live` as an operator would run it, for the bench: a terminal, keys, a look at its memory, its end."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
from pathlib import Path

from hardware.clock import WallClock

NAME = "(sb-"  # of the processes of a run, as the system tells it
STARTED = 300.0  # s in which a run must have begun to print, on a busy machine
LOOK = 0.005  # s


class LiveSession:
    """A run in a process of its own. said: what it told so far. memory: of all its processes, (s, MB)."""

    def __init__(self, arguments: list[str]) -> None:
        self.said = ""
        self.memory: list[tuple[float, float]] = []
        self._clock = WallClock()
        self.keys, theirs = pty.openpty()
        command = [sys.executable, "-m", "hardware.cli", "live", *arguments]
        nothing = subprocess.DEVNULL
        self.process = subprocess.Popen(command, stdin=theirs, stdout=nothing, stderr=subprocess.PIPE, text=True)
        os.close(theirs)
        threading.Thread(target=self._read, daemon=True).start()

    def wait_for(self, words: str, after: int = 0, patience: float = STARTED) -> int:
        """Wait until it said so beyond the first `after` characters; where that ended, -1 where it never did."""
        until = self._clock.now() + patience
        while self._clock.now() < until:
            if (place := self.said.find(words, after)) >= 0:
                return place + len(words)
            if self.process.poll() is not None and not self.said.find(words, after) >= 0:
                return -1
            self._clock.wait_until(self._clock.now() + LOOK)
        return -1

    def press(self, key: str) -> None:
        """Press a key."""
        os.write(self.keys, key.encode())

    def children(self) -> dict[str, int]:
        """Its processes by name."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                text = (folder / "stat").read_text()
            except OSError:
                continue
            name, rest = text[text.find("(") : text.rfind(")")], text[text.rfind(")") + 2 :].split()
            if name.startswith(NAME) and int(rest[1]) == self.process.pid:
                found[name.removeprefix(NAME)] = int(folder.name)
        return found

    def weigh(self) -> None:
        """Note how much memory all its processes but the virtual arm hold that no other has, MB."""
        pages = 0
        own = [pid for name, pid in self.children().items() if name != "arm"]  # which keeps all that it ever did
        for pid in (self.process.pid, *own):
            try:
                resident, shared = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1:3]
            except (OSError, ValueError):
                continue
            pages += int(resident) - int(shared)
        self.memory.append((self._clock.now(), pages * os.sysconf("SC_PAGE_SIZE") / 1e6))

    def kill(self, name: str) -> float:
        """Kill one of its processes, "run" for the one that conducts; the instant, s, NaN where there is none."""
        pid = self.process.pid if name == "run" else self.children().get(name)
        if pid is None:
            return float("nan")
        now = self._clock.now()
        os.kill(pid, signal.SIGKILL)
        return now

    def end(self, patience: float = STARTED) -> int | None:
        """Wait for its end; its exit code."""
        try:
            return self.process.wait(patience)
        except subprocess.TimeoutExpired:
            return None

    def close(self) -> None:
        """Leave nothing behind."""
        if self.process.poll() is None:
            self.process.terminate()
            self.end(30.0)
        self.process.kill()
        self.process.wait()
        os.close(self.keys)

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said += line
