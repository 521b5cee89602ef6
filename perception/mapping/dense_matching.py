"""Dense matching across cameras on one rough surface, and the surface's depth map at the first instant.

Cameras stand 36 to 84 degrees apart, but once resampled on a surface that is right to a millimetre their pictures look
alike, and what is left is a shift of a node or two. On the true surface thousands of points were measured to come out
to 0.02 mm (skin) and 0.07 mm (a wet wound) at 0.36 mm a pixel, where flat patches across a wound's wall give 0.2.

The depth map is a height field over the first map. Landmarks are few and their patches flat, so they miss a wound's
walls by tenths of a millimetre. Their smooth surface is where dense matching begins; it is then matched and corrected
repeatedly, from coarse to fine.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.triangulation import triangulate
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.first_map import FirstMap
from perception.matching.features import polygon_mask

NODE_PIXELS = 1.1  # of the cameras, a node: a finer lattice shows nothing more
FLOW_PATCH_NODES, FLOW_STRIDE_NODES, FLOW_STEPS = 12, 3, 25  # nodes, nodes and steps of the flow
EVENING_SIGMA_NODES = 6.0  # over which brightness and contrast are evened out: glare and light differ by camera
EVENED_CONTRAST = 40.0  # grey levels
MIN_EVENED_VARIANCE = 100.0  # grey levels squared, below which a correlation tells nothing
MIN_MATCH_CORRELATION = 0.6  # correlation below which a match is not believed
MAX_EPIPOLAR_ERROR_PX = 0.5  # px off the epipolar line, or three times the median, beyond which it is not
MIN_NODE_FACING = 0.2  # cosine of the viewing angle below which a camera sees too little of a node

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class DenseMatch:
    """The surface at the nodes of a lattice."""

    points: Array  # (H, W, 3) mm, base frame
    sure: NDArray[np.bool_]  # (H, W) whether to believe it


@dataclass(frozen=True, slots=True, eq=False)
class _LatticeImage:
    """One camera's picture on the lattice."""

    even: Image  # (H, W) brightness and contrast evened out
    pixels: Array  # (H, W, 2) px, ideal
    visible: NDArray[np.bool_]  # (H, W)


def node_size(lenses: Lenses, cameras: list[int], centre: Array) -> float:
    """A good distance, mm, between nodes about `centre` (3,), base frame: what the sharpest camera resolves."""
    own = [lenses.rig.cameras[c] for c in cameras]
    away = [float(np.linalg.norm(centre - camera.base_from_camera[:3, 3])) for camera in own]
    focal = [float(camera.matrix[[0, 1], [0, 1]].mean()) for camera in own]
    return min(NODE_PIXELS * a / f for a, f in zip(away, focal, strict=True))


def match_near(
    lenses: Lenses, images: dict[int, Image], nodes: Array, reference: int, every: int = 1
) -> DenseMatch | None:
    """Where the surface near `nodes` (H, W, 3), base frame, really is; None where no two cameras see any of it.

    Each node's ray in the reference camera is intersected with those of the other cameras at the places that match.
    every: step in rows and columns between the nodes given, (H', W', 3).
    """
    towards = _normals(nodes)
    first = _lattice_image(lenses, reference, images[reference], nodes, towards)
    flow = _flow()
    pixels, camera, used = [first.pixels], [reference], [first.visible]
    for c in sorted(set(images) - {reference}):
        other = _lattice_image(lenses, c, images[c], nodes, towards)
        matches, correlation = _matched(flow, first, other)
        pixels.append(matches)
        camera.append(c)
        used.append(first.visible & other.visible & (correlation > MIN_MATCH_CORRELATION))
    if len(used) < 2:
        return None
    chosen = (slice(None), slice(None, None, every), slice(None, None, every))
    looks, where = np.stack(used)[chosen], np.stack(pixels)[chosen]
    both = np.asarray(looks[1:].any(axis=0), bool)
    return _triangulated(lenses, nodes[chosen[1:]], where, np.array(camera), looks & both, both) if both.any() else None


def middle_camera(lenses: Lenses, cameras: list[int], centre: Array) -> int:
    """The camera that stands nearest to the middle of all, as seen from `centre` (3,), base frame."""
    views = np.stack([lenses.rig.cameras[c].base_from_camera[:3, 3] - centre for c in cameras])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    return cameras[int(np.argmax(views @ views.sum(0)))]


