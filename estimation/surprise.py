"""Motion that no forecast could have known of: told by the newest pose alone, long before forecasts are judged.

What a forecast is off by is learned when its time has come, a tenth of a second later at the soonest; a patient who
coughs has moved by millimetres then. But the very next pose shows it: where it lies apart from what the one before
foretold, by more than poses usually do and by more than the forecasts' claim allows, the surface has a velocity that
nobody knew of. It widens the claims at once, and fades once poses come as they are expected.
"""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array

NOISE = 5.0  # times what poses usually are off what the one before foretold,
CLAIM = 3.0  # and times the claim for the first horizon, if they went on like that: beyond both it is a surprise
LATELY = 4.0  # s over which it is learned what is usual
FADES = 0.1  # s, of the unknown velocity's square


class Surprise:
    """Watches how far each pose is off the forecast of the one before it; in mm, turns at a lever."""

    def __init__(self) -> None:
        self._usual = 0.0  # mm^2
        self.velocity = np.zeros((6, 6))  # covariance of what is not known of the velocity, mm^2/s^2

    def __call__(self, off: Array, seconds: float, ahead: float, claim: Array) -> bool:
        """Whether a pose surprises.

        off: (6,) mm, from where the one before foretold it, which was `seconds` s before. claim: (6, 6) mm^2, of that
        forecast `ahead` s ahead, as learned from the errors seen before.
        """
        square, known = float(off @ off), NOISE**2 * self._usual
        self.velocity *= np.exp(-seconds / FADES)
        surprises = 0 < known < square and square * (ahead / seconds) ** 2 > CLAIM**2 * np.trace(claim)
        if surprises:
            self.velocity += np.outer(off, off) / seconds**2
        self._usual += min(1.0, seconds / LATELY) * (min(square, known) - self._usual) if known else square
        return surprises
