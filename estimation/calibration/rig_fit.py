"""All cameras at once: lenses, places, clock offsets and the board's motion, adjusted to every corner that was seen.

GTSAM's Python has no stock factor in which a camera's place, its lens and a moving board are unknown together, and one
written in Python is called once per corner and step. The equations here are GTSAM's own (tangents, right perturbation,
Levenberg and Marquardt, robust weights), made for all views at once: a step over 300 views takes tens of milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from estimation import se3
from estimation.calibration.lens_model import MODELS, KnownLenses, belief, image, knowledge
from estimation.camera_calibration.board_motion import WIDTH, Stencils, carried, stencils
from estimation.camera_calibration.least_squares import damped, huber, minimise
from estimation.camera_calibration.views import Views
from estimation.se3 import Array

OWN = 16  # numbers per camera: lens 9, place 6, offset 1
OFFSET = slice(15, 16)
FAR = 0.5  # s: one sigma of an offset before any view; beyond it frames would have been paired otherwise
MEAN = 1e-6  # s: the mean of the offsets is held at zero, since the board's own clock is nobody's


@dataclass(frozen=True, slots=True, eq=False)
class RigState:
    """What is unknown. lens: (C, 9). base_from_camera: (C, 4, 4). offset: (C,) s, added to the stamps. jitter: (V,) s,
    beyond it, of single pictures. base_from_board: (S, 4, 4) at the instants' mean stamps.
    """

    lens: Array
    base_from_camera: Array
    offset: Array
    jitter: Array
    base_from_board: Array


@dataclass(frozen=True, slots=True, eq=False)
class RigFit:
    """The state that fits best.

    covariance: (16 C, 16 C) at the views' stated sigma, camera by camera: fx .. k3, place (a right perturbation of
    base_from_camera), offset; zero where nothing was free or doubted. residuals: (V, P, 2) px, imaged less
    seen. pace: (V, P, 2) px/s by which the board passed. scale: of the residuals, in stated sigmas.
    """

    state: RigState
    covariance: Array
    residuals: Array
    pace: Array
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """A richer model that may be the true one. free: (16 C,) what it seeks. chance: 0 to 1."""

    free: NDArray[np.bool_]
    chance: float


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What stays the same from step to step.

    free: (16 C,) which of the cameras' numbers are sought. jitter: s, one sigma of single pictures' own delays, 0 for
    none. known: of the lenses, if anything. late: (V,) s, each view's stamp after its instant's.
    """

    views: Views
    who: Stencils
    late: Array
    free: NDArray[np.bool_]
    jitter: float
    known: KnownLenses | None


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    cost: float
    matrix: Array
    slope: Array
    residuals: Array
    pace: Array
    jitter_slope: Array  # (V,)
    jitter_own: Array  # (V,)
    jitter_cross: Array  # (V, K)
    places: NDArray[np.int64]  # (V, K) rows of the views' numbers in `matrix`


def instant_stamps(views: Views) -> Array:
    """(S,) s: the mean stamp of each instant's views."""
    first = views.stamp[0]
    return np.asarray(first + np.bincount(views.instant, views.stamp - first) / np.bincount(views.instant))


def free_numbers(models: tuple[str, ...], known: KnownLenses | None = None) -> NDArray[np.bool_]:
    """(16 C,) what is sought with these distortion models: the first camera's place is the base.

    known: what of the lenses is known; what is known exactly is not sought.
    """
    free = np.zeros((len(models), OWN), bool)
    for c, model in enumerate(models):
        free[c, MODELS[model]] = True
        if known is not None:
            free[c, :9] = known.sigma[c] > 0
        free[c, 9:15] = c > 0
        free[c, OFFSET] = len(models) > 1
    return free.ravel()


