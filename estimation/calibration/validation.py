"""Validation of a calibration: cross-validation of lens models and rig, and predicted error in the working volume.

Segments of the recording are held out in turn. Of a held-out segment only the board's poses are estimated, which all
cameras share, so that cameras that fit their own views but not each other's show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from estimation import se3
from estimation.calibration import lens_model
from estimation.calibration.lens_fit import LensFit, fit_lens, fit_poses, initial_lens
from estimation.calibration.lens_model import CAMERA_PARAMETERS, MODELS, BoardViews, Implausible, KnownLenses
from estimation.calibration.rig_fit import RigState, fit_rig
from estimation.rig import Rig
from estimation.se3 import Array, Index, Mask

CROSS_FOLDS = 4
FOLD_BLOCKS = 12  # segments of neighbouring views, which are similar, that are held out together
USUAL_MODEL = "k1 k2"  # of webcams: a fixed parameter is taken for exactly zero, a free one has an uncertainty
MIN_RICHER_PROBABILITY = 0.15  # of a richer lens: the views' free poses hide a part of the error from the test
RICHEST_MODEL = list(MODELS)[-1]
FOLD_MIN_GAIN = 1e-5  # relative cost reduction below which a held-out fit ends: models differ by a hundred times that
MIN_ADVANTAGE = 2.0  # standard errors of another model over the usual one: one is exceeded by chance in six
MIN_TRAINING_VIEWS = 6  # of each camera outside a fold: fewer do not determine its pose


@dataclass(frozen=True, slots=True)
class ModelScore:
    """One distortion model's error on held-out views."""

    model: str
    held_out: float  # px, RMS
    gain: float  # px^2, mean square error of the usual model less this one's
    gain_sigma: float  # px^2, standard error of `gain`

    @property
    def probability(self) -> float:
        """Probability that `gain` is positive, its mean over the views being normal."""
        return float(ndtr(self.gain / self.gain_sigma)) if self.gain_sigma > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LensChoice:
    """The chosen model and its fit to all views."""

    fit: LensFit
    scores: tuple[ModelScore, ...]  # of all models
    rival: str = ""  # the richest model, '' if it was chosen
    probability: float = 0.0  # probability that a richer model predicts better


def choose_model(views: BoardViews) -> LensChoice:
    """One camera's lens model: the usual one, or one clearly better on held-out views; plausible if any is."""
    folds = folds_of(len(views))
    fits = _fit_models(views)
    errors = {model: _fold_errors(views, fits[model], folds) for model in MODELS}
    possible = [model for model in MODELS if _is_possible(views, fits[model].lens)] or list(MODELS)
    usual = USUAL_MODEL if USUAL_MODEL in possible else possible[0]
    scores = tuple(_score(model, errors[model], errors[usual]) for model in MODELS)
    better = [s for s in scores if s.model in possible and s.gain > MIN_ADVANTAGE * s.gain_sigma]
    chosen = max(better, key=lambda s: s.gain).model if better else usual
    richer = [_score(m, errors[m], errors[chosen]) for m in possible if len(MODELS[m]) > len(MODELS[chosen])]
    if not richer:
        return LensChoice(fits[chosen], scores)
    probability = max(MIN_RICHER_PROBABILITY, *(score.probability for score in richer))
    return LensChoice(fits[chosen], scores, richer[-1].model, probability)


def validate_given_lens(views: BoardViews, given: LensFit) -> LensChoice:
    """A given lens, with the probability that a lens fitted to these views would predict held-out ones better."""
    fits, folds = _fit_models(views), folds_of(len(views))
    errors = _squares(views, given.residuals)
    rivals = [_score(model, _fold_errors(views, fits[model], folds), errors) for model in (USUAL_MODEL, RICHEST_MODEL)]
    return LensChoice(given, (), RICHEST_MODEL, max(score.probability for score in rivals))


def _is_possible(views: BoardViews, lens: Array) -> bool:
    try:
        lens_model.check_lens("", views.sizes[int(views.camera[0])], lens)
    except Implausible:
        return False
    return True


