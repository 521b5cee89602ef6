"""Bundle adjustment of a rig: lenses, camera poses, clock offsets and the board's motion from all corners at once.

GTSAM's Python has no stock factor with camera pose, lens and a moving board as unknowns, and a custom one is called
once per corner and step. The equations here are GTSAM's own (tangents, right perturbation, Levenberg-Marquardt, robust
weights), for all views at once: a step over 300 views takes tens of milliseconds.

Between frame sets the board moves on the exponential of the Lagrange polynomial through the logarithms of up to four
neighbouring poses, two on either side where there are two (fourth order): no parameters, and a pose depends on its
neighbours alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from estimation import se3
from estimation.calibration import lens_model
from estimation.calibration.lens_fit import damped, huber, minimise
from estimation.calibration.lens_model import CAMERA_PARAMETERS, MODELS, BoardViews, KnownLenses
from estimation.se3 import Array, Index, Mask

MAX_INSTANT_GAP = 0.5  # s between instants, beyond which the motion is not interpolated: the board is taken to rest
STENCIL_SIDE = 2  # neighbours on either side
STENCIL_WIDTH = 2 * STENCIL_SIDE  # K below
OFFSET_SIGMA = 0.5  # s: prior of a clock offset; with larger ones frames are paired differently
MEAN_OFFSET_SIGMA = 1e-6  # s: the mean of the offsets is held at zero, as only their differences are observable


@dataclass(frozen=True, slots=True, eq=False)
class Stencils:
    """The neighbours through which each instant's motion is interpolated."""

    neighbours: Index  # (S, K) instants; the instant itself where there is none
    times: Array  # (S, K) s after the instant, or nan


def stencils(stamps: Array) -> Stencils:
    """The neighbours of instants with the rising stamps (S,), s."""
    count = len(stamps)
    neighbours, times = np.repeat(np.arange(count)[:, None], STENCIL_WIDTH, 1), np.full((count, STENCIL_WIDTH), np.nan)
    for run in np.split(np.arange(count), np.flatnonzero(np.diff(stamps) > MAX_INSTANT_GAP) + 1):
        for k, i in enumerate(run):
            first = min(max(k - STENCIL_SIDE, 0), max(len(run) - STENCIL_WIDTH - 1, 0))  # one-sided at a run's ends
            others = np.delete(run[first : first + STENCIL_WIDTH + 1], k - first)
            neighbours[i, : len(others)], times[i, : len(others)] = others, stamps[others] - stamps[i]
    return Stencils(neighbours, times)


@dataclass(frozen=True, slots=True, eq=False)
class BoardPoses:
    """The board's pose in each view, and the Jacobians of its right perturbation."""

    pose: Array  # (V, 4, 4)
    by_delay: Array  # (V, 6) per s
    by_pose: Array  # (V, 6, 6 + 6 K) by the own pose, then by the neighbours


def interpolate_board(poses: Array, around: Stencils, instant: Index, delay: Array) -> BoardPoses:
    """The board's poses in views exposed `delay` (V,), s, after their instants (V,); poses: (S, 4, 4)."""
    own, others, times = poses[instant], poses[around.neighbours[instant]], around.times[instant]
    way = se3.log(se3.inverse(own)[:, None] @ others)  # (V, K, 6)
    weight, slope = _lagrange(times, delay)
    xi, rate = np.einsum("vk,vki->vi", weight, way), np.einsum("vk,vki->vi", slope, way)
    right = se3.right_jacobian(xi)
    by_pose = np.empty((len(own), 6, 6 + 6 * STENCIL_WIDTH))
    there = weight[..., None, None] * se3.inverse_right_jacobian(way)
    here = (weight[..., None, None] * se3.inverse_right_jacobian(-way)).sum(1)
    step = se3.exp(xi)
    by_pose[:, :, :6] = se3.adjoint(se3.inverse(step)) - right @ here
    by_pose[:, :, 6:] = (right[:, None] @ there).transpose(0, 2, 1, 3).reshape(-1, 6, 6 * STENCIL_WIDTH)
    return BoardPoses(own @ step, (right @ rate[..., None])[..., 0], by_pose)


