"""Dense matching across cameras: their pictures laid onto one rough surface, and the flow that is left between them.

Cameras stand 36 to 84 degrees apart, but once laid onto a surface that is right to a millimetre their pictures look
alike, and what is left is a shift of a node or two. On the true surface thousands of points were measured to come out
to 0.02 mm (skin) and 0.07 mm (a wet wound) at 0.36 mm a pixel, where flat patches across a wound's wall give 0.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.mapping.triangulation import triangulate
from estimation.rig import ideal_pixels
from estimation.se3 import Array
from perception.frames import Image
from perception.lens import Lenses

PIXELS = 1.1  # of the cameras, a node: a finer lattice shows nothing more
PATCH, STRIDE, ROUNDS = 12, 3, 25  # nodes, nodes and steps of the flow
CONTRAST = 6.0  # nodes over which brightness and contrast are evened out, since glare and light differ by camera
EVEN, FAINT = 40.0, 100.0  # grey levels of contrast once evened out; their square below which it tells nothing
ALIKE = 0.6  # correlation below which a match is not believed
ASIDE = 0.5  # px off the epipolar line, or three times the median, beyond which it is not
FACING = 0.2  # cosine of the viewing angle below which a camera sees too little of a node

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """What a lattice's nodes turned out to be. points: (H, W, 3) mm, base frame; sure: (H, W) whether to believe it."""

    points: Array
    sure: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Laid:
    """One camera's picture on the lattice. even: (H, W) uint8, evened out; pixels: (H, W, 2) ideal; seen: (H, W)."""

    even: Image
    pixels: Array
    seen: NDArray[np.bool_]


def node_size(lenses: Lenses, cameras: list[int], centre: Array) -> float:
    """A good distance, mm, between nodes about `centre` (3,), base frame: what the sharpest camera resolves."""
    sizes = []
    for c in cameras:
        lens = lenses.rig.cameras[c]
        away = float(np.linalg.norm(centre - lens.base_from_camera[:3, 3]))
        sizes.append(PIXELS * away / float(lens.matrix[[0, 1], [0, 1]].mean()))
    return min(sizes)


def match_on(lenses: Lenses, images: dict[int, Image], nodes: Array, reference: int, every: int = 1) -> Matched | None:
    """Where the surface near `nodes` (H, W, 3), base frame, really is; None where no two cameras see any of it.

    Each node's ray in the reference camera is met with those of the other cameras at the places that look like it.
    every: only each so manieth row and column of nodes is given, (H', W', 3).
    """
    towards = _normals(nodes)
    first = _laid(lenses, reference, images[reference], nodes, towards)
    flow = _flow()
    pixels, camera, used = [first.pixels], [reference], [first.seen]
    for c in sorted(set(images) - {reference}):
        other = _laid(lenses, c, images[c], nodes, towards)
        found, alike = _moved(flow, first, other)
        pixels.append(found)
        camera.append(c)
        used.append(first.seen & other.seen & (alike > ALIKE))
    if len(used) < 2:
        return None
    chosen = (slice(None), slice(None, None, every), slice(None, None, every))
    seen, where = np.stack(used)[chosen], np.stack(pixels)[chosen]
    both = np.asarray(seen[1:].any(axis=0), bool)
    return _met(lenses, nodes[chosen[1:]], where, np.array(camera), seen & both, both) if both.any() else None


def middle_camera(lenses: Lenses, cameras: list[int], centre: Array) -> int:
    """The camera that stands nearest to the middle of all, as seen from `centre` (3,), base frame."""
    views = np.stack([lenses.rig.cameras[c].base_from_camera[:3, 3] - centre for c in cameras])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    return cameras[int(np.argmax(views @ views.sum(0)))]


