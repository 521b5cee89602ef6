"""A frame set as it reaches the tracker, and where such sets come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from estimation.errors import StillbedError
from estimation.se3 import Array
from perception.frames import FrameSet

Encoded = tuple[str, bytes]  # "png" or "jpeg", and the picture as the camera gave it


class SourceEnded(StillbedError):
    """There will be no more pictures; it says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """A frame set. encoded: by camera, where the camera gave it so. handed: s, when the newest of its frames was handed
    over. source: s, its stamp on the clock of a recorded session; NaN of cameras. dropped: sets before it that nobody
    took.
    """

    frames: FrameSet
    encoded: Mapping[int, Encoded] = field(default_factory=dict)
    handed: float = 0.0
    source: float = float("nan")
    dropped: int = 0


class Source(Protocol):
    """Cameras, or what stands for them."""

    def take(self, patience: float) -> Arrived | None:
        """The newest set, waiting `patience` s for one; None where none came. SourceEnded once there will be none."""
        ...

    def learn(self, offsets: Array) -> None:
        """How much later than stamped each camera exposes (C,), s, as it is known by now."""
        ...

    def close(self) -> None:
        """Let the cameras go."""
        ...