def _triangulated(
    lenses: Lenses,
    nodes: Array,
    pixels: Array,
    camera: NDArray[np.int64],
    used: NDArray[np.bool_],
    both: NDArray[np.bool_],
) -> DenseMatch:
    """The points where rays (K, H, W, 2) meet, K cameras, of those `used` (K, H, W), at nodes seen by `both` (H, W)."""
    number = np.cumsum(both.ravel()).reshape(both.shape) - 1
    which, row, column = np.nonzero(used)
    point = number[row, column]
    looks = pixels[which, row, column]
    met, _, residual = triangulate(lenses.rig, point, camera[which], looks, int(both.sum()), iterations=2)
    aside = np.zeros(len(met))
    np.maximum.at(aside, point, np.linalg.norm(residual, axis=1))
    points, sure = nodes.copy(), both.copy()
    points[both] = met
    sure[both] = (aside < max(MAX_EPIPOLAR_ERROR_PX, 3 * float(np.median(aside)))) & np.isfinite(met).all(1)
    return DenseMatch(points, sure)


def _normals(nodes: Array) -> Array:
    down, right = np.gradient(nodes, axis=(0, 1))
    across = np.cross(right, down)
    return np.asarray(across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-12))


def _lattice_image(lenses: Lenses, camera: int, image: Image, nodes: Array, normals: Array) -> _LatticeImage:
    lens = lenses.rig.cameras[camera]
    ideal, depth = ideal_pixels(lens, nodes.reshape(-1, 3))
    imaged, in_lens = lenses.image(camera, ideal, depth)
    view = lens.base_from_camera[:3, 3] - nodes
    facing = np.abs(np.einsum("hwi,hwi->hw", view, normals)) / np.linalg.norm(view, axis=2)
    inside = in_lens & ((imaged > 1) & (imaged < np.array(lens.size) - 2)).all(1)
    shape = nodes.shape[:2]
    x, y = imaged.astype(np.float32).reshape(*shape, 2).transpose(2, 0, 1)
    laid = cv2.remap(image, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_CUBIC)
    grey = np.asarray(laid).astype(np.float32)
    centred = grey - cv2.GaussianBlur(grey, (0, 0), EVENING_SIGMA_NODES)
    spread = np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), EVENING_SIGMA_NODES))
    even = np.clip(np.rint(128 + EVENED_CONTRAST * centred / (spread + 2.0)), 0, 255).astype(np.uint8)
    return _LatticeImage(even, ideal.reshape(*shape, 2), inside.reshape(shape) & (facing > MIN_NODE_FACING))


