"""One camera's lens from its own views: homographies (Zhang 2000), refined by Levenberg-Marquardt.

Each view has its own pose, so no common clock is needed: the distortion model is chosen before time is estimated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from estimation import se3
from estimation.calibration.lens_model import MODELS, BoardViews, lens_prior, project_lens
from estimation.se3 import Array, Index, Mask

MIN_PLANE_CORNERS = 4  # corners that fix a homography
MIN_VIEW_CORNERS = 6  # of a view: four fix its pose and leave nothing to check it by
SUSPICIOUS_PX = 3.0  # px off a homography: strong distortion over a board in the corner of the image leaves 2
BLUNDER_RATIO = 2.0  # of the worst residual with and without an outlier
HUBER_SIGMAS = 3.0  # 0.3 % of pure noise is beyond, so that the covariance needs no correction for it
MAX_LM_STEPS, MIN_GAIN = 40, 1e-7  # steps; relative cost reduction below which the iteration ends
MAX_DAMPING = 1e8  # beyond, no step reduces the cost


def homography(plane: Array, pixels: Array) -> Array:
    """Homography (3, 3) of unit norm from plane points (N, 2) to pixels (N, 2), by the direct linear transform."""
    to_plane, to_pixels = _normaliser(plane), _normaliser(pixels)
    a, b = (np.c_[p, np.ones(len(p))] @ t.T for p, t in ((plane, to_plane), (pixels, to_pixels)))
    nothing = np.zeros_like(a)
    rows = np.concatenate([np.hstack([a, nothing, -b[:, :1] * a]), np.hstack([nothing, a, -b[:, 1:2] * a])])
    normalised = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    out = np.linalg.inv(to_pixels) @ normalised @ to_plane
    return np.asarray(out / np.linalg.norm(out))


def _normaliser(points: Array) -> Array:
    middle = points.mean(0)
    scale = 1.4 / max(float(np.linalg.norm(points - middle, axis=1).mean()), 1e-12)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])


def homographies(views: BoardViews) -> Array:
    """(V, 3, 3) from the board's plane, mm, to pixels about each image's middle; nan with fewer than four corners."""
    out = np.full((len(views), 3, 3), np.nan)
    for v, seen in enumerate(views.seen):
        if seen.sum() >= MIN_PLANE_CORNERS:
            middle = (np.array(views.sizes[views.camera[v]]) - 1) / 2
            out[v] = homography(views.points[seen, :2], views.pixels[v, seen] - middle)
    return out


def plane_outliers(views: BoardViews) -> Mask:
    """(V, P) corners without which the rest of their view fits a homography much better; needs no lens."""
    out = np.zeros(views.seen.shape, bool)
    for v, seen in enumerate(views.seen):
        rows = np.flatnonzero(seen)
        while len(rows) >= MIN_PLANE_CORNERS + 2:
            away = _homography_residuals(views, v, rows)
            worst = float(away.max())
            if worst < SUSPICIOUS_PX:
                break
            rest = [float(_homography_residuals(views, v, np.delete(rows, i)).max()) for i in range(len(rows))]
            if min(rest) > worst / BLUNDER_RATIO:
                break
            out[v, rows[int(np.argmin(rest))]] = True
            rows = np.delete(rows, int(np.argmin(rest)))
    return out


def _homography_residuals(views: BoardViews, v: int, rows: Index) -> Array:
    plane, pixels = views.points[rows, :2], views.pixels[v, rows]
    there = np.c_[plane, np.ones(len(rows))] @ homography(plane, pixels).T
    return np.asarray(np.linalg.norm(there[:, :2] / there[:, 2:] - pixels, axis=1))


def focal_terms(planes: Array) -> Array:
    """(3,) sums over homographies (V, 3, 3) that determine the focal length; sums of several sets add up.

    Square pixels and the axis in the image's middle are assumed: h1' w h2 = 0 and h1' w h1 = h2' w h2 with
    w = diag(1/f^2, 1/f^2, 1), which is linear in 1/f^2; weighted by tilt.
    """
    h = planes[np.isfinite(planes).all((1, 2))]
    a, b = h[:, :, 0], h[:, :, 1]
    flat = np.concatenate([(a[:, :2] * b[:, :2]).sum(1), (a[:, :2] ** 2 - b[:, :2] ** 2).sum(1)])
    deep = np.concatenate([a[:, 2] * b[:, 2], a[:, 2] ** 2 - b[:, 2] ** 2])
    scale = np.tile((a[:, :2] ** 2).sum(1), 2)
    flat, deep = flat / scale, deep / scale
    return np.array([flat @ flat, deep @ deep, flat @ deep])


def focal_from_terms(terms: Array) -> float:
    """The focal length, px, by summed terms (3,); nan where they do not determine it."""
    flat, deep, both = terms
    if not both < 0:
        return float("nan")
    return float((flat / deep) ** 0.25)  # total least squares: both sides are noisy


def poses(planes: Array, f: Array) -> Array:
    """camera_from_board (V, 4, 4) of homographies (V, 3, 3) and focal lengths (V,)."""
    columns = planes / np.stack([f, f, np.ones_like(f)], -1)[:, :, None]
    size = np.linalg.norm(columns[:, :, :2], axis=1).mean(1) * np.where(columns[:, 2, 2] < 0, -1, 1)
    columns = columns / size[:, None, None]
    x, y, shift = columns[:, :, 0], columns[:, :, 1], columns[:, :, 2]
    turns = [np.stack([a, b, np.cross(a, b)], 1) for a, b in zip(x, y, strict=True)]
    return np.stack([se3.orthonormalise(se3.make(turn, t)) for turn, t in zip(turns, shift, strict=True)])


def huber(squares: Array) -> tuple[Array, Array]:
    """Huber's cost and weight (...) of squared residual lengths (...), in sigmas."""
    length = np.sqrt(squares)
    out = length > HUBER_SIGMAS
    cost = np.where(out, 2 * HUBER_SIGMAS * length - HUBER_SIGMAS**2, squares)
    return cost, np.where(out, HUBER_SIGMAS / np.maximum(length, HUBER_SIGMAS), 1.0)


