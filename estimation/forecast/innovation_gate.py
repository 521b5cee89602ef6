"""Motion that no forecast could have known of: a cough or a push shows in the innovation of the very next pose.

The error of a forecast is learned when its time has come, a tenth of a second later at the soonest. A patient who
coughs has moved by millimetres then. But if a pose lies apart from the forecast of the one before, by more than poses
usually do and by more than the forecast's covariance allows, something new moves the surface. Its displacement is set
aside with a velocity of its own, which widens the covariance, and the known motion goes on underneath, until the
surface moves by that alone again.
"""

from __future__ import annotations

import numpy as np

from estimation.pose import SurfacePose
from estimation.se3 import Array

NOISE_RATIO = 5.0  # times the usual innovation,
CLAIM_SIGMAS = (
    3.0  # and times the sigma for the first horizon, if it went on like that: beyond both it is an innovation
)
INNOVATION_MEMORY_S = 4.0  # over which the usual innovation is learned
UNKNOWN_DECAY_S = 0.012  # of the covariance of the new velocity
DRIFT_DECAY_S = 0.1  # of the velocity of what was set aside: what suddenly moves a surface as suddenly stops
END_AFTER_S = 0.1  # without an innovation until all is as before
ACCEPT_AFTER_S = 2.0  # after which what goes on surprising is usual
PSD_GROWTH_S = 1.0  # in which the kept density grows by e: what goes on for longer is the surface's own


class InnovationGate:
    """Watches how far each pose is off the forecast of the one before it; in mm, turns at a lever."""

    def __init__(self) -> None:
        self._usual, self._learned = 0.0, 0.0  # mm^2, and s over which it was learned
        self._left = 0.0  # s until all is as before, if nothing surprises any more
        self._lasted, self._squares = 0.0, 0.0  # s since the first innovation, and their mean square since, mm^2
        self.drift = np.zeros(6)  # mm/s, of what was set aside
        self.unknown = np.zeros((6, 6))  # mm^2/s^2, covariance of that velocity

    @property
    def active(self) -> bool:
        """Whether something is set aside."""
        return self._left > 0

    def forget(self) -> None:
        """Set nothing aside any more; what is usual is kept."""
        self._left = self._lasted = self._squares = 0.0
        self.drift = np.zeros(6)

    def ahead(self, seconds: Array) -> tuple[Array, Array]:
        """How far, (H, 6) mm, what was set aside moves on in `seconds` (H,), and its covariances (H, 6, 6)."""
        goes = DRIFT_DECAY_S * (1 - np.exp(-seconds / DRIFT_DECAY_S))
        stops = np.outer(self.drift, self.drift)
        doubt = seconds[:, None, None] ** 2 * self.unknown + (seconds - goes)[:, None, None] ** 2 * stops
        return goes[:, None] * self.drift, doubt

    def __call__(self, off: Array, seconds: float, ahead: float, claim: Array) -> bool:
        """Whether a pose is set aside from the known motion.

        off: (6,) mm, from the forecast of the known motion `seconds` s before. claim: (6, 6) mm^2, covariance of that
        forecast `ahead` s ahead, as learned from earlier errors.
        """
        new = off - self.drift * seconds
        square, known, allowed = float(new @ new), NOISE_RATIO**2 * self._usual, CLAIM_SIGMAS**2 * np.trace(claim)
        self.unknown *= np.exp(-seconds / UNKNOWN_DECAY_S)
        if 0 < known < square and square * (ahead / seconds) ** 2 > allowed:
            self._left = END_AFTER_S
        elif self.active and self.drift @ self.drift * ahead**2 < allowed:
            self._left -= seconds
        if not self.active:
            self._learned = min(self._learned + seconds, INNOVATION_MEMORY_S)
            self._usual += seconds / self._learned * ((min(square, known) if known else square) - self._usual)
        if self._lasted > ACCEPT_AFTER_S:
            self._usual, self._left = self._squares, 0.0
        if not self.active:
            self.forget()
            return False
        self.unknown += np.outer(new, new) / seconds**2
        self.drift, self._lasted = off / seconds, self._lasted + seconds
        self._squares += (square - self._squares) * seconds / self._lasted
        return True


class WarmupForecast:
    """Constant velocity before any forecast is learned, with covariances that one push does not widen for long.

    A pose's own covariance knows how lively the surface was in the last second, with whatever struck it. The calmer
    motion before goes on: the least density of late is kept, and trusted less as time goes by.

    twist: (6,) rad/s and mm/s, the velocity used. calmer: whether the covariance is less than the pose's own.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.twist, self.calmer = np.zeros(6), False
        self._known, self._psd = np.zeros((6, 6)), np.full(6, np.inf)

    def __call__(self, pose: SurfacePose, seconds: float, aside: Array | None, ahead: Array) -> Array:
        """Covariances (H, 6, 6) `ahead` (H,) s after a pose, `seconds` s newer than the last.

        aside: (6,) the velocity without what was set aside, None where nothing is. Afterwards what was known of it
        counts until the pose itself knows the velocity better.
        """
        grown = (
            self._known + seconds * np.diag(self._psd) if self.calmer or aside is not None else pose.twist_covariance
        )
        if aside is not None:
            self.twist, self._known, self.calmer = aside, grown, True
        else:
            self._psd = np.minimum(pose.acceleration_psd, self._psd * np.exp(seconds / PSD_GROWTH_S))
            self.calmer = self.calmer and bool((self._psd < pose.acceleration_psd).any())
            if not self.calmer or np.trace(pose.twist_covariance[3:, 3:]) <= np.trace(grown[3:, 3:]):
                self.twist, grown = pose.twist, pose.twist_covariance
            self._known = grown
        span = ahead[:, None, None]
        return np.asarray(span**2 * self._known + span**3 / 3 * np.diag(self._psd))
