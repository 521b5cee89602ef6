"""Registration of a scan to pictures, and the landmarks on it.

First the scan is registered to the surface's depth map. Then the pictures are matched densely on the scan itself: a
pose error shifts them against each other by the change of the scan's relief along it. That needs no estimate of the
relief, so the last steps are free of the error of flat patches on a wound's walls.

Dense matching: cameras stand 36 to 84 degrees apart, but resampled on a surface that is right to a millimetre pictures
look alike, and a shift of a node or two is left. On the true surface thousands of points came out to 0.02 mm (skin) and
0.07 mm (a wet wound) at 0.36 mm a pixel, where flat patches across a wound's wall give 0.2.

The depth map is a height field over the first map: matching begins at the landmarks' smooth surface, which misses a
wound's walls by tenths of a millimetre, and corrects it from coarse to fine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.mapping.bundle_adjustment import FREE_SIGMA_MM, Anchors, rigid_motion_covariance
from estimation.mapping.triangulation import triangulate
from estimation.rig import Rig, ideal_pixels
from estimation.scans.registration import Registration, register, register_near, resolve_ambiguity
from estimation.scans.scan import Scan, ScanIndex, cast_rays, intersection_jacobians
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import Image
from perception.lens import Lenses
from perception.mapping.features import polygon_mask
from perception.mapping.first_map import FirstMap

NODE_PIXELS = 1.1  # of the cameras, a node: a finer lattice adds nothing
FLOW_PATCH_NODES, FLOW_STRIDE_NODES, FLOW_STEPS = 12, 3, 25  # nodes, nodes and steps of the flow
EVENING_SIGMA_NODES = 6.0  # over which brightness and contrast are normalised: glare and light differ by camera
EVENED_CONTRAST = 40.0  # grey levels
MIN_EVENED_VARIANCE = 100.0  # grey levels squared: regularises the correlation
MIN_MATCH_CORRELATION = 0.6  # correlation, from which a match is used
MAX_EPIPOLAR_ERROR_PX = 0.5  # px from the epipolar line, or three times the median if larger
MIN_NODE_FACING = 0.2  # cosine of the viewing angle below which a camera sees too little of a node

Float32 = NDArray[np.float32]
Picture = Image | Float32  # (H, W) one channel


@dataclass(frozen=True, slots=True, eq=False)
class DenseMatch:
    """The surface at the nodes of a lattice."""

    points: Array  # (H, W, 3) mm, base frame
    sure: NDArray[np.bool_]  # (H, W) whether the match is reliable


@dataclass(frozen=True, slots=True, eq=False)
class LatticeImage:
    """One camera's picture on the lattice."""

    even: Image  # (H, W) of normalised brightness and contrast
    pixels: Array  # (H, W, 2) px, ideal
    visible: NDArray[np.bool_]  # (H, W)


def node_size(lenses: Lenses, cameras: list[int], centre: Array) -> float:
    """Distance, mm, between nodes about `centre` (3,), base frame: the resolution of the sharpest camera."""
    rig_cameras = [lenses.rig.cameras[c] for c in cameras]
    distance = [float(np.linalg.norm(centre - camera.base_from_camera[:3, 3])) for camera in rig_cameras]
    focal = [float(camera.matrix[[0, 1], [0, 1]].mean()) for camera in rig_cameras]
    return min(NODE_PIXELS * a / f for a, f in zip(distance, focal, strict=True))


def match_near(
    lenses: Lenses, images: Mapping[int, Picture], nodes: Array, reference: int, stride: int = 1
) -> DenseMatch | None:
    """Where the surface near `nodes` (H, W, 3), base frame, is; None where no two cameras see any of it.

    None also for too few nodes for the flow, as for a small surface in pictures of few pixels.
    Each node's ray in the reference camera is intersected with the rays of matching pixels in the other cameras.
    stride: step in rows and columns between the nodes of the result, (H', W', 3).
    """
    if min(nodes.shape[:2]) <= FLOW_PATCH_NODES:
        return None
    normals = lattice_normals(nodes)
    first = lattice_image(lenses, reference, images[reference], nodes, normals)
    flow = _flow()
    pixels, camera, masks = [first.pixels], [reference], [first.visible]
    for c in sorted(set(images) - {reference}):
        other = lattice_image(lenses, c, images[c], nodes, normals)
        matches, correlation = _match_images(flow, first, other)
        pixels.append(matches)
        camera.append(c)
        masks.append(first.visible & other.visible & (correlation > MIN_MATCH_CORRELATION))
    if len(masks) < 2:
        return None
    part = (slice(None), slice(None, None, stride), slice(None, None, stride))
    mask, where = np.stack(masks)[part], np.stack(pixels)[part]
    valid = np.asarray(mask[1:].any(axis=0), bool)
    return _triangulate(lenses, nodes[part[1:]], where, np.array(camera), mask & valid, valid) if valid.any() else None


