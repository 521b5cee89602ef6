"""Calibration's common ground: a board's corners in pictures, the lens as nine parameters, and what a lens can be.

A lens is fx fy cx cy k1 k2 p1 p2 k3 (px; thesis Eq. 4.5 with OpenCV's order of the last five). A model says which of
them are free; the others are zero. A fit outside the plausible range is refused, as a small residual alone proves
nothing: the thesis's Table 4.1 (fx 5258 and fy 5800 px beside a neighbour's 981, k3 = 5751) has one of 0.04 px.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from estimation.errors import StillbedError
from estimation.rig import Camera
from estimation.se3 import Array, Index, Mask

CAMERA_PARAMETERS = 16  # of one camera: lens 9, pose 6 (a right perturbation), clock offset 1 (s)
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
DISTORTIONS = {"none": 4, "k1": 5, "k1 k2": 6, "k1 k2 p1 p2": 8, "k1 k2 p1 p2 k3": 9}
MODELS = {name: np.arange(count) for name, count in DISTORTIONS.items()}  # free parameters, from the simplest model on
# Priors, one sigma each; webcams were measured at k1 k2 p1 p2 k3 = 0.35, 0.27, 0.004, 0.01, 0.16
CENTRE_SIGMA = 0.04  # of the image's longer side: distance of the optical axis from the image's middle
SKEW_SIGMA = 0.005  # of ln(fx / fy): pixels are square
DISTORTION_SIGMA = (0.5, 0.5, 0.01, 0.01, 0.3)  # of k1 k2 p1 p2 k3
CORNER_SIGMA = 0.2  # of the shift of an image corner, as share of its radius; webcams: -0.18 to 0.19
# Limits, beyond which a lens is refused
MAX_SKEW = 0.03  # of fx / fy - 1: webcams' pixels are square to a few parts in a thousand
MAX_FOCAL_RATIO = 3.0  # to another camera of the rig, relative to the image size: they see the same surface
MAX_CENTRE_SHIFT = 0.15  # of the image's longer side, from its middle to the optical axis
FOCAL_RANGE = (0.3, 8.0)  # focal length in longer sides of the image: 118 to 7 degrees across
MAX_DISTORTION = {"k1": 2.0, "k2": 10.0, "p1": 0.03, "p2": 0.03, "k3": 50.0}
MAX_CORNER_SHIFT = 0.5  # of its radius, by which distortion may move a corner of the image
MIN_RADIAL_SLOPE = 0.05  # of the radial polynomial inside the image: below, it folds back over itself
MAX_FOCAL_SIGMA = 0.01  # one sigma, of the focal length itself


def lens_parameters(camera: Camera) -> Array:
    """The lens (9,) of a camera."""
    m = camera.matrix
    return np.concatenate([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]], camera.distortion])


def lens_matrix(lens: ArrayLike) -> Array:
    """The camera matrix (3, 3), px, of a lens (9,)."""
    fx, fy, cx, cy = np.asarray(lens, float)[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project_lens(lens: Array, points: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of points (..., 3), mm, camera frame, and their Jacobians by lens and by point.

    lens: (9,) or (..., 9). Jacobians: (..., 2, 9), and (..., 2, 3) px per mm.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(np.broadcast_to(lens, (*points.shape[:-1], 9)), -1, 0)
    z = points[..., 2]
    x, y = points[..., 0] / z, points[..., 1] / z
    r2, xy = x * x + y * y, x * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * k3 * r2)  # of `radial` by r2
    u = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy
    pixels = np.stack([fx * u + cx, fy * v + cy], -1)
    by_lens = np.zeros((*points.shape[:-1], 2, 9))
    by_lens[..., 0, 0], by_lens[..., 1, 1] = u, v
    by_lens[..., 0, 2] = by_lens[..., 1, 3] = 1.0
    for k, power in ((4, r2), (5, r2 * r2), (8, r2**3)):
        by_lens[..., 0, k], by_lens[..., 1, k] = fx * x * power, fy * y * power
    by_lens[..., 0, 6], by_lens[..., 1, 6] = fx * 2 * xy, fy * (r2 + 2 * y * y)
    by_lens[..., 0, 7], by_lens[..., 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * xy
    ux = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    uy = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y  # also v by x
    vy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    by_point = np.empty((*points.shape[:-1], 2, 3))
    for row, (focal, a, b) in enumerate(((fx, ux, uy), (fy, uy, vy))):
        by_point[..., row, 0], by_point[..., row, 1] = focal * a / z, focal * b / z
        by_point[..., row, 2] = -focal * (a * x + b * y) / z
    return pixels, by_lens, by_point


@dataclass(frozen=True, slots=True, eq=False)
class LensPrior:
    """Prior knowledge of a lens, as a term of the least squares at one lens."""

    cost: float
    slope: Array  # (9,)
    information: Array  # (9, 9)


def lens_prior(size: tuple[int, int], lens: Array) -> LensPrior:
    """The weak prior of any webcam with images of `size` (W, H) px, at a lens (9,)."""
    about = np.array([lens[0], lens[1], (size[0] - 1) / 2, (size[1] - 1) / 2, 0, 0, 0, 0, 0])
    sigma = np.array([np.inf, np.inf, CENTRE_SIGMA * max(size), CENTRE_SIGMA * max(size), *DISTORTION_SIGMA])
    off = (lens - about) / sigma
    skew = np.array([1 / lens[0], -1 / lens[1], 0, 0, 0, 0, 0, 0, 0]) / SKEW_SIGMA
    log_ratio = float(np.log(lens[0] / lens[1])) / SKEW_SIGMA
    bend, bend_slope = _corner_bend(size, lens)
    information = np.diag(sigma**-2) + np.outer(skew, skew) + np.outer(bend_slope, bend_slope)
    slope = off / sigma + log_ratio * skew + bend * bend_slope
    return LensPrior(float(off @ off) + log_ratio**2 + bend**2, slope, information)


@dataclass(frozen=True, slots=True, eq=False)
class KnownLenses:
    """Lenses that are given."""

    lens: Array  # (C, 9)
    sigma: Array  # (C, 9) one standard deviation of each number; 0: exact


def given_prior(known: KnownLenses, camera: int, lens: Array) -> LensPrior:
    """The prior of one camera's given lens, at a lens (9,); exact numbers are not estimated and add nothing."""
    sigma = known.sigma[camera]
    weight = np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1.0) ** 2, 0.0)
    off = lens - known.lens[camera]
    return LensPrior(float(weight @ off**2), weight * off, np.diag(weight))


