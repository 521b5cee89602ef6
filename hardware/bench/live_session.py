"""One `stillbed live` as an operator would run it, for the bench: a terminal, keys, a look at its memory, its end."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
from pathlib import Path

from hardware.process.clock import WallClock

NAME = "(sb-"  # of the processes of a run, as the system tells it
MAP = "map"  # the processes of the tracking's own
STARTED = 300.0  # s in which a run must have begun to print, on a busy machine
LOOK = 0.005  # s


class LiveSession:
    """A run in a process of its own. said: what it told so far. memory: s, and MB by process."""

    def __init__(self, arguments: list[str]) -> None:
        self.said = ""
        self.memory: list[tuple[float, dict[str, float]]] = []
        self._clock = WallClock()
        self.keys, theirs = pty.openpty()
        command = [sys.executable, "-m", "hardware.cli.main", "live", *arguments]
        nothing = subprocess.DEVNULL
        self.process = subprocess.Popen(command, stdin=theirs, stdout=nothing, stderr=subprocess.PIPE, text=True)
        os.close(theirs)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def wait_for(self, words: str, after: int = 0, patience: float = STARTED) -> int:
        """Wait until it said so beyond the first `after` characters; where that ended, -1 where it never did."""
        until = self._clock.now() + patience
        while self._clock.now() < until:
            if (place := self.said.find(words, after)) >= 0:
                return place + len(words)
            if self.process.poll() is not None and not self._reader.is_alive() and self.said.find(words, after) < 0:
                return -1
            self._clock.wait_until(self._clock.now() + LOOK)
        return -1

    @property
    def last_words(self) -> str:
        """The last two lines that it said, and how it ended."""
        lines = [line for line in self.said.splitlines() if line.strip()]
        code = self.process.poll()
        return f"{' / '.join(lines[-2:]) or 'nothing said'} ({'still runs' if code is None else f'exit code {code}'})"

    def press(self, key: str) -> None:
        """Press a key."""
        os.write(self.keys, key.encode())

    def children(self) -> dict[str, int]:
        """Its processes by name."""
        named = ((name, pid) for pid, name in _children(self.process.pid) if name.startswith(NAME))
        return {name.removeprefix(NAME): pid for name, pid in named}

    def weigh(self) -> None:
        """Note how much memory each of its processes but the virtual arm holds that no other has, MB."""
        held: dict[str, float] = {}
        own = {name: pid for name, pid in self.children().items() if name != "arm"}  # which keeps all that it ever did
        of_map = [(MAP, pid) for pid, _ in _children(own.get("tracking", -1))]
        for name, pid in [("run", self.process.pid), *own.items(), *of_map]:
            try:
                resident, shared = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1:3]
            except (OSError, ValueError):
                continue
            held[name] = held.get(name, 0.0) + (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE") / 1e6
        self.memory.append((self._clock.now(), held))

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


def _children(parent: int) -> list[tuple[int, str]]:
    """The processes that a process has started: each its number and name, which begins with a bracket."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            text = (folder / "stat").read_text()
        except OSError:
            continue
        name, rest = text[text.find("(") : text.rfind(")")], text[text.rfind(")") + 2 :].split()
        if int(rest[1]) == parent:
            found.append((int(folder.name), name))
    return found
