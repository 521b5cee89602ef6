"""Small textured patches of the surface: templates, projection into a camera, and alignment there.

Each landmark has a picture of a small square of the surface's tangent plane, cut once from its reference image. In a
later image the square is projected with the predicted pose and shifted until the picture fits (inverse compositional
Lucas-Kanade, Baker and Matthews 2004, on pictures normalised for brightness and contrast). A track does not drift: it
is always compared with its reference picture, never with the previous frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses, bend_one
from perception.mapping.alignment_kernels import (
    PATCH_RADIUS,
    PATCH_SAMPLES,
    PATCH_SIDE,
    Float32,
    descend,
    sample_grids,
)

MIN_PATCH_CONTRAST = 3.0  # grey levels: a patch with less contrast is not tracked


class Pyramid:
    """An image, level 0, and its half-size version, level 1, computed on first use: most frames need none."""

    __slots__ = ("_half", "_image")

    def __init__(self, image: Image) -> None:
        self._image = image
        self._half: Image | None = None

    def __getitem__(self, level: int) -> Image:
        if level == 0:
            return self._image
        if self._half is None:
            self._half = np.asarray(cv2.pyrDown(self._image), np.uint8)
        return self._half


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Reference pictures as parallel arrays, one per landmark; coarse_*: the same at twice the spacing."""

    camera: NDArray[np.int64]  # (N,) of the reference image
    axes: Array  # (N, 3, 2) mm per sample, the square's two sides in the surface frame
    picture: Float32  # (N, S) of zero mean and unit contrast
    steepest: Float32  # (N, 2, S) its gradient per sample, orthogonal to brightness and contrast
    inverse_hessian: Array  # (N, 2, 2)
    coarse_picture: Float32
    coarse_steepest: Float32
    coarse_inverse_hessian: Array
    contrast: Array  # (N,) grey levels

    def __len__(self) -> int:
        return len(self.camera)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Templates:
        """The rows of an index or mask."""
        return Templates(*(getattr(self, name)[index] for name in self.__slots__))


def join(parts: list[Templates]) -> Templates:
    """Several sets of templates one after the other."""
    return Templates(*(np.concatenate([getattr(p, name) for p in parts]) for name in Templates.__slots__))


def sample(image: Image, centre: Array, per_sample: Array, spacing: float = 1.0, half: bool = False) -> Float32:
    """Grey levels (N, S) of the grid laid at centres (N, 2) px with per_sample (N, 2, 2) px a step.

    spacing: steps from sample to sample. half: the image is the half-size one of a Pyramid. Bilinear; outside the image
    the border's value.
    """
    scale = (0.5 if half else 1.0) * spacing
    steps = contiguous(per_sample)
    return np.asarray(sample_grids(image, on_level(centre, half), steps, scale), np.float32)


def sample_each(images: Mapping[int, Pyramid], number: NDArray[np.int64], centre: Array, per_sample: Array) -> Float32:
    """Grey levels (N, S) as `sample`, each of the full image of its own number (N,)."""
    levels = np.zeros((len(number), PATCH_SAMPLES), np.float32)
    for i, pyramid in images.items():
        rows = np.flatnonzero(number == i)
        if len(rows):
            levels[rows] = sample(pyramid[0], centre[rows], per_sample[rows])
    return levels


def on_level(centre: Array, half: bool) -> Array:
    """Centres (N, 2) px of an image in the pixels of the image or of its half-size version."""
    # Bilinear sampling a quarter pixel off the half-size grid blurs the image, which widens the reach: on the grid
    # tests/test_patches.py finds fewer from 5 px away. Templates are cut the same way, so there is no relative shift.
    return centre * 0.5 - 0.25 if half else contiguous(centre)


def normalise(pictures: Float32) -> tuple[Float32, Float32]:
    """Pictures (N, S) of zero mean and unit contrast, and the contrast (N,), grey levels (standard deviation)."""
    centred = pictures - pictures.mean(1, keepdims=True)
    contrast = np.sqrt(np.square(centred).mean(1))
    return centred / np.maximum(contrast, 1e-3)[:, None], contrast


GRAIN_ORDER = 5  # of the polynomial over a patch that is subtracted: shading and soft edges


def _coarse_basis() -> Float32:
    """Orthonormal polynomials (S, B) over a patch, up to GRAIN_ORDER."""
    u, v = (part.ravel() for part in np.meshgrid(*(np.linspace(-1, 1, PATCH_SIDE),) * 2))
    powers = [(i, j) for i in range(GRAIN_ORDER + 1) for j in range(GRAIN_ORDER + 1 - i)]
    return np.asarray(np.linalg.qr(np.stack([u**i * v**j for i, j in powers], -1))[0], np.float32)


