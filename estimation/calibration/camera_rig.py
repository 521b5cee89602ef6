"""From corners to a calibrated rig: lenses first, each by itself, then everything together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.calibration.lens_fit import LEAST, plane_blunders
from estimation.calibration.lens_model import MODELS, KnownLenses, matrix_of
from estimation.calibration.rig_fit import OWN, RigFit, RigState, Rival, fit_rig, free_numbers, with_rivals
from estimation.camera_calibration.held_out import held_out
from estimation.camera_calibration.lens_fit import LEAST_CORNERS, LensFit, Undetermined, fit_lens, with_lens
from estimation.camera_calibration.model_choice import Choice, ModelScore, choose, doubted
from estimation.camera_calibration.plausible import check_doubt, check_lens, check_neighbours
from estimation.camera_calibration.rig_start import first_rig
from estimation.camera_calibration.views import Views
from estimation.rig import Camera, Rig
from estimation.se3 import Array

FEWEST = 10  # views of a camera: eight leave a distortion model to chance, and a minute gives hundreds
OUTLIER = 6.0  # sigmas; and
OUTLIER_PX = 0.5  # px at least: a corner this near is none that was found wrong
WRONG_SHARE = 0.5  # of a view's corners, beyond which all of it is dropped
FIRST_SIGMA = 0.3  # px, of a corner, until the residuals tell it
RAYLEIGH = 1.18  # median length of a vector whose two entries are normal, in their sigmas
FINEST = 0.01  # px: no corner is found better, whatever the residuals of a few say
WORST_FIT = 2.0  # px, of a camera's own views: beyond, the board's drawing is not what hung before it
JITTER_ROUNDS = 6
LEAST_JITTER = 3e-4  # s: below, single pictures are on time
UNEXPLAINED = 1.15  # times the cameras' own residuals, that instants in common must leave before they are doubted

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated rig and all that is known about it.

    rig: base is the first camera. fit: the joint adjustment, whose covariance is already in real units. views: those
    used, with the sigma that their residuals show. choices: per camera. jitter: s, one sigma of single pictures' own
    delays; 0 where the stamps are as good as the pictures tell. dropped: corners left out as blunders. held_out:
    (V, P, 2) px, residuals under the rig that the rest of the recording gives.
    """

    rig: Rig
    fit: RigFit
    views: Views
    models: tuple[str, ...]
    scores: tuple[tuple[ModelScore, ...], ...]
    jitter: float
    dropped: int
    held_out: Array

    def covariance_of(self, camera: int) -> Array:
        """(16, 16) of one camera's numbers: lens 9, place 6, offset 1."""
        rows = slice(OWN * camera, OWN * camera + OWN)
        return np.asarray(self.fit.covariance[rows, rows])


def calibrate(views: Views, say: Say | None = None, known: KnownLenses | None = None) -> Calibration:
    """The rig that the views tell.

    Undetermined where they do not tell it, Implausible where what they tell is no camera; both name camera and figure.
    say: told what is being done. known: lenses that are taken as they are, or within what they are said to be off by.
    """
    tell = say or _silent
    views, choices, dropped = lenses(views, tell, known)
    names, models = views.names, tuple(choice.fit.model for choice in choices)
    camera_from_board = np.full((len(views), 4, 4), np.nan)
    for c, choice in enumerate(choices):
        camera_from_board[views.camera == c] = choice.fit.camera_from_board
    tell("places and clocks of all cameras together")
    base_from_camera, base_from_board = first_rig(views, camera_from_board)
    nothing = np.zeros(len(names)), np.zeros(len(views))
    state = RigState(np.stack([c.fit.lens for c in choices]), base_from_camera, *nothing, base_from_board)
    views, fit, jitter, more = adjust(views, state, choices, known)
    for c, name in enumerate(names):
        check_lens(name, views.sizes[c], fit.state.lens[c])
        if known is None:
            check_doubt(name, fit.state.lens[c], fit.covariance[OWN * c : OWN * c + 9, OWN * c : OWN * c + 9])
    check_neighbours(names, views.sizes, fit.state.lens)
    scores = tuple(choice.scores for choice in choices)
    tell("stretches held out, one after another")
    unseen = held_out(views, fit.state, free_numbers(models, known), jitter, known)
    return Calibration(rig_of(views, fit.state), fit, views, models, scores, jitter, dropped + more, unseen)


