"""One camera's lens from its own views, each with a pose of its own: Zhang's method, refined, with covariance.

The views need no common clock here, so the lens and its distortion model are settled before anything is asked of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.calibration.lens_fit import focal, homographies, poses
from estimation.calibration.lens_model import MODELS, belief, image
from estimation.camera_calibration.least_squares import DONE, damped, huber, minimise
from estimation.camera_calibration.views import Views
from estimation.errors import StillbedError
from estimation.se3 import Array

LEAST_CORNERS = 6  # in a view: four fix its pose and leave nothing to tell a wrong one by


class Undetermined(StillbedError):
    """A camera whose views do not tell its lens."""


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens, its views' poses and what is left.

    lens: (9,). covariance: (9, 9) at the pixels' stated sigma, zero where a number is not free.
    camera_from_board: (V, 4, 4). residuals: (V, P, 2) px, imaged less seen, or nan. scale: theirs, in sigmas.
    """

    model: str
    lens: Array
    covariance: Array
    camera_from_board: Array
    residuals: Array
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    lens: Array
    poses: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    cost: float
    residuals: Array
    lens: Array  # (9, 9)
    cross: Array  # (V, 9, 6)
    pose: Array  # (V, 6, 6)
    lens_slope: Array  # (9,)
    pose_slope: Array  # (V, 6)


def start(views: Views) -> tuple[Array, Array]:
    """A lens (9,) without distortion and poses (V, 4, 4), from the planes alone; one camera's views."""
    found = homographies(views)
    size = np.array(views.sizes[int(views.camera[0])], float)
    f = focal(found)
    if not 0.3 * size.max() < f < 20 * size.max():
        f = float(size.max())
    lens = np.array([f, f, *(size - 1) / 2, 0, 0, 0, 0, 0])
    return lens, poses(found, np.full(len(views), f))


def fit_lens(views: Views, model: str, begin: tuple[Array, Array] | None = None, done: float = DONE) -> LensFit:
    """The lens that fits one camera's views best; begin: a lens (9,) and poses (V, 4, 4) to start from.

    done: share of the cost that is not worth another step.
    """
    free = MODELS[model]
    lens, camera_from_board = start(views) if begin is None else begin
    lens = np.where(np.isin(np.arange(9), free), lens, 0.0)

    def normal(state: _State) -> _Normal:
        return _equations(views, state)

    def moved(state: _State, at: _Normal, damping: float) -> _State | None:
        return _step(state, at, damping, free)

    state, at = minimise(_State(lens, camera_from_board), normal, moved, done)
    return LensFit(model, state.lens, _covariance(at, free), state.poses, at.residuals, _scale(views, at, len(free)))


def fit_poses(views: Views, lens: Array, camera_from_board: Array, done: float = DONE) -> tuple[Array, Array]:
    """Poses (V, 4, 4) with the lens held, and residuals (V, P, 2) px."""
    nothing = np.zeros(0, np.int64)
    state, at = minimise(
        _State(lens, camera_from_board),
        lambda state: _equations(views, state),
        lambda state, at, damping: _step(state, at, damping, nothing),
        done,
    )
    return state.poses, at.residuals


