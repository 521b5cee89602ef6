"""What is claimed of the velocity before any forecast is learned, also where something suddenly moves the surface.

A pose's own claim knows how lively the surface was in the last second: whatever struck it, for a second after. What
moved it before, and moves it still, was calmer: the least of late is kept, and trusted less as time goes by.
"""

from __future__ import annotations

import numpy as np

from estimation.pose import SurfacePose
from estimation.se3 import Array

TRUSTED = 1.0  # s in which the kept liveliness grows by e: what goes on for longer is the surface's own


class Early:
    """Constant velocity, and covariances of it that one surprise does not widen for long.

    twist: (6,) rad/s and mm/s, the velocity reckoned with. calmer: whether less is claimed than the pose itself does.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Nothing is kept."""
        self.twist, self.calmer = np.zeros(6), False
        self._known, self._psd = np.zeros((6, 6)), np.full(6, np.inf)

    def __call__(self, pose: SurfacePose, seconds: float, aside: Array | None, ahead: Array) -> Array:
        """Covariances (H, 6, 6) `ahead` (H,) s after a pose, `seconds` s newer than the last.

        aside: (6,) the velocity without a surprise that was set aside, None where there is none. Afterwards what was
        known of it counts until the pose itself knows the velocity better.
        """
        grown = (
            self._known + seconds * np.diag(self._psd) if self.calmer or aside is not None else pose.twist_covariance
        )
        if aside is not None:
            self.twist, self._known, self.calmer = aside, grown, True
        else:
            self._psd = np.minimum(pose.acceleration_psd, self._psd * np.exp(seconds / TRUSTED))
            self.calmer = self.calmer and bool((self._psd < pose.acceleration_psd).any())
            if not self.calmer or np.trace(pose.twist_covariance[3:, 3:]) <= np.trace(grown[3:, 3:]):
                self.twist, grown = pose.twist, pose.twist_covariance
            self._known = grown
        span = ahead[:, None, None]
        return np.asarray(span**2 * self._known + span**3 / 3 * np.diag(self._psd))