class HasCost(Protocol):
    """The normal equations at one state."""

    @property
    def cost(self) -> float:
        """Of residuals and priors."""


State = TypeVar("State")
Normal = TypeVar("Normal", bound=HasCost)


def minimise(
    state: State,
    normal: Callable[[State], Normal],
    step: Callable[[State, Normal, float], State | None],
    min_gain: float = MIN_GAIN,
) -> tuple[State, Normal]:
    """The state of least cost by Levenberg-Marquardt, and its normal equations.

    step: the state after a damped step, None where the equations cannot be solved. min_gain: relative cost reduction
    below which the iteration ends.
    """
    at, damping = normal(state), 1e-4
    for _ in range(MAX_LM_STEPS):
        while damping < MAX_DAMPING:
            tried = step(state, at, damping)
            there = None if tried is None else normal(tried)
            if tried is not None and there is not None and there.cost < at.cost:
                break
            damping *= 10
        else:
            break
        assert tried is not None and there is not None
        gain, state, at = at.cost - there.cost, tried, there
        damping = max(damping / 10, 1e-9)
        if gain <= min_gain * at.cost:
            break
    return state, at


def damped(matrix: Array, damping: float) -> Array:
    """Matrices (..., n, n) with diagonals multiplied by 1 + damping."""
    out = np.array(matrix)
    n = np.arange(matrix.shape[-1])
    out[..., n, n] *= 1 + damping
    out[..., n, n] += 1e-12
    return out


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens fitted to one camera's views."""

    model: str
    lens: Array  # (9,)
    camera_from_board: Array  # (V, 4, 4)
    residuals: Array  # (V, P, 2) px, projection less measurement, or nan
    scale: float  # of the residuals, in stated sigmas


@dataclass(frozen=True, slots=True, eq=False)
class _LensState:
    lens: Array
    poses: Array


@dataclass(frozen=True, slots=True, eq=False)
class _LensEquations:
    cost: float
    residuals: Array
    lens: Array  # (9, 9)
    cross: Array  # (V, 9, 6)
    pose: Array  # (V, 6, 6)
    lens_slope: Array  # (9,)
    pose_slope: Array  # (V, 6)


def initial_lens(views: BoardViews) -> tuple[Array, Array]:
    """A lens (9,) without distortion and poses (V, 4, 4) of one camera's views, from homographies alone."""
    planes = homographies(views)
    size = np.array(views.sizes[int(views.camera[0])], float)
    f = focal_from_terms(focal_terms(planes))
    if not 0.3 * size.max() < f < 20 * size.max():
        f = float(size.max())
    lens = np.array([f, f, *(size - 1) / 2, 0, 0, 0, 0, 0])
    return lens, poses(planes, np.full(len(views), f))


def fit_lens(
    views: BoardViews, model: str, begin: tuple[Array, Array] | None = None, min_gain: float = MIN_GAIN
) -> LensFit:
    """The lens that fits one camera's views best. begin: a lens (9,) and poses (V, 4, 4) to start from."""
    free = MODELS[model]
    lens, camera_from_board = initial_lens(views) if begin is None else begin
    lens = np.where(np.isin(np.arange(9), free), lens, 0.0)
    state, at = _minimise(views, _LensState(lens, camera_from_board), free, min_gain)
    return LensFit(model, state.lens, state.poses, at.residuals, _scale(views, at.residuals, len(free)))