def _equations(views: Views, state: _State) -> _Normal:
    if not (state.lens[:2] > 1).all():
        return _nowhere(views)
    points = se3.transform_points(state.poses, views.points)  # (V, P, 3)
    seen = views.seen
    if (points[..., 2][seen] < 1.0).any():
        return _nowhere(views)
    points[..., 2] = np.where(seen, points[..., 2], 1.0)
    pixels, by_lens, by_point = image(state.lens, points)
    residuals = np.where(seen[..., None], pixels - np.nan_to_num(views.pixels), 0.0)
    cost, weight = huber((residuals**2).sum(-1) / views.sigma[:, None] ** 2)
    weight = weight * seen / views.sigma[:, None] ** 2
    turned = by_point @ state.poses[:, None, :3, :3]
    by_pose = np.concatenate([-turned @ se3.hat(views.points), turned], -1)
    count = len(views)
    a, b = by_lens.reshape(count, -1, 9), by_pose.reshape(count, -1, 6)
    w, r = np.repeat(weight, 2, axis=1)[..., None], residuals.reshape(count, -1, 1)
    known = belief(views.sizes[int(views.camera[0])], state.lens)
    return _Normal(
        float(cost[seen].sum()) + known.cost,
        np.where(seen[..., None], residuals, np.nan),
        (np.swapaxes(a, 1, 2) @ (w * a)).sum(0) + known.information,
        np.swapaxes(a, 1, 2) @ (w * b),
        np.swapaxes(b, 1, 2) @ (w * b),
        (np.swapaxes(a, 1, 2) @ (w * r)).sum((0, 2)) + known.slope,
        (np.swapaxes(b, 1, 2) @ (w * r))[..., 0],
    )


def _nowhere(views: Views) -> _Normal:
    """A state that images nothing: a corner behind the lens, a focal length below nothing."""
    v, p = views.seen.shape
    nothing = np.zeros((v, p, 2)), np.zeros((9, 9)), np.zeros((v, 9, 6)), np.zeros((v, 6, 6))
    return _Normal(np.inf, *nothing, np.zeros(9), np.zeros((v, 6)))


def _reduced(at: _Normal, free: NDArray[np.int64], damping: float) -> tuple[Array, Array, Array]:
    """The lens's own equations with all poses eliminated: matrix (F, F), slope (F,) and what eliminates (V, F, 6)."""
    cross = at.cross[:, free]
    gone = cross @ np.linalg.inv(damped(at.pose, damping))
    matrix = damped(at.lens[np.ix_(free, free)], damping) - (gone @ np.swapaxes(cross, 1, 2)).sum(0)
    return matrix, at.lens_slope[free] - (gone @ at.pose_slope[..., None]).sum((0, 2)), gone


def _step(state: _State, at: _Normal, damping: float, free: NDArray[np.int64]) -> _State | None:
    try:
        matrix, slope, _ = _reduced(at, free, damping)
        change = np.zeros(9)
        change[free] = -np.linalg.solve(matrix, slope)
        rest = at.pose_slope + np.einsum("vij,i->vj", at.cross, change)
        turn = -np.linalg.solve(damped(at.pose, damping), rest[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(turn).all() or np.abs(turn[:, :3]).max(initial=0.0) > 1.0:
        return None
    return _State(state.lens + change, state.poses @ se3.exp(turn))


def _covariance(at: _Normal, free: NDArray[np.int64]) -> Array:
    matrix = _reduced(at, free, 0.0)[0]
    out = np.zeros((9, 9))
    try:
        out[np.ix_(free, free)] = np.linalg.inv((matrix + matrix.T) / 2)
    except np.linalg.LinAlgError:
        out[free, free] = np.inf
    return out


def with_lens(views: Views, lens: Array) -> LensFit:
    """One camera's views with the lens (9,) as given; its model is called by the numbers that are not zero."""
    f = np.full(len(views), float(np.sqrt(lens[0] * lens[1])))
    camera_from_board, residuals = fit_poses(views, lens, poses(homographies(views), f))
    model = next(name for name, free in MODELS.items() if not lens[np.setdiff1d(np.arange(9), free)].any())
    found = _Normal(0.0, residuals, *[np.zeros(0)] * 5)
    return LensFit(model, lens, np.zeros((9, 9)), camera_from_board, residuals, _scale(views, found, 0))


def _scale(views: Views, at: _Normal, free: int) -> float:
    """Spread of the residuals, in stated sigmas, with what the fit takes out of it given back."""
    squares = np.nansum(at.residuals**2, -1) / views.sigma[:, None] ** 2
    cost = huber(squares[views.seen])[0].sum()
    return float(np.sqrt(cost / max(2 * views.seen.sum() - 6 * len(views) - free, 1)))
