"""Small textured tiles of the surface: what each looks like, and where it falls in a camera.

Each landmark keeps the picture of a small square of the surface's tangent plane, taken once from its reference image.
In a later image the square is projected with the predicted pose; perception.alignment shifts it until the picture fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.runtime import NEW
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses
from perception.matching.alignment_kernels import RADIUS, SIDE, Float32, look

FLAT = 3.0  # grey levels: a patch with less contrast is not worth a track


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


def pyramid(image: Image) -> Pyramid:
    """The image and its half-size version, as alignment takes them."""
    return Pyramid(image)


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


def sample(image: Image, centre: Array, per_sample: Array, spacing: float = 1.0, half: bool = False) -> Float32:
    """Grey levels (N, S) of the grid laid at centres (N, 2) px with per_sample (N, 2, 2) px a step.

    spacing: steps from sample to sample. half: the image is the half-size one of `pyramid`. Bilinear; outside the image
    the border's value.
    """
    scale = (0.5 if half else 1.0) * spacing
    steps = np.require(per_sample, float, NEW)
    return np.asarray(look(image, on_level(centre, half), steps, scale), np.float32)


def on_level(centre: Array, half: bool) -> Array:
    """Centres (N, 2) px of an image in the pixels of the image or of its half-size version."""
    # A quarter pixel beside the half-size grid bilinear sampling blurs the image, which widens the reach: on the grid
    # tests/test_patches.py finds fewer from 5 px away. Templates are cut alike, so what is compared is not shifted.
    return centre * 0.5 - 0.25 if half else np.require(centre, float, NEW)


def normalise(pictures: Float32) -> tuple[Float32, Float32]:
    """Pictures (N, S) freed of mean and contrast, and the contrast (N,), grey levels (standard deviation)."""
    centred = pictures - pictures.mean(1, keepdims=True)
    contrast = np.sqrt(np.square(centred).mean(1))
    return centred / np.maximum(contrast, 1e-3)[:, None], contrast


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where squares fall in one camera, or in several one after the other.

    centre: (N, 2) px as imaged. per_sample: (N, 2, 2) px. visible: (N,). facing: (N,) cosine of the viewing angle.
    """

    centre: Array
    per_sample: Array
    visible: NDArray[np.bool_]
    facing: Array

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
    """Project the squares into several cameras, each with its own base_from_surface (C, 4, 4).

    Row c N + i of the answer is square i in cameras[c].
    """
    which = np.asarray(cameras, np.int64)
    camera_from_surface = lenses.rig.camera_from_base[which] @ base_from_surface
    count, step = len(which), 2.0  # samples: wide enough that the difference is the patch's own scale, not rounding
    corners = np.stack([points, points + step * axes[:, :, 0], points + step * axes[:, :, 1]]).reshape(-1, 3)
    in_camera = camera_from_surface[:, :3, :3] @ corners.T + camera_from_surface[:, :3, 3:]  # (C, 3, 3N)
    x, y, depth = in_camera.reshape(count, 3, 3, -1).swapaxes(0, 1)  # each (C, 3, N)
    inverse_depth = 1 / np.where(np.abs(depth) < 1e-6, 1e-6, depth)
    imaged, seen = lenses.bend(which[:, None, None], x * inverse_depth, y * inverse_depth, depth)  # (2, C, 3, N)
    per_sample = (imaged[:, :, 1:] - imaged[:, :, :1]) / step  # (2, C, 2, N)
    turned = camera_from_surface[:, :3, :3] @ normals.T  # (C, 3, N)
    from_eye = in_camera[:, :, : len(points)]
    facing = -(turned * from_eye).sum(1) / np.maximum(np.sqrt((from_eye * from_eye).sum(1)), 1e-9)
    reach = RADIUS * np.abs(per_sample).sum(2) + 2
    centre = imaged[:, :, 0]
    limit = lenses.sizes[which].T[..., None] - 1 - reach
    visible = seen.all(1) & ((centre >= reach) & (centre < limit)).all(0) & (facing > 0.15)
    return Projection(
        np.ascontiguousarray(centre.reshape(2, -1).T),
        np.ascontiguousarray(per_sample.transpose(1, 3, 0, 2).reshape(-1, 2, 2)),
        visible.ravel(),
        facing.ravel(),
    )


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