def _corner_bend(size: tuple[int, int], lens: Array) -> tuple[float, Array]:
    """Shift of an image corner as share of its radius, in sigmas, and the derivative (9,) of that."""
    fx, fy, k1, k2, k3 = lens[[0, 1, 4, 5, 8]]
    r2 = (size[0] ** 2 + size[1] ** 2) / (4 * fx * fy)
    rate = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    slope = np.array([-rate * r2 / fx, -rate * r2 / fy, 0, 0, r2, r2**2, 0, 0, r2**3])
    return float(r2 * (k1 + r2 * (k2 + r2 * k3))) / CORNER_SIGMA, slope / CORNER_SIGMA


@dataclass(frozen=True, slots=True, eq=False)
class BoardViews:
    """The corners of one rigid board in V pictures of C cameras."""

    names: tuple[str, ...]  # of the cameras
    sizes: tuple[tuple[int, int], ...]  # (W, H) px of each camera
    points: Array  # (P, 3) mm, the board's corners in its own frame
    camera: Index  # (V,) number of the camera
    instant: Index  # (V,) number of the frame set, from 0 in order of stamp
    stamp: Array  # (V,) s, by the camera's own clock
    pixels: Array  # (V, P, 2) px, distorted; nan where a corner was not seen
    sigma: Array  # (V,) px, one standard deviation per axis

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def seen(self) -> Mask:
        """(V, P) which corners were seen."""
        return np.isfinite(self.pixels[..., 0])

    def select(self, kept: Mask | Index) -> BoardViews:
        """The rows `kept`, a mask (V,) or numbers, with instants renumbered from 0."""
        instant = np.unique(self.instant[kept], return_inverse=True)[1].astype(np.int64)
        rows = self.camera[kept], instant, self.stamp[kept], self.pixels[kept], self.sigma[kept]
        return BoardViews(self.names, self.sizes, self.points, *rows)

    def without(self, outliers: Mask) -> BoardViews:
        """The same with the corners `outliers` (V, P) taken as not seen."""
        return replace(self, pixels=np.where(outliers[..., None], np.nan, self.pixels))


class Undetermined(StillbedError):
    """The views do not determine a camera's lens or pose."""


class Implausible(StillbedError):
    """A fitted lens that no camera can have."""


