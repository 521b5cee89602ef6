"""What a lens can be. A fit that leaves it is refused: a small residual alone proves nothing of a calibration.

The thesis's own Table 4.1 (fx 5258 and fy 5800 px beside a neighbour's 981, k3 = 5751) has a residual of 0.04 px.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.calibration.lens_model import PARAMETERS
from estimation.errors import StillbedError
from estimation.se3 import Array

SQUARE = 0.03  # of fx / fy - 1: webcams' pixels are square to a few parts in a thousand
NEIGHBOURS = 3.0  # times another camera's field of view: cameras of one rig see the same surface
CENTRE = 0.15  # of the image's longer side, from its middle to the optical axis
VIEW = (0.3, 8.0)  # focal length in longer sides of the image: 118 to 7 degrees across
LARGEST = {
    "k1": 2.0,
    "k2": 10.0,
    "p1": 0.03,
    "p2": 0.03,
    "k3": 50.0,
}  # webcams measured: 0.34, 0.27, 0.003, 0.008, 0.16
BEND = 0.5  # of its radius, by which distortion may move a corner of the image
RISING = 0.05  # least slope of the radial polynomial inside the image: below, it folds back over itself
FOCAL_DOUBT = 0.01  # one sigma, of the focal length itself


class Implausible(StillbedError):
    """A camera's fit that no camera can have."""


def check_lens(name: str, size: tuple[int, int], lens: Array) -> None:
    """Implausible, with camera, figure and what is allowed, unless a lens (9,) can be one; size: (W, H) px."""
    fx, fy, cx, cy = lens[:4]
    side = max(size)
    if not np.isfinite(lens).all():
        raise _refused(name, "lens", str(lens), "finite numbers")
    if abs(fx / fy - 1) > SQUARE:
        raise _refused(name, "fx / fy", f"{fx:.1f} / {fy:.1f} = {fx / fy:.3f}", f"1 within {SQUARE:g}: square pixels")
    if not VIEW[0] * side <= fx <= VIEW[1] * side:
        raise _refused(name, "fx", f"{fx:.1f} px", f"{VIEW[0] * side:.0f} to {VIEW[1] * side:.0f} px")
    for letter, value, extent in (("cx", cx, size[0]), ("cy", cy, size[1])):
        middle, room = (extent - 1) / 2, CENTRE * side
        if abs(value - middle) > room:
            raise _refused(name, letter, f"{value:.1f} px", f"{middle - room:.0f} to {middle + room:.0f} px")
    for i, value in enumerate(lens[4:], 4):
        most = LARGEST[PARAMETERS[i]]
        if abs(value) > most:
            raise _refused(name, PARAMETERS[i], f"{value:.4g}", f"-{most:g} to {most:g}")
    _check_bend(name, size, lens)


def check_neighbours(names: Sequence[str], sizes: Sequence[tuple[int, int]], lenses: Array) -> None:
    """Implausible where a camera's field of view is unlike all others'; lenses: (C, 9)."""
    relative = lenses[:, 0] / np.array([max(size) for size in sizes])
    for c, name in enumerate(names):
        others = np.delete(relative, c)
        if len(others) and np.abs(np.log(relative[c] / others)).min() > np.log(NEIGHBOURS):
            n = int(np.delete(np.arange(len(names)), c)[np.abs(np.log(relative[c] / others)).argmin()])
            got = f"{lenses[c, 0]:.1f} px, {max(relative[c] / relative[n], relative[n] / relative[c]):.1f} times apart"
            raise _refused(name, f"fx beside {names[n]}'s {lenses[n, 0]:.1f} px", got, f"at most {NEIGHBOURS:g} times")


def check_doubt(name: str, lens: Array, covariance: Array) -> None:
    """Implausible where the views left the focal length open; lens (9,) with its covariance (9, 9)."""
    doubt = float(np.sqrt(covariance[0, 0])) / float(lens[0])
    if not doubt <= FOCAL_DOUBT:
        allowed = f"{100 * FOCAL_DOUBT:g} % or less: tilt the board by 30 degrees and more, to all sides, near and far"
        raise _refused(name, "uncertainty of the focal length", f"{100 * doubt:.2g} %", allowed)


def _check_bend(name: str, size: tuple[int, int], lens: Array) -> None:
    corners = np.array([[0, 0], [size[0], 0], [0, size[1]], [size[0], size[1]]]) - lens[2:4]
    reach = float(np.linalg.norm(corners / lens[:2], axis=1).max())
    k1, k2, k3 = lens[[4, 5, 8]]
    r = np.linspace(0, reach, 100)
    rising = 1 + r**2 * (3 * k1 + r**2 * (5 * k2 + r**2 * 7 * k3))
    bend = np.abs(r**2 * (k1 + r**2 * (k2 + r**2 * k3))).max()
    if bend > BEND:
        raise _refused(name, "distortion at the corner", f"{100 * bend:.0f} %", f"at most {100 * BEND:.0f} %")
    inside = r <= 0.9 * reach / max(1 + bend, 1.0)  # an imaged corner's ideal radius is not known to better
    if (rising[inside] < RISING).any():
        raise _refused(name, "slope of the radial distortion", f"{rising[inside].min():.2f}", f"{RISING:g} or more")


def _refused(name: str, what: str, got: str, allowed: str) -> Implausible:
    return Implausible(f"camera {name}: {what} = {got}, allowed {allowed}")