def lenses(views: Views, say: Say, known: KnownLenses | None = None) -> tuple[Views, list[Choice], int]:
    """The views that are used, with their measured sigmas, each camera's lens by itself, and corners dropped."""
    kept, sigma, choices = np.zeros(len(views), bool), views.sigma.copy(), []
    first = plane_blunders(views)
    views, dropped = views.without(first), int(first.sum())
    pixels = views.pixels.copy()
    for c, name in enumerate(views.names):
        say(f"lens of {name}")
        rows = np.flatnonzero((views.camera == c) & (views.seen.sum(1) >= LEAST_CORNERS))
        _check_number(name, len(rows))
        own = views.only(rows)
        own, choice, out = _chosen(own) if known is None else _given(own, known.lens[c], not known.sigma[c].any())
        good = own.without(out).seen.sum(1) >= np.maximum(LEAST_CORNERS, WRONG_SHARE * own.seen.sum(1))
        _check_number(name, int(good.sum()))
        dropped += int(out.sum())
        pixels[rows] = own.without(out).pixels
        own = own.without(out).only(good)
        begin = choice.fit.lens, choice.fit.camera_from_board[good]
        fit = fit_lens(own, choice.fit.model, begin) if known is None else with_lens(own, known.lens[c])
        _check_fit(name, own, fit)
        check_lens(name, own.sizes[c], fit.lens)
        choices.append(replace(choice, fit=fit))
        kept[rows[good]] = True
        sigma[rows[good]] = np.maximum(own.sigma * fit.scale, FINEST)
    views = replace(views, pixels=pixels, sigma=sigma)
    return views.only(kept), choices, dropped


def _chosen(own: Views) -> tuple[Views, Choice, NDArray[np.bool_]]:
    """One camera's views with their own spread, their model and lens, and which corners (V, P) are blunders."""
    own = replace(own, sigma=np.full(len(own), FIRST_SIGMA))
    rough = fit_lens(own, "k1 k2")
    usual = float(np.nanmedian(np.linalg.norm(rough.residuals, axis=-1))) / RAYLEIGH
    own = replace(own, sigma=np.full(len(own), max(usual, FINEST)))
    rough = fit_lens(own, "k1 k2", (rough.lens, rough.camera_from_board))
    out = blunders(own, rough.residuals, rough.scale)
    out &= (~out & own.seen).sum(1, keepdims=True) >= LEAST  # a view that is wrong as a whole is dropped as a whole
    return own, choose(own.without(out)), out


def _given(own: Views, lens: Array, exact: bool) -> tuple[Views, Choice, NDArray[np.bool_]]:
    """As `_chosen`, with a lens (9,) that is known. exact: whether nobody told how far it may be off."""
    rough = with_lens(replace(own, sigma=np.full(len(own), FIRST_SIGMA)), lens)
    usual = float(np.nanmedian(np.linalg.norm(rough.residuals, axis=-1))) / RAYLEIGH
    own = replace(own, sigma=np.full(len(own), max(usual, FINEST)))
    fit = with_lens(own, lens)
    out = blunders(own, fit.residuals, fit.scale)
    out &= (~out & own.seen).sum(1, keepdims=True) >= LEAST
    if not exact:
        return own, Choice(fit, ()), out
    left = own.without(out)
    return own, doubted(left, with_lens(left, lens)), out


def blunders(views: Views, residuals: Array, scale: float) -> NDArray[np.bool_]:
    """(V, P) which corners are not where the rest says; their spread is told by the median, which they do not pull."""
    away = np.linalg.norm(residuals, axis=-1)
    usual = min(scale * float(np.median(views.sigma)), float(np.nanmedian(away)) / RAYLEIGH)
    return np.asarray(np.nan_to_num(away) > max(OUTLIER * usual, OUTLIER_PX))