def _met(
    lenses: Lenses,
    nodes: Array,
    pixels: Array,
    camera: NDArray[np.int64],
    used: NDArray[np.bool_],
    both: NDArray[np.bool_],
) -> Matched:
    """The points where rays (K, H, W, 2) meet, K cameras, of those `used` (K, H, W), at nodes seen by `both` (H, W)."""
    number = np.cumsum(both.ravel()).reshape(both.shape) - 1
    which, row, column = np.nonzero(used)
    point = number[row, column]
    found, _, residual = triangulate(
        lenses.rig, point, camera[which], pixels[which, row, column], int(both.sum()), iterations=2
    )
    aside = np.zeros(len(found))
    np.maximum.at(aside, point, np.linalg.norm(residual, axis=1))
    points, sure = nodes.copy(), both.copy()
    points[both] = found
    sure[both] = (aside < max(ASIDE, 3 * float(np.median(aside)))) & np.isfinite(found).all(1)
    return Matched(points, sure)


def _normals(nodes: Array) -> Array:
    down, right = np.gradient(nodes, axis=(0, 1))
    across = np.cross(right, down)
    return np.asarray(across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-12))


def _laid(lenses: Lenses, camera: int, image: Image, nodes: Array, normals: Array) -> _Laid:
    lens = lenses.rig.cameras[camera]
    ideal, depth = ideal_pixels(lens, nodes.reshape(-1, 3))
    imaged, seen = lenses.image(camera, ideal, depth)
    view = lens.base_from_camera[:3, 3] - nodes
    facing = np.abs(np.einsum("hwi,hwi->hw", view, normals)) / np.linalg.norm(view, axis=2)
    inside = seen & ((imaged > 1) & (imaged < np.array(lens.size) - 2)).all(1)
    x, y = imaged.astype(np.float32).reshape(*nodes.shape[:2], 2).transpose(2, 0, 1)
    laid = cv2.remap(image, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_CUBIC)
    shape = nodes.shape[:2]
    return _Laid(_evened(np.asarray(laid)), ideal.reshape(*shape, 2), inside.reshape(shape) & (facing > FACING))


def _evened(image: Image) -> Image:
    grey = image.astype(np.float32)
    centred = grey - cv2.GaussianBlur(grey, (0, 0), CONTRAST)
    spread = np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), CONTRAST))
    return np.asarray(np.clip(np.rint(128 + EVEN * centred / (spread + 2.0)), 0, 255), np.uint8)


def _flow() -> cv2.DISOpticalFlow:
    """Dense inverse search (Kroeger et al. 2016). Patches do not ask their neighbours: with that, results would depend
    on the number of threads."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setPatchSize(PATCH)
    flow.setPatchStride(STRIDE)
    flow.setFinestScale(0)
    flow.setGradientDescentIterations(ROUNDS)
    flow.setVariationalRefinementIterations(0)
    flow.setUseSpatialPropagation(False)
    return flow


def _moved(flow: cv2.DISOpticalFlow, first: _Laid, other: _Laid) -> tuple[Array, Float32]:
    """Ideal pixels (H, W, 2) in the other camera of what the first sees at each node, and how alike they look."""
    still = np.zeros((*first.even.shape, 2), np.float32)
    shift = np.asarray(flow.calc(first.even, other.even, still))
    y, x = np.mgrid[: shift.shape[0], : shift.shape[1]].astype(np.float32)
    x, y = x + shift[..., 0], y + shift[..., 1]
    found = cv2.remap(other.pixels.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there = cv2.remap(other.even, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, float), _likeness(first.even, np.asarray(there))


def _likeness(a: Image, b: Image) -> Float32:
    """Correlation (H, W) of two evened pictures about each node."""
    here, there = a.astype(np.float32) - 128, b.astype(np.float32) - 128

    def mean(product: Float32) -> Float32:
        return np.asarray(cv2.GaussianBlur(product, (0, 0), CONTRAST / 2), np.float32)

    return np.asarray(mean(here * there) / (np.sqrt(mean(here * here) * mean(there * there)) + FAINT), np.float32)
