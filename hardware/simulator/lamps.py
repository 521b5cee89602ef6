"""Two lamps over the field and what they give: directions, soft shadows of the nozzle, highlights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from hardware.simulator.look import Look


@dataclass(frozen=True, slots=True, eq=False)
class Lamp:
    """A lamp far away.

    towards: (3,) unit, rest frame (z out of the wound). strength: irradiance. spread: its radius seen from the wound,
    rad. colour: BGR.
    """

    towards: Array
    strength: float
    spread: float
    colour: tuple[float, float, float]


def lamps(look: Look) -> tuple[Lamp, Lamp]:
    """The key lamp, warm and to one side, and the fill, cool and broad, on the other."""
    return (
        Lamp(_unit(-0.62, -0.30, 1.0), look.key, 0.075, (0.93, 0.99, 1.04)),
        Lamp(_unit(0.75, 0.42, 1.0), look.fill, 0.2, (1.08, 1.0, 0.94)),
    )


AMBIENT = (1.04, 1.0, 0.98)  # BGR of the room


def _unit(*vector: float) -> Array:
    return np.asarray(np.array(vector) / np.linalg.norm(vector))