def _flow() -> cv2.DISOpticalFlow:
    """Dense inverse search (Kroeger et al. 2016). Patches do not ask their neighbours: with that, results would depend
    on the number of threads."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setPatchSize(FLOW_PATCH_NODES)
    flow.setPatchStride(FLOW_STRIDE_NODES)
    flow.setFinestScale(0)
    flow.setGradientDescentIterations(FLOW_STEPS)
    flow.setVariationalRefinementIterations(0)
    flow.setUseSpatialPropagation(False)
    return flow


def _matched(flow: cv2.DISOpticalFlow, first: _LatticeImage, other: _LatticeImage) -> tuple[Array, Float32]:
    """Ideal pixels (H, W, 2) in the other camera of what the first sees at each node, and their correlation (H, W)."""
    still = np.zeros((*first.even.shape, 2), np.float32)
    shift = np.asarray(flow.calc(first.even, other.even, still))
    y, x = np.mgrid[: shift.shape[0], : shift.shape[1]].astype(np.float32)
    x, y = x + shift[..., 0], y + shift[..., 1]
    pixels, picture = (
        np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        for values in (other.pixels.astype(np.float32), other.even)
    )
    a, b = first.even.astype(np.float32) - 128, picture.astype(np.float32) - 128
    ab, aa, bb = (cv2.GaussianBlur(product, (0, 0), EVENING_SIGMA_NODES / 2) for product in (a * b, a * a, b * b))
    return pixels.astype(float), np.asarray(ab / (np.sqrt(aa * bb) + MIN_EVENED_VARIANCE), np.float32)


GUESS_SIGMA_MM = 6.0  # mm over which landmarks are averaged for the first guess: about the distance between them
LATTICE_MARGIN_MM = 3.0  # mm that the lattice reaches beyond the landmarks
NODE_WIDTHS = (2.0, 2.0, 1.0, 1.0)  # widths of a node, in its finest size
CORRECTION_SIGMA_NODES = 1.2  # over which corrections are averaged: neighbours share their matches anyway
MAX_JUMP_MM = 0.5  # mm: a correction this far from its neighbours' is a wrong match
POINT_SPACING_NODES = 6  # nodes from one point given out to the next: half a matched patch, so they share little


def relief_points(lenses: Lenses, images: dict[int, Image], first: FirstMap, polygons: dict[int, Array]) -> Array:
    """Points (N, 3) mm, base frame, spread over the surface inside the middle camera's polygon; none without matches.

    images: grey, by camera. polygons: (N, 2) px as imaged, by camera.
    """
    cameras, centre = sorted(images), first.base_from_surface[:3, 3]
    reference = middle_camera(lenses, [c for c in cameras if c in polygons] or cameras, centre)
    finest = node_size(lenses, cameras, centre)
    points = first.map.points
    low, high = np.percentile(points[:, :2], [1, 99], axis=0) + np.array([[-LATTICE_MARGIN_MM], [LATTICE_MARGIN_MM]])
    heights, relief, sure = _initial_heights(points, low, high), np.zeros((0, 0, 3)), np.zeros((0, 0), bool)
    for width in NODE_WIDTHS:
        flat = _lattice(low, high, width * finest)
        size = flat.shape[1], flat.shape[0]
        resized = np.asarray(cv2.resize(heights, size, interpolation=cv2.INTER_CUBIC), np.float32)
        nodes = np.dstack([flat, resized.astype(float)])
        match = match_near(lenses, images, _transformed(first.base_from_surface, nodes), reference)
        if match is None:
            return np.zeros((0, 3))
        relief, sure = match.points, match.sure
        inner = _transformed(se3.inverse(first.base_from_surface), relief)
        heights = _corrected(nodes, inner, sure, width * finest)
    sure &= _inside(lenses, reference, relief, polygons)
    every = slice(None, None, POINT_SPACING_NODES)
    return np.asarray(relief[every, every][sure[every, every]])


def _lattice(low: Array, high: Array, step: float) -> Array:
    x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y), -1)


def _initial_heights(points: Array, low: Array, high: Array) -> Float32:
    """Heights on a coarse lattice by a plane through the landmarks (N, 3) around each node, the nearer the more."""
    flat = _lattice(low, high, GUESS_SIGMA_MM / 2)
    away = points[None, :, :2] - flat.reshape(-1, 1, 2)
    weight = np.exp(-(away**2).sum(2) / (2 * GUESS_SIGMA_MM**2)) + 1e-6
    design = np.concatenate([np.ones((*away.shape[:2], 1)), away / GUESS_SIGMA_MM], 2)
    normal = np.einsum("nmi,nm,nmj->nij", design, weight, design, optimize=True) + 1e-4 * np.eye(3)
    right = np.einsum("nmi,nm->ni", design, weight * points[:, 2])
    return np.linalg.solve(normal, right[..., None])[:, 0, 0].reshape(flat.shape[:2]).astype(np.float32)


def _transformed(transform: Array, nodes: Array) -> Array:
    return se3.transform_points(transform, nodes.reshape(-1, 3)).reshape(nodes.shape)


def _corrected(nodes: Array, matches: Array, sure: NDArray[np.bool_], step: float) -> Float32:
    """New heights (H, W) from the points (H, W, 3) matched at the nodes (H, W, 3), in the surface frame."""
    heights, off = nodes[..., 2], matches - nodes
    down, right = np.gradient(heights, step)
    up = (off[..., 2] - right * off[..., 0] - down * off[..., 1]).astype(np.float32)
    up = np.where(sure, up, 0).astype(np.float32)
    around = np.asarray(cv2.medianBlur(up, 5))
    up = np.where(np.abs(up - around) < MAX_JUMP_MM, up, around)
    weight = sure.astype(np.float32) + 1e-6
    total, weights = (cv2.GaussianBlur(values, (0, 0), CORRECTION_SIGMA_NODES) for values in (up * weight, weight))
    return np.asarray(heights + total / weights, np.float32)


def _inside(lenses: Lenses, camera: int, points: Array, polygons: dict[int, Array]) -> NDArray[np.bool_]:
    """Whether points (H, W, 3) fall into the camera's polygon; without one, all do."""
    if camera not in polygons:
        return np.ones(points.shape[:2], bool)
    lens = lenses.rig.cameras[camera]
    mask = polygon_mask(lens.size, polygons[camera])
    ideal, depth = ideal_pixels(lens, points.reshape(-1, 3))
    x, y = np.clip(np.rint(lenses.image(camera, ideal, depth)[0]), 0, np.array(lens.size) - 1).astype(int).T
    return np.asarray(mask[y, x].reshape(points.shape[:2]) > 0)
