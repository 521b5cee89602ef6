"""Registration of a scan to triangulated points, and the motions that its shape does not determine.

Many starts (each part of the scan under the points, turned in steps about the normal) are ranked by the points'
distances, and the best are refined by robust point-to-plane steps (Chen and Medioni 1992). The eigenvalues of the
information matrix show which motions are determined (Gelfand et al., Geometrically Stable Sampling, 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.scans.scan import Scan, ScanIndex
from estimation.se3 import Array, Index
from estimation.surface_map import farthest_points

MIN_REGISTRATION_POINTS = 12  # six for the pose, six to check it
YAW_STARTS = 24  # starts per place, 15 degrees apart: the refinement converges from 7.5
MAX_PLACES = 150  # of the scan, tried as starts
FIRST_POINTS, COARSE_POINTS = 24, 60  # points used while there are many candidate poses
FIRST_STEPS = 3  # of all starts before they are ranked: on a steep surface starts near the truth fit badly
ROUGH_STARTS = 80  # starts that are refined roughly
FINE_STARTS = 6  # of these, refined with exact nearest points
FINAL_STARTS = 3  # of these, refined with all points: several, to find rivals
COARSE_SAMPLES = 4000  # of the scan, for the starts

# of a full step's information: without it, rounding of float32 moves undetermined directions by metres
STEP_DAMPING = 1e-6

FREE_STD = 0.3  # mm: a direction with a larger sigma is free; three times the wanted error
FREE_SLOPE = 0.012  # mm of distance per mm of motion (0.7 degrees): below, errors of the scan's shape dominate
RIVAL_RMS_RATIO = 1.5  # of the RMS distances, above which a rival pose is rejected
SAME_POSE_MM = FREE_STD  # largest distance of points between two poses that count as one
MAX_SLIDE_ROTATION = 0.2  # share of rotation in a motion that is named a slide


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Determined and free motions."""

    directions: Array  # (K, 6) free right perturbations, rad and mm, that move the points by about 1 mm
    names: tuple[str, ...]  # of the K directions
    covariance: Array  # (6, 6), as wide as the scan along free directions
    weakest: float  # mm, largest sigma of the determined directions


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The pose of the scan."""

    base_from_surface: Array  # (4, 4) mm
    rms: float  # mm, of the inliers, across the surface
    covariance: Array  # (6, 6) of the right perturbation, rad and mm; as wide as the scan along free directions
    free: Array  # (K, 6) directions of that perturbation that the shape does not determine
    sure: bool  # whether the pose is determined, unique and fits
    verdict: str  # for the operator
    rival: Array | None = None  # (4, 4) another pose that fits as well
    fits: bool = True  # whether the points lie on the scan


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    pose: Array  # (4, 4) base_from_surface
    cost: float  # mm^2, mean of capped squared distances
    rms: float  # mm, of the inliers
    share: float  # of inliers
    observability: Observability


def register(points_base: Array, sigma: float, scan: Scan, outward: Array) -> Registration:
    """Find base_from_surface from points (N, 3) on the surface, mm, base frame.

    sigma: mm, one standard deviation of a point across the surface. outward: (3,) rough direction out of the surface,
    base frame, as from the points to the cameras. The points may cover a part of the scan only, and include outliers.
    Deterministic.
    """
    assert sigma > 0 and np.isfinite(points_base).all()
    index = ScanIndex(scan)
    if len(points_base) < MIN_REGISTRATION_POINTS:
        return _no_registration(index, len(points_base))
    few = points_base[_spread_rows(points_base, min(COARSE_POINTS, len(points_base)))]  # the first ones furthest apart
    reach = 0.1 * _radius(points_base) + 3 * sigma  # mm: further off counts no more
    poses = _starts(points_base, outward, index)
    for _ in range(FIRST_STEPS):
        poses = _rough_step(index, poses, few[:FIRST_POINTS], reach)
    poses = poses[np.argsort(_costs(index, poses, few[:FIRST_POINTS], reach), kind="stable")[:ROUGH_STARTS]]
    for step in range(8):
        poses = _rough_step(index, poses, few, reach * 0.75**step)
    ranked = poses[np.argsort(_costs(index, poses, few, reach), kind="stable")]
    finer = [_refine(index, pose, few, sigma, reach, 12) for pose in _distinct_poses(ranked, few, FINE_STARTS)]
    fits = [_measure(index, pose, gate, points_base, sigma) for pose, gate in finer]
    best = sorted(zip(fits, finer, strict=True), key=lambda f: f[0].cost)[:FINAL_STARTS]
    finest = [_refine(index, pose, points_base, sigma, gate, 40) for _, (pose, gate) in best]
    fits = [_measure(index, pose, gate, points_base, sigma) for pose, gate in finest]
    return _assess(sorted(fits, key=lambda f: f.cost), points_base, sigma)


def register_near(points_base: Array, sigma: float, shared: float, index: ScanIndex, near: Array) -> Registration:
    """Refine a pose `near` (4, 4), right to a millimetre or two, by points (N, 3), mm, base frame.

    sigma: mm, of a point across the surface. shared: factor on the covariance's sigma where errors of neighbouring
    points are correlated. The pose does not move along free directions.
    """
    if len(points_base) < MIN_REGISTRATION_POINTS:
        return replace(_no_registration(index, len(points_base)), base_from_surface=near)
    pose, gate = _refine(index, near, points_base, sigma, 10 * sigma, 20, held=True)
    fit = _measure(index, pose, gate, points_base, sigma, shared)
    return _assess([fit], points_base, max(sigma, fit.rms))


def resolve_ambiguity(ambiguous: Registration, best: Registration, rival: Registration, points: Array) -> Registration:
    """The registration after the `best` and `rival` poses of an ambiguous one were refined on better points.

    It is the one that fits clearly better; `best` where both converged to one pose; else it stays ambiguous. points:
    (N, 3) mm, surface frame, at which the two poses are compared; N may be 0.
    """
    if rival.rms > RIVAL_RMS_RATIO * best.rms:
        return best
    if best.rms > RIVAL_RMS_RATIO * rival.rms:
        return rival
    places = (se3.transform_points(each.base_from_surface, points) for each in (best, rival))
    if len(points) and np.linalg.norm(np.subtract(*places), axis=1).max() < SAME_POSE_MM:
        return best
    return replace(best, rival=ambiguous.rival, sure=False, verdict=f"{ambiguous.verdict}; {best.verdict}")


def _assess(candidates: list[_Candidate], points: Array, sigma: float) -> Registration:
    best = candidates[0]
    free = best.observability
    problems: list[str] = []
    if best.rms > 2 * sigma:
        problems.append(f"poor fit: {best.rms:.3g} mm rms, {sigma:.3g} mm expected")
    if best.share < 0.7:
        problems.append(f"poor fit: only {100 * best.share:.0f} % of the points lie on the scan")
    fits = not problems
    # another pose that fits as well as the best, within what chance explains
    bound, min_distance = max(best.cost, sigma**2) * (1 + 4 * np.sqrt(2 / len(points))), 0.1 * _radius(points)
    rivals = (f for f in candidates[1:] if f.cost < bound and _pose_distance(f.pose, best.pose, points) > min_distance)
    rival = next(rivals, None)
    if rival is not None and not len(free.directions):
        distance = _pose_distance(best.pose, rival.pose, points)
        comparison = f"fits as well ({rival.rms:.3g} against {best.rms:.3g} mm rms)"
        problems.append(f"ambiguous: a pose {distance:.3g} mm distance {comparison}")
    if len(free.directions):
        problems.append("free: " + "; ".join(free.names))
    verdict = ". ".join(problems) or f"found: {best.rms:.3g} mm rms, weakest direction good to {free.weakest:.2g} mm"
    other = None if rival is None or len(free.directions) else rival.pose
    return Registration(best.pose, best.rms, free.covariance, free.directions, not problems, verdict, other, fits)


def _no_registration(index: ScanIndex, count: int) -> Registration:
    size = float(np.ptp(index.samples, axis=0).max())
    covariance = np.diag([np.pi**2] * 3 + [size**2] * 3)
    verdict = f"{count} points, {MIN_REGISTRATION_POINTS} needed"
    return Registration(np.eye(4), np.inf, covariance, np.eye(6), False, verdict, fits=False)


def _refine(
    index: ScanIndex, pose: Array, points: Array, sigma: float, gate: float, steps: int, held: bool = False
) -> tuple[Array, float]:
    """Robust point-to-plane steps (Geman-McClure) with exact nearest points: the pose, and the gate, mm.

    The gate narrows to three standard deviations of the residuals. held: whether free directions are held.
    """
    for _ in range(steps):
        pull, offset, inner = _point_residuals(index, pose, points)
        weight = (1 + (offset / gate) ** 2) ** -2
        jacobian = np.concatenate([np.cross(inner, pull), pull], axis=1)  # -d offset / d xi
        weighted = jacobian * weight[:, None]
        information = weighted.T @ jacobian
        reach = float(np.einsum("ni,ni->", inner, inner)) + len(points)
        damping = STEP_DAMPING * np.diag([reach] * 3 + [len(points)] * 3)
        step = np.linalg.solve(information + damping, weighted.T @ offset)
        step = observable_part(inner, pull, step) if held else step
        pose = pose @ se3.exp(step)
        spread = 1.4826 * float(np.median(np.abs(offset)))
        narrowed = max(3 * max(spread, sigma), 0.5 * gate)
        settled = narrowed >= 0.95 * gate and np.abs(jacobian @ step).max() < 1e-5
        gate = min(gate, narrowed)
        if settled:
            break
    return pose, gate


def _measure(
    index: ScanIndex, pose: Array, gate: float, points: Array, sigma: float, shared: float = 1.0
) -> _Candidate:
    """The fit of points (N, 3), base frame, at a pose; inliers are within two gates. shared: see `register_near`."""
    inner = se3.transform_points(se3.inverse(pose), points)
    near = index.closest(inner)
    distance = np.linalg.norm(inner - near.points, axis=1)
    counts = (distance < 2 * gate) & ~near.rim
    rms = float(np.sqrt(np.mean(distance[counts] ** 2))) if counts.any() else np.inf
    held = observability_of(inner[counts], near.normals[counts], shared * max(sigma, min(rms, gate)), index)
    return _Candidate(pose, float(np.mean(np.minimum(distance, 2 * gate) ** 2)), rms, float(counts.mean()), held)


def _point_residuals(index: ScanIndex, pose: Array, points: Array) -> tuple[Array, Array, Array]:
    """Normals (N, 3), beyond the rim directions from it; offsets (N,) mm along them; points (N, 3), surface frame."""
    inner = se3.transform_points(se3.inverse(pose), points)
    near = index.closest(inner)
    gap = inner - near.points
    length = np.linalg.norm(gap, axis=1)
    beside = near.rim & (length > 1e-6)
    pull = np.where(beside[:, None], gap / np.maximum(length, 1e-12)[:, None], near.normals)
    return pull, np.einsum("ni,ni->n", pull, gap), inner


def _rough_step(index: ScanIndex, poses: Array, points: Array, gate: float) -> Array:
    """One point-to-plane step of all poses (H, 4, 4) at once, against the nearest samples."""
    inner = se3.transform_points(se3.inverse(poses), points)  # (H, N, 3)
    _, near = index.tree.query(inner)
    normal = index.normals[near]
    gap = inner - index.samples[near]
    offset = np.einsum("hni,hni->hn", normal, gap)
    weight = (1 + np.einsum("hni,hni->hn", gap, gap) / gate**2) ** -2
    jacobian = np.concatenate([np.cross(inner, normal), normal], axis=-1)
    weighted = jacobian * weight[..., None]
    information = np.swapaxes(weighted, 1, 2) @ jacobian
    damped = information + 1e-3 * information * np.eye(6) + 1e-9 * np.eye(6)
    step = np.linalg.solve(damped, np.einsum("hni,hn->hi", weighted, offset)[..., None])[..., 0]
    length = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    return np.asarray(poses @ se3.exp(step * np.minimum(1, 0.3 / np.maximum(length, 1e-12))))


def _costs(index: ScanIndex, poses: Array, points: Array, reach: float) -> Array:
    """Mean squared distances (H,), each capped at `reach` mm, from the plane of the nearest sample."""
    inner = se3.transform_points(se3.inverse(poses), points)
    _, near = index.tree.query(inner)
    gap = inner - index.samples[near]
    across = np.einsum("hni,hni->hn", index.normals[near], gap)
    along = np.sqrt(np.maximum(np.einsum("hni,hni->hn", gap, gap) - across**2, 0))
    squared = across**2 + np.maximum(along - 2 * index.spacing, 0) ** 2
    return np.asarray(np.minimum(squared, reach**2).mean(axis=1))


def _starts(points: Array, outward: Array, index: ScanIndex) -> Array:
    """Poses (H, 4, 4) that match centre and normal of the points and of each part of the scan, at every yaw."""
    from scipy.spatial import cKDTree  # half a second, which processes without a scan need not spend

    radius = _radius(points)
    base_from_cap = _local_frame(points, np.asarray(outward, float))
    stride = max(1, len(index.samples) // COARSE_SAMPLES)
    samples, normals = index.samples[::stride], index.normals[::stride]
    places = samples[_spread_rows(samples, MAX_PLACES, 0.5 * radius)]
    yaws = se3.exp_rotation(np.arange(YAW_STARTS)[:, None] * [0.0, 0.0, 2 * np.pi / YAW_STARTS])
    turned = base_from_cap @ se3.make(yaws, np.zeros(3))  # (Y, 4, 4)
    neighbours = cKDTree(samples).query_ball_point(places, 1.6 * radius)
    return np.concatenate([turned @ se3.inverse(_local_frame(samples[n], normals[n].mean(0))) for n in neighbours])


def _local_frame(points: Array, outward: Array) -> Array:
    """a_from_local (4, 4): origin at the mean of points (N, 3), z their normal on the side of `outward` (3,)."""
    centre = points.mean(0)
    _, vectors = np.linalg.eigh((points - centre).T @ (points - centre))
    z = vectors[:, 0] * (1 if vectors[:, 0] @ outward >= 0 else -1)
    length = np.linalg.norm(outward)
    if length > 1e-9 and z @ outward < 0.35 * length:  # deeper than wide: trust the direction that was given
        z = outward / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return se3.make(np.column_stack([x, np.cross(z, x), z]), centre)


def _radius(points: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, axis=1))))


def _pose_distance(a: Array, b: Array, points: Array) -> float:
    """RMS distance, mm, of points between two poses of the surface."""
    moved = se3.transform_points(b @ se3.inverse(a), points)
    return float(np.sqrt(np.mean(np.sum((moved - points) ** 2, axis=1))))


def _distinct_poses(poses: Array, points: Array, count: int) -> list[Array]:
    """The first `count` poses (H, 4, 4) that differ from each other."""
    distinct: list[Array] = []
    near = 0.1 * _radius(points)
    for pose in poses:
        if all(_pose_distance(pose, other, points) > near for other in distinct):
            distinct.append(pose)
        if len(distinct) == count:
            break
    return distinct


def _spread_rows(points: Array, count: int, nearest: float = 0.0) -> Index:
    """Rows of up to `count` points (N, 3) as far apart as can be, from the centre on, none nearer than `nearest` mm."""
    first = int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))
    return farthest_points(points, first, count, nearest)


def observability_of(points: Array, normals: Array, sigma: float, index: ScanIndex) -> Observability:
    """Motions determined by point-to-plane distances of `sigma` mm at points (N, 3) with normals, surface frame."""
    size = float(np.ptp(index.samples, axis=0).max())
    if not len(points):
        return Observability(np.eye(6), ("everything",), np.diag([np.pi**2] * 3 + [size**2] * 3), np.inf)
    centre, radius = _middle(points)
    slope, vectors = _distance_slopes(points, normals)
    std = sigma / np.maximum(slope * np.sqrt(len(points)), 1e-12)
    free = (slope < FREE_SLOPE) | (std > FREE_STD)
    perturbation = _perturbation_from_motion(centre, radius)
    spread = perturbation @ vectors @ np.diag(np.where(free, size, np.minimum(std, size)))
    motions = vectors[:, free].T
    if len(motions):  # as pure slides, as far as there are any, then by how much they turn
        motions = (np.linalg.svd(motions[:, :3])[0].T @ motions)[::-1]
    names = tuple(_motion_name(m, centre, radius) for m in motions)
    weakest = float(std[~free].max(initial=0.0))
    return Observability(motions @ perturbation.T, names, spread @ spread.T, weakest)


def observable_part(points: Array, normals: Array, step: Array) -> Array:
    """The part of a right perturbation (6,) that changes distances at points with normals (N, 3)."""
    slope, vectors = _distance_slopes(points, normals)
    held = vectors[:, slope >= FREE_SLOPE]
    perturbation = _perturbation_from_motion(*_middle(points))
    return np.asarray(perturbation @ held @ held.T @ np.linalg.solve(perturbation, step))


def _middle(points: Array) -> tuple[Array, float]:
    return points.mean(0), max(_radius(points), 1e-6)


def _distance_slopes(points: Array, normals: Array) -> tuple[Array, Array]:
    """Change of distance per mm of motion (6,), ascending, and the motions (6, 6), in columns."""
    centre, radius = _middle(points)
    jacobian = np.concatenate([np.cross(points - centre, normals) / radius, normals], axis=1)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian / len(points))
    return np.sqrt(np.maximum(values, 0)), vectors


def _perturbation_from_motion(centre: Array, radius: float) -> Array:
    """(6, 6) right perturbation, rad and mm, by a motion: rotation about `centre` in mm at `radius`, and shift."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = np.eye(3) / radius, np.eye(3)
    out[3:, :3] = se3.hat(centre) / radius
    return out


def _motion_name(motion: Array, centre: Array, radius: float) -> str:
    turn, move = motion[:3] / radius, motion[3:]
    if np.linalg.norm(motion[:3]) < MAX_SLIDE_ROTATION:
        return f"slide along {_vector(move / np.linalg.norm(move), 2)}"
    axis = turn / np.linalg.norm(turn)
    through = centre + np.cross(turn, move) / (turn @ turn)
    return f"turn about {_vector(axis, 2)} through {_vector(through, 1)} mm"


def _vector(v: Array, digits: int) -> str:
    v = v * (1 if v[np.argmax(np.abs(v))] > 0 or digits == 1 else -1)
    return "(" + " ".join(f"{x + 0.0:.{digits}f}" for x in np.round(v, digits)) + ")"
