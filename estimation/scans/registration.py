"""Where a scan lies: triangulated points against its surface, and what its shape leaves open.

Many starts (every part of the scan laid under the points, turned in steps about the normal) are ranked by the points'
distances, and the best are refined by robust point-to-plane steps (Chen and Medioni 1992). What the shape determines is
read from the eigenvalues of the information matrix (Gelfand et al., Geometrically Stable Sampling, 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.scans.scan import Scan, ScanIndex
from estimation.se3 import Array, Index
from estimation.surface_map import farthest_points

MIN_REGISTRATION_POINTS = 12  # six unknowns, and as many again to see that they fit
YAW_STARTS = 24  # starts per place: 15 degrees apart, half of it is within reach of the refinement
MAX_PLACES = 150  # at most
FIRST_POINTS, COARSE_POINTS = 24, 60  # spread over all, while there are many poses to be tried
FIRST_STEPS = 3  # of all starts: ranked as they are laid down, those near the truth on a steep surface are lost
ROUGH_STARTS = 80  # starts that are refined roughly
FINE_STARTS = 6  # and of these, those refined with exact nearest points
FINAL_STARTS = 3  # and of these, those refined with all points: more than one, to see whether the best is alone
COARSE_SAMPLES = 4000  # of the scan: enough to lay a part of it under the points

# of what a full step costs: along what the shape leaves open, the last digits of float32 would else move by metres
STEP_DAMPING = 1e-6

FREE_STD = 0.3  # mm: a direction known no better is called free; three times the error that is wanted
FREE_SLOPE = 0.012  # mm of distance per mm of motion (0.7 degrees): below, errors of the scan's own shape decide
RIVAL_RMS_RATIO = 1.5  # a rival pose whose points stand off this much more is none
ONE_PLACE_MM = FREE_STD  # by which no point of two places is apart: they are one, as well as places are known
SLIDE_TURN_SHARE = 0.2  # of turning, below which a motion is called a slide


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Which motions are determined and which are free."""

    directions: Array  # (K, 6) free right perturbations, rad and mm, that move the points by about 1 mm
    names: tuple[str, ...]  # one each
    covariance: Array  # (6, 6), as wide as the scan along them
    weakest: float  # mm, one standard deviation of the worst direction that is determined


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Where the scan lies."""

    base_from_surface: Array  # (4, 4) mm
    rms: float  # mm, of the points that fit, across the surface
    covariance: Array  # (6, 6) of the right perturbation, rad and mm; as wide as the scan along what is free
    free: Array  # (K, 6) directions of that perturbation that the shape does not determine
    sure: bool  # whether the pose is determined, unique and fits
    verdict: str  # the same in words
    rival: Array | None = None  # (4, 4) another pose that fits as well
    fits: bool = True  # whether the points lie on the scan there: it is this surface's scan


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    pose: Array  # (4, 4) base_from_surface
    cost: float  # mm^2, mean of capped squared distances
    rms: float  # mm, of the points that count
    share: float  # of points that count
    observability: Observability


def register(points_base: Array, sigma: float, scan: Scan, outward: Array) -> Registration:
    """Find base_from_surface from points (N, 3) on the surface, mm, base frame.

    sigma: mm, one standard deviation of a point across the surface. outward: (3,) rough direction out of the surface,
    base frame, as from the points to the cameras. The points may cover a part of the scan only; a share of them may be
    wrong. Deterministic.
    """
    assert sigma > 0 and np.isfinite(points_base).all()
    index = ScanIndex(scan)
    if len(points_base) < MIN_REGISTRATION_POINTS:
        return _no_registration(index, len(points_base))
    few = points_base[_spread_out(points_base, min(COARSE_POINTS, len(points_base)))]  # the first ones furthest apart
    reach = 0.1 * _radius(points_base) + 3 * sigma  # mm: further off counts no more
    poses = _starts(points_base, outward, index)
    for _ in range(FIRST_STEPS):
        poses = _rough_step(index, poses, few[:FIRST_POINTS], reach)
    poses = poses[np.argsort(_costs(index, poses, few[:FIRST_POINTS], reach), kind="stable")[:ROUGH_STARTS]]
    for step in range(8):
        poses = _rough_step(index, poses, few, reach * 0.75**step)
    ranked = poses[np.argsort(_costs(index, poses, few, reach), kind="stable")]
    finer = [_refine(index, pose, few, sigma, reach, 12) for pose in _distinct(ranked, few, FINE_STARTS)]
    fits = [_measure(index, pose, gate, points_base, sigma) for pose, gate in finer]
    best = sorted(zip(fits, finer, strict=True), key=lambda f: f[0].cost)[:FINAL_STARTS]
    finest = [_refine(index, pose, points_base, sigma, gate, 40) for _, (pose, gate) in best]
    fits = [_measure(index, pose, gate, points_base, sigma) for pose, gate in finest]
    return _judge(sorted(fits, key=lambda f: f.cost), points_base, sigma)


def register_near(points_base: Array, sigma: float, shared: float, index: ScanIndex, near: Array) -> Registration:
    """Refine a pose `near` (4, 4) that is right to a millimetre or two, from points (N, 3), mm, base frame.

    sigma: mm, of a point across the surface. shared: factor of that for all points together, where the errors of
    neighbours are alike. Along what the shape leaves open the pose stays.
    """
    if len(points_base) < MIN_REGISTRATION_POINTS:
        return replace(_no_registration(index, len(points_base)), base_from_surface=near)
    pose, gate = _refine(index, near, points_base, sigma, 10 * sigma, 20, held=True)
    fit = _measure(index, pose, gate, points_base, sigma, shared)
    return _judge([fit], points_base, max(sigma, fit.rms))


def better_of(ambiguous: Registration, best: Registration, rival: Registration, points: Array) -> Registration:
    """What an `ambiguous` place is once it and its rival were refined on better points: the one that fits clearly
    better, the first where both have become one place, else as ambiguous as before.

    points: (N, 3) mm, surface frame, by which the distance of two places is judged; N may be 0.
    """
    if rival.rms > RIVAL_RMS_RATIO * best.rms:
        return best
    if best.rms > RIVAL_RMS_RATIO * rival.rms:
        return rival
    places = (se3.transform_points(each.base_from_surface, points) for each in (best, rival))
    if len(points) and np.linalg.norm(np.subtract(*places), axis=1).max() < ONE_PLACE_MM:
        return best
    return replace(best, rival=ambiguous.rival, sure=False, verdict=f"{ambiguous.verdict}; {best.verdict}")


def _judge(candidates: list[_Candidate], points: Array, sigma: float) -> Registration:
    best = candidates[0]
    free = best.observability
    words: list[str] = []
    if best.rms > 2 * sigma:
        words.append(f"poor fit: {best.rms:.3g} mm rms, {sigma:.3g} mm expected")
    if best.share < 0.7:
        words.append(f"poor fit: only {best.share:.0%} of the points lie on the scan")
    fits = not words
    # another pose that fits as well as the best, within what chance explains
    bound, near = max(best.cost, sigma**2) * (1 + 4 * np.sqrt(2 / len(points))), 0.1 * _radius(points)
    rivals = (f for f in candidates[1:] if f.cost < bound and _apart(f.pose, best.pose, points) > near)
    rival = next(rivals, None)
    if rival is not None and not len(free.directions):
        away = _apart(best.pose, rival.pose, points)
        fits_as_well = f"fits as well ({rival.rms:.3g} against {best.rms:.3g} mm rms)"
        words.append(f"ambiguous: a pose {away:.3g} mm away {fits_as_well}")
    if len(free.directions):
        words.append("free: " + "; ".join(free.names))
    verdict = ". ".join(words) or f"found: {best.rms:.3g} mm rms, weakest direction good to {free.weakest:.2g} mm"
    other = None if rival is None or len(free.directions) else rival.pose
    return Registration(best.pose, best.rms, free.covariance, free.directions, not words, verdict, other, fits)


def _no_registration(index: ScanIndex, count: int) -> Registration:
    size = float(np.ptp(index.samples, axis=0).max())
    covariance = np.diag([np.pi**2] * 3 + [size**2] * 3)
    verdict = f"{count} points, {MIN_REGISTRATION_POINTS} needed"
    return Registration(np.eye(4), np.inf, covariance, np.eye(6), False, verdict, fits=False)


def _refine(
    index: ScanIndex, pose: Array, points: Array, sigma: float, gate: float, steps: int, held: bool = False
) -> tuple[Array, float]:
    """Robust point-to-plane steps (Geman-McClure) with exact nearest points: the pose, and the gate, mm.

    The gate is narrowed to three of the residuals' own standard deviations as they settle. held: no steps along what
    the shape does not hold.
    """
    for _ in range(steps):
        pull, offset, inner = _pull(index, pose, points)
        weight = (1 + (offset / gate) ** 2) ** -2
        jacobian = np.concatenate([np.cross(inner, pull), pull], axis=1)  # -d offset / d xi
        weighted = jacobian * weight[:, None]
        information = weighted.T @ jacobian
        reach = float(np.einsum("ni,ni->", inner, inner)) + len(points)
        damping = STEP_DAMPING * np.diag([reach] * 3 + [len(points)] * 3)
        step = np.linalg.solve(information + damping, weighted.T @ offset)
        step = without_free(inner, pull, step) if held else step
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
    """How well points (N, 3), base frame, fit at a pose; those within two gates count. shared: see `register_near`."""
    inner = se3.transform_points(se3.inverse(pose), points)
    near = index.closest(inner)
    distance = np.linalg.norm(inner - near.points, axis=1)
    counts = (distance < 2 * gate) & ~near.rim
    rms = float(np.sqrt(np.mean(distance[counts] ** 2))) if counts.any() else np.inf
    held = observability_of(inner[counts], near.normals[counts], shared * max(sigma, min(rms, gate)), index)
    return _Candidate(pose, float(np.mean(np.minimum(distance, 2 * gate) ** 2)), rms, float(counts.mean()), held)


def _pull(index: ScanIndex, pose: Array, points: Array) -> tuple[Array, Array, Array]:
    """Surface normals (beside the rim: the way back) (N, 3), offsets (N,) mm and points (N, 3), surface frame."""
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
    """Mean squared distance (H,), each capped at `reach` mm; beside a sample the distance from its plane counts."""
    inner = se3.transform_points(se3.inverse(poses), points)
    _, near = index.tree.query(inner)
    gap = inner - index.samples[near]
    across = np.einsum("hni,hni->hn", index.normals[near], gap)
    along = np.sqrt(np.maximum(np.einsum("hni,hni->hn", gap, gap) - across**2, 0))
    squared = across**2 + np.maximum(along - 2 * index.spacing, 0) ** 2
    return np.asarray(np.minimum(squared, reach**2).mean(axis=1))


def _starts(points: Array, outward: Array, index: ScanIndex) -> Array:
    """Poses (H, 4, 4) that lay each part of the scan under the points, centres and normals matched, at every yaw."""
    from scipy.spatial import cKDTree  # half a second, which processes without a scan need not spend

    radius = _radius(points)
    base_from_cap = _cap(points, np.asarray(outward, float))
    stride = max(1, len(index.samples) // COARSE_SAMPLES)
    samples, normals = index.samples[::stride], index.normals[::stride]
    places = samples[_spread_out(samples, MAX_PLACES, 0.5 * radius)]
    yaws = se3.exp_rotation(np.arange(YAW_STARTS)[:, None] * [0.0, 0.0, 2 * np.pi / YAW_STARTS])
    turned = base_from_cap @ se3.make(yaws, np.zeros(3))  # (Y, 4, 4)
    neighbours = cKDTree(samples).query_ball_point(places, 1.6 * radius)
    return np.concatenate([turned @ se3.inverse(_cap(samples[n], normals[n].mean(0))) for n in neighbours])


def _cap(points: Array, outward: Array) -> Array:
    """a_from_cap (4, 4): origin amid the points (N, 3), z their normal on the side of `outward` (3,)."""
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


def _apart(a: Array, b: Array, points: Array) -> float:
    """How far two poses lay the same points of the surface apart, mm rms."""
    moved = se3.transform_points(b @ se3.inverse(a), points)
    return float(np.sqrt(np.mean(np.sum((moved - points) ** 2, axis=1))))


def _distinct(poses: Array, points: Array, count: int) -> list[Array]:
    """The first `count` poses (H, 4, 4) of which no two are nearly the same."""
    distinct: list[Array] = []
    near = 0.1 * _radius(points)
    for pose in poses:
        if all(_apart(pose, other, points) > near for other in distinct):
            distinct.append(pose)
        if len(distinct) == count:
            break
    return distinct


def _spread_out(points: Array, count: int, nearest: float = 0.0) -> Index:
    """Rows of up to `count` points (N, 3) as far apart as can be, from the centre on, none nearer than `nearest` mm."""
    first = int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))
    return farthest_points(points, first, count, nearest)


def observability_of(points: Array, normals: Array, sigma: float, index: ScanIndex) -> Observability:
    """What point-to-plane distances, `sigma` mm each, determine: at points (N, 3) with normals, surface frame."""
    size = float(np.ptp(index.samples, axis=0).max())
    if not len(points):
        return Observability(np.eye(6), ("everything",), np.diag([np.pi**2] * 3 + [size**2] * 3), np.inf)
    centre, radius = _middle(points)
    slope, vectors = _slopes(points, normals)
    std = sigma / np.maximum(slope * np.sqrt(len(points)), 1e-12)
    free = (slope < FREE_SLOPE) | (std > FREE_STD)
    perturbation = _perturbation(centre, radius)
    spread = perturbation @ vectors @ np.diag(np.where(free, size, np.minimum(std, size)))
    motions = vectors[:, free].T
    if len(motions):  # as pure slides, as far as there are any, then by how much they turn
        motions = (np.linalg.svd(motions[:, :3])[0].T @ motions)[::-1]
    names = tuple(_name(m, centre, radius) for m in motions)
    weakest = float(std[~free].max(initial=0.0))
    return Observability(motions @ perturbation.T, names, spread @ spread.T, weakest)


def without_free(points: Array, normals: Array, step: Array) -> Array:
    """A right perturbation (6,) without motions that hardly change distances at points with normals (N, 3)."""
    slope, vectors = _slopes(points, normals)
    held = vectors[:, slope >= FREE_SLOPE]
    perturbation = _perturbation(*_middle(points))
    return np.asarray(perturbation @ held @ held.T @ np.linalg.solve(perturbation, step))


def _middle(points: Array) -> tuple[Array, float]:
    return points.mean(0), max(_radius(points), 1e-6)


def _slopes(points: Array, normals: Array) -> tuple[Array, Array]:
    """Change of distance per mm of motion (6,), least first, along six motions (6, 6), in columns."""
    centre, radius = _middle(points)
    jacobian = np.concatenate([np.cross(points - centre, normals) / radius, normals], axis=1)
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian / len(points))
    return np.sqrt(np.maximum(values, 0)), vectors


def _perturbation(centre: Array, radius: float) -> Array:
    """(6, 6) right perturbation, rad and mm, by a motion with turns about `centre`, in mm at `radius` to compare."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = np.eye(3) / radius, np.eye(3)
    out[3:, :3] = se3.hat(centre) / radius
    return out


def _name(motion: Array, centre: Array, radius: float) -> str:
    turn, move = motion[:3] / radius, motion[3:]
    if np.linalg.norm(motion[:3]) < SLIDE_TURN_SHARE:
        return f"slide along {_vector(move / np.linalg.norm(move), 2)}"
    axis = turn / np.linalg.norm(turn)
    through = centre + np.cross(turn, move) / (turn @ turn)
    return f"turn about {_vector(axis, 2)} through {_vector(through, 1)} mm"


def _vector(v: Array, digits: int) -> str:
    v = v * (1 if v[np.argmax(np.abs(v))] > 0 or digits == 1 else -1)
    return "(" + " ".join(f"{x + 0.0:.{digits}f}" for x in np.round(v, digits)) + ")"
