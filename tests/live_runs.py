"""Live runs for tests: a small session rendered once, runs under a terminal of their own, and what they left."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple
from itertools import pairwise
from pathlib import Path

import aiohttp
import numpy as np

from hardware.files.session import Session
from hardware.live.prepared import RunFiles
from hardware.operator.view import MoveRequest
from hardware.process.clock import WallClock
from hardware.recording.mcap_file import ChunkMessages, parse, walk
from hardware.recording.session_reader import open_session
from tests.pictureless_run import prepare_files

ROOT = Path(__file__).parents[1]
CLOCK = WallClock()
PATIENCE = 90.0  # s: a busy machine takes most of a minute to start six processes
SCENARIO = """
title = "Small"
seconds = 2.7
seed = 3
path = "path.csv"
clearance_mm = 0.4
bead_mm = 1.0
[scene]
body = "chest"
wound = false
texel_mm = 0.3
[[motion]]
kind = "breathing"
amplitude_mm = 2.0
rate_hz = 0.4
[rig]
size = [320, 180]
focal_px = 275
[cameras]
fps = 20.0
"""

PATH = """x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude
-6,-2,0,0,0,0,5,1,20,0,0
6,-2,0,0,0,0,5,1,20,0,1
6,0,0,0,0,0,5,1,20,0,1
-6,0,0,0,0,0,5,1,20,0,1
-6,2,0,0,0,0,5,1,20,0,1
6,2,0,0,0,0,5,1,20,0,1
"""  # 40 mm: 8 s


class Running:
    """`stillbed live` with a terminal; `said` grows as it speaks."""

    def __init__(
        self,
        *arguments: str,
        cache: Path,
        limits: Callable[[], None] | None = None,
        program: Sequence[str] = ("hardware.cli.main", "live"),
        cwd: Path = ROOT,
    ) -> None:
        self.keys, theirs = pty.openpty()
        more = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        environment = os.environ | {"PYTHONPATH": more, "XDG_CACHE_HOME": str(cache), "OPENBLAS_NUM_THREADS": "1"}
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - closed with this object
        self.process = subprocess.Popen(
            [sys.executable, "-m", *program, *arguments],
            cwd=cwd,
            env=environment,
            stdin=theirs,
            stdout=self._output,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=limits,
        )
        os.close(theirs)
        self.said = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def press(self, key: str) -> None:
        """Press a key."""
        os.write(self.keys, key.encode())

    def wait_for(self, pattern: str, after: int = 0) -> int:
        """Wait until it said so, beyond the first `after` characters; where that ended."""
        until = CLOCK.now() + PATIENCE
        while CLOCK.now() < until:
            if found := re.compile(pattern).search(self.said, after):
                return found.end()
            if self.process.poll() is not None:
                self._reader.join(1.0)
                if found := re.compile(pattern).search(self.said, after):
                    return found.end()
                break
            CLOCK.wait_until(CLOCK.now() + 0.01)
        ended = self.process.poll()
        state = "it runs" if ended is None else f"it ended with {ended}"
        raise AssertionError(f"{pattern!r} was not said, {state}:\n{self.said}\nits output:\n{self.output()}")

    def output(self) -> str:
        """What it wrote to its standard output so far."""
        return os.pread(self._output.fileno(), 1 << 20, 0).decode(errors="replace")

    def pid(self, name: str) -> int:
        """The process of that name among its children."""
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                text = stat.read_text()
            except OSError:
                continue
            if f"(sb-{name})" in text and int(text.rsplit(")", 1)[1].split()[1]) == self.process.pid:
                return int(stat.parent.name)
        raise AssertionError(f"no process {name}")

    def page(self) -> int:
        """The process of the operator's page: the child that has no name of a run's."""
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                stat, line = (folder / "stat").read_text(), (folder / "cmdline").read_bytes()
            except OSError:
                continue
            ours = int(stat.rsplit(")", 1)[1].split()[1]) == self.process.pid
            if ours and b"spawn_main" in line and "(sb-" not in stat:
                return int(folder.name)
        raise AssertionError("no page")

    def kill(self, name: str, number: int = signal.SIGKILL) -> float:
        """Kill a child; the instant, s."""
        pid = self.pid(name)
        now = CLOCK.now()
        os.kill(pid, number)
        return now

    def end(self) -> int:
        """Wait for its end; the exit code."""
        try:
            code = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"it goes on; what it said: {self.said}") from None
        self._reader.join(5.0)
        if self.keys >= 0:
            os.close(self.keys)
        return code

    def close(self) -> None:
        """Leave nothing behind, whatever a test did."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def _read(self) -> None:
        for line in self.process.stderr:
            self.said += line