def _fit_models(views: BoardViews) -> dict[str, LensFit]:
    """Every model's fit to all views, started from the next simpler one's."""
    begin, out = initial_lens(views), {}
    for model in MODELS:
        out[model] = fit_lens(views, model, begin)
        begin = out[model].lens, out[model].camera_from_board
    return out


def folds_of(count: int) -> Index:
    """(N,) the fold of each view; neighbours stay together, each fold is spread over the recording."""
    blocks = min(FOLD_BLOCKS, count)
    return np.asarray(np.arange(count) * blocks // count % min(CROSS_FOLDS, blocks), np.int64)


def _fold_errors(views: BoardViews, whole: LensFit, folds: Index) -> Array:
    """(V,) mean squared error, px^2, of each view under the lens fitted outside its fold; whole: the fit to all."""
    out = np.zeros(len(views))
    for fold in range(folds.max() + 1):
        held, rest = folds == fold, views.select(folds == fold)
        begin = whole.lens, whole.camera_from_board[~held]
        lens = fit_lens(views.select(~held), whole.model, begin, FOLD_MIN_GAIN).lens
        out[held] = _squares(rest, fit_poses(rest, lens, whole.camera_from_board[held], FOLD_MIN_GAIN)[1])
    return out


def _squares(views: BoardViews, residuals: Array) -> Array:
    """(V,) mean squared length, px^2, of each view's residuals (V, P, 2)."""
    limit = (6 * views.sigma[:, None]) ** 2  # bounds the effect of outliers
    return np.asarray(np.nanmean(np.minimum((residuals**2).sum(-1), limit * 4), axis=1))


def _score(model: str, errors: Array, usual: Array) -> ModelScore:
    gain = usual - errors
    rms, gain_sigma = float(np.sqrt(errors.mean() / 2)), float(gain.std() / np.sqrt(len(gain)))
    return ModelScore(model, rms, float(gain.mean()), gain_sigma)


def held_out_residuals(
    views: BoardViews, state: RigState, free: Mask, jitter: float, known: KnownLenses | None = None
) -> Array:
    """Residuals (V, P, 2) px of every view under the rig of the other folds, nan where undetermined; state: of all."""
    out = np.full(views.pixels.shape, np.nan)
    folds = folds_of(len(state.base_from_board))[views.instant]
    for fold in range(folds.max() + 1):
        held, cameras = folds == fold, range(len(views.names))
        if min(int((~held & (views.camera == c)).sum()) for c in cameras) < MIN_TRAINING_VIEWS:
            continue
        rig = fit_rig(views.select(~held), _state_of(views, state, ~held), free, jitter, known).state
        own = _state_of(views, state, held)
        begin = replace(own, lens=rig.lens, base_from_camera=rig.base_from_camera, offset=rig.offset)
        out[held] = fit_rig(views.select(held), begin, np.zeros_like(free), jitter, known).residuals
    return out


def _state_of(views: BoardViews, state: RigState, rows: Mask) -> RigState:
    boards = state.base_from_board[np.unique(views.instant[rows])]
    return replace(state, jitter=state.jitter[rows], base_from_board=boards)


@dataclass(frozen=True, slots=True, eq=False)
class VolumeError:
    """Predicted errors over a working volume."""

    points: Array  # (N, 3) mm, base
    error: Array  # (N,) mm, one sigma in 3D from the calibration; nan if fewer than two cameras see the point
    pixel: Array  # (N,) mm, from one pixel of noise per camera; nan likewise
    seen: Array  # (N,) number of cameras that see the point

    @property
    def typical(self) -> float:
        """Root mean square of the error, mm; nan where no point is seen by two cameras."""
        known = self.error[np.isfinite(self.error)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    @property
    def worst(self) -> float:
        """95th percentile of the error, mm; nan likewise."""
        known = self.error[np.isfinite(self.error)]
        return float(np.percentile(known, 95)) if len(known) else float("nan")


def volume_error(rig: Rig, covariance: Array, points: Array, speed: float = 0.0) -> VolumeError:
    """Errors of triangulated points (N, 3) mm, base, of a surface that moves at `speed`, mm/s, in any direction.

    covariance: (16 C, 16 C) of the cameras' parameters. What moves all points as one rigid body is no error for
    printing: the surface is tracked in the same frame that it is printed in.
    """
    count, cameras, seen = len(points), len(rig), []
    by_point = np.zeros((count, 2 * cameras, 3))
    by_rig = np.zeros((count, 2 * cameras, CAMERA_PARAMETERS * cameras))
    for c, camera in enumerate(rig.cameras):
        camera_from_base = se3.inverse(camera.base_from_camera)
        inside = se3.transform_points(camera_from_base, points)
        front = inside[:, 2] > 1.0
        inside[:, 2] = np.where(front, inside[:, 2], 1.0)
        pixels, by_lens, by_place = lens_model.project_lens(lens_model.lens_parameters(camera), inside)
        visible = front & (pixels >= 0).all(1) & (pixels <= np.array(camera.size) - 1).all(1)
        rows, columns = slice(2 * c, 2 * c + 2), CAMERA_PARAMETERS * c
        by_point[:, rows] = np.where(visible[:, None, None], by_place @ camera_from_base[:3, :3], 0.0)
        own = np.concatenate([by_lens, by_place @ se3.hat(inside), -by_place], -1)
        by_rig[:, rows, columns : columns + 15] = np.where(visible[:, None, None], own, 0.0)
        seen.append(visible)
    number = np.sum(seen, axis=0)
    known = number >= 2
    information = np.where(known[:, None, None], np.swapaxes(by_point, 1, 2) @ by_point, np.eye(3))
    spread = np.linalg.inv(information)
    moves = -spread @ np.swapaxes(by_point, 1, 2) @ by_rig  # (N, 3, 16 C): triangulation, linearised
    error, pixel = np.full(count, np.nan), np.sqrt(np.trace(spread, axis1=1, axis2=2))
    if known.any():
        moved = _remove_rigid_motion(points[known], moves[known])
        late = _clock_variance(covariance, spread[known], by_point[known], cameras, speed)
        variance = np.einsum("nia,ab,nib->n", moved, covariance, moved) + late
        error[known] = np.sqrt(np.maximum(variance, 0.0))
    return VolumeError(points, error, np.where(known, pixel, np.nan), number.astype(float))


def _remove_rigid_motion(points: Array, moves: Array) -> Array:
    """Moves (N, 3, K) of points less their best common rigid motion; nothing is left of a single point's."""
    middle = points - points.mean(0)
    size = max(float(np.abs(middle).max()), 1.0)
    rigid = np.concatenate([-se3.hat(middle / size), np.broadcast_to(np.eye(3), (len(points), 3, 3))], -1)
    base = np.linalg.svd(rigid.reshape(-1, 6), full_matrices=False)
    basis = base[0][:, base[1] > 1e-9 * base[1][0]]
    flat = moves.reshape(-1, moves.shape[-1])
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(moves.shape))


def _clock_variance(covariance: Array, spread: Array, by_point: Array, cameras: int, speed: float) -> Array:
    """Variance (N,), mm^2, from the clock offsets at `speed` mm/s, as the mean over all directions."""
    out = np.zeros(len(spread))
    if not speed:
        return out
    offsets = covariance[15::CAMERA_PARAMETERS, 15::CAMERA_PARAMETERS]
    own = [by_point[:, 2 * c : 2 * c + 2] for c in range(cameras)]  # (N, 2, 3) of each camera
    for direction in np.eye(3):
        pulls = [spread @ np.swapaxes(by, 1, 2) @ (by @ direction)[..., None] for by in own]
        by_offset = np.concatenate(pulls, -1) * speed  # (N, 3, C)
        out += np.einsum("nia,ab,nib->n", by_offset, offsets, by_offset) / 3
    return out
