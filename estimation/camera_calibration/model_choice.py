"""Which distortion model a camera's views support, by the error on views that were held out (cross-validation)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from estimation.calibration.lens_model import MODELS
from estimation.camera_calibration.lens_fit import LensFit, fit_lens, fit_poses, start
from estimation.camera_calibration.plausible import Implausible, check_lens
from estimation.camera_calibration.views import Views
from estimation.se3 import Array

FOLDS = 4
BLOCKS = 12  # stretches of neighbouring views that are held out as one: neighbours look alike
USUAL = "k1 k2"  # what any webcam is given: a number left out is claimed to be zero, one kept has its doubt stated
LEAST_CHANCE = 0.15  # of a richer lens, whatever the test says: each view's own pose hides what the whole rig shows
RICHEST = list(MODELS)[-1]
ENOUGH = 1e-5  # share of a held-out fit's cost that is not worth another step: models differ by a hundred times that
WORTH = 2.0  # standard errors by which another model must beat the usual one: one is passed by chance in six


@dataclass(frozen=True, slots=True)
class ModelScore:
    """One model's root mean square error on held-out views, px; by how much it is ahead of the usual model's mean
    square, px^2, and the standard error of that.
    """

    model: str
    held_out: float
    ahead: float
    doubt: float

    @property
    def chance(self) -> float:
        """That it is ahead at all, 0 to 1, the mean over the views being normal."""
        return float(ndtr(self.ahead / self.doubt)) if self.doubt > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The chosen model's fit to all views, and how all models did.

    rival: the richest model, '' where it was chosen. chance: that a model richer than the chosen one predicts better
    after all, 0 to 1.
    """

    fit: LensFit
    scores: tuple[ModelScore, ...]
    rival: str = ""
    chance: float = 0.0


def choose(views: Views) -> Choice:
    """The usual model, or the one that beats it clearly on views held out; one camera's views.

    Models whose fit no lens can have are passed over, unless all are.
    """
    folds = folds_of(len(views))
    fits = _fits(views)
    errors = {model: _held_out(views, fits[model], folds) for model in MODELS}
    possible = [model for model in MODELS if _is_possible(views, fits[model].lens)] or list(MODELS)
    usual = USUAL if USUAL in possible else possible[0]
    scores = tuple(_score(model, errors[model], errors[usual]) for model in MODELS)
    better = [s for s in scores if s.model in possible and s.ahead > WORTH * s.doubt]
    chosen = max(better, key=lambda s: s.ahead).model if better else usual
    richer = [_score(m, errors[m], errors[chosen]) for m in possible if len(MODELS[m]) > len(MODELS[chosen])]
    if not richer:
        return Choice(fits[chosen], scores)
    return Choice(fits[chosen], scores, richer[-1].model, max(LEAST_CHANCE, *(score.chance for score in richer)))


def doubted(views: Views, given: LensFit) -> Choice:
    """A lens that was given, with the chance that one sought from these views images others of them better."""
    fits, folds = _fits(views), folds_of(len(views))
    kept = _squares(views, given.residuals)
    rivals = [_score(model, _held_out(views, fits[model], folds), kept) for model in (USUAL, RICHEST)]
    return Choice(given, (), RICHEST, max(score.chance for score in rivals))


def _is_possible(views: Views, lens: Array) -> bool:
    try:
        check_lens("", views.sizes[int(views.camera[0])], lens)
    except Implausible:
        return False
    return True


def _fits(views: Views) -> dict[str, LensFit]:
    """Every model's fit to all views, each from the next simpler one's."""
    begin, out = start(views), {}
    for model in MODELS:
        out[model] = fit_lens(views, model, begin)
        begin = out[model].lens, out[model].camera_from_board
    return out


def folds_of(count: int) -> NDArray[np.int64]:
    """(N,) the fold that each view is held out in; neighbours go together, each fold is spread over the recording."""
    blocks = min(BLOCKS, count)
    return np.asarray(np.arange(count) * blocks // count % min(FOLDS, blocks), np.int64)


def _held_out(views: Views, whole: LensFit, folds: NDArray[np.int64]) -> Array:
    """(V,) mean squared error, px^2, of each view under the lens of those outside its fold; whole: the fit to all."""
    out = np.zeros(len(views))
    for fold in range(folds.max() + 1):
        kept, held = folds != fold, folds == fold
        lens = fit_lens(views.only(kept), whole.model, (whole.lens, whole.camera_from_board[kept]), ENOUGH).lens
        rest = views.only(held)
        out[held] = _squares(rest, fit_poses(rest, lens, whole.camera_from_board[held], ENOUGH)[1])
    return out


def _squares(views: Views, residuals: Array) -> Array:
    """(V,) mean squared length, px^2, of each view's residuals (V, P, 2)."""
    limit = (6 * views.sigma[:, None]) ** 2  # a blunder says nothing of a lens
    return np.asarray(np.nanmean(np.minimum((residuals**2).sum(-1), limit * 4), axis=1))


def _score(model: str, errors: Array, usual: Array) -> ModelScore:
    ahead = usual - errors
    return ModelScore(
        model, float(np.sqrt(errors.mean() / 2)), float(ahead.mean()), float(ahead.std() / np.sqrt(len(ahead)))
    )
