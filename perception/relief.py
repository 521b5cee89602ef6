"""The surface's relief at the first instant, densely: a height field that begins at the first map's landmarks.

Landmarks are few and their patches flat, so that they miss a wound's walls by tenths of a millimetre. Their smooth
surface is only where dense matching begins; it is matched, corrected and matched again, from coarse to fine.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from perception.features import polygon_mask
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.dense_matching import match_on, middle_camera, node_size
from perception.mapping.first_map import FirstMap

BEGIN = 6.0  # mm over which landmarks are averaged for the first guess: about the distance between them
MARGIN = 3.0  # mm that the lattice reaches beyond the landmarks
LEVELS = (2.0, 2.0, 1.0, 1.0)  # widths of a node, in its finest size
SOFT = 1.2  # nodes over which corrections are averaged: pairs of neighbours share their matches anyway
JUMP = 0.5  # mm: a correction this far from its neighbours' is a wrong match
SPREAD = 6  # nodes from one point given out to the next: half a matched patch, so they share little

Float32 = NDArray[np.float32]


def relief(lenses: Lenses, images: dict[int, Image], first: FirstMap, polygons: dict[int, Array]) -> Array:
    """Points (N, 3) mm, base frame, spread over the surface inside the middle camera's polygon; none without matches.

    images: grey, by camera. polygons: (N, 2) px as imaged, by camera.
    """
    cameras, centre = sorted(images), first.base_from_surface[:3, 3]
    reference = middle_camera(lenses, [c for c in cameras if c in polygons] or cameras, centre)
    finest = node_size(lenses, cameras, centre)
    points = first.map.points
    low, high = np.percentile(points[:, :2], [1, 99], axis=0) + np.array([[-MARGIN], [MARGIN]])
    heights, found, sure = None, np.zeros((0, 0, 3)), np.zeros((0, 0), bool)
    for width in LEVELS:
        flat = _lattice(low, high, width * finest)
        heights = _begin(points, low, high, flat.shape[:2]) if heights is None else _resized(heights, flat.shape[:2])
        nodes = np.dstack([flat, heights.astype(float)])
        matched = match_on(lenses, images, _moved(first.base_from_surface, nodes), reference)
        if matched is None:
            return np.zeros((0, 3))
        found, sure = matched.points, matched.sure
        inner = _moved(se3.inverse(first.base_from_surface), found)
        heights = _corrected(nodes, inner, sure, width * finest)
    sure &= _inside(lenses, reference, found, polygons)
    return np.asarray(found[::SPREAD, ::SPREAD][sure[::SPREAD, ::SPREAD]])


def _lattice(low: Array, high: Array, step: float) -> Array:
    x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y), -1)


def _begin(points: Array, low: Array, high: Array, shape: tuple[int, ...]) -> Float32:
    """Heights on the lattice by a plane through the landmarks (N, 3) around each node, the nearer the more."""
    flat = _lattice(low, high, BEGIN / 2)
    away = points[None, :, :2] - flat.reshape(-1, 1, 2)
    weight = np.exp(-(away**2).sum(2) / (2 * BEGIN**2)) + 1e-6
    design = np.concatenate([np.ones((*away.shape[:2], 1)), away / BEGIN], 2)
    normal = np.einsum("nmi,nm,nmj->nij", design, weight, design, optimize=True) + 1e-4 * np.eye(3)
    right = np.einsum("nmi,nm->ni", design, weight * points[:, 2])
    rough = np.linalg.solve(normal, right[..., None])[:, 0, 0].reshape(flat.shape[:2])
    return _resized(rough.astype(np.float32), shape)


def _resized(heights: Float32, shape: tuple[int, ...]) -> Float32:
    return np.asarray(cv2.resize(heights, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)


def _moved(transform: Array, nodes: Array) -> Array:
    return se3.transform_points(transform, nodes.reshape(-1, 3)).reshape(nodes.shape)


def _corrected(nodes: Array, found: Array, sure: NDArray[np.bool_], step: float) -> Float32:
    """New heights (H, W) from where the nodes (H, W, 3) were found, in the surface frame."""
    heights, off = nodes[..., 2], found - nodes
    down, right = np.gradient(heights, step)
    up = (off[..., 2] - right * off[..., 0] - down * off[..., 1]).astype(np.float32)
    up = np.where(sure, up, 0).astype(np.float32)
    around = np.asarray(cv2.medianBlur(up, 5))
    up = np.where(np.abs(up - around) < JUMP, up, around)
    weight = sure.astype(np.float32) + 1e-6
    mean = cv2.GaussianBlur(up * weight, (0, 0), SOFT) / cv2.GaussianBlur(weight, (0, 0), SOFT)
    return np.asarray(heights + mean, np.float32)


def _inside(lenses: Lenses, camera: int, points: Array, polygons: dict[int, Array]) -> NDArray[np.bool_]:
    """Whether points (H, W, 3) fall into the camera's polygon; without one, all do."""
    if camera not in polygons:
        return np.ones(points.shape[:2], bool)
    lens = lenses.rig.cameras[camera]
    mask = polygon_mask(lens.size, polygons[camera])
    ideal, depth = ideal_pixels(lens, points.reshape(-1, 3))
    x, y = np.clip(np.rint(lenses.image(camera, ideal, depth)[0]), 0, np.array(lens.size) - 1).astype(int).T
    return np.asarray(mask[y, x].reshape(points.shape[:2]) > 0)
