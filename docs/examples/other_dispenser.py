"""Drive another dispenser: a valve on a pin of this machine, which the system shows as a file.

python docs/examples/other_dispenser.py /sys/class/gpio/gpio17/value [SECONDS]    opens it for so long
"""

from __future__ import annotations

from pathlib import Path

from hardware.cli.dispenser import open_for
from hardware.cli.parser import run_script
from hardware.dispenser.dispenser import DispenserProfile, SwitchedDispenser
from hardware.process.clock import WallClock

# The delays are the valve's, s; at 22 degrees C it is kept by other means. It has no watchdog.
VALVE = DispenserProfile("valve", ("gel",), on_dead_time=0.008, off_dead_time=0.005, kept_at=22.0, flow=2.0)


class PinDispenser(SwitchedDispenser):
    """A valve that is open while the file holds 1: states, events and temperatures are those of any switch."""

    def __init__(self, pin: Path) -> None:
        super().__init__(VALVE, self._write)
        self._pin = pin

    def _write(self, on: bool) -> str:
        """Open or close it; why that cannot be done."""
        try:
            self._pin.write_text("1" if on else "0")
        except OSError as error:
            return str(error)
        return ""


def main(pin: str, seconds: float = 1.0) -> None:
    """Open the valve for so long."""
    open_for(PinDispenser(Path(pin)), float(seconds), None, None, WallClock())


if __name__ == "__main__":
    run_script(main, __doc__)
