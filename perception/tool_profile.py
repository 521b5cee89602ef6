"""What hangs on the arm, as radius over height; apart from `Tool`, as the motion process must not load cv2."""

from __future__ import annotations

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array

# Height above the tip and radius, mm: a luer needle of half an inch on a 5 ml cartridge in its holder.
SYRINGE = np.array([[0, 0.5], [12.7, 0.5], [13.6, 2.5], [23, 3.6], [27, 4.8], [50, 4.8], [58, 8], [96, 8]], float)


def check_profile(where: object, what: str, profile: Array) -> None:
    """InputError unless a profile (K, 2) of [height, radius], mm, is that of a tool."""
    rising = profile.ndim == 2 and profile.shape[1:] == (2,) and len(profile) > 1
    if not (rising and np.isfinite(profile).all() and (np.diff(profile[:, 0]) > 0).all() and (profile >= 0).all()):
        allowed = "two or more [height, radius] in mm, none negative, heights rising"
        raise InputError(where, what, profile.tolist(), allowed)
