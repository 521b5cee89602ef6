"""Triangulation of landmarks from several cameras, their update by later observations, and landmarks of one camera.

A landmark of one camera has no depth of its own: it is the intersection of its ray with a local fit to the landmarks
around. Their heights over their mean plane are a polynomial of fourth order (moving least squares; Levin 1998) with a
prior on its coefficients from the curvature of bodies (Bayesian linear regression; Bishop 2006, 3.3). Between the
points their scatter gives the height's uncertainty, beyond them the prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose_solver import project
from estimation.rig import Rig
from estimation.scans.scan import intersection_jacobians
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap, local_normals, surface_frame

MIN_MAP_LANDMARKS = 3  # landmarks: a plane's points, and no fewer span a frame
MAX_RESIDUAL_SIGMAS = 4.0  # RMS over the sightings of a landmark: beyond, one of them is an outlier
MAX_INNOVATION_CHI2 = 16.0  # two degrees of freedom: beyond, an outlier; one in three thousand by chance


def rays(rig: Rig, camera: Index, pixels: Array) -> tuple[Array, Array]:
    """Origins (N, 3) and unit directions (N, 3), base frame, of undistorted pixels (N, 2), each in its camera (N,)."""
    matrices = rig.matrices[camera]
    x = (pixels[:, 0] - matrices[:, 0, 2]) / matrices[:, 0, 0]
    y = (pixels[:, 1] - matrices[:, 1, 2]) / matrices[:, 1, 1]
    poses = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    directions = np.einsum("nij,nj->ni", poses[:, :3, :3], np.stack([x, y, np.ones_like(x)], -1))
    return poses[:, :3, 3], directions / np.linalg.norm(directions, axis=1, keepdims=True)


def triangulate(
    rig: Rig, point: Index, camera: Index, pixels: Array, count: int, iterations: int = 6
) -> tuple[Array, Array, Array]:
    """Points (count, 3) in the base frame, covariances (count, 3, 3) at 1 px, residuals (M, 2) px.

    point: (M,) number of the point of each sighting; each point needs two cameras or more.
    camera: (M,) number in the rig. pixels: (M, 2) undistorted px.

    Start: the nearest point to the rays in least squares; then Gauss-Newton on pixels.
    """
    origins, directions = rays(rig, camera, pixels)
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    normal = _summed(point, across, count)
    right = _summed(point, np.einsum("mij,mj->mi", across, origins), count)
    ridge = 1e-12 * np.eye(3)
    points = np.asarray(np.linalg.solve(normal + ridge, right[..., None])[..., 0], float)
    identity = np.eye(4)
    for _ in range(iterations):
        predicted, _, jacobian = project(rig, camera, identity, points[point])
        jacobian = jacobian[:, :, 3:]
        residual = predicted - pixels
        normal = _summed(point, np.swapaxes(jacobian, 1, 2) @ jacobian, count)
        right = _summed(point, np.einsum("mki,mk->mi", jacobian, residual), count)
        points = np.asarray(points - np.linalg.solve(normal + ridge, right[..., None])[..., 0], float)
    residual = project(rig, camera, identity, points[point])[0] - pixels
    return points, np.asarray(np.linalg.inv(normal + ridge), float), residual


def _summed(point: Index, values: Array, count: int) -> Array:
    """Sums (count, ...) of values (M, ...) by the point (M,) of each."""
    size = int(np.prod(values.shape[1:]))
    each = (point[:, None] * size + np.arange(size)).ravel()  # half of what np.add.at takes
    return np.asarray(np.bincount(each, values.ravel(), count * size).reshape(count, *values.shape[1:]))


def epipolar_distance(rig: Rig, a: int, b: int, pixels_a: Array, pixels_b: Array) -> Array:
    """Signed distance (N,), px in camera b, of pixels_b (N, 2) from the epipolar lines of pixels_a (N, 2)."""
    b_from_a = rig.camera_from_base[b] @ rig.cameras[a].base_from_camera
    essential = se3.hat(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    fundamental = np.linalg.inv(rig.matrices[b]).T @ essential @ np.linalg.inv(rig.matrices[a])
    lines = np.c_[pixels_a, np.ones(len(pixels_a))] @ fundamental.T
    return np.asarray((np.c_[pixels_b, np.ones(len(pixels_b))] * lines).sum(1) / np.hypot(lines[:, 0], lines[:, 1]))


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedMap:
    """A map from one frame set."""

    map: SurfaceMap
    base_from_surface: Array  # (4, 4), which defines the surface frame
    tracks: Index  # (N,) id of each landmark among the observations


def triangulated_map(rig: Rig, observations: Observations) -> TriangulatedMap:
    """The map of landmarks on which two cameras or more agree; its frame is in their middle, z out of the surface.

    InputError with fewer than MIN_MAP_LANDMARKS, which define no frame.
    """
    _, point, count = np.unique(observations.track, return_inverse=True, return_counts=True)
    several = count[point] > 1
    allowed = f"{MIN_MAP_LANDMARKS} or more that two cameras see alike"
    if int((count > 1).sum()) < MIN_MAP_LANDMARKS:
        raise InputError("observations", "landmarks", int((count > 1).sum()), allowed)
    ids, point = np.unique(observations.track[several], return_inverse=True)
    camera, pixels, sigma = observations.camera[several], observations.pixels[several], observations.sigma[several]
    points, covariance, residual = triangulate(rig, point, camera, pixels, len(ids))
    off = np.bincount(point, ((residual / sigma[:, None]) ** 2).sum(1)) / np.bincount(point) / 2
    good = np.isfinite(points).all(1) & (off < MAX_RESIDUAL_SIGMAS**2)
    if int(good.sum()) < MIN_MAP_LANDMARKS:
        raise InputError("observations", "landmarks", int(good.sum()), allowed)
    widest = np.zeros(len(ids))
    np.maximum.at(widest, point, sigma)
    points, covariance = points[good], (covariance * widest[:, None, None] ** 2)[good]
    # in its own frame
    poses = np.stack([c.base_from_camera for c in rig.cameras])
    base_from_surface = surface_frame(points, poses[:, :3, 3].mean(0), poses[:, :3, 0].mean(0))
    turn = base_from_surface[:3, :3].T
    own = se3.transform_points(se3.inverse(base_from_surface), points)
    joint = np.zeros((len(own), 3, len(own), 3))
    joint[np.arange(len(own)), :, np.arange(len(own))] = turn @ covariance @ turn.T
    normals = local_normals(own, np.array([0.0, 0.0, 1.0]))
    whole = SurfaceMap(own, normals, joint.reshape(3 * len(own), -1))
    return TriangulatedMap(whole, base_from_surface, ids[good])


def update_from_observations(
    surface_map: SurfaceMap, track: Index, residuals: Array, jacobians: Array, sigma: Array, pose_covariance: Array
) -> tuple[SurfaceMap, Mask]:
    """The map after M observations of its landmarks at known poses, and which observations (M,) are inliers.

    One joint Kalman update: the landmarks' errors are correlated, and all observations share the pose's error.

    track: (M,) rows of the map.
    residuals: (M, 2) px, predicted minus observed.
    jacobians: (M, 2, 6) px by the pose's right perturbation.
    sigma: (M,) px.
    pose_covariance: (6, 6), rad and mm.
    """
    count, looks = len(surface_map), len(track)
    if not looks:
        return surface_map, np.zeros(0, bool)
    by_map = np.zeros((looks, 2, count, 3))
    by_map[np.arange(looks), :, track] = jacobians[:, :, 3:]
    design = by_map.reshape(2 * looks, -1)
    by_pose = jacobians.reshape(-1, 6)
    noise = by_pose @ pose_covariance @ by_pose.T + np.diag(np.repeat(sigma**2, 2))
    across = surface_map.covariance @ design.T
    spread = design @ across + noise
    own = np.einsum("minj->mnij", spread.reshape(looks, 2, looks, 2))[np.arange(looks), np.arange(looks)]
    agrees = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(own), residuals) < MAX_INNOVATION_CHI2
    rows = np.repeat(agrees, 2)
    gain = np.linalg.solve(spread[np.ix_(rows, rows)], across[:, rows].T).T
    covariance = surface_map.covariance - gain @ across[:, rows].T
    points = surface_map.points - (gain @ residuals[agrees].ravel()).reshape(-1, 3)
    return SurfaceMap(points, surface_map.normals, (covariance + covariance.T) / 2), agrees


FIT_NEIGHBOURS = 24  # of a local fit with 15 coefficients
MIN_SURFACE_POINTS = 12  # of a surface
POLYNOMIAL_ORDER = 4
MIN_BODY_RADIUS_MM = 30.0  # of curvature: a wrist's, the smallest of the bodies that are printed on
MIN_SCATTER_MM = 0.02  # roughness of skin and error of landmarks, at least
OUTLIER_SCATTERS = 3.0  # Huber's threshold, in scatters
MIN_RAY_COSINE = 0.15  # between ray and normal: below, the surface is not visible
MONOMIAL_POWERS = [(n - j, j) for n in range(POLYNOMIAL_ORDER + 1) for j in range(n + 1)]
# mm^(1 - order), one standard deviation: h = y^2 / 2R + y^4 / 8R^3 on a cylinder; mixed terms alike
COEFFICIENT_SIGMAS = (1e2, 1e1, 0.5 / MIN_BODY_RADIUS_MM, 0.25 / MIN_BODY_RADIUS_MM**2, 0.125 / MIN_BODY_RADIUS_MM**3)
COEFFICIENT_PRIOR = np.array([COEFFICIENT_SIGMAS[a + b] ** -2 for a, b in MONOMIAL_POWERS])


@dataclass(frozen=True, slots=True, eq=False)
class RaySurfaceHits:
    """Intersections of M rays with the surface."""

    points: Array  # (M, 3) mm
    normals: Array  # (M, 3) unit, against the rays
    sigma: Array  # (M,) mm across the surface
    covariance: Array  # (3M, 3M) mm^2, joint: neighbours share a part of their heights' errors
    good: Mask  # (M,) whether the ray meets the surface


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """One polynomial fit for each of M rays, with P coefficients, to K neighbours."""

    near: Index  # (M, K) rows of the neighbours
    frames: Array  # (M, 3, 3) rows u, v and up
    centres: Array  # (M, 3) mm
    maps: Array  # (M, P, K) from the neighbours' heights to the coefficients
    coefficients: Array  # (M, P)
    posterior: Array  # (M, P, P) covariance of the coefficients
    scatter: Array  # (M,) mm, one sigma
    reach: Array  # (M,) mm, RMS distance of the neighbours from the centre


def intersect_rays_with_surface(
    points: Array, covariance: Array, origins: Array, directions: Array, angle: Array
) -> RaySurfaceHits:
    """Intersections of rays with the surface through points (N, 3) with joint covariance (3N, 3N), mm^2.

    origins, directions: (M, 3), unit, the points' frame. angle: (M,) rad, one sigma of each ray.
    """
    count = len(origins)
    if len(points) < MIN_SURFACE_POINTS or not count:
        nothing = origins.copy(), -directions, np.full(count, np.inf), np.zeros((3 * count, 3 * count))
        return RaySurfaceHits(*nothing, np.zeros(count, bool))
    each = len(points)
    own_covariance = np.einsum("ninj->nij", covariance.reshape(each, 3, each, 3))
    fits = _fits(points, own_covariance, _nearest(points, origins, directions), -directions)
    turned = np.einsum("mki,mi->mk", fits.frames, directions)
    places = np.stack([((origins - fits.centres)[:, None] * fits.frames).sum(2), turned], 1)
    u, v, good = _crossing(fits.coefficients, places)
    at, slopes = _basis(u, v), _slopes(fits.coefficients, u, v)
    up = np.stack([-slopes[0], -slopes[1], np.ones(count)], -1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    height = np.einsum("mp,mp->m", at, fits.coefficients)
    hits = fits.centres + np.einsum("mk,mki->mi", np.stack([u, v, height], -1), fits.frames)
    normals = np.einsum("mk,mki->mi", up, fits.frames)
    good &= (np.einsum("mi,mi->m", normals, directions) < -MIN_RAY_COSINE) & np.isfinite(hits).all(1)
    heights = _heights(fits, at, hits, covariance) * up[:, 2:] * up[:, 2]  # across the surface, not along the fit's up
    shift, depth = intersection_jacobians(hits - origins, normals)
    side = (np.linalg.norm(hits - origins, axis=1) * angle)[:, None, None] ** 2 * shift @ np.swapaxes(shift, 1, 2)
    joint = np.einsum("mi,mn,nj->minj", depth, heights, depth)
    joint[np.arange(count), :, np.arange(count)] += side
    return RaySurfaceHits(hits, normals, np.sqrt(np.diag(heights)), joint.reshape(3 * count, -1), good)


def smooth_normals(points: Array, outward: Array) -> Array:
    """Unit normals (N, 3) of the smooth surface through points (N, 3), on the side of `outward`, (3,) or (N, 3).

    At the rim of a bent surface, where neighbours lie on one side, a plane through them would lean inwards.
    """
    outward = np.broadcast_to(outward, points.shape)
    near = np.asarray(cKDTree(points).query(points, k=min(FIT_NEIGHBOURS, len(points)))[1], np.int64)
    fits = _fits(points, np.zeros((len(points), 3, 3)), near, outward)
    u, v, _ = np.einsum("mki,mi->km", fits.frames, points - fits.centres)
    slopes = _slopes(fits.coefficients, u, v)
    up = np.stack([-slopes[0], -slopes[1], np.ones(len(points))], -1)
    return np.asarray(np.einsum("mk,mki->mi", up / np.linalg.norm(up, axis=1, keepdims=True), fits.frames))


def _fits(points: Array, own_covariance: Array, near: Index, outward: Array) -> _Fits:
    """M fits to rows near (M, K) of points (N, 3) with covariances (N, 3, 3) mm^2.

    outward: (M, 3), the side of the frames' up.
    """
    own = points[near]  # (M, K, 3)
    centres = own.mean(1)
    spread = own - centres[:, None]
    frames = np.swapaxes(np.linalg.eigh(np.swapaxes(spread, 1, 2) @ spread)[1], 1, 2)[:, ::-1].copy()
    frames[:, 2] *= np.where(np.einsum("mi,mi->m", frames[:, 2], outward) < 0, -1.0, 1.0)[:, None]
    frames[:, 1] = np.cross(frames[:, 2], frames[:, 0])
    local = np.einsum("mki,mji->mkj", spread, frames)
    reach = np.sqrt((local[..., :2] ** 2).sum(2).mean(1))
    design = _basis(local[..., 0], local[..., 1])  # (M, K, P)
    known = np.einsum("mi,mkij,mj->mk", frames[:, 2], own_covariance[near], frames[:, 2])
    scatter, weight = np.full(len(near), 0.1), np.ones(near.shape)
    for _ in range(4):
        trusted = weight / (scatter[:, None] ** 2 + known)
        normal = np.einsum("mkp,mk,mkq->mpq", design, trusted, design) + np.diag(COEFFICIENT_PRIOR)
        posterior = np.linalg.inv(normal)
        maps = posterior @ np.swapaxes(design * trusted[..., None], 1, 2)
        coefficients = np.einsum("mpk,mk->mp", maps, local[..., 2])
        off = local[..., 2] - np.einsum("mkp,mp->mk", design, coefficients)
        free = np.maximum(weight.sum(1) - np.einsum("mkp,mpk->m", design, maps), 1.0)
        variance = (weight * (off**2 - known)).sum(1) / free
        scatter = np.sqrt(np.maximum(variance, MIN_SCATTER_MM**2))
        limit = OUTLIER_SCATTERS * np.sqrt(scatter[:, None] ** 2 + known)
        weight = np.minimum(1.0, limit / np.maximum(np.abs(off), 1e-9))
    freedom = np.maximum(free, 3.0)
    scatter = scatter * np.sqrt(freedom / (freedom - 2))  # known from few neighbours: Student's t
    return _Fits(near, frames, centres, maps, coefficients, posterior, scatter, reach)


def _nearest(points: Array, origins: Array, directions: Array) -> Index:
    """Rows (M, K) of the points nearest to each ray."""
    away = points - origins[:, None]  # (M, N, 3)
    along = np.einsum("mni,mi->mn", away, directions)
    aside = np.linalg.norm(away - along[..., None] * directions[:, None], axis=2)
    beside = np.argsort(aside, axis=1)[:, :MIN_SURFACE_POINTS]
    depth = np.median(np.take_along_axis(along, beside, 1), axis=1)
    places = origins + depth[:, None] * directions
    return np.asarray(cKDTree(points).query(places, k=min(FIT_NEIGHBOURS, len(points)))[1], np.int64)


def _basis(u: Array, v: Array) -> Array:
    return np.stack([u**a * v**b for a, b in MONOMIAL_POWERS], -1)


def _slopes(coefficients: Array, u: Array, v: Array) -> tuple[Array, Array]:
    across = np.stack([a * u ** max(a - 1, 0) * v**b for a, b in MONOMIAL_POWERS], -1)
    along = np.stack([b * u**a * v ** max(b - 1, 0) for a, b in MONOMIAL_POWERS], -1)
    return (across * coefficients).sum(-1), (along * coefficients).sum(-1)


def _crossing(coefficients: Array, places: Array) -> tuple[Array, Array, Mask]:
    """Intersections u and v (M,), mm, of rays with the fits, by Newton's method, and whether it converged (M,).

    places: (M, 2, 3) origin and direction of the rays in the fits' frames.
    """
    origin, direction = places[:, 0], places[:, 1]
    level = np.where(np.abs(direction[:, 2]) < MIN_RAY_COSINE, -MIN_RAY_COSINE, direction[:, 2])
    reach = -origin[:, 2] / level
    step = np.zeros(len(reach))
    for _ in range(6):
        u, v, w = (origin + reach[:, None] * direction).T
        slopes = _slopes(coefficients, u, v)
        steep = direction[:, 2] - slopes[0] * direction[:, 0] - slopes[1] * direction[:, 1]
        step = (w - (_basis(u, v) * coefficients).sum(-1)) / np.where(np.abs(steep) < 1e-3, -1e-3, steep)
        reach = reach - step
    u, v, _ = (origin + reach[:, None] * direction).T
    return u, v, np.asarray(np.abs(step) < 1e-3)


def _heights(fits: _Fits, at: Array, hits: Array, covariance: Array) -> Array:
    """Covariance (M, M) mm^2 of the heights at `hits`, the sum of three parts:

    - the surface's own scatter, independent at each place;
    - the neighbours' scatter and errors, by their weights in the fits;
    - the remaining uncertainty of the coefficients, correlated over the distance between places.
    """
    rays, count = np.arange(len(at)), len(covariance) // 3
    weights = np.einsum("mp,mpk->mk", at, fits.maps)  # of the neighbours' heights
    rough, lever = np.zeros((2, len(at), count))
    lever[rays[:, None], fits.near] = weights
    rough[rays[:, None], fits.near] = weights * fits.scatter[:, None]
    by_point = (lever[..., None] * fits.frames[:, 2][:, None]).reshape(len(at), -1)  # (M, 3N)
    shared = rough @ rough.T + by_point @ covariance @ by_point.T
    unseen = np.sqrt(np.maximum(np.einsum("mp,mpq,mq->m", at, fits.posterior, at) - np.diag(shared), 0.0))
    apart = np.linalg.norm(hits[:, None] - hits, axis=2) / np.median(fits.reach)
    return np.asarray(shared + np.outer(unseen, unseen) * np.exp(-0.5 * apart**2) + np.diag(fits.scatter**2))
