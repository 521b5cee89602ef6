"""What the tests of dispensers share: a line that takes what it likes, and a driver on it in virtual time."""

from __future__ import annotations

from dataclasses import replace

from hardware.arm.driver import UnpluggedError
from hardware.dispenser.dispenser import DispenserProfile, DispenserState
from hardware.dispenser.line_dispenser import LineDispenser
from hardware.dispenser.messages import PRESETS, DispenserLine
from hardware.process.clock import SimClock
from hardware.simulator.dispenser import DispenserModel, DispenserPort, VirtualDispenserSettings

POLL = 0.002  # s, the motion loop's
PORT = "/dev/none"


class HinderedPort(DispenserPort):
    """A line to a model that may be full or unplugged; it remembers what it took.

    room: bytes that it takes until there is more. taken: (instant, bytes) of each write. extra: bytes to be read.
    """

    def __init__(self, model: DispenserModel, clock: SimClock) -> None:
        super().__init__(model, clock)
        self.room, self.plugged = 10**9, True
        self.taken: list[tuple[float, bytes]] = []
        self.extra = b""
        self.clock = clock

    def __call__(self) -> HinderedPort:
        self._there()
        return self

    def write(self, data: bytes) -> int:
        self._there()
        part = data[: self.room]
        self.room -= len(part)
        if part:
            self.taken.append((self.clock.now(), part))
            self.model.receive(part, self.clock.now())
        return len(part)

    def read(self) -> bytes:
        self._there()
        data, self.extra = self.extra + super().read(), b""
        return data

    def lines(self) -> list[bytes]:
        """All lines that came whole, but for questions."""
        whole = b"".join(data for _, data in self.taken).replace(b"\r", b"\n").split(b"\n")[:-1]
        return [line for line in whole if line not in (b"T?", b"M105")]

    def _there(self) -> None:
        if not self.plugged:
            raise UnpluggedError("the cable is out")


class Bench:
    """A driver, its line, the model behind it and their clock."""

    def __init__(self, preset: str = "arduino", profile: DispenserProfile | None = None, **line: object) -> None:
        kind = PRESETS[preset]
        if profile is None:
            profile = DispenserProfile("d", ("gel",), metered=kind.metered, watchdog=kind.watchdog)
        settings = VirtualDispenserSettings(preset=preset, watchdog=kind.watchdog or float("inf"))
        self.clock = SimClock(100.0)
        self.model = DispenserModel(settings, self.clock.now())
        self.port = HinderedPort(self.model, self.clock)
        self.line: DispenserLine = replace(kind.line, port=PORT, **({"start": 0.0} | line))  # type: ignore[arg-type]
        self.driver = LineDispenser(profile, self.line, self.port)

    def prepared(self) -> Bench:
        self.driver.prepare(self.clock.now())
        self.run(0.5)
        assert self.driver.status.state is DispenserState.READY
        return self

    def run(self, seconds: float, poll: float = POLL) -> None:
        end = self.clock.now() + seconds
        while self.clock.now() < end - 1e-9:
            self.clock.wait_until(min(self.clock.now() + poll, end))
            self.driver.poll(self.clock.now())

    def on(self, flow: float = 1.0) -> str:
        return self.driver.on(flow, self.clock.now())

    def off(self) -> None:
        self.driver.off(self.clock.now())

    @property
    def state(self) -> DispenserState:
        return self.driver.status.state

    @property
    def open(self) -> bool:
        """Whether the model lets material out."""
        self.model.advance(self.clock.now())
        return self.model.on
