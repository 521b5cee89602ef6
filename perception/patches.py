"""Small textured tiles of the surface, found again in later images by warping and sub-pixel alignment.

Each landmark keeps the picture of a small square of the surface's tangent plane, taken once from its reference image.
In a later image the square is projected with the predicted pose and shifted until the picture fits (inverse
compositional Lucas-Kanade, Baker and Matthews 2004, on patches freed of brightness and contrast), so a track never
creeps: it is compared with the reference, never with the frame before.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses

RADIUS = 7  # samples: 15 x 15, of which 225 decide
SIDE = 2 * RADIUS + 1
FLAT = 3.0  # grey levels: a patch with less contrast is not worth a track

Float32 = NDArray[np.float32]
Pyramid = tuple[Image, Image]  # an image and its half-size version


def _grid() -> Array:
    line = np.arange(-RADIUS, RADIUS + 1, dtype=float)
    return np.stack([a.ravel() for a in np.meshgrid(line, line)], -1)


GRID = _grid()  # (SIDE * SIDE, 2)
_SPAN = np.ascontiguousarray(GRID.T, np.float32)  # (2, S)


@dataclass(frozen=True, slots=True, eq=False)
class Templates:
    """Reference pictures as parallel arrays, one per landmark.

    camera: (N,) that took it. axes: (N, 3, 2) mm per sample, the square's two sides in the surface frame. picture:
    (N, S) of zero mean and unit contrast. steepest: (N, 2, S) its gradient a sample, freed of brightness and contrast.
    inverse_hessian: (N, 2, 2). coarse_*: the same at twice the spacing. contrast: (N,) grey levels.
    """

    camera: NDArray[np.int64]
    axes: Array
    picture: Float32
    steepest: Float32
    inverse_hessian: Array
    coarse_picture: Float32
    coarse_steepest: Float32
    coarse_inverse_hessian: Array
    contrast: Array

    def __len__(self) -> int:
        return len(self.camera)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Templates:
        """The chosen ones."""
        return Templates(*(getattr(self, name)[index] for name in self.__slots__))


def join(parts: list[Templates]) -> Templates:
    """Several sets of templates one after the other."""
    return Templates(*(np.concatenate([getattr(p, name) for p in parts]) for name in Templates.__slots__))


def pyramid(image: Image) -> Pyramid:
    """The image and its half-size version, as alignment takes them."""
    return image, np.asarray(cv2.pyrDown(image), np.uint8)


def sample(image: Image, centre: Array, per_sample: Array, spacing: float = 1.0, half: bool = False) -> Float32:
    """Grey levels (N, S) of the grid laid at centres (N, 2) px with per_sample (N, 2, 2) px a step.

    spacing: steps from sample to sample. half: the image is the half-size one of `pyramid`. Bilinear; outside the image
    the border's value.
    """
    # A quarter pixel beside the half-size grid bilinear sampling blurs the image, which widens the reach: on the grid
    # tests/test_patches.py finds fewer from 5 px away. Templates are cut alike, so what is compared is not shifted.
    scale, shift = (0.5, -0.25) if half else (1.0, 0.0)
    offsets = np.matmul((per_sample * (spacing * scale)).astype(np.float32), _SPAN)  # (N, 2, S)
    start = (centre * scale + shift).astype(np.float32)
    x, y = offsets[:, 0] + start[:, :1], offsets[:, 1] + start[:, 1:]
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def normalise(pictures: Float32) -> tuple[Float32, Float32]:
    """Pictures (N, S) freed of mean and contrast, and the contrast (N,), grey levels (standard deviation)."""
    centred = pictures - pictures.mean(1, keepdims=True)
    contrast = np.sqrt(np.square(centred).mean(1))
    return centred / np.maximum(contrast, 1e-3)[:, None], contrast


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where squares fall in one camera.

    centre: (N, 2) px as imaged. per_sample: (N, 2, 2) px. visible: (N,). facing: (N,) cosine of the viewing angle.
    """

    centre: Array
    per_sample: Array
    visible: NDArray[np.bool_]
    facing: Array


def project_squares(
    lenses: Lenses, camera: int, base_from_surface: Array, points: Array, normals: Array, axes: Array
) -> Projection:
    """Project tangent squares at points (N, 3) with sides axes (N, 3, 2), surface frame, mm, into one camera."""
    lens = lenses.rig.cameras[camera]
    camera_from_surface = lenses.rig.camera_from_base[camera] @ base_from_surface
    step = 2.0  # samples: wide enough that the difference is the patch's own scale, not rounding
    corners = np.stack([points, points + step * axes[:, :, 0], points + step * axes[:, :, 1]], 1)  # (N, 3, 3)
    in_camera = se3.transform_points(camera_from_surface, corners.reshape(-1, 3)).reshape(-1, 3, 3)
    depth = in_camera[..., 2]
    ideal = in_camera[..., :2] / np.where(np.abs(depth) < 1e-6, 1e-6, depth)[..., None]
    ideal = ideal * lens.matrix[[0, 1], [0, 1]] + lens.matrix[:2, 2]
    imaged, seen = lenses.image(camera, ideal, depth)
    per_sample = np.swapaxes(imaged[:, 1:] - imaged[:, :1], 1, 2) / step
    view = in_camera[:, 0] / np.maximum(np.linalg.norm(in_camera[:, 0], axis=1, keepdims=True), 1e-9)
    facing = -np.einsum("ni,ni->n", normals @ camera_from_surface[:3, :3].T, view)
    reach = RADIUS * np.abs(per_sample).sum(2) + 2
    centre = imaged[:, 0]
    inside = ((centre >= reach) & (centre < np.array(lens.size) - 1 - reach)).all(1)
    return Projection(centre, per_sample, seen.all(1) & inside & (facing > 0.15), facing)


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
    tiles = normal.reshape(-1, SIDE, SIDE)
    gradients = [np.asarray(np.gradient(tiles, axis=axis)) for axis in (2, 1)]
    steepest = np.stack([g.reshape(len(tiles), -1) for g in gradients], 1)
    steepest = steepest - steepest.mean(2, keepdims=True)
    along = np.einsum("nks,ns->nk", steepest, normal) / (SIDE * SIDE)
    steepest = steepest - along[:, :, None] * normal[:, None]
    hessian = np.einsum("nis,njs->nij", steepest, steepest).astype(float) + 1e-3 * np.eye(2)
    return normal, steepest.astype(np.float32), np.linalg.inv(hessian), contrast