def executed(record: Path) -> tuple[np.ndarray, np.ndarray]:
    """What the virtual arm of a run did: stamps (N,) s, axes (N, 6)."""
    until = CLOCK.now() + PATIENCE
    file = RunFiles(record).executed
    while not file.exists() and CLOCK.now() < until:
        CLOCK.wait_until(CLOCK.now() + 0.05)
    CLOCK.wait_until(CLOCK.now() + 0.2)
    found = np.load(file)
    return found["stamps"], found["axes"]


def rests(record: Path, since: float, within: float) -> bool:
    """Whether the arm stands still from `within` s after `since`, s, on, and moved before."""
    stamps, axes = executed(record)
    after = axes[stamps > min(since + within, stamps[-1] - 0.05)]  # a run that ended sooner is judged by its last 50 ms
    before = axes[(stamps > since - 0.5) & (stamps <= since)]
    assert len(after) and len(before)
    return bool(np.ptp(after[:, :3], axis=0).max() < 0.05 and np.ptp(before[:, :3], axis=0).max() > 0.05)


def closed(record: Path) -> Session:
    """A recording, once whoever writes it has closed it."""
    until = CLOCK.now() + PATIENCE
    while (session := open_session(record)).damage and CLOCK.now() < until:
        CLOCK.wait_until(CLOCK.now() + 0.2)
    assert not session.damage
    return session


def messages(record: Path, topic: str) -> list[dict[str, object]]:
    """All messages of a topic, in the order of the file, up to its damage if there is any."""
    return [
        parse(record, stored)
        for part in walk(record)
        if isinstance(part, ChunkMessages)
        for stored in part.messages
        if stored.topic == topic
    ]


def summary(record: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads(RunFiles(record).summary.read_text())
    return found


def printed_once(*records: Path) -> None:
    """That no stretch of the path was extruded in two of the runs, and that hardly any was left out between them."""
    spans = []
    for record in records:
        extruding = {m["stamp"]: m["extrude"] for m in messages(record, "/move")}
        places = [float(str(m["fraction"])) for m in messages(record, "/tick") if extruding.get(m["stamp"])]
        assert places
        spans.append((min(places), max(places)))
    for before, after in pairwise(spans):
        assert after[0] >= before[1] - 1e-9 and after[0] - before[1] <= 1.0 + 1e-9


def asks_to_move(run: Running, move: MoveRequest) -> None:
    """Ask for a move in a window of the run's page; again, as an operator does, where the surface is not seen then."""

    async def ask(address: str) -> None:
        origin = {"Origin": address.rsplit("/", 2)[0]}
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{address}socket", headers=origin) as socket:
            asked, number = False, None
            async for message in socket:
                said = json.loads(message.data) if message.type is aiohttp.WSMsgType.TEXT else {}
                if "bundle" in said:
                    await socket.send_str(json.dumps({"shown": said["bundle"]}))
                view = said.get("view") or {}
                if said.get("kind") == "asked":
                    number = said["number"]
                    assert number, said
                elif number is not None and (answer := view.get("answer")) and answer["number"] == number:
                    if answer["followed"]:
                        return
                    assert "not seen" in answer["words"] or "mapped" in answer["words"], answer
                    asked, number = False, None
                if not asked and view.get("stage") == "confirm":
                    asked = True
                    wanted = {"ask": "move", "turn": view["turn"], "tag": 1, "move": astuple(move)}
                    await socket.send_str(json.dumps(wanted))

    asyncio.run(asyncio.wait_for(ask(re.search(r"open (\S+) to see", run.said)[1]), 30.0))


@contextmanager
def light_runs(folder: Path, *flags: str, **path: float) -> Iterator[Callable[..., Running]]:
    """A starter of runs without pictures, over a printed `path` (`prepare_files`); none is left behind."""
    running: list[Running] = []
    prepare_files(folder, **path)

    def start(record: Path, *more: str) -> Running:
        program = "tests.pictureless_run", str(folder), str(record)
        running.append(Running(*flags, *more, cache=folder, program=program))
        return running[-1]

    yield start
    for run in running:
        run.close()
