"""Processes that work for another end with it; those of a bench do at Ctrl-C, too, whatever they are at."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from hardware.bench.workers import workers

PATIENCE = 20.0  # s, on a busy machine
AT_WORK = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from hardware.bench.workers import workers
from hardware.tracker import _settle

def work(number):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(600)

if __name__ == "__main__":
    with {pool} as pool:
        list(pool.map(work, range(8)))
"""
STARTS = """
import os, time
from hardware.process.system import settle
from hardware.live.ipc import Crew
from hardware.tracker import tracker

def tracked():
    with tracker(None, [None]):
        time.sleep(60)

def begun():
    crew = Crew()
    crew.start("small", settle, ("small",))
    try:
        time.sleep(60)
    finally:
        crew.end("small")

if __name__ == "__mp_main__":
    os.write(1, b"loads\\n")
    time.sleep(1)
if __name__ == "__main__":
    try:
        {how}()
    except KeyboardInterrupt:
        print("interrupted")
"""
BENCH = "workers(2)"
TRACKER = "ProcessPoolExecutor(2, get_context('spawn'), _settle)"


def gone(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for yet has, too."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


ONE, ALL = os.kill, os.killpg  # who is told: the parent alone, or all of them as a terminal does
ENDS = [
    *((BENCH, ONE, signal.SIGKILL), (BENCH, ONE, signal.SIGTERM), (TRACKER, ONE, signal.SIGKILL)),
    *((BENCH, ALL, signal.SIGKILL), (BENCH, ALL, signal.SIGTERM), (BENCH, ALL, signal.SIGINT)),
]


@pytest.mark.parametrize(("pool", "end", "word"), ENDS)
def test_they_end_with_whoever_started_them(
    pool: str, end: Callable[[int, int], None], word: int, tmp_path: Path
) -> None:
    (script := tmp_path / "at_work.py").write_text(AT_WORK.replace("{pool}", pool))
    started = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    )
    assert started.stdout is not None
    try:
        own = [int(started.stdout.readline()) for _ in range(2)]
        assert not any(map(gone, own))
        end(started.pid, word)
        assert started.wait(PATIENCE) != 0
        until = time.monotonic() + PATIENCE
        while not all(map(gone, own)) and time.monotonic() < until:
            time.sleep(0.02)
        assert all(map(gone, own))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)


@pytest.mark.parametrize("how", ["tracked", "begun"])
def test_ctrl_c_while_a_process_loads_is_its_parents_alone(how: str, tmp_path: Path) -> None:
    (script := tmp_path / "starts.py").write_text(STARTS.replace("{how}", how))
    started = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert started.stdout is not None
    try:
        assert started.stdout.readline() == "loads\n"
        os.killpg(started.pid, signal.SIGINT)
        assert started.communicate(timeout=PATIENCE) == ("interrupted\n", "") and started.returncode == 0
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)


def test_what_has_not_begun_is_left_out() -> None:
    begun = time.monotonic()
    with pytest.raises(ZeroDivisionError), workers(1) as pool:
        for _ in pool.map(time.sleep, [0.1] * 3000):
            raise ZeroDivisionError
    assert time.monotonic() - begun < PATIENCE