def fit_rig(
    views: Views, state: RigState, free: NDArray[np.bool_], jitter: float, known: KnownLenses | None = None
) -> RigFit:
    """The state that fits the views best, from a near one. jitter: s, one sigma of single pictures' delays."""
    problem = _problem(views, free, jitter, known)
    state, at = minimise(state, lambda s: _equations(problem, s), lambda s, at, damping: _step(problem, s, at, damping))
    seen, instants = views.seen, len(state.base_from_board)
    cost = huber((np.nan_to_num(at.residuals) ** 2).sum(-1) / views.sigma[:, None] ** 2)[0][seen].sum()
    count = 2 * int(seen.sum()) - 6 * instants - int(free.sum()) - (len(views) - instants if jitter else 0)
    scale = float(np.sqrt(cost / max(count, 1)))
    return RigFit(state, _covariance(problem, at), at.residuals, at.pace, scale)


def with_rivals(views: Views, fit: RigFit, free: NDArray[np.bool_], jitter: float, rivals: Sequence[Rival]) -> RigFit:
    """The fit with a covariance in real units, which also holds which model is the true one.

    Residuals larger than stated widen it. Each rival adds, by its chance, what it knows less and how far it lies away
    (the total covariance over the models), to first order at the fit's state.
    """
    problem, size = _problem(views, free, jitter), max(fit.scale, 1.0)
    covariance = size**2 * fit.covariance
    at = _equations(problem, fit.state)
    for rival in rivals:
        wider = replace(problem, free=free | rival.free)
        change = _change(wider, at, 0.0)
        if change is not None:
            away = change[: len(free)]
            less, known = np.zeros_like(fit.covariance), np.isfinite(fit.covariance)  # of what is not, nothing is less
            less[known] = size**2 * (_covariance(wider, at)[known] - fit.covariance[known])
            covariance = covariance + rival.chance * (less + np.outer(away, away))
    return replace(fit, covariance=covariance)


def _problem(views: Views, free: NDArray[np.bool_], jitter: float, known: KnownLenses | None = None) -> Problem:
    stamps = instant_stamps(views)
    return Problem(views, stencils(stamps), views.stamp - stamps[views.instant], free, jitter, known)


def _equations(problem: Problem, state: RigState) -> _Normal:
    views = problem.views
    camera, seen = views.camera, views.seen
    delay = problem.late + state.offset[camera] + state.jitter
    board = carried(state.base_from_board, problem.who, views.instant, delay)
    camera_from_base = se3.inverse(state.base_from_camera)[camera]
    points = se3.transform_points(camera_from_base @ board.pose, views.points)
    if not (state.lens[:, :2] > 1).all():
        state = replace(state, lens=np.maximum(state.lens, [1, 1, *[-np.inf] * 7]))
    infinite = bool((points[..., 2][seen] < 1.0).any()) or bool((state.lens[:, :2] <= 1).any())
    points[..., 2] = np.where(seen & (points[..., 2] >= 1.0), points[..., 2], 1.0)
    pixels, by_lens, by_point = image(state.lens[camera][:, None], points)
    residuals = np.where(seen[..., None], pixels - np.nan_to_num(views.pixels), 0.0)
    cost, weight = huber((residuals**2).sum(-1) / views.sigma[:, None] ** 2)
    weight = weight * seen / views.sigma[:, None] ** 2
    turned = by_point @ (camera_from_base @ board.pose)[:, None, :3, :3]
    by_board = np.concatenate([-turned @ se3.hat(views.points), turned], -1)
    by_place = np.concatenate([by_point @ se3.hat(points), -by_point], -1)
    count = len(views)
    rows = np.concatenate([by_lens, by_place, by_board], -1).reshape(count, -1, 21)
    weighted = rows * np.repeat(weight, 2, axis=1)[..., None]
    square = np.swapaxes(rows, 1, 2) @ weighted
    slope = np.einsum("vri,vr->vi", weighted, residuals.reshape(count, -1))
    chain = np.zeros((count, 21, 16 + 6 + 6 * WIDTH))
    chain[:, :15, :15] = np.eye(15)
    chain[:, 15:, 15], chain[:, 15:, 16:] = board.by_delay, board.by_pose
    blocks, slopes = np.swapaxes(chain, 1, 2) @ square @ chain, np.einsum("vij,vi->vj", chain, slope)
    pace = np.einsum("vpij,vj->vpi", by_board, board.by_delay)
    total = float(cost[seen].sum()) if not infinite else np.inf
    shown = np.where(seen[..., None], residuals, np.nan)
    return _assembled(problem, state, total, blocks, slopes, shown, pace)


