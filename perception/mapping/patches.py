"""Small textured patches of the surface: what each looks like, where it falls in a camera, and its alignment there.

Each landmark keeps the picture of a small square of the surface's tangent plane, cut once from its reference image. In
a later image the square is projected with the predicted pose and shifted until the picture fits (inverse compositional
Lucas-Kanade, Baker and Matthews 2004, on pictures normalised for brightness and contrast). A track does not drift: it
is always compared with its reference picture, never with the previous frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array
from perception.frames import Image, parallel_map
from perception.lens import Lenses, bend_one
from perception.mapping.alignment_kernels import PATCH_RADIUS, PATCH_SIDE, Float32, descend, sample_grids

MIN_PATCH_CONTRAST = 3.0  # grey levels: a patch with less contrast is not worth a track


class Pyramid:
    """An image, level 0, and its half-size version, level 1, made when it is first asked for: most frames need none."""

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

    camera: NDArray[np.int64]  # (N,) that took it
    axes: Array  # (N, 3, 2) mm per sample, the square's two sides in the surface frame
    picture: Float32  # (N, S) of zero mean and unit contrast
    steepest: Float32  # (N, 2, S) its gradient a sample, freed of brightness and contrast
    inverse_hessian: Array  # (N, 2, 2)
    coarse_picture: Float32
    coarse_steepest: Float32
    coarse_inverse_hessian: Array
    contrast: Array  # (N,) grey levels

    def __len__(self) -> int:
        return len(self.camera)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Templates:
        """The chosen ones."""
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


def on_level(centre: Array, half: bool) -> Array:
    """Centres (N, 2) px of an image in the pixels of the image or of its half-size version."""
    # A quarter pixel beside the half-size grid bilinear sampling blurs the image, which widens the reach: on the grid
    # tests/test_patches.py finds fewer from 5 px away. Templates are cut alike, so what is compared is not shifted.
    return centre * 0.5 - 0.25 if half else contiguous(centre)


def normalise(pictures: Float32) -> tuple[Float32, Float32]:
    """Pictures (N, S) freed of mean and contrast, and the contrast (N,), grey levels (standard deviation)."""
    centred = pictures - pictures.mean(1, keepdims=True)
    contrast = np.sqrt(np.square(centred).mean(1))
    return centred / np.maximum(contrast, 1e-3)[:, None], contrast


GRAIN_ORDER = 5  # of the polynomial over a patch that is taken out: shading and soft edges


def _coarse_basis() -> Float32:
    """Orthonormal polynomials (S, B) over a patch, up to GRAIN_ORDER."""
    u, v = (part.ravel() for part in np.meshgrid(*(np.linspace(-1, 1, PATCH_SIDE),) * 2))
    powers = [(i, j) for i in range(GRAIN_ORDER + 1) for j in range(GRAIN_ORDER + 1 - i)]
    return np.asarray(np.linalg.qr(np.stack([u**i * v**j for i, j in powers], -1))[0], np.float32)


_COARSE = _coarse_basis()


def grain_of(pictures: Float32) -> Float32:
    """Pictures (N, S) without what polynomials explain."""
    return np.asarray(pictures - (pictures @ _COARSE) @ _COARSE.T, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where squares fall in one camera, or in several one after the other."""

    centre: Array  # (N, 2) px as imaged
    per_sample: Array  # (N, 2, 2) px
    visible: NDArray[np.bool_]  # (N,)
    facing: Array  # (N,) cosine of the viewing angle

    def take(self, index: NDArray[np.int64]) -> Projection:
        """The chosen ones."""
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
    which = np.asarray(cameras, np.int64)
    camera_from_surface = lenses.rig.camera_from_base[which] @ base_from_surface
    step = 2.0  # samples: wide enough that the difference is the patch's own scale, not rounding
    corners = np.stack([points, points + step * axes[:, :, 0], points + step * axes[:, :, 1]]).reshape(-1, 3)
    in_camera = camera_from_surface[:, :3, :3] @ corners.T + camera_from_surface[:, :3, 3:]  # (C, 3, 3N)
    turned = camera_from_surface[:, :3, :3] @ normals.T  # (C, 3, N)
    models, radius, sizes = lenses.models[which], lenses.radius[which], lenses.sizes[which]
    return Projection(*project_corners(in_camera, turned, models, radius, sizes, step))