_COARSE = _coarse_basis()


def grain_of(pictures: Float32) -> Float32:
    """Pictures (N, S) minus their polynomial fit."""
    return np.asarray(pictures - (pictures @ _COARSE) @ _COARSE.T, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Squares projected into one camera, or into several one after the other."""

    centre: Array  # (N, 2) px as imaged
    per_sample: Array  # (N, 2, 2) px
    visible: NDArray[np.bool_]  # (N,)
    facing: Array  # (N,) cosine of the viewing angle

    def take(self, index: NDArray[np.int64]) -> Projection:
        """The rows of an index."""
        return Projection(self.centre[index], self.per_sample[index], self.visible[index], self.facing[index])


def project_squares(
    lenses: Lenses, camera: int, base_from_surface: Array, points: Array, normals: Array, axes: Array
) -> Projection:
    """Project tangent squares at points (N, 3) with sides axes (N, 3, 2), surface frame, mm, into one camera."""
    return project_into(lenses, [camera], base_from_surface[None], points, normals, axes)


def project_into(
    lenses: Lenses, cameras: Sequence[int], base_from_surface: Array, points: Array, normals: Array, axes: Array
) -> Projection:
    """Squares projected into cameras, each with its base_from_surface (C, 4, 4); row c N + i: square i of camera c."""
    count, index = len(points), np.arange(len(cameras))
    place, square = np.repeat(index, count), np.tile(np.arange(count), len(index))
    return _project(lenses, np.asarray(cameras, np.int64), place, square, base_from_surface, points, normals, axes)


def project_tracks_into(
    lenses: Lenses, camera: NDArray[np.int64], base_from_surface: Array, points: Array, normals: Array, axes: Array
) -> Projection:
    """Squares (N,), each into its own camera (N,). base_from_surface: (C, 4, 4), of all cameras of the rig."""
    cameras, square = np.arange(len(lenses.rig)), np.arange(len(points))
    return _project(lenses, cameras, contiguous(camera, np.int64), square, base_from_surface, points, normals, axes)


def _project(
    lenses: Lenses,
    cameras: NDArray[np.int64],
    place: NDArray[np.int64],
    square: NDArray[np.int64],
    base_from_surface: Array,
    points: Array,
    normals: Array,
    axes: Array,
) -> Projection:
    """R projections, each of its square (R,) into the camera at its place (R,) in `cameras` (C,)."""
    camera_from_surface = lenses.rig.camera_from_base[cameras] @ base_from_surface
    step = 2.0  # samples: wide enough that the difference is the patch's own scale, not rounding
    corners = np.concatenate([points, points + step * axes[:, :, 0], points + step * axes[:, :, 1]])
    in_camera = camera_from_surface[:, :3, :3] @ corners.T + camera_from_surface[:, :3, 3:]  # (C, 3, 3N)
    camera_normals = camera_from_surface[:, :3, :3] @ normals.T  # (C, 3, N)
    models, radius, sizes = lenses.models[cameras], lenses.radius[cameras], lenses.sizes[cameras]
    return Projection(*project_corners(place, square, in_camera, camera_normals, models, radius, sizes, step))


@compiled(
    "Tuple((f8[:,::1], f8[:,:,::1], b1[::1], f8[::1]))"
    "(i8[::1], i8[::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8)"
)
def project_corners(
    place: NDArray[np.int64],
    square: NDArray[np.int64],
    in_camera: Array,
    normals: Array,
    models: Array,
    radius: Array,
    sizes: Array,
    step: float,
) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """The parts of a `Projection` of R rows: squares (R,) of N, in the cameras at places (R,) of C.

    in_camera: (C, 3, 3N) mm, their centres, and points `step` samples along both sides. normals: (C, 3, N). models,
    radius, sizes: of the cameras, as in `Lenses`.
    """
    count, squares = len(square), normals.shape[2]
    centre, per_sample = np.empty((count, 2)), np.empty((count, 2, 2))
    visible, facing = np.empty(count, np.bool_), np.empty(count)
    for row in range(count):
        c, n = place[row], square[row]
        in_view, across, down = True, 0.0, 0.0
        for corner in range(3):
            k = corner * squares + n
            depth = in_camera[c, 2, k]
            inverse = 1 / (1e-6 if abs(depth) < 1e-6 else depth)
            x, y = in_camera[c, 0, k] * inverse, in_camera[c, 1, k] * inverse
            u, v, in_lens = bend_one(x, y, depth, models[c], radius[c])
            in_view = in_view and in_lens
            if corner == 0:
                across, down = u, v
            else:
                per_sample[row, 0, corner - 1] = (u - across) / step
                per_sample[row, 1, corner - 1] = (v - down) / step
        along = normals[c, 0, n] * in_camera[c, 0, n] + normals[c, 1, n] * in_camera[c, 1, n]
        along += normals[c, 2, n] * in_camera[c, 2, n]
        far = in_camera[c, 0, n] * in_camera[c, 0, n] + in_camera[c, 1, n] * in_camera[c, 1, n]
        far += in_camera[c, 2, n] * in_camera[c, 2, n]
        facing[row] = -along / max(np.sqrt(far), 1e-9)
        centre[row, 0], centre[row, 1] = across, down
        for axis in range(2):
            reach = PATCH_RADIUS * (abs(per_sample[row, axis, 0]) + abs(per_sample[row, axis, 1])) + 2
            limit = sizes[c, axis] - 1 - reach
            in_view = in_view and centre[row, axis] >= reach and centre[row, axis] < limit
        visible[row] = in_view and facing[row] > 0.15
    return centre, per_sample, visible, facing


def square_axes(lenses: Lenses, camera: int, base_from_surface: Array, points: Array, normals: Array) -> Array:
    """Sides (N, 3, 2), mm per sample, of squares that are about one pixel per sample in `camera`."""
    camera_from_surface = lenses.rig.camera_from_base[camera] @ base_from_surface
    focal = lenses.rig.matrices[camera][[0, 1], [0, 1]].mean()
    depth = se3.transform_points(camera_from_surface, points)[:, 2]
    right = camera_from_surface[0, :3] - normals * (normals @ camera_from_surface[0, :3])[:, None]
    right = right / np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-6)
    down = np.cross(-normals, right)
    return np.asarray(np.stack([right, down], -1) * (depth / focal)[:, None, None])


def _describe(pictures: Float32) -> tuple[Float32, Float32, Array, Float32]:
    normal, contrast = normalise(pictures)
    tiles = normal.reshape(-1, PATCH_SIDE, PATCH_SIDE)
    gradients = [np.asarray(np.gradient(tiles, axis=axis)) for axis in (2, 1)]
    steepest = np.stack([g.reshape(len(tiles), -1) for g in gradients], 1)
    steepest = steepest - steepest.mean(2, keepdims=True)
    along = np.einsum("nks,ns->nk", steepest, normal) / (PATCH_SIDE * PATCH_SIDE)
    steepest = steepest - along[:, :, None] * normal[:, None]
    hessian = np.einsum("nis,njs->nij", steepest, steepest).astype(float) + 1e-3 * np.eye(2)
    return normal, steepest.astype(np.float32), np.linalg.inv(hessian), contrast


def cut_templates(
    lenses: Lenses, images: Pyramid, camera: int, base_from_surface: Array, points: Array, normals: Array
) -> Templates:
    """Cut the reference pictures of landmarks from one image (and its half-size version)."""
    axes = square_axes(lenses, camera, base_from_surface, points, normals)
    where = project_squares(lenses, camera, base_from_surface, points, normals, axes)
    fine = _describe(sample(images[0], where.centre, where.per_sample))
    coarse = _describe(sample(images[1], where.centre, where.per_sample, 2.0, half=True))
    return Templates(np.full(len(points), camera), axes, fine[0], fine[1], fine[2], *coarse[:3], fine[3].astype(float))


MIN_ALIGNMENT_SIGMA_PX = 0.05  # px
# Height of the surface over a patch's plane, px: in an oblique view it shifts the patch by the angle's tangent in every
# image alike, so residuals do not show it. Measured on simulated skin with a wound of 2.4 mm and on a roof's edge:
# 0.06 px in a frontal view, 0.1 at 60 degrees, 0.2-0.3 at 70, 0.4-0.5 at 75; twice the sigma of alignment alone.
RELIEF_PX, MIN_FACING = 0.1, 0.1  # px; cosine: smaller ones are not visible
MAX_COARSE_STEPS, MAX_FINE_STEPS = 4, 6  # on the half-size image and the full one; from near, mostly three


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Aligned templates in one image, or in several one after the other."""

    pixels: Array  # (N, 2) px as imaged
    sigma: Array  # (N,) px
    score: Array  # (N,) correlation in [-1, 1]
    found: NDArray[np.bool_]  # (N,)


def align(
    templates: Templates, images: Pyramid, where: Projection, start: Array, min_score: float = 0.75, coarse: bool = True
) -> Alignment:
    """Shift each template until it fits one image: `align_in` of one camera."""
    return align_in(templates, [images], [len(templates)], where, start, min_score, coarse)


def align_in(
    templates: Templates,
    images: Sequence[Pyramid],
    counts: Sequence[int],
    where: Projection,
    start: Array,
    min_score: float = 0.75,
    coarse: bool = True,
) -> Alignment:
    """Shift each template until it fits.

    Without threads: a landmark takes microseconds, starting a thread on a busy machine milliseconds. counts: number of
    rows of each image, one after the other. start: (N, 2) px as imaged. min_score: correlation below which a landmark
    is not found. coarse: begin on the half-size images, which doubles the reach (5 px always, 8 mostly) and the time.
    """
    t, begin, per_sample = templates, contiguous(start), contiguous(where.per_sample)
    shift, results = np.zeros((len(t), 2)), np.zeros((len(t), 3))  # shifts in samples of the template
    for image, (first, last) in zip(images, pairwise(np.cumsum([0, *counts]).tolist()), strict=True):
        rows = slice(first, last)
        at, steps, visible = begin[rows], per_sample[rows], where.visible[rows]
        if coarse:
            template = t.coarse_picture[rows], t.coarse_steepest[rows], t.coarse_inverse_hessian[rows]
            descend(image[1], on_level(at, True), steps, visible, *template, shift[rows], 0.5, 2.0, MAX_COARSE_STEPS)
        template = t.picture[rows], t.steepest[rows], t.inverse_hessian[rows]
        results[rows] = descend(image[0], at, steps, visible, *template, shift[rows], 1.0, 1.0, MAX_FINE_STEPS)
    hessian = contiguous(t.inverse_hessian)
    return Alignment(
        *_alignment_parts(begin, per_sample, where.visible, where.facing, hessian, shift, results, min_score)
    )


def coarse_score(templates: Templates, images: Pyramid, where: Projection, centre: Array) -> Array:
    """Correlation (N,) in [-1, 1] of each template with the half-size image at centres (N, 2) px, without alignment."""
    current, _ = normalise(sample(images[1], centre, where.per_sample, 2.0, half=True))
    return np.asarray((current * templates.coarse_picture).mean(1), float)


@compiled(
    "Tuple((f8[:,::1], f8[::1], f8[::1], b1[::1]))"
    "(f8[:,::1], f8[:,:,::1], b1[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8)"
)
def _alignment_parts(
    start: Array,
    per_sample: Array,
    visible: NDArray[np.bool_],
    facing: Array,
    inverse_hessian: Array,
    shift: Array,
    results: Array,
    min_score: float,
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """The parts of an `Alignment`, of shifts (N, 2), samples, and the results (N, 3) of `descend`."""
    pixels, sigma, found = np.empty_like(start), np.empty(len(start)), np.zeros(len(start), np.bool_)
    for n in range(len(start)):
        step, inverse = per_sample[n], inverse_hessian[n]
        score, contrast, residual = results[n, 0], results[n, 1], results[n, 2]
        across = step[0, 0] * shift[n, 0] + step[0, 1] * shift[n, 1]
        down = step[1, 0] * shift[n, 0] + step[1, 1] * shift[n, 1]
        pixels[n, 0], pixels[n, 1] = start[n, 0] + across, start[n, 1] + down
        noise = 2 * (1 - min(max(score, -1.0), 1.0)) * 2.0  # variance per sample; neighbours share noise, hence the two
        per_pixel = 0.0  # the trace of step @ inverse @ step.T
        for i in range(2):
            for j in range(2):
                per_pixel += (step[i, 0] * inverse[0, j] + step[i, 1] * inverse[1, j]) * step[i, j]
        cosine = min(max(facing[n], MIN_FACING), 1.0)
        relief = RELIEF_PX**2 * (1 / cosine**2 - 1)  # the tangent's square
        alignment = max(noise * per_pixel / 2, MIN_ALIGNMENT_SIGMA_PX**2)
        sigma[n] = np.sqrt(alignment + residual**2 + relief)
        near = np.sqrt(across * across + down * down) < 3 * PATCH_SIDE  # false where it is not finite
        found[n] = visible[n] and score > min_score and contrast > MIN_PATCH_CONTRAST and near
    return pixels, sigma, results[:, 0].copy(), found
