"""Live cameras as a source of frame sets."""

from __future__ import annotations

from pathlib import Path

from estimation.se3 import Array
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import read_live_rig
from hardware.live.arrived import Arrived, SourceEnded
from hardware.process.clock import WallClock


class CameraSource:
    """The newest frame set of the cameras in a rig.toml. rig: their calibration."""

    def __init__(self, file: Path) -> None:
        self.rig, sources = read_live_rig(file)
        self._clock = WallClock()
        self._cameras = LiveCameras(self.rig, sources, self._clock)
        self._cameras.start()
        self._passed = 0

    def take(self, patience: float) -> Arrived | None:
        """The newest set, waiting `patience` s for one; None where none came. SourceEnded once all have ended."""
        until = self._clock.now() + patience
        frames = self._cameras.next_set(until)
        now = self._clock.now()
        if frames is None:
            if now < until:  # it did not wait: there is nothing to wait for
                raise SourceEnded("all have ended")
            return None
        passed = self._cameras.health().passed_over
        dropped, self._passed = passed - self._passed, passed
        return Arrived(frames, handed=now, dropped=dropped)

    def learn(self, offsets: Array) -> None:
        """Pair frames as the cameras really expose: (C,) s later than their sets are stamped."""
        self._cameras.learn(offsets)

    def close(self) -> None:
        """Let the cameras go."""
        self._cameras.close()
