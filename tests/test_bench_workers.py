"""Processes of a bench: they end with whoever started them, and Ctrl-C does not wait for what they do."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hardware.bench.workers import workers

PATIENCE = 20.0  # s, on a busy machine
AT_WORK = """
import os, time
from hardware.bench.workers import workers

def work(number):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(600)

if __name__ == "__main__":
    with workers(2) as pool:
        list(pool.map(work, range(8)))
"""


def gone(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for yet has, too."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


ENDS = [
    *((os.kill, word) for word in (signal.SIGKILL, signal.SIGTERM)),  # one process alone, which says nothing
    *((os.killpg, word) for word in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)),  # as a terminal does
]


@pytest.mark.parametrize(("end", "word"), ENDS, ids=lambda it: getattr(it, "__name__", None) or it.name)
def test_they_end_with_whoever_started_them(end: Callable[[int, int], None], word: int, tmp_path: Path) -> None:
    (script := tmp_path / "at_work.py").write_text(AT_WORK)
    started = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    )
    assert started.stdout is not None
    own = [int(started.stdout.readline()) for _ in range(2)]
    assert not any(map(gone, own))
    end(started.pid, word)
    assert started.wait(PATIENCE) != 0
    until = time.monotonic() + PATIENCE
    while not all(map(gone, own)) and time.monotonic() < until:
        time.sleep(0.02)
    assert all(map(gone, own))


def test_what_has_not_begun_is_left_out() -> None:
    begun = time.monotonic()
    with pytest.raises(ZeroDivisionError), workers(1) as pool:
        for _ in pool.map(time.sleep, [0.1] * 3000):
            raise ZeroDivisionError
    assert time.monotonic() - begun < PATIENCE
