"""What a recording tells of its cameras beside the motion: clocks, places, lenses, with their calibration as prior."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array

TOGETHER = 1e-6  # s: what all clocks have in common cannot be seen; their mean is the reference
LENS = 4  # fx fy cx cy


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """What is left to the recording, and how well it is known before: one standard deviation each, 0 for as it is.

    clock: s, of a camera's instant from its stamp. turn, shift: rad and mm, of a camera's place. focal, centre: px, of
    its matrix. The distortion stays as it is, since observations are undistorted already.
    """

    clock: float = 0.02  # webcams were seen 10 to 60 ms apart; beyond two sigmas it still gives way
    turn: float = 0.0
    shift: float = 0.0
    focal: float = 0.0
    centre: float = 0.0


REFINED = CalibrationPrior(turn=1e-3, shift=0.3, focal=1.5, centre=1.5)  # what a calibration with a board leaves


@dataclass(frozen=True, slots=True, eq=False)
class Cameras:
    """C cameras as far as a recording corrects them.

    base_from_camera: (C, 4, 4) mm. matrices: (C, 3, 3) px. offsets: (C,) s, later than stamped.
    """

    base_from_camera: Array
    matrices: Array
    offsets: Array

    def __len__(self) -> int:
        return len(self.offsets)

    def moved(self, step: Array) -> Cameras:
        """The same after a step (11 C,): offsets, places, lenses."""
        n = len(self)
        lens = step[7 * n :].reshape(n, LENS)
        matrices = self.matrices.copy()
        matrices[:, [0, 1, 0, 1], [0, 1, 2, 2]] += lens
        places = self.base_from_camera @ se3.exp(step[n : 7 * n].reshape(n, 6))
        return Cameras(places, matrices, self.offsets + step[:n])

    def since(self, before: Cameras) -> Array:
        """The step (11 C,) that made these of those `before`."""
        places = se3.log(se3.inverse(before.base_from_camera) @ self.base_from_camera)
        lens = (self.matrices - before.matrices)[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        return np.concatenate([self.offsets - before.offsets, places.ravel(), lens.ravel()])

    def rig(self, rig: Rig) -> Rig:
        """The rig with these corrections."""
        return Rig(
            tuple(
                replace(camera, matrix=matrix, base_from_camera=place, clock_offset=camera.clock_offset + float(offset))
                for camera, matrix, place, offset in zip(
                    rig.cameras, self.matrices, self.base_from_camera, self.offsets, strict=True
                )
            )
        )


def cameras_of(rig: Rig) -> Cameras:
    """The cameras as they were calibrated, each exposed when it is stamped."""
    places = np.stack([camera.base_from_camera for camera in rig.cameras])
    return Cameras(places, rig.matrices.copy(), np.zeros(len(rig)))


def sigmas(prior: CalibrationPrior, cameras: int) -> Array:
    """(11 C,) standard deviations of `Cameras.moved`'s step, 0 for what is held."""
    place = [prior.turn] * 3 + [prior.shift] * 3
    lens = [prior.focal] * 2 + [prior.centre] * 2
    return np.array([prior.clock] * cameras + place * cameras + lens * cameras)


def prior_information(sigma: Array, cameras: int) -> Array:
    """(11 C, 11 C) information of that step about the calibration; of what is held, zero."""
    known = np.divide(1.0, sigma**2, out=np.zeros_like(sigma), where=sigma > 0)
    out = np.diag(known)
    out[:cameras, :cameras] += np.where(sigma[0] > 0, 1 / (TOGETHER * cameras) ** 2, 0.0)
    return out
