"""What is true of the world at one instant: the seam between the simulated motion and the pictures taken of it."""

from __future__ import annotations

from dataclasses import dataclass

from estimation.se3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """The world in the middle of one exposure.

    stamp: s, true time. exposure: s, how long the shutter is open about it. base_from_surface: (4, 4) mm. twist: (6,)
    body velocity of the surface, rad/s and mm/s. strain: amount of the scene's deformation, 0 at rest, 1 as specified.
    base_from_nozzle: (4, 4) mm, tip at the origin and z back into the tool; None where there is none. gain: of the
    exposure, 1 is nominal, in linear light.
    """

    stamp: float
    exposure: float
    base_from_surface: Array
    twist: Array
    strain: float = 0.0
    base_from_nozzle: Array | None = None
    gain: float = 1.0
