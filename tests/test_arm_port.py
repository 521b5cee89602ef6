"""The virtual arm as a serial device: clients come and go; the lock on a port: one writer at a time."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.driver import ReplyKind
from hardware.arm.port import CLOSE_TIME, PortLock, SerialPort, lock_folder
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import reply_stream
from hardware.process.clock import WallClock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import POLL_PERIOD, _arrivals, run_virtual_arm
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from tests.virtual_arm import IDEAL, move

CLOCK = WallClock()


def wait(seconds: float) -> None:
    CLOCK.wait_until(CLOCK.now() + seconds)


@contextmanager
def serving(link: Path, settings: ArmSettings = IDEAL, **more: object) -> Iterator[list[VirtualArm]]:
    """A virtual arm that serves meanwhile; the list holds it afterwards."""
    stop, ended = threading.Event(), list[VirtualArm]()
    thread = threading.Thread(target=lambda: ended.append(run_virtual_arm(settings, link=link, stop=stop, **more)))
    thread.start()
    try:
        for _ in range(200):
            if link.is_symlink():
                break
            wait(0.005)
        yield ended
    finally:
        stop.set()
        thread.join(5)


def test_a_client_moves_the_arm_and_may_come_and_go(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link, log, begun = tmp_path / "arm", tmp_path / "motion.csv", CLOCK.now()
    with serving(link, log=log) as ended:
        device = os.readlink(link)
        with serial.Serial(str(link), 115_200) as client:
            client.write(b"\x00\x01" + move(100.0, x=207.5))
        wait(0.15)
        with serial.Serial(str(link), 9600) as client:
            client.write(move(100.0, x=207.5, b=9) + move(100.0, x=212.5, b=9))
            wait(0.4)
    arm = ended[0]
    assert (arm.frames, arm.ignored, arm.refused) == (3, [], [])
    assert [data for _, data in arm.garbage] == [b"\x00\x01"]
    assert not link.is_symlink() and not os.path.lexists(link)
    printed = capsys.readouterr().out.splitlines()
    assert printed[:2] == [device, f"3 frames in {arm.now:.1f} s"]
    assert "2 bytes in no frame" in printed[-1] and "00 01" in printed[-1]
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    assert log.read_text().splitlines()[0] == "stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"
    assert begun <= rows[0, 0] < rows[-1, 0] <= CLOCK.now()  # as a dispenser's log and a recording are stamped
    assert rows[0, 1:].tolist() == [202.5, 225, 113, 0, 0, 0] and rows[-1, 1:].tolist() == [212.5, 225, 113, 0, 9, 0]
    assert np.diff(rows[:, 0]) == pytest.approx(0.001, abs=1e-9)
    assert np.diff(rows[:, 1]).max() == pytest.approx(0.1, abs=1e-3)  # 100 mm/s


def test_a_client_reads_replies(tmp_path: Path) -> None:
    settings = ArmSettings(replies=ReplyMode.STREAM, reply_period=0.01)
    with serving(tmp_path / "arm", settings), serial.Serial(str(tmp_path / "arm"), 115_200, timeout=2) as client:
        stream = reply_stream()
        replies, _ = stream(client.read(30))
        assert replies[0].kind in list(ReplyKind)
        places = [reply for reply in replies + stream(client.read(60))[0] if reply.kind is ReplyKind.PLACE]
        assert places[0].values == pytest.approx([202.5, 225, 113])


def test_bytes_are_taken_no_faster_than_the_line_carries_them(tmp_path: Path) -> None:
    with serving(tmp_path / "arm", profile=ArmProfile(baud=48_000)) as ended:
        with serial.Serial(str(tmp_path / "arm"), 115_200) as client:
            client.write(b"".join(move(1.0, x=202.5 + k) for k in range(1, 41)))
        wait(0.2)  # room for 20 frames
    assert 5 <= ended[0].frames <= 100 * ended[0].now + 1


def test_a_link_never_overwrites_what_may_be_in_use(tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    file, folder, used, left = (tmp_path / name for name in ("file", "folder", "used", "left"))
    file.write_text("precious")
    folder.mkdir()
    used.symlink_to(file)
    left.symlink_to(tmp_path / "gone")
    for link in file, folder, used:
        with pytest.raises(InputError, match="link = 'exists'"):
            run_virtual_arm(IDEAL, link=link, stop=stop)
    assert file.read_text() == "precious" and used.resolve() == file
    run_virtual_arm(IDEAL, link=left, stop=stop)
    assert not os.path.lexists(left)


def test_a_log_never_overwrites_a_file(tmp_path: Path) -> None:
    log = tmp_path / "motion.csv"
    log.write_text("precious")
    with pytest.raises(InputError, match="log"):
        run_virtual_arm(IDEAL, log=log)
    with pytest.raises(InputError, match="no such file"):
        run_virtual_arm(IDEAL, log=tmp_path / "none" / "motion.csv")
    assert log.read_text() == "precious"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_in_order(tmp_path: Path, number: signal.Signals) -> None:
    link, log = tmp_path / "arm", tmp_path / "motion.csv"
    code = (
        "from pathlib import Path\nfrom hardware.simulator.arm.ports import *\n"
        f"run_virtual_arm(ArmSettings(), link=Path({str(link)!r}), log=Path({str(log)!r}))"
    )
    root = Path(__file__).parents[1]
    with subprocess.Popen([sys.executable, "-c", code], cwd=root, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline().strip() == os.readlink(link)
        process.send_signal(number)
        assert process.communicate()[0].startswith("0 frames")
    assert process.returncode == 0 and not os.path.lexists(link)
    assert (
        log.read_text().splitlines()[1].partition(",")[2]
        == "202.500000,225.000000,113.000000,0.000000,0.000000,0.000000"
    )


@given(st.binary(max_size=200), st.floats(0.0, 5.0), st.floats(0.0, 2.0))
def test_what_came_while_the_machine_was_held_up_is_spread_evenly(data: bytes, before: float, late: float) -> None:
    parts = list(_arrivals(data, before, before + late))
    assert b"".join(part for part, _ in parts) == data
    instants = np.array([before, *(instant for _, instant in parts)])
    assert (np.diff(instants) >= 0).all() and instants[-1] == pytest.approx(before + late)
    assert np.diff(instants).max() <= 1.5 * POLL_PERIOD + 1e-9
    sizes = [len(part) for part, _ in parts]
    assert max(sizes) - min(sizes) <= 1


ROOT = Path(__file__).parents[1]
HOLD = """
import sys, pathlib
from hardware.arm.port import PortLock
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


class FullPort(SerialPort):
    """A port that says what it holds, which the system does not say of a pseudo-terminal."""

    taken: int | None = None  # bytes after which the line has taken all; None: it takes none

    def waiting(self) -> int:
        self.looks = getattr(self, "looks", 0) + 1
        return 96 if self.taken is None or self.looks < self.taken else 0


@pytest.mark.parametrize("taken", [None, 3])
def test_a_line_that_takes_nothing_is_closed_soon_and_one_that_does_loses_nothing(taken: int | None) -> None:
    master, slave = pty.openpty()
    os.set_blocking(master, False)
    port = FullPort(os.ttyname(slave), 115_200)
    port.taken = taken
    given = 0
    while count := port.write(b"x" * 4096):  # until it is full
        given += count
    begun = CLOCK.now()
    port.close()
    assert CLOCK.now() - begun < 5 * CLOSE_TIME
    left = 0
    with suppress(OSError):
        while data := os.read(master, 4096):
            left += len(data)
    assert left < given if taken is None else left == given
    os.close(master)
    os.close(slave)