def adjust(
    views: Views, state: RigState, choices: Sequence[Choice], known: KnownLenses | None = None
) -> tuple[Views, RigFit, float, int]:
    """The joint adjustment: views without blunders, fit, jitter (s) and how many corners were dropped.

    Where instants in common leave more than the cameras' own residuals, single pictures are late by amounts of their
    own; how much is found by expectation maximisation.
    """
    free = free_numbers(tuple(choice.fit.model for choice in choices), known)
    fit = fit_rig(views, state, free, 0.0, known)
    jitter = 0.0
    if fit.scale > UNEXPLAINED and len(choices) > 1:
        jitter = first_jitter(views, fit)
        for _ in range(JITTER_ROUNDS if jitter > LEAST_JITTER else 0):
            fit = fit_rig(views, fit.state, free, jitter, known)
            jitter = _jitter(views, fit, jitter)
        jitter = jitter if jitter > LEAST_JITTER else 0.0
    out = blunders(views, fit.residuals, fit.scale)
    kept = views.without(out).seen.sum(1) >= 4
    left = views.without(out).only(kept)
    boards = np.isin(np.arange(len(fit.state.base_from_board)), views.instant[kept])
    state = replace(
        fit.state, jitter=fit.state.jitter[kept] * (jitter > 0), base_from_board=fit.state.base_from_board[boards]
    )
    fit = with_rivals(left, fit_rig(left, state, free, jitter, known), free, jitter, rivals_of(choices))
    return left, fit, jitter, int(out.sum())


def rivals_of(choices: Sequence[Choice]) -> list[Rival]:
    """The models that may be the true ones after all, one camera at a time."""
    out = []
    for c, choice in enumerate(choices):
        if choice.rival:
            free = np.zeros(OWN * len(choices), bool)
            free[OWN * c + MODELS[choice.rival]] = True
            out.append(Rival(free, choice.chance))
    return out


def _delays(views: Views, fit: RigFit) -> tuple[Array, Array]:
    """How much later each view looks than it is taken to be, s, and the variance (V,) of that, by its corners alone."""
    seen = views.seen[..., None]
    pace, residuals = np.where(seen, fit.pace, 0.0), np.where(seen, fit.residuals, 0.0)
    information = (pace**2).sum((1, 2)) / views.sigma**2
    late = -(pace * residuals).sum((1, 2)) / views.sigma**2 / np.maximum(information, 1e-9)
    return late, 1 / np.maximum(information, 1e-9)


def first_jitter(views: Views, fit: RigFit) -> float:
    """One sigma, s, of single pictures' delays by what is left of a fit without any (Fisher scoring)."""
    late, doubt = _delays(views, fit)
    variance = float(np.median(late**2))
    for _ in range(20):
        weight = (variance + doubt) ** -2
        variance = max(float(weight @ (late**2 - doubt) / weight.sum()), 0.0)
    return float(np.sqrt(variance))


def _jitter(views: Views, fit: RigFit, jitter: float) -> float:
    doubt = 1 / (1 / _delays(views, fit)[1] + 1 / jitter**2)
    return float(np.sqrt(np.mean(fit.state.jitter**2 + doubt)))


def rig_of(views: Views, state: RigState) -> Rig:
    """The state as a rig."""
    return Rig(
        tuple(
            Camera(
                name,
                views.sizes[c],
                matrix_of(state.lens[c]),
                state.lens[c, 4:].copy(),
                state.base_from_camera[c],
                float(state.offset[c]),
            )
            for c, name in enumerate(views.names)
        )
    )


def rebased(rig: Rig, base_from_first: Array) -> Rig:
    """The same rig in the base in which its first camera is at `base_from_first` (4, 4)."""
    change = base_from_first @ se3.inverse(rig.cameras[0].base_from_camera)
    return Rig(tuple(replace(c, base_from_camera=change @ c.base_from_camera) for c in rig.cameras))


def _check_number(name: str, count: int) -> None:
    if count == 0:
        raise Undetermined(f"camera {name}: never sees the board, allowed {FEWEST} views or more")
    if count < FEWEST:
        raise Undetermined(f"camera {name}: views of the board = {count}, allowed {FEWEST} or more")


def _check_fit(name: str, views: Views, fit: LensFit) -> None:
    spread = fit.scale * float(np.median(views.sigma))
    if not spread <= WORST_FIT:
        raise Undetermined(
            f"camera {name}: corners scatter by {spread:.1f} px about the best lens, allowed {WORST_FIT:g} px: "
            "the board is not the one that board.toml describes, or it bends"
        )


def _silent(text: str) -> None:
    """Say nothing."""