def _assembled(
    problem: Problem, state: RigState, cost: float, blocks: Array, slopes: Array, residuals: Array, pace: Array
) -> _Normal:
    """The views' equations, blocks (V, K, K) and slopes (V, K), put together, with what is believed beforehand."""
    views, cameras, instants = problem.views, len(problem.views.names), len(state.base_from_board)
    size = OWN * cameras + 6 * instants
    who = np.concatenate([views.instant[:, None], problem.who.neighbours[views.instant]], 1)
    places = np.concatenate(
        [
            OWN * views.camera[:, None] + np.arange(OWN),
            (OWN * cameras + 6 * who[..., None] + np.arange(6)).reshape(len(views), -1),
        ],
        1,
    )
    own, cross, jitter_slope = np.ones(len(views)), np.zeros((len(views), blocks.shape[1])), np.zeros(len(views))
    if problem.jitter:
        own = blocks[:, 15, 15] + 1 / problem.jitter**2
        cross = blocks[:, :, 15].copy()
        jitter_slope = slopes[:, 15] + state.jitter / problem.jitter**2
        blocks = blocks - cross[:, :, None] * cross[:, None] / own[:, None, None]
        slopes = slopes - cross * (jitter_slope / own)[:, None]
        cost += float((state.jitter**2).sum()) / problem.jitter**2
    flat = places[:, :, None] * size + places[:, None]
    matrix: Array = np.bincount(flat.ravel(), blocks.ravel(), size * size).reshape(size, size).astype(float)
    slope: Array = np.bincount(places.ravel(), slopes.ravel(), size).astype(float)
    offsets = OWN * np.arange(cameras) + 15
    mean = state.offset.sum() / MEAN**2
    matrix[np.ix_(offsets, offsets)] += 1 / MEAN**2 + np.eye(cameras) / FAR**2
    slope[offsets] += mean + state.offset / FAR**2
    for c in range(cameras):
        lens, beliefs = slice(OWN * c, OWN * c + 9), [belief(views.sizes[c], state.lens[c])]
        if problem.known is not None:
            beliefs.append(knowledge(problem.known, c, state.lens[c]))
        for believed in beliefs:
            matrix[lens, lens] += believed.information
            slope[lens] += believed.slope
            cost += believed.cost
    cost += float(mean * state.offset.sum() + (state.offset**2).sum() / FAR**2)
    return _Normal(cost, matrix, slope, residuals, pace, jitter_slope, own, cross, places)


def _sought(problem: Problem, size: int) -> NDArray[np.int64]:
    return np.flatnonzero(np.concatenate([problem.free, np.ones(size - len(problem.free), bool)]))


def _change(problem: Problem, at: _Normal, damping: float) -> Array | None:
    """(16 C + 6 S,) what a damped step adds to all numbers; None where the equations cannot be solved."""
    sought = _sought(problem, len(at.slope))
    change = np.zeros(len(at.slope))
    try:
        factor = cho_factor(damped(at.matrix[np.ix_(sought, sought)], damping), overwrite_a=True, check_finite=False)
        change[sought] = -cho_solve(factor, at.slope[sought], check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return change


def _step(problem: Problem, state: RigState, at: _Normal, damping: float) -> RigState | None:
    change = _change(problem, at, damping)
    if change is None:
        return None
    split = OWN * len(state.lens)
    own, boards = change[:split].reshape(-1, OWN), change[split:].reshape(-1, 6)
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


def _covariance(problem: Problem, at: _Normal) -> Array:
    """(16 C, 16 C) of the cameras' numbers, boards and jitters being unknown too."""
    sought = _sought(problem, len(at.slope))
    count = int(problem.free.sum())
    out = np.zeros((len(problem.free), len(problem.free)))
    try:
        factor = cho_factor(at.matrix[np.ix_(sought, sought)], check_finite=False)
        inverse = cho_solve(factor, np.eye(len(sought), count), check_finite=False)[:count]
        out[np.ix_(problem.free, problem.free)] = (inverse + inverse.T) / 2
    except np.linalg.LinAlgError:
        out[problem.free, problem.free] = np.inf
    return out