@compiled(
    "Tuple((f8[:,::1], f8[:,:,::1], b1[::1], f8[::1]))(f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[:,::1], f8)"
)
def project_corners(
    in_camera: Array, turned: Array, models: Array, radius: Array, sizes: Array, step: float
) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """The parts of a `Projection` of N squares into C cameras, one after the other.

    in_camera: (C, 3, 3N) mm, their places, and what lies `step` samples along both sides. turned: (C, 3, N) normals.
    models, radius, sizes: of the cameras, as `Lenses` has them.
    """
    count, squares = len(in_camera), turned.shape[2]
    centre, per_sample = np.empty((count * squares, 2)), np.empty((count * squares, 2, 2))
    visible, facing = np.empty(count * squares, np.bool_), np.empty(count * squares)
    for c in range(count):
        for n in range(squares):
            row = c * squares + n
            seen, across, down = True, 0.0, 0.0
            for corner in range(3):
                k = corner * squares + n
                depth = in_camera[c, 2, k]
                inverse = 1 / (1e-6 if abs(depth) < 1e-6 else depth)
                x, y = in_camera[c, 0, k] * inverse, in_camera[c, 1, k] * inverse
                u, v, in_lens = bend_one(x, y, depth, models[c], radius[c])
                seen = seen and in_lens
                if corner == 0:
                    across, down = u, v
                else:
                    per_sample[row, 0, corner - 1] = (u - across) / step
                    per_sample[row, 1, corner - 1] = (v - down) / step
            along = turned[c, 0, n] * in_camera[c, 0, n] + turned[c, 1, n] * in_camera[c, 1, n]
            along += turned[c, 2, n] * in_camera[c, 2, n]
            far = in_camera[c, 0, n] * in_camera[c, 0, n] + in_camera[c, 1, n] * in_camera[c, 1, n]
            far += in_camera[c, 2, n] * in_camera[c, 2, n]
            facing[row] = -along / max(np.sqrt(far), 1e-9)
            centre[row, 0], centre[row, 1] = across, down
            for axis in range(2):
                reach = PATCH_RADIUS * (abs(per_sample[row, axis, 0]) + abs(per_sample[row, axis, 1])) + 2
                limit = sizes[c, axis] - 1 - reach
                seen = seen and centre[row, axis] >= reach and centre[row, axis] < limit
            visible[row] = seen and facing[row] > 0.15
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
# Height of the surface over a patch's plane, px: seen from the side it shifts all that shows it, by the angle's
# tangent, and does so in every image, so no residual tells. Measured on simulated skin with a wound of 2.4 mm and on a
# roof's edge: 0.06 px seen squarely, 0.1 at 60 degrees, 0.2-0.3 at 70, 0.4-0.5 at 75; alignment alone claimed half.
RELIEF_PX, MIN_FACING = 0.1, 0.1  # px; cosine beyond which nothing is visible anyway
MAX_COARSE_STEPS, MAX_FINE_STEPS = 4, 6  # on the half-size image and the full one; from near, three are the rule


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Where templates fit in one image, or in several one after the other."""

    pixels: Array  # (N, 2) px as imaged
    sigma: Array  # (N,) px
    score: Array  # (N,) correlation in [-1, 1]
    found: NDArray[np.bool_]  # (N,)


def align(
    templates: Templates, images: Pyramid, where: Projection, start: Array, least: float = 0.75, coarse: bool = True
) -> Alignment:
    """Shift each template until it fits one image: `align_in` of one camera."""
    return align_in(templates, [images], [len(templates)], where, start, least, coarse)


def align_in(
    templates: Templates,
    images: Sequence[Pyramid],
    counts: Sequence[int],
    where: Projection,
    start: Array,
    least: float = 0.75,
    coarse: bool = True,
) -> Alignment:
    """Shift each template until it fits; the cameras side by side.

    counts: how many of the rows belong to each of the images, one after the other. start: (N, 2) px as imaged, where to
    begin. least: the correlation below which a landmark is not found. coarse: begin on the half-size images, which
    reaches twice as far (5 px surely, 8 mostly) and costs as much again.
    """
    begin, per_sample = contiguous(start), contiguous(where.per_sample)
    shift, ended = np.zeros((len(templates), 2)), np.zeros((len(templates), 3))  # shifts in samples of the template

    def in_one(images: Pyramid, mine: slice) -> None:
        t, at, steps, visible = templates, begin[mine], per_sample[mine], where.visible[mine]
        if coarse:
            looks = t.coarse_picture[mine], t.coarse_steepest[mine], t.coarse_inverse_hessian[mine]
            descend(images[1], on_level(at, True), steps, visible, *looks, shift[mine], 0.5, 2.0, MAX_COARSE_STEPS)
        looks = t.picture[mine], t.steepest[mine], t.inverse_hessian[mine]
        ended[mine] = descend(images[0], at, steps, visible, *looks, shift[mine], 1.0, 1.0, MAX_FINE_STEPS)

    parts = [slice(first, last) for first, last in pairwise(np.cumsum([0, *counts]).tolist())]
    if len(parts) > 1:
        parallel_map(in_one, images, parts)
    else:
        in_one(images[0], parts[0])
    return _accepted(templates, where, start, shift, ended, least)


def coarse_score(templates: Templates, images: Pyramid, where: Projection, centre: Array) -> Array:
    """Correlation (N,) in [-1, 1] of each template with the half-size image at centres (N, 2) px, without alignment."""
    current, _ = normalise(sample(images[1], centre, where.per_sample, 2.0, half=True))
    return np.asarray((current * templates.coarse_picture).mean(1), float)


def _accepted(
    templates: Templates, where: Projection, start: Array, shift: Array, ended: Array, least: float
) -> Alignment:
    moved = (where.per_sample @ shift[..., None])[..., 0]
    pixels = start + moved
    score, contrast, rest = ended.T
    noise = 2 * (1 - np.clip(score, -1, 1)) * 2.0  # variance per sample; neighbours share noise, hence the two
    per_pixel = where.per_sample @ templates.inverse_hessian @ np.swapaxes(where.per_sample, 1, 2)
    sidelong = np.clip(where.facing, MIN_FACING, 1.0)
    bent = RELIEF_PX**2 * (1 / sidelong**2 - 1)  # the tangent's square
    white = np.maximum(noise * (per_pixel[:, 0, 0] + per_pixel[:, 1, 1]) / 2, MIN_ALIGNMENT_SIGMA_PX**2)
    sigma = np.sqrt(white + rest**2 + bent)
    reach = np.sqrt((moved * moved).sum(1))
    fits = (score > least) & (contrast > MIN_PATCH_CONTRAST)
    found = where.visible & fits & (reach < 3 * PATCH_SIDE) & np.isfinite(pixels).all(1)
    return Alignment(pixels, sigma, score, found)
