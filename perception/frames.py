"""Images with their instants, and the sets of frames that belong together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimation.se3 import Array

Image = NDArray[np.uint8]
StampedBy = Literal["", "driver", "stream", "arrival"]  # who told a live frame's instant; "" where it was recorded


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image. camera: number in the rig. stamp: s, middle of the exposure. image: (H, W) grey or (H, W, 3) BGR.

    by: who told the stamp of a live frame.
    """

    camera: int
    stamp: float
    image: Image
    by: StampedBy = ""


@dataclass(frozen=True, slots=True, eq=False)
class PrintHead:
    """What the arm knows of itself. base_from_nozzle: (4, 4), z from the tip up into the head. extruding: ink flows."""

    base_from_nozzle: Array
    extruding: bool


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """The frames of one instant, at most one per camera, in the rig's order; a camera may be missing. stamp: s.

    head: the print head at that instant, where an arm is known.
    """

    stamp: float
    frames: tuple[Frame, ...]
    head: PrintHead | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Roi:
    """Where the surface is in one image. camera: number in the rig. stamp: s. polygon: (N, 2) px, may lie outside."""

    camera: int
    stamp: float
    polygon: Array
