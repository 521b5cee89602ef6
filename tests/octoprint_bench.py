"""OctoPrint's virtual printer as a G-code machine that the laws are tried on, in a process and a Python of its own."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estimation.se3 import Array
from hardware.arm.profile import ArmProfile, open_arm
from hardware.files.arm_file import read_arm
from hardware.process.clock import WallClock
from tests.arm_benches import CounterpartServer, ServedBench

ROOT = Path(__file__).parents[1]
PYTHON = ROOT / ".octoprint/bin/python"
PARKED = np.array([110.0, 110.0, 60.0])  # mm
GREETED_TIME = 5.0  # s in which it has said who it is, on a busy machine
MISSING = "OctoPrint is not installed in .octoprint: make counterparts"


def installed() -> bool:
    return PYTHON.exists()


def gantry() -> ArmProfile:
    return read_arm(ROOT / "data/arms/gantry.toml")


class OctoPrintServer(CounterpartServer):
    """The virtual printer on the pseudo-terminal `link`."""

    def __init__(self, folder: Path, place: Array = PARKED, errors: Sequence[str] = ()) -> None:
        """place: (3,) mm, where it was left. errors: that it makes; see `octoprint_server.py`."""
        self.link, self.log = folder / "printer", folder / "places.txt"
        script = str(ROOT / "tests/octoprint_server.py")
        arguments = [str(self.link), str(self.log), *map(str, place[:3].tolist()), *errors]
        super().__init__("OctoPrint's virtual printer", [str(PYTHON), script, *arguments])

    def end(self, number: int = signal.SIGTERM) -> None:
        super().end(number)
        self.link.unlink(missing_ok=True)

    def truth(self) -> Array:
        """End it; rows (N, 5) of s, X Y Z and E mm."""
        self.end()
        return np.loadtxt(self.log)

    def places(self) -> tuple[Array, Array]:
        """End it; stamps (N,), s, and axes (N, 6), mm."""
        rows = self.truth()
        return rows[:, 0], np.hstack([rows[:, 1:4], np.zeros((len(rows), 3))])


class GcodeBench(ServedBench):
    """The driver of G-code machines before OctoPrint's virtual printer."""

    tolerance, rest_time, rest_way, silent_time = 0.5, 0.15, 1.0, 0.5

    def __init__(self, folder: Path, errors: Sequence[str] = ()) -> None:
        self.server, profile = OctoPrintServer(folder, PARKED, errors), gantry()
        super().__init__(open_arm(f"gcode://{self.server.link}", profile), profile, WallClock())

    def begin(self) -> Array:
        until = self.clock.now() + GREETED_TIME
        while self.arm.driver.enable(self.clock.now()) and self.clock.now() < until:
            self.run(0.1)
        return super().begin()

    def truth(self) -> tuple[Array, Array]:
        return self.server.places()
