"""The port over what pyserial opens: nothing waits, a full buffer takes a part, and a device that goes is told."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from hardware.arm import port as arm_port
from hardware.arm import s6h4d
from hardware.arm.device import ArmState
from hardware.arm.driver import Pause, UnpluggedError
from hardware.arm.link import Arm
from hardware.arm.port import PortOpener, SerialPort
from hardware.arm.profile import ArmProfile, emergency_stop, open_arm
from hardware.arm.protocol import FRAME_LENGTH, encode
from hardware.process.clock import WallClock
from hardware.simulator.arm.ports import open_pty
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from tests.linked_arm import circle, moving
from tests.test_arm_port import serving
from tests.virtual_arm import HOME

CLOCK = WallClock()


@pytest.fixture
def pair() -> Iterator[tuple[int, str]]:
    """The arm's side of a pty, and the name of the host's."""
    ours, theirs, name = open_pty()
    yield ours, name
    for file in (ours, theirs):
        os.close(file)


def came(port: SerialPort, count: int) -> bytes:
    """The first bytes that come; the system takes a moment to carry them."""
    data, until = b"", CLOCK.now() + 5
    while len(data) < count and CLOCK.now() < until:
        data += port.read()
        CLOCK.wait_until(CLOCK.now() + 0.002)
    return data


def test_bytes_go_both_ways_and_nothing_waits(pair: tuple[int, str]) -> None:
    ours, name = pair
    port = SerialPort(name, 115_200)
    start = CLOCK.now()
    assert port.read() == b"" and port.waiting() == 0
    assert port.write(b"abc") == 3
    assert os.read(ours, 9) == b"abc"
    os.write(ours, b"\xce\x00\xcf")
    assert CLOCK.now() - start < 1.0
    assert came(port, 3) == b"\xce\x00\xcf"
    port.close()


def test_a_full_buffer_takes_a_part_and_then_nothing_and_then_again(pair: tuple[int, str]) -> None:
    ours, name = pair
    port = SerialPort(name, 115_200)
    data, sent = bytes(range(FRAME_LENGTH)) * 2000, 0
    while taken := port.write(data[sent:]):
        sent += taken
    assert 0 < sent < len(data)
    got = bytearray()
    while len(got) < sent:
        got += os.read(ours, 4096)
    assert bytes(got) == data[:sent]
    assert port.write(b"x") == 1
    port.close()


def test_a_device_that_goes_is_told_by_reading_and_by_writing() -> None:
    ours, theirs, name = open_pty()
    port = SerialPort(name, 115_200)
    os.close(theirs)
    os.close(ours)
    with pytest.raises(UnpluggedError):
        port.read()
    with pytest.raises(UnpluggedError):
        port.write(b"x")
    port.close()
    with pytest.raises(UnpluggedError, match=r"^/dev/there-is-none: no such file or directory$"):
        SerialPort("/dev/there-is-none", 115_200)


def test_a_socket_is_a_port_too_and_its_end_is_an_unplugged_device() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = SerialPort(f"socket://127.0.0.1:{server.getsockname()[1]}", 115_200)
        theirs, _ = server.accept()
        assert port.read() == b""
        assert port.write(b"abc") == 3 and theirs.recv(9) == b"abc"
        theirs.sendall(b"xyz")
        assert came(port, 3) == b"xyz"
        while port.write(b"\0" * 65_536):  # full, and does not wait
            pass
        theirs.close()
        with pytest.raises(UnpluggedError):
            for _ in range(100):
                port.read()
                CLOCK.wait_until(CLOCK.now() + 0.005)
        port.close()
        with pytest.raises(UnpluggedError):
            SerialPort("socket://127.0.0.1:1", 115_200)


def test_a_loop_gives_back_what_it_was_given() -> None:
    port = SerialPort("loop://", 115_200)
    assert port.write(b"abc") == 3
    assert port.read() == b"abc" and port.read() == b"" and port.waiting() == 0
    port.close()


def test_a_url_that_means_nothing_is_wrong_input() -> None:
    with pytest.raises(InputError, match="URL of pyserial's"):
        SerialPort("gopher://x", 115_200)


def test_two_writers_on_one_port_are_impossible(pair: tuple[int, str], tmp_path: Path) -> None:
    _, name = pair
    link = tmp_path / "arm"
    link.symlink_to(name)
    first = PortOpener(name, 115_200)
    port = first()
    for second in (name, str(link)):
        with pytest.raises(InputError, match="a port that is free"):
            PortOpener(second, 115_200)()
    first.release()
    other = PortOpener(name, 115_200)
    with pytest.raises(InputError, match="no other program"):  # its lock is gone, but it is still open
        other()
    other.release()
    port.close()
    again = PortOpener(name, 115_200)
    again().close()
    again.release()


def test_an_adapter_back_under_another_name_is_the_same(pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    _, name = pair
    there = [("/dev/ttyUSB0", (0x1A86, 0x7523, "at 1-1")), ("/dev/ttyUSB7", (0x0403, 0x6001, "A50285BI"))]
    monkeypatch.setattr(arm_port, "_adapters", lambda: list(there))
    device = PortOpener("/dev/ttyUSB7", 115_200)
    there[:] = [("/dev/ttyUSB7", (0x1A86, 0x7523, "at 1-1"))]  # another one has taken its name
    with pytest.raises(UnpluggedError, match="0403:6001 A50285BI"):
        device()
    there.append((name, (0x0403, 0x6001, "A50285BI")))
    device().close()
    device.release()


def test_over_a_pty_in_real_time_the_arm_moves_answers_and_stops(tmp_path: Path) -> None:
    settings = ArmSettings(servo_lag=0.0, replies=ReplyMode.STREAM)
    with serving(tmp_path / "arm", settings) as ended:
        device = open_arm(str(tmp_path / "arm"), ArmProfile())
        arm = Arm(device, ArmProfile(), CLOCK.now())
        assert arm.stand(HOME, CLOCK.now()) == "" and arm.arm(CLOCK.now()) == ""
        phase, start, most = 0.0, CLOCK.now(), 0.0
        tick = start
        while (now := CLOCK.now()) < start + 1.5:
            arm.poll(now)
            if now >= tick:
                tick = max(tick + 0.02, now)
                if not arm.hold(now) and arm.target is not None:
                    phase += 0.02
                    goal = circle(phase)
                    feed = float(np.linalg.norm((goal - arm.target)[:3])) / 0.02
                    assert arm.send(moving(goal, feed), now) == ""
            most = max(most, arm.in_flight(now))
            CLOCK.wait_until(now + 0.002)
        arm.stop("asked for", CLOCK.now())
        rests = CLOCK.now() + 0.4
        while (now := CLOCK.now()) < rests:
            arm.poll(now)
            CLOCK.wait_until(now + 0.002)
        status = arm.status(CLOCK.now())
        arm.close()
        device.release()
    virtual = ended[0]
    assert status.state is ArmState.STOPPED and status.answers > 10 and most <= 0.05
    assert virtual.frames == arm.frames and not virtual.garbage and not virtual.ignored
    assert virtual.axes_at(np.array([virtual.now]))[0] == pytest.approx(status.answered, abs=0.06)


def test_a_pty_that_goes_and_comes_back_is_disarmed(tmp_path: Path) -> None:
    link = tmp_path / "arm"
    device = open_arm(str(link), ArmProfile())
    with serving(link):
        arm = Arm(device, ArmProfile(), CLOCK.now())
        arm.stand(HOME, CLOCK.now())
        arm.arm(CLOCK.now())
        arm.poll(CLOCK.now())
        assert arm.state is ArmState.ARMED
    arm.poll(CLOCK.now())
    assert arm.state is ArmState.UNPLUGGED
    with serving(link):
        CLOCK.wait_until(CLOCK.now() + 0.6)
        arm.poll(CLOCK.now())
        assert arm.state is ArmState.DISARMED
        assert "nobody knows" in arm.arm(CLOCK.now())
        arm.close()
        device.release()


def full(name: str) -> int:
    """How many bytes a line takes that nobody reads, until it takes no more."""
    port, sent, refused = SerialPort(name, 115_200), 0, 0
    while refused < 10:  # the system carries bytes on for a moment, and then takes more
        taken = port.write(bytes(65_536))
        sent, refused = sent + taken, 0 if taken else refused + 1
        CLOCK.wait_until(CLOCK.now() + 0.002)
    port.close()
    return sent


def test_an_emergency_stop_waits_for_a_full_line_and_goes_out_whole(pair: tuple[int, str]) -> None:
    (ours, name), received = pair, bytearray()
    waiting, stop = full(name), encode(Pause(), ArmProfile().dialect) * s6h4d.STOP_FRAMES

    def drain() -> None:
        CLOCK.wait_until(CLOCK.now() + 0.1)
        while len(received) < waiting + len(stop):
            received.extend(os.read(ours, 4096))

    reader = threading.Thread(target=drain, daemon=True)
    reader.start()
    begun = CLOCK.now()
    sent, reason = emergency_stop(name, ArmProfile())
    reader.join(5.0)
    assert reason == "" and sent > begun + 0.1 and bytes(received[waiting:]) == stop


def test_an_emergency_stop_that_a_full_line_does_not_take_is_told(pair: tuple[int, str]) -> None:
    _, name = pair
    full(name)
    assert emergency_stop(name, ArmProfile())[1] == "its line is full and took 0 of the stop's 96 bytes"


def test_an_emergency_stop_tries_again_on_a_line_that_goes_while_it_writes(
    pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (ours, name), write, failures = pair, SerialPort.write, [UnpluggedError("gone"), UnpluggedError("gone")]

    def failing(port: SerialPort, data: bytes) -> int:
        if failures:
            raise failures.pop()
        return write(port, data)

    monkeypatch.setattr(SerialPort, "write", failing)
    assert emergency_stop(name, ArmProfile())[1] == "" and not failures
    assert os.read(ours, 999) == encode(Pause(), ArmProfile().dialect) * s6h4d.STOP_FRAMES
    failures.extend([UnpluggedError("gone")] * 1000)
    assert emergency_stop(name, ArmProfile())[1] == "gone"