def take_templates(
    lenses: Lenses, images: Pyramid, camera: int, base_from_surface: Array, points: Array, normals: Array
) -> Templates:
    """Cut the reference pictures of landmarks from one image (and its half-size version)."""
    axes = square_axes(lenses, camera, base_from_surface, points, normals)
    where = project_squares(lenses, camera, base_from_surface, points, normals, axes)
    fine = _describe(sample(images[0], where.centre, where.per_sample))
    coarse = _describe(sample(images[1], where.centre, where.per_sample, 2.0, half=True))
    return Templates(np.full(len(points), camera), axes, fine[0], fine[1], fine[2], *coarse[:3], fine[3].astype(float))


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Where landmarks were found in one image: pixels (N, 2) as imaged, sigma (N,) px, score (N,) correlation in
    [-1, 1], found (N,)."""

    pixels: Array
    sigma: Array
    score: Array
    found: NDArray[np.bool_]


def align(
    templates: Templates,
    images: Pyramid,
    where: Projection,
    start: Array,
    least: float = 0.75,
    coarse: bool = True,
) -> Alignment:
    """Shift each template until it fits.

    start: (N, 2) px as imaged, where to begin. least: the correlation below which a landmark is not found. coarse:
    begin on the half-size image, which reaches twice as far (5 px surely, 8 mostly) and costs as much again.
    """
    shift = np.zeros((len(templates), 2))  # in samples of the template
    if coarse:
        pieces = templates.coarse_picture, templates.coarse_steepest, templates.coarse_inverse_hessian
        _descend(pieces, images[1], where, start, shift, 2.0, 4)
    _descend((templates.picture, templates.steepest, templates.inverse_hessian), images[0], where, start, shift, 1.0, 6)
    return _judge(templates, images[0], where, start, shift, least)


def _descend(
    pieces: tuple[Float32, Float32, Array],
    image: Image,
    where: Projection,
    start: Array,
    shift: Array,
    spacing: float,
    rounds: int,
) -> None:
    """Gauss-Newton on the shifts (N, 2), in place, of those in view; who has arrived is left alone."""
    picture, steepest, inverse = pieces
    busy = np.nonzero(where.visible)[0]
    for _ in range(rounds):
        if not len(busy):
            return
        per_sample = where.per_sample[busy]
        centre = start[busy] + (per_sample @ shift[busy, :, None])[..., 0]
        current, _ = normalise(sample(image, centre, per_sample, spacing, half=spacing > 1))
        gradient = np.matmul(steepest[busy], (current - picture[busy])[..., None])
        step = -(inverse[busy] @ gradient)[..., 0]
        length = np.sqrt((step * step).sum(1))
        shift[busy] += step * (spacing * np.minimum(1.0, 3.0 / np.maximum(length, 1e-9)))[:, None]
        busy = busy[length > 0.03]


def coarse_score(templates: Templates, images: Pyramid, where: Projection, centre: Array) -> Array:
    """Correlation (N,) in [-1, 1] of each template with the half-size image at centres (N, 2) px, without alignment."""
    current, _ = normalise(sample(images[1], centre, where.per_sample, 2.0, half=True))
    return np.asarray((current * templates.coarse_picture).mean(1), float)


def _judge(
    templates: Templates, image: Image, where: Projection, start: Array, shift: Array, least: float
) -> Alignment:
    moved = (where.per_sample @ shift[..., None])[..., 0]
    pixels = start + moved
    current, contrast = normalise(sample(image, pixels, where.per_sample))
    score = (current * templates.picture).mean(1).astype(float)
    noise = 2 * (1 - np.clip(score, -1, 1)) * 2.0  # variance per sample; neighbours share noise, hence the two
    per_pixel = where.per_sample @ templates.inverse_hessian @ np.swapaxes(where.per_sample, 1, 2)
    sigma = np.sqrt(np.maximum(noise * np.trace(per_pixel, axis1=1, axis2=2) / 2, 0.05**2))
    reach = np.linalg.norm(moved, axis=1)
    found = where.visible & (score > least) & (contrast > FLAT) & (reach < 3 * SIDE) & np.isfinite(pixels).all(1)
    return Alignment(pixels, sigma, score, found)
