"""Arms that the laws of an arm are tried on: each a driver before something that knows where the arm truly was."""

from __future__ import annotations

import signal
import socket
import subprocess
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np

from estimation.se3 import Array
from hardware.arm.driver import G1, ArmDriver, Reply
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile, LinkSettings, open_arm
from hardware.arm.queue import ArmQueue
from hardware.arm.s6h4d import S6H4D
from hardware.process.clock import Clock, SimClock, WallClock, WatchedClock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice, run_virtual_arm
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from planning.command import Move

STEP = 0.002  # s between looks
ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "docs/examples/own_arm.py"
LISTEN_TIME = 0.3  # s in which an arm that answers has told where it stands
ANSWERING = ArmSettings(servo_lag=0.02, replies=ReplyMode.STREAM)


class ArmBench:
    """One arm by its driver, and what it truly did.

    tolerance: mm by which a good arm of this make may be off its way, lag taken out.
    rest_time: s, and rest_way: mm, in which it comes to rest after a stop.
    silent_time: s after its last answer in which it is held.
    """

    tolerance, rest_time, rest_way, silent_time = 0.1, 0.15, 1.0, 0.3

    def __init__(self, driver: ArmDriver, profile: ArmProfile, clock: Clock) -> None:
        self.clock, self.profile = clock, profile
        self.arm = Arm(driver, profile, clock.now(), LinkSettings())
        self.most_in_flight = 0.0

    @abstractmethod
    def truth(self) -> tuple[Array, Array]:
        """Where it truly was so far: stamps (N,) by `clock`, s, and axes (N, 6); the bench is at its end then."""

    @abstractmethod
    def silence(self) -> None:
        """From now on it answers no more."""

    @abstractmethod
    def unplug(self) -> None:
        """It is gone."""

    @abstractmethod
    def plug(self) -> None:
        """It is back."""

    def end(self) -> None:
        """Let go of what it was tried on."""
        return

    def run(self, seconds: float, each: Callable[[float], None] = lambda now: None) -> None:
        """Let time pass; `each` is called once a tick."""
        end, due = self.clock.now() + seconds, self.clock.now()
        while (now := self.clock.now()) < end - 1e-9:
            self.arm.poll(now)
            if now >= due - 1e-9:
                due = max(due + self.profile.tick * 1.005, now)
                each(now)
            self.most_in_flight = max(self.most_in_flight, self.arm.in_flight(now))
            self.clock.wait_until(now + STEP)

    def begin(self) -> Array:
        """Listen, have the operator arm it, and give where it stands (6,)."""
        self.run(LISTEN_TIME)
        assert self.arm.arm(self.clock.now()) == ""
        assert self.arm.target is not None
        return self.arm.target

    def follow(self, way: Callable[[float], Array], seconds: float) -> list[str]:
        """Send axes (6,) = way(s) from s = 0 on, where they may be sent; why some were not."""
        refused: list[str] = []
        phase = 0.0

        def each(now: float) -> None:
            nonlocal phase
            self.arm.take_up()
            if reason := self.arm.hold(now):
                refused.append(reason)
                return
            goal, target = way(phase + self.profile.tick), self.arm.target
            assert target is not None
            feed = max(float(np.linalg.norm((goal - target)[:3])) / (0.98 * self.profile.tick), 1.0)
            if reason := self.arm.send(Move(now, goal, feed, 0, False), now):
                refused.append(reason)
            else:
                phase += self.profile.tick

        self.run(seconds, each)
        return refused


class VirtualTimeBench(ArmBench):
    """The S6H4D's driver on a virtual arm in virtual time."""

    def __init__(self) -> None:
        clock, profile = SimClock(), ArmProfile()
        self.virtual = VirtualArm(ANSWERING, profile.dialect, profile.arm.home, (), profile.baud)
        self.device = VirtualDevice(self.virtual, clock, profile.baud)
        super().__init__(S6H4D(self.device, profile), profile, clock)

    def truth(self) -> tuple[Array, Array]:
        self.virtual.advance(self.clock.now())
        stamps = np.arange(0.0, self.clock.now(), 0.001)
        return stamps, self.virtual.axes_at(stamps)

    def silence(self) -> None:
        _silence(self.arm.driver)

    def unplug(self) -> None:
        self.device.away = [(self.clock.now(), np.inf)]

    def plug(self) -> None:
        self.device.away = ()