def check_lens(name: str, size: tuple[int, int], lens: Array) -> None:
    """Implausible, with camera, value and allowed range, unless a lens (9,) is possible; size: (W, H) px."""
    fx, fy, cx, cy = lens[:4]
    side = max(size)
    if not np.isfinite(lens).all():
        raise _implausible(name, "lens", str(lens), "finite numbers")
    if abs(fx / fy - 1) > MAX_SKEW:
        got = f"{fx:.1f} / {fy:.1f} = {fx / fy:.3f}"
        raise _implausible(name, "fx / fy", got, f"1 within {MAX_SKEW:g}: square pixels")
    if not FOCAL_RANGE[0] * side <= fx <= FOCAL_RANGE[1] * side:
        raise _implausible(name, "fx", f"{fx:.1f} px", f"{FOCAL_RANGE[0] * side:.0f} to {FOCAL_RANGE[1] * side:.0f} px")
    for letter, value, extent in (("cx", cx, size[0]), ("cy", cy, size[1])):
        middle, room = (extent - 1) / 2, MAX_CENTRE_SHIFT * side
        if abs(value - middle) > room:
            raise _implausible(name, letter, f"{value:.1f} px", f"{middle - room:.0f} to {middle + room:.0f} px")
    for i, value in enumerate(lens[4:], 4):
        most = MAX_DISTORTION[PARAMETERS[i]]
        if abs(value) > most:
            raise _implausible(name, PARAMETERS[i], f"{value:.4g}", f"-{most:g} to {most:g}")
    _check_bend(name, size, lens)


def check_neighbours(names: Sequence[str], sizes: Sequence[tuple[int, int]], lenses: Array) -> None:
    """Implausible where a camera's field of view differs from all others'; lenses: (C, 9)."""
    relative = lenses[:, 0] / np.array([max(size) for size in sizes])
    for c, name in enumerate(names):
        others = np.delete(relative, c)
        if len(others) and np.abs(np.log(relative[c] / others)).min() > np.log(MAX_FOCAL_RATIO):
            n = int(np.delete(np.arange(len(names)), c)[np.abs(np.log(relative[c] / others)).argmin()])
            got = f"{lenses[c, 0]:.1f} px, {max(relative[c] / relative[n], relative[n] / relative[c]):.1f} times apart"
            what = f"fx beside {names[n]}'s {lenses[n, 0]:.1f} px"
            raise _implausible(name, what, got, f"at most {MAX_FOCAL_RATIO:g} times")


def check_focal_uncertainty(name: str, lens: Array, covariance: Array) -> None:
    """Implausible where the views do not determine the focal length; lens (9,) with its covariance (9, 9)."""
    sigma = float(np.sqrt(covariance[0, 0])) / float(lens[0])
    if not sigma <= MAX_FOCAL_SIGMA:
        hint = "tilt the board by 30 degrees and more, to all sides, near and far"
        allowed = f"{100 * MAX_FOCAL_SIGMA:g} % or less: {hint}"
        raise _implausible(name, "uncertainty of the focal length", f"{100 * sigma:.2g} %", allowed)


def _check_bend(name: str, size: tuple[int, int], lens: Array) -> None:
    corners = np.array([[0, 0], [size[0], 0], [0, size[1]], [size[0], size[1]]]) - lens[2:4]
    reach = float(np.linalg.norm(corners / lens[:2], axis=1).max())
    k1, k2, k3 = lens[[4, 5, 8]]
    r = np.linspace(0, reach, 100)
    rising = 1 + r**2 * (3 * k1 + r**2 * (5 * k2 + r**2 * 7 * k3))
    bend = np.abs(r**2 * (k1 + r**2 * (k2 + r**2 * k3))).max()
    if bend > MAX_CORNER_SHIFT:
        allowed = f"at most {100 * MAX_CORNER_SHIFT:.0f} %"
        raise _implausible(name, "distortion at the corner", f"{100 * bend:.0f} %", allowed)
    inside = r <= 0.9 * reach / max(1 + bend, 1.0)  # the undistorted radius of a corner is not known better
    if (rising[inside] < MIN_RADIAL_SLOPE).any():
        got = f"{rising[inside].min():.2f}"
        raise _implausible(name, "slope of the radial distortion", got, f"{MIN_RADIAL_SLOPE:g} or more")


def _implausible(name: str, what: str, got: str, allowed: str) -> Implausible:
    return Implausible(f"camera {name}: {what} = {got}, allowed {allowed}")