def fit_poses(
    views: BoardViews, lens: Array, camera_from_board: Array, min_gain: float = MIN_GAIN
) -> tuple[Array, Array]:
    """Poses (V, 4, 4) with a fixed lens, and residuals (V, P, 2) px."""
    state, at = _minimise(views, _LensState(lens, camera_from_board), np.zeros(0, np.int64), min_gain)
    return state.poses, at.residuals


def _minimise(views: BoardViews, start: _LensState, free: Index, min_gain: float) -> tuple[_LensState, _LensEquations]:
    def step(state: _LensState, at: _LensEquations, damping: float) -> _LensState | None:
        return _lens_step(state, at, damping, free)

    return minimise(start, lambda state: _lens_equations(views, state), step, min_gain)


def _lens_equations(views: BoardViews, state: _LensState) -> _LensEquations:
    points, seen = se3.transform_points(state.poses, views.points), views.seen  # (V, P, 3), (V, P)
    if not (state.lens[:2] > 1).all() or (points[..., 2][seen] < 1.0).any():  # impossible: a corner behind the lens
        v, p = seen.shape
        zeros = np.zeros((v, p, 2)), np.zeros((9, 9)), np.zeros((v, 9, 6)), np.zeros((v, 6, 6))
        return _LensEquations(np.inf, *zeros, np.zeros(9), np.zeros((v, 6)))
    points[..., 2] = np.where(seen, points[..., 2], 1.0)
    pixels, by_lens, by_point = project_lens(state.lens, points)
    residuals = np.where(seen[..., None], pixels - np.nan_to_num(views.pixels), 0.0)
    cost, weight = huber((residuals**2).sum(-1) / views.sigma[:, None] ** 2)
    weight = weight * seen / views.sigma[:, None] ** 2
    turned = by_point @ state.poses[:, None, :3, :3]
    by_pose = np.concatenate([-turned @ se3.hat(views.points), turned], -1)
    count = len(views)
    a, b = by_lens.reshape(count, -1, 9), by_pose.reshape(count, -1, 6)
    w, r = np.repeat(weight, 2, axis=1)[..., None], residuals.reshape(count, -1, 1)
    prior = lens_prior(views.sizes[int(views.camera[0])], state.lens)
    return _LensEquations(
        float(cost[seen].sum()) + prior.cost,
        np.where(seen[..., None], residuals, np.nan),
        (np.swapaxes(a, 1, 2) @ (w * a)).sum(0) + prior.information,
        np.swapaxes(a, 1, 2) @ (w * b),
        np.swapaxes(b, 1, 2) @ (w * b),
        (np.swapaxes(a, 1, 2) @ (w * r)).sum((0, 2)) + prior.slope,
        (np.swapaxes(b, 1, 2) @ (w * r))[..., 0],
    )


def _schur_complement(at: _LensEquations, free: Index, damping: float) -> tuple[Array, Array]:
    """The lens's equations with all poses eliminated: matrix (F, F) and slope (F,)."""
    cross = at.cross[:, free]
    factor = cross @ np.linalg.inv(damped(at.pose, damping))  # (V, F, 6)
    matrix = damped(at.lens[np.ix_(free, free)], damping) - (factor @ np.swapaxes(cross, 1, 2)).sum(0)
    return matrix, at.lens_slope[free] - (factor @ at.pose_slope[..., None]).sum((0, 2))


def _lens_step(state: _LensState, at: _LensEquations, damping: float, free: Index) -> _LensState | None:
    try:
        matrix, slope = _schur_complement(at, free, damping)
        change = np.zeros(9)
        change[free] = -np.linalg.solve(matrix, slope)
        rest = at.pose_slope + np.einsum("vij,i->vj", at.cross, change)
        turn = -np.linalg.solve(damped(at.pose, damping), rest[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(turn).all() or np.abs(turn[:, :3]).max(initial=0.0) > 1.0:
        return None
    return _LensState(state.lens + change, state.poses @ se3.exp(turn))


def fit_given_lens(views: BoardViews, lens: Array) -> LensFit:
    """One camera's views with a given lens (9,); its model is the simplest that has its non-zero parameters."""
    f = np.full(len(views), float(np.sqrt(lens[0] * lens[1])))
    camera_from_board, residuals = fit_poses(views, lens, poses(homographies(views), f))
    model = next(name for name, free in MODELS.items() if not lens[np.setdiff1d(np.arange(9), free)].any())
    return LensFit(model, lens, camera_from_board, residuals, _scale(views, residuals, 0))


def _scale(views: BoardViews, residuals: Array, free: int) -> float:
    """Scatter of the residuals in stated sigmas, corrected for the degrees of freedom."""
    squares = np.nansum(residuals**2, -1) / views.sigma[:, None] ** 2
    cost = huber(squares[views.seen])[0].sum()
    return float(np.sqrt(cost / max(2 * views.seen.sum() - 6 * len(views) - free, 1)))