class PtyBench(ArmBench):
    """The S6H4D's driver on a virtual arm that a thread serves on a pseudo-terminal in real time."""

    def __init__(self, link: Path) -> None:
        clock, profile, self.link = WallClock(), ArmProfile(), link
        self._served: list[tuple[VirtualArm, float]] = []
        self._serve(profile)
        super().__init__(open_arm(str(link), profile), profile, clock)

    def _serve(self, profile: ArmProfile) -> None:
        clock, stop, there = WatchedClock(WallClock()), threading.Event(), threading.Event()

        def serve() -> None:
            arm = run_virtual_arm(ANSWERING, profile, (), self.link, None, clock, stop, lambda text: there.set())
            self._served.append((arm, clock.begun or 0.0))

        self._stop, self._thread = stop, threading.Thread(target=serve, daemon=True)
        self._thread.start()
        assert there.wait(5.0)

    def truth(self) -> tuple[Array, Array]:
        self.unplug()
        arm, begun = self._served[-1]
        stamps = np.arange(0.0, arm.now, 0.001)
        return stamps + begun, arm.axes_at(stamps)

    def silence(self) -> None:
        _silence(self.arm.driver)

    def unplug(self) -> None:
        self._stop.set()
        self._thread.join(5.0)

    def plug(self) -> None:
        self._serve(self.profile)

    def end(self) -> None:
        self.unplug()


class ExampleBench(ArmBench):
    """The example's driver, before an arm of our own that takes its lines in a thread."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._silent = threading.Event()
        profile = ArmProfile(dead_time=0.0, lag=0.01)
        self._place, self._clock = profile.arm.home.copy(), WallClock()
        self._server = socket.create_server(("127.0.0.1", 0))
        self._port = self._server.getsockname()[1]
        self.plug()
        spec = spec_from_file_location("own_arm", EXAMPLE)
        assert spec is not None and spec.loader is not None
        example = module_from_spec(spec)
        spec.loader.exec_module(example)
        super().__init__(example.LineArm("127.0.0.1", str(self._port)), profile, self._clock)

    def _serve(self, server: socket.socket, gone: threading.Event) -> None:
        """Be the arm: straight to each target at its feed, one after the other; STOP drops them."""
        with server:
            server.settimeout(0.02)
            line, rest, queue = None, b"", ArmQueue(self._place.tolist(), 0.0, self._clock.now())
            while not gone.is_set():
                now = self._clock.now()
                if line is None:
                    with suppress(TimeoutError):
                        line = server.accept()[0]
                        line.setblocking(False)
                    continue
                with suppress(BlockingIOError, OSError):
                    *lines, rest = (rest + line.recv(4096)).split(b"\n")
                    for words in map(bytes.split, lines):
                        if words[0] == b"STOP":
                            queue.stop()
                            queue.stand(queue.at(now), now)
                        else:
                            numbers = [float(word) for word in words[1:]]
                            queue.add(G1(np.array(numbers[:6]), numbers[6]), now)
                self._place = np.array(queue.at(now))
                self._rows.append((now, *self._place))
                if not self._silent.is_set():
                    with suppress(OSError):
                        line.sendall(f"AT {' '.join(map(str, self._place))}\n".encode())
                self._clock.wait_until(now + 0.005)
            if line is not None:
                line.close()

    def truth(self) -> tuple[Array, Array]:
        rows = np.array(self._rows)
        return rows[:, 0], rows[:, 1:]

    def silence(self) -> None:
        self._silent.set()

    def unplug(self) -> None:
        self._gone.set()
        self._thread.join(5.0)

    def plug(self) -> None:
        server = self._server if self._server.fileno() >= 0 else socket.create_server(("127.0.0.1", self._port))
        self._gone = threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(server, self._gone), daemon=True)
        self._thread.start()

    def end(self) -> None:
        self.unplug()


def _silence(driver: ArmDriver) -> None:
    """Have what the arm answers come to nobody."""
    assert isinstance(driver, S6H4D)
    whole = driver.receive

    def nothing() -> tuple[list[Reply], bytes]:
        whole()
        return [], b""

    driver.receive = nothing  # type: ignore[method-assign]


@contextmanager
def closing_bench(bench: ArmBench) -> Iterator[ArmBench]:
    """The bench, whose arm and device are let go at the end."""
    try:
        yield bench
    finally:
        bench.arm.close()
        bench.arm.driver.release()
        bench.end()


READY = "ready"  # on a line of a counterpart's output, once it answers


class CounterpartServer:
    """An arm that others wrote, in a process of its own."""

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self.process: subprocess.Popen[str] | None = None
        self._name, self._command = name, command
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(self._command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        while READY not in (line := self.process.stdout.readline()):
            assert line, f"{self._name} did not start"

    def silence(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGSTOP)

    def end(self, number: int = signal.SIGTERM) -> None:
        if self.process is not None:
            self.process.send_signal(number)
            self.process.send_signal(signal.SIGCONT)
            self.process.wait(20.0)
        self.process = None


class ServedBench(ArmBench):
    """A driver before such an arm."""

    server: CounterpartServer

    def silence(self) -> None:
        self.server.silence()

    def unplug(self) -> None:
        self.server.end(signal.SIGKILL)

    def plug(self) -> None:
        self.server.start()

    def end(self) -> None:
        self.server.end(signal.SIGKILL)
