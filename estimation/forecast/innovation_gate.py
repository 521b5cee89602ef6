"""Motion that no forecast could have known of: told by the newest poses alone, long before forecasts are judged.

What a forecast is off by is learned when its time has come, a tenth of a second later at the soonest; a patient who
coughs has moved by millimetres then. But the very next pose shows it: where it lies apart from what the one before
foretold, by more than poses usually do and by more than the forecasts' claim allows, something moves the surface beside
what was known of it. That is set aside: it keeps its velocity, which widens the claims by as much as it surprises, and
the motion known before goes on underneath, until the surface moves by that alone again.
"""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array

NOISE = 5.0  # times what poses usually are off what the one before foretold,
CLAIM = 3.0  # and times the claim for the first horizon, if they went on like that: beyond both it is a surprise
LATELY = 4.0  # s over which it is learned what is usual
FADES = 0.012  # s, of the square of what is not known of the velocity
LASTS = 0.1  # s, of the velocity of what was set aside: what suddenly moves a surface as suddenly stops
CALM = 0.1  # s without a surprise until all is as before
PATIENCE = 2.0  # s, after which what goes on surprising is usual


class Surprise:
    """Watches how far each pose is off the forecast of the one before it; in mm, turns at a lever.

    drift: (6,) mm/s, of what was set aside; zero without. unknown: (6, 6) mm^2/s^2, covariance of the velocity.
    """

    def __init__(self) -> None:
        self._usual, self._seen = 0.0, 0.0  # mm^2, and s over which it was learned
        self._left = 0.0  # s until all is as before, if nothing surprises any more
        self._lasted, self._squares = (
            0.0,
            0.0,
        )  # s since the first surprise, and the mean of the squares since then, mm^2
        self.drift, self.unknown = np.zeros(6), np.zeros((6, 6))

    @property
    def active(self) -> bool:
        """Whether something is set aside."""
        return self._left > 0

    def forget(self) -> None:
        """Nothing is set aside any more; what is usual is kept."""
        self._left = self._lasted = self._squares = 0.0
        self.drift = np.zeros(6)

    def ahead(self, seconds: Array) -> tuple[Array, Array]:
        """How far, (H, 6) mm, it goes on in `seconds` (H,), and covariances (H, 6, 6) of what is not known of that."""
        goes = LASTS * (1 - np.exp(-seconds / LASTS))
        stops = np.outer(self.drift, self.drift)
        doubt = seconds[:, None, None] ** 2 * self.unknown + (seconds - goes)[:, None, None] ** 2 * stops
        return goes[:, None] * self.drift, doubt

    def __call__(self, off: Array, seconds: float, ahead: float, claim: Array) -> bool:
        """Whether a pose is to be set aside from what was foretold.

        off: (6,) mm, from where the one before foretold it, which was `seconds` s before, by what was known before any
        surprise. claim: (6, 6) mm^2, of that forecast `ahead` s ahead, as learned from the errors seen before.
        """
        new = off - self.drift * seconds
        square, known, allowed = float(new @ new), NOISE**2 * self._usual, CLAIM**2 * np.trace(claim)
        self.unknown *= np.exp(-seconds / FADES)
        if 0 < known < square and square * (ahead / seconds) ** 2 > allowed:
            self._left = CALM
        elif self.active and self.drift @ self.drift * ahead**2 < allowed:
            self._left -= seconds
        if not self.active:
            self._seen = min(self._seen + seconds, LATELY)
            self._usual += seconds / self._seen * ((min(square, known) if known else square) - self._usual)
        if self._lasted > PATIENCE:
            self._usual, self._left = self._squares, 0.0
        if not self.active:
            self.forget()
            return False
        self.unknown += np.outer(new, new) / seconds**2
        self.drift, self._lasted = off / seconds, self._lasted + seconds
        self._squares += (square - self._squares) * seconds / self._lasted
        return True