def middle_camera(lenses: Lenses, cameras: list[int], centre: Array) -> int:
    """The camera that stands nearest to the middle of all, as seen from `centre` (3,), base frame."""
    views = np.stack([lenses.rig.cameras[c].base_from_camera[:3, 3] - centre for c in cameras])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    return cameras[int(np.argmax(views @ views.sum(0)))]


def _triangulate(
    lenses: Lenses,
    nodes: Array,
    pixels: Array,
    camera: NDArray[np.int64],
    mask: NDArray[np.bool_],
    shared: NDArray[np.bool_],
) -> DenseMatch:
    """Triangulated points of pixels (K, H, W, 2) of K cameras where `mask` (K, H, W), at `shared` nodes (H, W)."""
    number = np.cumsum(shared.ravel()).reshape(shared.shape) - 1
    which, row, column = np.nonzero(mask)
    point, looks = number[row, column], pixels[which, row, column]
    intersections, _, residual = triangulate(lenses.rig, point, camera[which], looks, int(shared.sum()), iterations=2)
    error = np.zeros(len(intersections))
    np.maximum.at(error, point, np.linalg.norm(residual, axis=1))
    points, sure = nodes.copy(), shared.copy()
    points[shared] = intersections
    sure[shared] = (error < max(MAX_EPIPOLAR_ERROR_PX, 3 * float(np.median(error)))) & np.isfinite(intersections).all(1)
    return DenseMatch(points, sure)


def lattice_normals(nodes: Array) -> Array:
    """Unit normals (H, W, 3) of the surface through nodes (H, W, 3)."""
    down, right = np.gradient(nodes, axis=(0, 1))
    normals = np.cross(right, down)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12))


def lattice_image(
    lenses: Lenses, camera: int, image: Picture, nodes: Array, normals: Array, evening: float = EVENING_SIGMA_NODES
) -> LatticeImage:
    """A picture resampled at nodes (H, W, 3), base frame, with normals; normalised over `evening` nodes."""
    lens = lenses.rig.cameras[camera]
    ideal, depth = ideal_pixels(lens, nodes.reshape(-1, 3))
    imaged, in_lens = lenses.image(camera, ideal, depth)
    view = lens.base_from_camera[:3, 3] - nodes
    facing = np.abs(np.einsum("hwi,hwi->hw", view, normals)) / np.linalg.norm(view, axis=2)
    inside = in_lens & ((imaged > 1) & (imaged < np.array(lens.size) - 2)).all(1)
    shape = nodes.shape[:2]
    x, y = np.ascontiguousarray(imaged.astype(np.float32).reshape(*shape, 2).transpose(2, 0, 1))
    grey = np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC)).astype(np.float32)
    centred = grey - cv2.GaussianBlur(grey, (0, 0), evening)
    spread = np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), evening))
    even = np.clip(np.rint(128 + EVENED_CONTRAST * centred / (spread + 2.0)), 0, 255).astype(np.uint8)
    return LatticeImage(even, ideal.reshape(*shape, 2), inside.reshape(shape) & (facing > MIN_NODE_FACING))