def _lagrange(times: Array, at: Array) -> tuple[Array, Array]:
    """Lagrange weights (V, K) of the neighbours at `at` (V,), and their derivatives; the own node at 0 adds nothing."""
    there = np.isfinite(times)
    t = np.where(there, times, 0.0)
    safe = np.where(there, times, 1.0)
    weight, slope = at[:, None] / safe, 1 / safe
    for m in range(STENCIL_WIDTH):
        other = np.arange(STENCIL_WIDTH) != m
        used = there[:, m : m + 1] & other
        gap = np.where(used, t - t[:, m : m + 1], 1.0)
        factor = np.where(used, (at[:, None] - t[:, m : m + 1]) / gap, 1.0)
        slope = slope * factor + np.where(used, weight / gap, 0.0)
        weight = weight * factor
    return np.where(there, weight, 0.0), np.where(there, slope, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """The unknowns."""

    lens: Array  # (C, 9)
    base_from_camera: Array  # (C, 4, 4)
    offset: Array  # (C,) s, added to the stamps
    jitter: Array  # (V,) s, additional delay of single pictures
    base_from_board: Array  # (S, 4, 4) at the instants' mean stamps


@dataclass(frozen=True, slots=True, eq=False)
class RigFit:
    """The estimate. covariance: camera by camera fx .. k3, pose (right perturbation of base_from_camera), offset."""

    state: RigState
    covariance: Array  # (16 C, 16 C) at the views' stated sigma; zero for parameters that are not free
    residuals: Array  # (V, P, 2) px, projection less measurement
    image_velocity: Array  # (V, P, 2) px/s, of the corners
    scale: float  # of the residuals, in stated sigmas


@dataclass(frozen=True, slots=True, eq=False)
class RivalModel:
    """A richer lens model that may be the true one."""

    free: Mask  # (16 C,) its additional parameters
    probability: float  # that it is


@dataclass(frozen=True, slots=True, eq=False)
class RigProblem:
    """The constants of the iteration."""

    views: BoardViews
    stencils: Stencils
    late: Array  # (V,) s, each view's stamp after its instant's
    free: Mask  # (16 C,) which of the cameras' parameters are estimated
    jitter: float  # s, one sigma of single pictures' delays, 0 for none
    known: KnownLenses | None  # prior of the lenses


@dataclass(frozen=True, slots=True, eq=False)
class _RigEquations:
    cost: float
    matrix: Array
    slope: Array
    residuals: Array
    image_velocity: Array
    jitter_slope: Array  # (V,)
    jitter_own: Array  # (V,)
    jitter_cross: Array  # (V, K)
    places: Index  # (V, K) rows of the views' parameters in `matrix`


def free_numbers(models: tuple[str, ...], known: KnownLenses | None = None) -> Mask:
    """(16 C,) which parameters are free with these distortion models: not the first pose, nor exactly known numbers."""
    free = np.zeros((len(models), CAMERA_PARAMETERS), bool)
    for c, model in enumerate(models):
        free[c, MODELS[model]] = True
        if known is not None:
            free[c, :9] = known.sigma[c] > 0
        free[c, 9:15] = c > 0
        free[c, 15] = len(models) > 1
    return free.ravel()


def fit_rig(views: BoardViews, state: RigState, free: Mask, jitter: float, known: KnownLenses | None = None) -> RigFit:
    """The state that fits the views best, from a start near it. jitter: s, one sigma of single pictures' delays."""
    problem = _problem(views, free, jitter, known)
    state, at = minimise(state, lambda s: _equations(problem, s), lambda s, at, damping: _step(problem, s, at, damping))
    seen, instants = views.seen, len(state.base_from_board)
    cost = huber((np.nan_to_num(at.residuals) ** 2).sum(-1) / views.sigma[:, None] ** 2)[0][seen].sum()
    count = 2 * int(seen.sum()) - 6 * instants - int(free.sum()) - (len(views) - instants if jitter else 0)
    scale = float(np.sqrt(cost / max(count, 1)))
    return RigFit(state, _covariance(problem, at), at.residuals, at.image_velocity, scale)


def with_rivals(views: BoardViews, fit: RigFit, free: Mask, jitter: float, rivals: Sequence[RivalModel]) -> RigFit:
    """The fit with a covariance scaled by the residuals, which includes the uncertainty of the model.

    Each rival adds, times its chance, its larger covariance and the outer product of its distance (law of total
    covariance), to first order at the fit's state.
    """
    problem, size = _problem(views, free, jitter), max(fit.scale, 1.0)
    covariance = size**2 * fit.covariance
    at = _equations(problem, fit.state)
    for rival in rivals:
        wider = replace(problem, free=free | rival.free)
        change = _change(wider, at, 0.0)
        if change is not None:
            away = change[: len(free)]
            excess, known = np.zeros_like(fit.covariance), np.isfinite(fit.covariance)  # infinite entries stay
            excess[known] = size**2 * (_covariance(wider, at)[known] - fit.covariance[known])
            covariance = covariance + rival.probability * (excess + np.outer(away, away))
    return replace(fit, covariance=covariance)


def _problem(views: BoardViews, free: Mask, jitter: float, known: KnownLenses | None = None) -> RigProblem:
    first = views.stamp[0]
    stamps = first + np.bincount(views.instant, views.stamp - first) / np.bincount(views.instant)  # (S,) mean
    return RigProblem(views, stencils(stamps), views.stamp - stamps[views.instant], free, jitter, known)


def _equations(problem: RigProblem, state: RigState) -> _RigEquations:
    views = problem.views
    camera, seen = views.camera, views.seen
    delay = problem.late + state.offset[camera] + state.jitter
    board = interpolate_board(state.base_from_board, problem.stencils, views.instant, delay)
    camera_from_base = se3.inverse(state.base_from_camera)[camera]
    points = se3.transform_points(camera_from_base @ board.pose, views.points)
    if not (state.lens[:, :2] > 1).all():  # an impossible state gets an infinite cost
        state = replace(state, lens=np.maximum(state.lens, [1, 1, *[-np.inf] * 7]))
    infinite = bool((points[..., 2][seen] < 1.0).any()) or bool((state.lens[:, :2] <= 1).any())
    points[..., 2] = np.where(seen & (points[..., 2] >= 1.0), points[..., 2], 1.0)
    pixels, by_lens, by_point = lens_model.project_lens(state.lens[camera][:, None], points)
    residuals = np.where(seen[..., None], pixels - np.nan_to_num(views.pixels), 0.0)
    cost, weight = huber((residuals**2).sum(-1) / views.sigma[:, None] ** 2)
    weight = weight * seen / views.sigma[:, None] ** 2
    # Jacobians of each pixel: lens 9, camera pose 6, board pose 6 (right perturbations)
    turned = by_point @ (camera_from_base @ board.pose)[:, None, :3, :3]
    by_board = np.concatenate([-turned @ se3.hat(views.points), turned], -1)
    by_place = np.concatenate([by_point @ se3.hat(points), -by_point], -1)
    count = len(views)
    rows = np.concatenate([by_lens, by_place, by_board], -1).reshape(count, -1, 21)
    weighted = rows * np.repeat(weight, 2, axis=1)[..., None]
    square = np.swapaxes(rows, 1, 2) @ weighted
    slope = np.einsum("vri,vr->vi", weighted, residuals.reshape(count, -1))
    # Chain rule from the board's pose in the view to delay, own pose and neighbours
    chain = np.zeros((count, 21, 16 + 6 + 6 * STENCIL_WIDTH))
    chain[:, :15, :15] = np.eye(15)
    chain[:, 15:, 15], chain[:, 15:, 16:] = board.by_delay, board.by_pose
    blocks, slopes = np.swapaxes(chain, 1, 2) @ square @ chain, np.einsum("vij,vi->vj", chain, slope)
    image_velocity = np.einsum("vpij,vj->vpi", by_board, board.by_delay)
    total = float(cost[seen].sum()) if not infinite else np.inf
    residuals = np.where(seen[..., None], residuals, np.nan)
    return _assemble(problem, state, total, blocks, slopes, residuals, image_velocity)


def _assemble(
    problem: RigProblem, state: RigState, cost: float, blocks: Array, slopes: Array, residuals: Array, velocity: Array
) -> _RigEquations:
    """The normal equations from the views' blocks (V, K, K) and slopes (V, K), with jitter eliminated, and priors."""
    views, cameras, instants = problem.views, len(problem.views.names), len(state.base_from_board)
    size = CAMERA_PARAMETERS * cameras + 6 * instants
    nodes = np.concatenate([views.instant[:, None], problem.stencils.neighbours[views.instant]], 1)
    camera_rows = CAMERA_PARAMETERS * views.camera[:, None] + np.arange(CAMERA_PARAMETERS)
    board_rows = (CAMERA_PARAMETERS * cameras + 6 * nodes[..., None] + np.arange(6)).reshape(len(views), -1)
    places = np.concatenate([camera_rows, board_rows], 1)
    own, cross, jitter_slope = np.ones(len(views)), np.zeros((len(views), blocks.shape[1])), np.zeros(len(views))
    if problem.jitter:  # one delay per view: its Schur complement
        own = blocks[:, 15, 15] + 1 / problem.jitter**2
        cross = blocks[:, :, 15].copy()
        jitter_slope = slopes[:, 15] + state.jitter / problem.jitter**2
        blocks = blocks - cross[:, :, None] * cross[:, None] / own[:, None, None]
        slopes = slopes - cross * (jitter_slope / own)[:, None]
        cost += float((state.jitter**2).sum()) / problem.jitter**2
    flat = places[:, :, None] * size + places[:, None]
    matrix: Array = np.bincount(flat.ravel(), blocks.ravel(), size * size).reshape(size, size).astype(float)
    slope: Array = np.bincount(places.ravel(), slopes.ravel(), size).astype(float)
    offsets = CAMERA_PARAMETERS * np.arange(cameras) + 15
    mean = state.offset.sum() / MEAN_OFFSET_SIGMA**2
    matrix[np.ix_(offsets, offsets)] += 1 / MEAN_OFFSET_SIGMA**2 + np.eye(cameras) / OFFSET_SIGMA**2
    slope[offsets] += mean + state.offset / OFFSET_SIGMA**2
    for c in range(cameras):
        lens = slice(CAMERA_PARAMETERS * c, CAMERA_PARAMETERS * c + 9)
        priors = [lens_model.lens_prior(views.sizes[c], state.lens[c])]
        if problem.known is not None:
            priors.append(lens_model.given_prior(problem.known, c, state.lens[c]))
        for prior in priors:
            matrix[lens, lens] += prior.information
            slope[lens] += prior.slope
            cost += prior.cost
    cost += float(mean * state.offset.sum() + (state.offset**2).sum() / OFFSET_SIGMA**2)
    return _RigEquations(cost, matrix, slope, residuals, velocity, jitter_slope, own, cross, places)


def _free_rows(problem: RigProblem, size: int) -> Index:
    return np.flatnonzero(np.concatenate([problem.free, np.ones(size - len(problem.free), bool)]))


def _change(problem: RigProblem, at: _RigEquations, damping: float) -> Array | None:
    """A damped step (16 C + 6 S,) of all parameters; None where the equations cannot be solved."""
    sought = _free_rows(problem, len(at.slope))
    change = np.zeros(len(at.slope))
    try:
        factor = cho_factor(damped(at.matrix[np.ix_(sought, sought)], damping), overwrite_a=True, check_finite=False)
        change[sought] = -cho_solve(factor, at.slope[sought], check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return change


def _step(problem: RigProblem, state: RigState, at: _RigEquations, damping: float) -> RigState | None:
    change = _change(problem, at, damping)
    if change is None:
        return None
    split = CAMERA_PARAMETERS * len(state.lens)
    own, boards = change[:split].reshape(-1, CAMERA_PARAMETERS), change[split:].reshape(-1, 6)
    if not np.isfinite(change).all() or max(np.abs(own[:, 9:12]).max(), np.abs(boards[:, :3]).max()) > 1.0:
        return None
    jitter = state.jitter
    if problem.jitter:
        jitter = jitter - (at.jitter_slope + np.einsum("vk,vk->v", at.jitter_cross, change[at.places])) / at.jitter_own
    return replace(
        state,
        lens=state.lens + own[:, :9],
        base_from_camera=state.base_from_camera @ se3.exp(own[:, 9:15]),
        offset=state.offset + own[:, 15],
        jitter=jitter,
        base_from_board=state.base_from_board @ se3.exp(boards),
    )


def _covariance(problem: RigProblem, at: _RigEquations) -> Array:
    """(16 C, 16 C) marginal covariance of the cameras' parameters."""
    sought = _free_rows(problem, len(at.slope))
    count = int(problem.free.sum())
    out = np.zeros((len(problem.free), len(problem.free)))
    try:
        factor = cho_factor(at.matrix[np.ix_(sought, sought)], check_finite=False)
        inverse = cho_solve(factor, np.eye(len(sought), count), check_finite=False)[:count]
        out[np.ix_(problem.free, problem.free)] = (inverse + inverse.T) / 2
    except np.linalg.LinAlgError:
        out[problem.free, problem.free] = np.inf
    return out
