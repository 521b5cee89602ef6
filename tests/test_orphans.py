"""A parent that is killed leaves no process behind on a busy machine, but those that have to end in order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.command_processes import ROOT

STARTS = """
import sys, time
from hardware.process.system import SPAWN
from tests import orphan_processes

if __name__ == "__main__":
    for _ in range(2):
        target, argument = getattr(orphan_processes, sys.argv[1]), orphan_processes.SlowToLoad(sys.argv[2])
        process = SPAWN.Process(target=target, args=(argument,))
        process.start()
        print(process.pid, flush=True)
    time.sleep(60)
"""
SOON = 1.0  # s
PATIENCE = 30.0  # s


@pytest.fixture
def busy() -> Iterator[None]:
    """Twice as many processes that only count as there are cores."""
    burning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    yield
    for process in burning:
        process.kill()
        process.wait()


def runs(pid: int) -> bool:
    """Whether a process is there and no zombie."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def orphans(folder: Path, body: str, ready: str) -> tuple[subprocess.Popen[str], list[int]]:
    """A parent and its two processes, once both have put a file `ready` there."""
    (folder / "starts.py").write_text(STARTS)
    parent = subprocess.Popen(
        [sys.executable, str(folder / "starts.py"), body, str(folder)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert parent.stdout is not None
    pids = [int(parent.stdout.readline()) for _ in range(2)]
    until = time.monotonic() + PATIENCE
    while len(list(folder.glob(f"{ready}.*"))) < 2:
        assert time.monotonic() < until
        time.sleep(0.01)
    return parent, pids


def left_after(pids: list[int], seconds: float) -> list[int]:
    until = time.monotonic() + seconds
    while any(map(runs, pids)) and time.monotonic() < until:
        time.sleep(0.01)
    return [pid for pid in pids if runs(pid)]


@pytest.mark.parametrize("ready", ["loading", "works"])
def test_what_is_bound_to_a_killed_parent_is_gone_at_once(ready: str, busy: None, tmp_path: Path) -> None:
    """While it still loads, and while it computes without letting any other thread in."""
    parent, pids = orphans(tmp_path, "work", ready)
    try:
        assert len(left_after(pids, 0.0)) == 2
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert left_after(pids, SOON) == []
    finally:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def test_what_has_to_end_in_order_outlives_its_parent(tmp_path: Path) -> None:
    parent, pids = orphans(tmp_path, "end_in_order", "works")
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert left_after(pids, PATIENCE) == [] and len(list(tmp_path.glob("ended.*"))) == 2