def _flow() -> cv2.DISOpticalFlow:
    """Dense inverse search (Kroeger et al. 2016); no spatial propagation, whose results depend on threads."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setPatchSize(FLOW_PATCH_NODES)
    flow.setPatchStride(FLOW_STRIDE_NODES)
    flow.setFinestScale(0)
    flow.setGradientDescentIterations(FLOW_STEPS)
    flow.setVariationalRefinementIterations(0)
    flow.setUseSpatialPropagation(False)
    return flow


def _match_images(flow: cv2.DISOpticalFlow, first: LatticeImage, other: LatticeImage) -> tuple[Array, Float32]:
    """Ideal pixels (H, W, 2) in the other camera that match the first at each node, and their correlation (H, W)."""
    zero_flow = np.zeros((*first.even.shape, 2), np.float32)
    shift = np.asarray(flow.calc(first.even, other.even, zero_flow))
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
CORRECTION_SIGMA_NODES = 1.2  # over which corrections are averaged: neighbours share their matches
MAX_JUMP_MM = 0.5  # mm: a correction this far from its neighbours' is a wrong match
POINT_STEP_NODES = 6  # nodes between points of the result: half a matched patch, so they share little


def relief_points(
    lenses: Lenses, images: dict[int, Image], first: FirstMap, polygons: dict[int, Array], step: int = POINT_STEP_NODES
) -> Array:
    """Points (N, 3) mm, base frame, spread over the surface inside the middle camera's polygon; none without matches.

    images: grey, by camera. polygons: (N, 2) px as imaged, by camera. step: nodes from a point to the next.
    """
    cameras, centre = sorted(images), first.base_from_surface[:3, 3]
    reference = middle_camera(lenses, [c for c in cameras if c in polygons] or cameras, centre)
    finest = node_size(lenses, cameras, centre)
    points = first.map.points
    low, high = np.percentile(points[:, :2], [1, 99], axis=0) + np.array([[-LATTICE_MARGIN_MM], [LATTICE_MARGIN_MM]])
    heights, relief, sure = initial_heights(points, low, high), np.zeros((0, 0, 3)), np.zeros((0, 0), bool)
    for width in NODE_WIDTHS:
        flat = lattice_nodes(low, high, width * finest)
        resized = np.asarray(cv2.resize(heights, flat.shape[1::-1], interpolation=cv2.INTER_CUBIC), np.float32)
        nodes = np.dstack([flat, resized.astype(float)])
        match = match_near(lenses, images, transformed_nodes(first.base_from_surface, nodes), reference)
        if match is None:
            continue
        relief, sure = match.points, match.sure
        inner = transformed_nodes(se3.inverse(first.base_from_surface), relief)
        heights = corrected_heights(nodes, inner, sure, width * finest)
    sure &= _inside(lenses, reference, relief, polygons)
    return np.asarray(relief[::step, ::step][sure[::step, ::step]])


def lattice_nodes(low: Array, high: Array, step: float) -> Array:
    """x and y (H, W, 2), mm, of nodes `step` apart from `low` to at least `high` (2,)."""
    x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(x, y), -1)


def initial_heights(points: Array, low: Array, high: Array) -> Float32:
    """Heights on a coarse lattice by a plane through the landmarks (N, 3) around each node, the nearer the more."""
    flat = lattice_nodes(low, high, GUESS_SIGMA_MM / 2)
    offsets = points[None, :, :2] - flat.reshape(-1, 1, 2)
    weight = np.exp(-(offsets**2).sum(2) / (2 * GUESS_SIGMA_MM**2)) + 1e-6
    design = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets / GUESS_SIGMA_MM], 2)
    normal = np.einsum("nmi,nm,nmj->nij", design, weight, design, optimize=True) + 1e-4 * np.eye(3)
    right = np.einsum("nmi,nm->ni", design, weight * points[:, 2])
    return np.linalg.solve(normal, right[..., None])[:, 0, 0].reshape(flat.shape[:2]).astype(np.float32)


def transformed_nodes(transform: Array, nodes: Array) -> Array:
    """Nodes (H, W, 3) in another frame, by a transform (4, 4)."""
    return se3.transform_points(transform, nodes.reshape(-1, 3)).reshape(nodes.shape)


def corrected_heights(nodes: Array, matches: Array, sure: NDArray[np.bool_], step: float) -> Float32:
    """New heights (H, W) from the points (H, W, 3) matched at the nodes (H, W, 3), in the surface frame."""
    heights, offset = nodes[..., 2], matches - nodes
    down, right = np.gradient(heights, step)
    up = np.where(sure, offset[..., 2] - right * offset[..., 0] - down * offset[..., 1], 0).astype(np.float32)
    median = np.asarray(cv2.medianBlur(up, 5))
    up = np.where(np.abs(up - median) < MAX_JUMP_MM, up, median)
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


RELIEF_SIGMA_MM = 0.1  # mm: of matched relief across the surface; no handheld scan is better
SEARCH_POINTS = 400  # points for the search: more take longer with the same result
MATCH_SIGMA_MM = 0.03  # mm, of points matched on the scan itself
MATCH_SPACING_NODES = 6  # nodes between points used: half a matched patch, so neighbours share half their error,
SHARED_ERROR_FACTOR = 2.5  # and their errors another part, as measured: each is worth a sixth of an independent one
REFINEMENT_ROUNDS = 4  # of matching and registration: measured changes 0.01 mm in the third, 0.002 in the fourth
SCAN_MARGIN_MM = 2.0  # mm around the measured part
# mm rms on the scan: 0.04 on the right one, 0.19 on another; the lower limit where the relief did not fit at first
MAX_FIT_RMS_MM, EXACT_FIT_RMS_MM = 0.15, 0.06


class ScanPlacing:
    """Registers one scan to pictures."""

    def __init__(self, scan: Scan) -> None:
        self.scan, self._index = scan, ScanIndex(scan)
        self._nodes = np.zeros((0, 0, 3))

    def search(
        self, lenses: Lenses, images: dict[int, Image], first: FirstMap, polygons: dict[int, Array]
    ) -> Registration:
        """Pose of the scan from pictures (grey, by camera) of one instant, without a start.

        polygons: (N, 2) px as imaged, by camera: the part of the surface that is matched with the scan.
        """
        points = relief_points(lenses, images, first, polygons)
        if not len(points):
            points = se3.transform_points(first.base_from_surface, first.map.points)
        outward = first.base_from_surface[:3, 2]
        place = register(points[:: max(1, len(points) // SEARCH_POINTS)], RELIEF_SIGMA_MM, self.scan, outward)
        self._nodes = self._lattice(lenses, sorted(images), points, outward, place.base_from_surface)
        return self.refine(lenses, images, place)

    def refine(self, lenses: Lenses, images: dict[int, Image], near: Registration) -> Registration:
        """A pose known to a millimetre, refined by pictures of one instant; if ambiguous, its rival as well."""
        best = self._settle(lenses, images, near)
        if near.rival is None:
            return best
        other = self._settle(lenses, images, replace(near, base_from_surface=near.rival, rival=None))
        return resolve_ambiguity(near, best, other, self._nodes[np.isfinite(self._nodes[..., 0])])

    def _settle(self, lenses: Lenses, images: dict[int, Image], near: Registration) -> Registration:
        """Matched on the scan at its pose and registered again, REFINEMENT_ROUNDS times."""
        place, on_scan = near, np.isfinite(self._nodes[..., 0])
        for _ in range(REFINEMENT_ROUNDS):
            pose = place.base_from_surface
            nodes = se3.transform_points(pose, np.nan_to_num(self._nodes).reshape(-1, 3)).reshape(self._nodes.shape)
            reference = middle_camera(lenses, sorted(images), nodes[on_scan].mean(0)) if on_scan.any() else 0
            match = match_near(lenses, images, nodes, reference, MATCH_SPACING_NODES) if on_scan.any() else None
            if match is None:
                reason = f"{near.verdict}; no two cameras see the scan there"
                return replace(near, sure=False, fits=False, verdict=reason)
            sure = match.sure & on_scan[::MATCH_SPACING_NODES, ::MATCH_SPACING_NODES]
            place = register_near(match.points[sure], MATCH_SIGMA_MM, SHARED_ERROR_FACTOR, self._index, pose)
        if place.rms > MAX_FIT_RMS_MM:
            reason = f"poor fit: {place.rms:.3g} mm rms on the scan, {MAX_FIT_RMS_MM:g} mm at most. {place.verdict}"
            return replace(place, sure=False, fits=False, verdict=reason)
        if place.sure and not near.sure and place.rms > EXACT_FIT_RMS_MM:
            reason = f"doubtful: {place.rms:.3g} mm rms on the scan, as the relief did not fit it. {place.verdict}"
            return replace(place, sure=False, verdict=reason)
        return place

    def _lattice(self, lenses: Lenses, cameras: list[int], points: Array, outward: Array, pose: Array) -> Array:
        """Nodes (H, W, 3), surface frame, on the part of the scan under points (N, 3), base frame; NaN beside it."""
        surface_from_base = se3.inverse(pose)
        z = surface_from_base[:3, :3] @ outward
        x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
        x /= np.linalg.norm(x)
        turn = np.column_stack([x, np.cross(z, x), z])
        inner = se3.transform_points(surface_from_base, points)
        surface_from_plane = se3.make(turn, inner.mean(0))
        flat = se3.transform_points(se3.inverse(surface_from_plane), inner)[:, :2]
        step = node_size(lenses, cameras, points.mean(0))
        low, high = flat.min(0) - SCAN_MARGIN_MM, flat.max(0) + SCAN_MARGIN_MM
        lines = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        lattice = np.stack(np.meshgrid(*lines), -1)
        size = float(np.ptp(self.scan.vertices, axis=0).max())
        above = np.concatenate([lattice, np.full((*lattice.shape[:2], 1), size)], -1).reshape(-1, 3)
        above = se3.transform_points(surface_from_plane, above)
        return cast_rays(self.scan, above, np.broadcast_to(-z, above.shape)).points.reshape(*lattice.shape[:2], 3)


def as_at_one_instant(rig: Rig, pose: Array, single: dict[int, Array]) -> Rig:
    """The rig relative to a surface at `pose` (4, 4), where each camera saw it at its own pose `single[c]`.

    Cameras that are not exposed together see a moving surface at different poses; each is moved by the difference, so
    that all see the same one.
    """
    poses = [pose @ se3.inverse(single.get(c, pose)) @ lens.base_from_camera for c, lens in enumerate(rig.cameras)]
    return Rig(tuple(replace(lens, base_from_camera=m) for lens, m in zip(rig.cameras, poses, strict=True)))


REFERENCE_SIGMA_PX = 0.2  # px, of a landmark's place in its reference picture
MIN_SCAN_SIGMA_MM = 0.03  # mm across the surface: no scan and no match is better
MAX_SCAN_DISTANCE_SIGMAS = 5.0  # of landmark and scan; beyond, it is not on the scan: a drape, a hair, an error


def landmarks_on_scan(
    surface_map: SurfaceMap, camera: NDArray[np.int64], lenses: Lenses, scan: Scan, place: Registration
) -> tuple[SurfaceMap, Anchors]:
    """The map with its landmarks on the scan, and their anchors to it.

    surface_map: in the scan's frame. camera: (N,) of each landmark's reference picture. place: pose of the scan for the
    cameras of `lenses`. Depth error is the scan's, lateral error the pixel's; the pose's covariance is common to all;
    it is left out where the pose is ambiguous, as it does not describe that error.
    """
    points, normals = surface_map.points.copy(), surface_map.normals.copy()
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(len(points), 3, len(points), 3)).copy()
    across = max(place.rms, MIN_SCAN_SIGMA_MM)
    frame = place.covariance if place.sure else np.zeros((6, 6))
    sigma = np.full(len(points), FREE_SIGMA_MM)
    for c in np.unique(camera):
        rows = np.flatnonzero(camera == c)
        lens = lenses.rig.cameras[c]
        surface_from_camera = se3.inverse(place.base_from_surface) @ lens.base_from_camera
        inner = se3.transform_points(se3.inverse(surface_from_camera), points[rows])
        hits = cast_rays(scan, surface_from_camera[:3, 3], inner @ surface_from_camera[:3, :3].T)
        height = np.einsum("ni,ni->n", hits.points - points[rows], hits.normals)
        variance = np.einsum("ni,nij,nj->n", hits.normals, blocks[rows], hits.normals)
        near = hits.hit & (np.abs(height) < MAX_SCAN_DISTANCE_SIGMAS * np.sqrt(variance + across**2))
        rows, rays = rows[near], inner[near] @ surface_from_camera[:3, :3].T
        points[rows], normals[rows], sigma[rows] = hits.points[near], hits.normals[near], across
        angle = REFERENCE_SIGMA_PX / float(lens.matrix[0, 0])
        blocks[rows] = _intersection_covariances(rays, hits.normals[near], across, angle)
    covariance = np.zeros((len(points), 3, len(points), 3))
    covariance[np.arange(len(points)), :, np.arange(len(points))] = blocks
    joint = covariance.reshape(3 * len(points), -1) + rigid_motion_covariance(points, frame)
    return SurfaceMap(points, normals, joint), Anchors(points, normals, sigma, frame)


def _intersection_covariances(rays: Array, normals: Array, across: float, angle: float) -> Array:
    """Covariances (N, 3, 3) mm^2 of where rays (N, 3), from the camera, each known to `angle` rad, meet planes with
    `normals` (N, 3), each known to `across` mm."""
    shift, depth = intersection_jacobians(rays, normals)
    sideways = (np.linalg.norm(rays, axis=1) * angle)[:, None, None] ** 2 * shift @ np.swapaxes(shift, 1, 2)
    return np.asarray(sideways + across**2 * depth[:, :, None] * depth[:, None])
