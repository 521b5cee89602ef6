"""The lock on a port: one writer at a time, whatever became of the last one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from estimation.errors import InputError
from hardware.port_lock import PortLock, lock_folder

ROOT = Path(__file__).parents[1]
HOLD = """
import sys, pathlib
from hardware.port_lock import PortLock
lock = PortLock("/dev/ttyX9", pathlib.Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def holder(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_a_second_owner_is_refused_until_the_first_lets_go(tmp_path: Path) -> None:
    first = PortLock("/dev/ttyX9", tmp_path)
    with pytest.raises(InputError, match=f"process {os.getpid()} has it"):
        PortLock("/dev/ttyX9", tmp_path)
    PortLock("/dev/ttyX8", tmp_path).release()
    first.release()
    PortLock("/dev/ttyX9", tmp_path).release()


def test_an_owner_that_was_killed_stops_nobody(tmp_path: Path) -> None:
    process = holder(tmp_path)
    with pytest.raises(InputError, match=f"process {process.pid} has it"):
        PortLock("/dev/ttyX9", tmp_path)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / "LCK..ttyX9").read_text().split() == [str(process.pid), "stillbed"]
    PortLock("/dev/ttyX9", tmp_path).release()


def test_a_number_of_ours_that_another_process_has_by_now_stops_nobody(tmp_path: Path) -> None:
    (tmp_path / "LCK..ttyX9").write_text(f"{os.getppid():10d}\nstillbed\n")
    PortLock("/dev/ttyX9", tmp_path).release()


def test_another_programs_lock_counts_while_it_lives(tmp_path: Path) -> None:
    file = tmp_path / "LCK..ttyX9"
    file.write_text(f"{os.getppid():10d}\n")
    with pytest.raises(InputError, match=f"process {os.getppid()} has it by"):
        PortLock("/dev/ttyX9", tmp_path)
    ended = subprocess.Popen(["true"])
    ended.wait()
    file.write_text(f"{ended.pid:10d}\n")
    PortLock("/dev/ttyX9", tmp_path).release()


def test_a_link_to_a_device_is_locked_as_the_device(tmp_path: Path) -> None:
    device, link = tmp_path / "ttyX9", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    held = PortLock(str(link), tmp_path)
    with pytest.raises(InputError):
        PortLock(str(device), tmp_path)
    held.release()
    PortLock("socket://127.0.0.1:5000", tmp_path).release()
    assert "LCK..socket___127.0.0.1_5000" in os.listdir(tmp_path)


def test_locks_are_kept_where_other_programs_look() -> None:
    assert lock_folder().is_dir() and os.access(lock_folder(), os.W_OK)
