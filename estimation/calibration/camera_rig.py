"""From corners to a calibrated rig: each lens by itself, first camera poses from shared views, then all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from estimation import se3
from estimation.calibration import lens_fit, lens_model, validation
from estimation.calibration.lens_fit import MIN_PLANE_CORNERS, MIN_VIEW_CORNERS, LensFit, fit_given_lens, fit_lens
from estimation.calibration.lens_model import CAMERA_PARAMETERS, MODELS, BoardViews, KnownLenses, Undetermined
from estimation.calibration.rig_fit import RigFit, RigState, RivalModel, fit_rig, free_numbers, with_rivals
from estimation.calibration.validation import LensChoice, ModelScore, VolumeError
from estimation.observations import RAYLEIGH_MEDIAN
from estimation.rig import Camera, Rig
from estimation.se3 import Array, Index, Mask

MIN_COMMON_INSTANTS = 3  # that two cameras must share
MAX_COMPARED = 60  # pose estimates of a pair of cameras, of which the medoid is taken
GRID_SIDE = 5  # points of the working volume's grid along each axis
VOLUME_SHARE = 0.9  # of the board's places, along each axis, within the working volume
MIN_VIEWS = 10  # of a camera: eight leave the distortion model to chance, and a minute gives hundreds
OUTLIER_SIGMAS, OUTLIER_PX = 6.0, 0.5  # both exceeded by an outlier: a corner nearer than half a pixel is a good one
MAX_WRONG_SHARE = 0.5  # of a view's corners, beyond which the whole view is dropped
INITIAL_SIGMA = 0.3  # px, of a corner, before it is estimated from residuals
MIN_CORNER_SIGMA = 0.01  # px
MAX_FIT_ERROR = 2.0  # px, of a camera's own views: beyond, the board differs from its description
JITTER_ROUNDS = 6  # of expectation maximisation
MIN_JITTER = 3e-4  # s: less counts as none
MAX_JOINT_SCALE = 1.15  # ratio of the joint residuals to the cameras' own, beyond which jitter is estimated


def initial_rig(views: BoardViews, camera_from_board: Array) -> tuple[Array, Array]:
    """First base_from_camera (C, 4, 4), the first camera being the base, and base_from_board (S, 4, 4).

    camera_from_board: (V, 4, 4). A spanning tree over the pairs with most shared instants. Undetermined names the
    cameras that no chain of shared views connects to the first.
    """
    count = len(views.names)
    shared: dict[tuple[int, int], Index] = {}  # (N, 2) rows of the views by two cameras of the same instants
    for a, b in permutations(range(count), 2):
        first, second = (np.flatnonzero(views.camera == c) for c in (a, b))
        _, i, j = np.intersect1d(views.instant[first], views.instant[second], return_indices=True)
        shared[a, b] = np.stack([first[i], second[j]], 1)
    base_from_camera = {0: np.eye(4)}
    while len(base_from_camera) < count:
        links = [pair for pair in shared if pair[0] in base_from_camera and pair[1] not in base_from_camera]
        a, b = max(links, key=lambda pair: len(shared[pair]))
        if len(shared[a, b]) < MIN_COMMON_INSTANTS:
            _raise_unconnected(views, base_from_camera, shared)
        rows = shared[a, b][:: -(-len(shared[a, b]) // MAX_COMPARED)]
        a_from_b = _medoid(camera_from_board[rows[:, 0]] @ se3.inverse(camera_from_board[rows[:, 1]]))
        base_from_camera[b] = base_from_camera[a] @ a_from_b
    placed = np.stack([base_from_camera[c] for c in range(count)])
    order = np.lexsort((views.seen.sum(1), views.instant))
    best = order[np.flatnonzero(np.diff(np.append(views.instant[order], -1)))]  # (S,) the view with most corners
    return placed, np.asarray(placed[views.camera[best]] @ camera_from_board[best])


def _raise_unconnected(views: BoardViews, placed: dict[int, Array], shared: dict[tuple[int, int], Index]) -> None:
    alone = [c for c in range(len(views.names)) if c not in placed]
    most = max(len(shared[a, b]) for a in placed for b in alone)
    cameras, others = (", ".join(views.names[c] for c in group) for group in (alone, placed))
    raise Undetermined(
        f"camera {cameras}: saw the board together with {others} in {most} frame sets, allowed {MIN_COMMON_INSTANTS} "
        "or more: hold the board where both see it"
    )


def _medoid(poses: Array) -> Array:
    """The transform (4, 4) of (N, 4, 4) with the least median distance to the others: robust to outliers."""
    apart = se3.log(se3.inverse(poses)[:, None] @ poses[None])
    reach = np.linalg.norm(poses[:, :3, 3], axis=1).mean()
    far = np.linalg.norm(apart[..., 3:], axis=-1) + reach * np.linalg.norm(apart[..., :3], axis=-1)
    return np.asarray(poses[np.median(far, axis=1).argmin()])


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated rig with its fit and validation."""

    rig: Rig  # its base is the first camera
    fit: RigFit  # the joint adjustment, with its covariance in real units
    views: BoardViews  # the views used, with the sigma that their residuals show
    models: tuple[str, ...]  # distortion model of each camera
    scores: tuple[tuple[ModelScore, ...], ...]  # of all models, for each camera
    jitter: float  # s, one sigma of single pictures' delays; 0 if not significant
    dropped: int  # corners left out as outliers
    held_out: Array  # (V, P, 2) px, residuals under rigs calibrated without the view's stretch of the recording

    def covariance_of(self, camera: int) -> Array:
        """(16, 16) of one camera's parameters: lens 9, pose 6, offset 1."""
        rows = slice(CAMERA_PARAMETERS * camera, CAMERA_PARAMETERS * camera + CAMERA_PARAMETERS)
        return np.asarray(self.fit.covariance[rows, rows])

    def working_volume(self, side: int = GRID_SIDE) -> Array:
        """Grid (side^3, 3) mm, base, over the places of the board's corners, without the outermost."""
        corners = se3.transform_points(self.fit.state.base_from_board, self.views.points).reshape(-1, 3)
        low, high = np.percentile(corners, [50 - 50 * VOLUME_SHARE, 50 + 50 * VOLUME_SHARE], axis=0)
        axes = [np.linspace(a, b, side) for a, b in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def predicted_error(self, points: Array, speed: float = 0.0) -> VolumeError:
        """The error at points (N, 3) mm, base, of a surface that moves at `speed`, mm/s, in any direction."""
        return validation.volume_error(self.rig, self.fit.covariance, points, speed)


def calibrate(views: BoardViews, known: KnownLenses | None = None) -> Calibration:
    """Calibrate a rig from views of a board.

    known: given lenses, fixed or with their stated sigma as prior. Undetermined where the views do not determine
    the rig, Implausible where the result is no camera; both name camera and figure.
    """
    views, choices, dropped = fit_lenses(views, known)
    names, models = views.names, tuple(choice.fit.model for choice in choices)
    camera_from_board = np.full((len(views), 4, 4), np.nan)
    for c, choice in enumerate(choices):
        camera_from_board[views.camera == c] = choice.fit.camera_from_board
    base_from_camera, base_from_board = initial_rig(views, camera_from_board)
    nothing = np.zeros(len(names)), np.zeros(len(views))
    state = RigState(np.stack([c.fit.lens for c in choices]), base_from_camera, *nothing, base_from_board)
    views, fit, jitter, more = adjust(views, state, choices, known)
    for c, name in enumerate(names):
        lens_model.check_lens(name, views.sizes[c], fit.state.lens[c])
        if known is None:
            rows = slice(CAMERA_PARAMETERS * c, CAMERA_PARAMETERS * c + 9)
            lens_model.check_focal_uncertainty(name, fit.state.lens[c], fit.covariance[rows, rows])
    lens_model.check_neighbours(names, views.sizes, fit.state.lens)
    scores = tuple(choice.scores for choice in choices)
    unseen = validation.held_out_residuals(views, fit.state, free_numbers(models, known), jitter, known)
    return Calibration(_rig_of(views, fit.state), fit, views, models, scores, jitter, dropped + more, unseen)


def fit_lenses(views: BoardViews, known: KnownLenses | None = None) -> tuple[BoardViews, list[LensChoice], int]:
    """The usable views with their measured sigmas, each camera's lens by itself, and the number of corners dropped."""
    usable, sigma, choices = np.zeros(len(views), bool), views.sigma.copy(), []
    first = lens_fit.plane_outliers(views)
    views, dropped = views.without(first), int(first.sum())
    pixels = views.pixels.copy()
    for c, name in enumerate(views.names):
        rows = np.flatnonzero((views.camera == c) & (views.seen.sum(1) >= MIN_VIEW_CORNERS))
        _check_number(name, len(rows))
        own = views.select(rows)
        exact = known is not None and not known.sigma[c].any()
        own, choice, out = _select_model(own) if known is None else _with_known_lens(own, known.lens[c], exact)
        good = own.without(out).seen.sum(1) >= np.maximum(MIN_VIEW_CORNERS, MAX_WRONG_SHARE * own.seen.sum(1))
        _check_number(name, int(good.sum()))
        dropped += int(out.sum())
        pixels[rows] = own.without(out).pixels
        own = own.without(out).select(good)
        begin = choice.fit.lens, choice.fit.camera_from_board[good]
        fit = fit_lens(own, choice.fit.model, begin) if known is None else fit_given_lens(own, known.lens[c])
        _check_fit(name, own, fit)
        lens_model.check_lens(name, own.sizes[c], fit.lens)
        choices.append(replace(choice, fit=fit))
        usable[rows[good]] = True
        sigma[rows[good]] = np.maximum(own.sigma * fit.scale, MIN_CORNER_SIGMA)
    views = replace(views, pixels=pixels, sigma=sigma)
    return views.select(usable), choices, dropped


def _select_model(own: BoardViews) -> tuple[BoardViews, LensChoice, Mask]:
    """One camera's views with their measured sigma, their model and lens, and which corners (V, P) are outliers."""
    rough = fit_lens(_with_sigma(own, INITIAL_SIGMA), "k1 k2")
    own = _with_sigma(own, _median_sigma(rough))
    rough = fit_lens(own, "k1 k2", (rough.lens, rough.camera_from_board))
    out = _single_outliers(own, rough)
    return own, validation.choose_model(own.without(out)), out


def _with_known_lens(own: BoardViews, lens: Array, exact: bool) -> tuple[BoardViews, LensChoice, Mask]:
    """As `_select_model`, with a given lens (9,). exact: whether it has no sigma."""
    own = _with_sigma(own, _median_sigma(fit_given_lens(_with_sigma(own, INITIAL_SIGMA), lens)))
    fit = fit_given_lens(own, lens)
    out = _single_outliers(own, fit)
    if not exact:
        return own, LensChoice(fit, ()), out
    left = own.without(out)
    return own, validation.validate_given_lens(left, fit_given_lens(left, lens)), out


def _with_sigma(views: BoardViews, sigma: float) -> BoardViews:
    return replace(views, sigma=np.full(len(views), sigma))


def _median_sigma(fit: LensFit) -> float:
    return max(float(np.nanmedian(np.linalg.norm(fit.residuals, axis=-1))) / RAYLEIGH_MEDIAN, MIN_CORNER_SIGMA)


def _single_outliers(own: BoardViews, fit: LensFit) -> Mask:
    out = outliers(own, fit.residuals, fit.scale)
    out &= (~out & own.seen).sum(1, keepdims=True) >= MIN_PLANE_CORNERS  # else the whole view is wrong, and dropped
    return out


def outliers(views: BoardViews, residuals: Array, scale: float) -> Mask:
    """Which corners (V, P) are outliers, by the median residual, which is robust to them."""
    away = np.linalg.norm(residuals, axis=-1)
    usual = min(scale * float(np.median(views.sigma)), float(np.nanmedian(away)) / RAYLEIGH_MEDIAN)
    return np.asarray(np.nan_to_num(away) > max(OUTLIER_SIGMAS * usual, OUTLIER_PX))


def adjust(
    views: BoardViews, state: RigState, choices: Sequence[LensChoice], known: KnownLenses | None = None
) -> tuple[BoardViews, RigFit, float, int]:
    """The joint adjustment: views without outliers, fit, jitter (s) and the number of corners dropped.

    Joint residuals larger than the cameras' own mean that single pictures have random delays (jitter), whose size is
    estimated by expectation maximisation.
    """
    free = free_numbers(tuple(choice.fit.model for choice in choices), known)
    fit = fit_rig(views, state, free, 0.0, known)
    jitter = 0.0
    if fit.scale > MAX_JOINT_SCALE and len(choices) > 1:
        jitter = _first_jitter(views, fit)
        for _ in range(JITTER_ROUNDS if jitter > MIN_JITTER else 0):
            fit = fit_rig(views, fit.state, free, jitter, known)
            jitter = _jitter(views, fit, jitter)
        jitter = jitter if jitter > MIN_JITTER else 0.0
    out = outliers(views, fit.residuals, fit.scale)
    usable = views.without(out).seen.sum(1) >= 4
    left = views.without(out).select(usable)
    boards = np.isin(np.arange(len(fit.state.base_from_board)), views.instant[usable])
    delays, poses = fit.state.jitter[usable] * (jitter > 0), fit.state.base_from_board[boards]
    state = replace(fit.state, jitter=delays, base_from_board=poses)
    fit = with_rivals(left, fit_rig(left, state, free, jitter, known), free, jitter, _rivals_of(choices))
    return left, fit, jitter, int(out.sum())


def _rivals_of(choices: Sequence[LensChoice]) -> list[RivalModel]:
    out = []
    for c, choice in enumerate(choices):
        if choice.rival:
            free = np.zeros(CAMERA_PARAMETERS * len(choices), bool)
            free[CAMERA_PARAMETERS * c + MODELS[choice.rival]] = True
            out.append(RivalModel(free, choice.probability))
    return out


def _delays(views: BoardViews, fit: RigFit) -> tuple[Array, Array]:
    """Delay (V,) of each view, s, by its own corners alone, and the variance of that."""
    seen = views.seen[..., None]
    image_velocity, residuals = np.where(seen, fit.image_velocity, 0.0), np.where(seen, fit.residuals, 0.0)
    information = (image_velocity**2).sum((1, 2)) / views.sigma**2
    late = -(image_velocity * residuals).sum((1, 2)) / views.sigma**2 / np.maximum(information, 1e-9)
    return late, 1 / np.maximum(information, 1e-9)


def _first_jitter(views: BoardViews, fit: RigFit) -> float:
    """One sigma, s, of single pictures' delays from the residuals of a fit without jitter (Fisher scoring)."""
    late, delay_variance = _delays(views, fit)
    variance = float(np.median(late**2))
    for _ in range(20):
        weight = (variance + delay_variance) ** -2
        variance = max(float(weight @ (late**2 - delay_variance) / weight.sum()), 0.0)
    return float(np.sqrt(variance))


def _jitter(views: BoardViews, fit: RigFit, jitter: float) -> float:
    """Expectation step: RMS of the delays, with their posterior variance."""
    variance = 1 / (1 / _delays(views, fit)[1] + 1 / jitter**2)
    return float(np.sqrt(np.mean(fit.state.jitter**2 + variance)))


def _rig_of(views: BoardViews, state: RigState) -> Rig:
    matrices, offsets = [lens_model.lens_matrix(lens) for lens in state.lens], state.offset.tolist()
    parts = views.names, views.sizes, matrices, state.lens[:, 4:].copy(), state.base_from_camera, offsets
    return Rig(tuple(Camera(*each) for each in zip(*parts, strict=True)))


def rebase(rig: Rig, base_from_first: Array) -> Rig:
    """The rig in the base frame in which its first camera is at `base_from_first` (4, 4)."""
    change = base_from_first @ se3.inverse(rig.cameras[0].base_from_camera)
    return Rig(tuple(replace(c, base_from_camera=change @ c.base_from_camera) for c in rig.cameras))


def _check_number(name: str, count: int) -> None:
    if count == 0:
        raise Undetermined(f"camera {name}: never sees the board, allowed {MIN_VIEWS} views or more")
    if count < MIN_VIEWS:
        raise Undetermined(f"camera {name}: views of the board = {count}, allowed {MIN_VIEWS} or more")


def _check_fit(name: str, views: BoardViews, fit: LensFit) -> None:
    spread = fit.scale * float(np.median(views.sigma))
    if not spread <= MAX_FIT_ERROR:
        raise Undetermined(
            f"camera {name}: corners scatter by {spread:.1f} px about the best lens, allowed {MAX_FIT_ERROR:g} px: "
            "the board is not the one that board.toml describes, or it bends"
        )
