"""Parts of the surface that move by themselves, and parts that nobody sees any more: the error of single places.

The robust fit takes a fold of the skin for outliers, and rightly: the pose and its covariance stay those of the rest.
But outliers of tracking are independent from camera to camera and from landmark to landmark. So each landmark's
displacement is estimated from all cameras; landmarks whose cameras do not agree on one are set aside; the others are
averaged under bells over the surface, relative to the usual displacement there. A mean that chance does not explain is
a part that moves by itself. It has no pose: the places under its bell are known no better than by its displacement.

What is usual is learned only within what a map may err by: a slow rise is not usual, nor is it undone by a refined map
that has taken it in, since the path was laid on the surface as it was.

A part that rises fast leaves the reach of the alignment, and its landmarks are no longer found. So it is also learned
which landmarks each camera usually finds. Where most of those under a bell are missing, more than chance and the
camera's whole picture explain, the place is known only as well as tissue keeps still since it was last seen.
"""

from __future__ import annotations

import numpy as np

from estimation import se3
from estimation.observations import Observations
from estimation.online.deformation import displacement_sums
from estimation.online.fit import FrameFit, solve_symmetric3, unusual_displacements
from estimation.pose_solver import GATE
from estimation.runtime import compiled, contiguous, median
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import LocalError, SurfaceMap, bells, farthest_points

BELL_SIGMA_MM = 6.0  # of a bell, at least: about a dozen landmarks of a dense map, and a fold of the skin
MAX_BELL_SIGMA_MM = 15.0  # of a bell where landmarks are sparse: what lies farther apart does not move as one
BELL_NEIGHBOURS, NEIGHBOUR_SHARE = 5, 0.6  # a bell is that part of the way to its fifth landmark wide: six count
MAX_BELLS = 96  # spread over the surface, BELL_SIGMA_MM apart
MIN_VIEWS = 2  # cameras that must see a landmark: one alone may have lost it
MAX_VIEW_SIGMAS = 3.0  # to which one displacement must explain what all cameras see,
NONLINEAR_SHARE = 0.02  # and of the square of what they see: cameras expose apart, and perspective is no line
MAX_LANDMARK_SIGMAS = 3.0  # a landmark counts as no more: what strayed alike in two cameras is no part of the surface
USUAL_MEMORY_SETS = 100  # frame sets over which it is learned what is usual,
MIN_LANDMARK_SETS = 10  # and in which a landmark must have been seen before it counts
PLACE_SETS = 20  # frame sets after which a landmark's usual place is known: from there it may wander by
MAX_USUAL_DRIFT_MM = 0.2  # and by the map's own two sigmas: by lenses, and as patches are seen from other sides
MAX_USUAL_RISE = 3.0  # times the usual, as which one frame set counts at most: a fold must not become usual
MIN_BELL_LANDMARKS = 4.0  # as which those under a bell must count
ONSET_CHI2 = 36.0  # three degrees of freedom: 7e-8, and there are dozens of bells; times what is usual there
END_CHI2 = 16.3  # likewise, 1e-3: it is over
MIN_DISPLACEMENT_MM = 0.2  # of a bell's mean: a fold twice as high, since it is no wider than the bell
CLEAR_DISPLACEMENT_MM = 0.4  # likewise: no usual error is as large, so it counts whatever is usual there
SMALL_MM, MIN_COSINE = 8.0, 0.7  # between landmarks of one small bump, two or three apart, which goes one way
MAX_SMALL_MM = 5.0  # beyond, two cameras have strayed alike along a line of sight
SMALL_RATIO, SMALL_REACH_MM = 2.0, 4.0  # times a landmark's displacement: the top may lie beside it; and how far
SMEAR_SIGMAS = 3.0  # of the exposures, whose motion looks like a displacement: the pose cannot fit it everywhere
HEIGHT_RATIO = 3.0  # times the bell's mean: the height of a fold, and what it grows by until the arm has obeyed
DISPLACEMENT_RIDGE = 1.0  # mm^-2: prior of a landmark's place, also along a line that all its cameras share
BELL_HEIGHT_RATIO = 4 / 3  # times a bell's height that is told, so that it holds one sigma away from its middle
MIN_BELL_VALUE = 0.3  # value of a bell below which a landmark is not part of it
GATE_TRACKS = 32  # tracks, about, by which it is judged how far an outlier is away
RIGID_STEPS = 5  # reweighted fits of a map's change
TISSUE_SPEED = 5.0  # mm/s, one sigma: how fast tissue moves against its surroundings, as a deep breath lifts a chest

RATE_MEMORY_SETS = 1000  # over which that is learned: a slow rise takes landmark after landmark
MIN_USUAL_RATE = 0.7  # share of the frame sets: a landmark found less often tells nothing by its absence
MIN_PICTURE_SHARE = 0.5  # of what a camera usually finds: with less, its picture is at fault, not a place
MIN_MISSING_LANDMARKS = 2.5  # as which those that are looked for under a bell must count
MIN_MISSING_SHARE = 0.5  # of them
MISSING_SURPRISE = 6.9  # nats beyond the usual share of missing ones, one in a thousand,
MISSING_SETS = 2  # in so many frame sets in a row
USUAL_MISSING = 0.05, 0.25  # lowest and highest share that counts as usual
NEAR_MM = 0.3  # what is found so near to its place is there: half of what the guard allows, and a bit
BEYOND_REACH_MM = 0.6  # one sigma: the fine alignment finds what lies within two pixels, and these are not found
REGION_SPAN_MM, PICTURE_SPAN_MM = 25.0, 10.0  # from a landmark, within which tissue moves with it: a region is one
# surface, and a wound in it may have little texture; whole pictures may hold several, and a window in a drape is larger
ANCHOR_SHARE, MAX_ANCHORS = 0.3, 128  # of that: landmarks nearer to each other need not be told apart
MAX_UNSEEN_MM = 10.0  # one sigma: tissue goes no farther by itself, and the number need not grow for ever


class LocalMotion:
    """Remembers how the landmarks of one map usually lie, and whether a part of them is displaced or missing now."""

    def __init__(self, cameras: int, region: bool = True) -> None:
        """region: whether somebody says that all of the map is one surface: then it is so between landmarks, too."""
        self.size = 0.0  # mm, largest mean displacement under a bell while a part moves by itself, else 0
        self.error: LocalError | None = None  # of places, at the last frame set; None: nothing to add
        self._points, self._centres = np.zeros((0, 3)), np.zeros((0, 3))
        self._reach, self._drift_limit = np.zeros(0), np.zeros(0)  # per bell, mm; per landmark, mm, by the map's sigma
        self._bells = self._squares = np.zeros((0, 0))  # (C, N)
        # per landmark: normal equations of its usual displacement, and in how many frame sets it was seen
        self._normal, self._right, self._counts = np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0)
        self._small = np.zeros(0)  # mm, by which a landmark stands out beside its neighbours, else 0;
        self._stood_out = np.zeros(0, bool)  # whether it seemed to in the last frame set
        self._place = np.zeros((0, 3))  # mm, where it usually was after PLACED_SETS, nan before
        self._usual, self._learned = np.zeros(0), np.zeros(0)  # per bell: mean chi square per axis, and looks
        self._moving = np.zeros(0, bool)  # per bell
        self._span = REGION_SPAN_MM if region else PICTURE_SPAN_MM
        self._anchors, self._near = np.zeros((0, 3)), np.zeros((0, 0))  # (S, 3) mm, and (S, N) whose landmark is whose
        self._gate = 0.1  # mm, at which the last fit took landmarks for outliers
        self._support = SupportedPlaces(cameras)

    @property
    def active(self) -> bool:
        """Whether a part of the surface moves by itself."""
        return self.size > 0

    @property
    def message(self) -> str:
        """For the operator, or ''."""
        return f"a part of the surface moves by itself, by {self.size:.1f} mm" if self.active else ""

    def __call__(
        self, observations: Observations, fit: FrameFit, sigma: Array, surface_map: SurfaceMap, smeared: float
    ) -> float:
        """Take an accepted fit to `observations`; the new `size`. sigma: (N,) px. Cameras left out do not count.

        smeared: mm that the surface moves in one sigma of the cameras' exposure delays.
        """
        self._take(surface_map)
        normal, right, weight, excess = self._landmarks(observations, fit, sigma)
        usable = (weight > 0) & (self._counts >= MIN_LANDMARK_SETS)
        shift, square, supported = self._means(normal, excess, weight, usable)
        chance = square / np.maximum(self._usual, 1.0)
        size, was_moving = np.linalg.norm(shift, axis=1), self._moving
        limit, share = np.where(was_moving, END_CHI2, ONSET_CHI2), np.where(was_moving, 0.5, 1.0)
        clear_size = size - SMEAR_SIGMAS * smeared
        usual = (chance > limit) & (clear_size > share * MIN_DISPLACEMENT_MM)
        self._moving = supported & (usual | (square > limit) & (clear_size > share * CLEAR_DISPLACEMENT_MM))
        self.size = float(size[self._moving].max(initial=0.0))
        gradients = fit.solution.jacobians[:: 1 + len(sigma) // GATE_TRACKS, :, 3:]
        pixels_per_mm = float(np.sqrt((gradients * gradients).mean() * 3))  # px per mm
        self._gate = GATE * fit.solution.scale * median(sigma) / max(pixels_per_mm, 1e-9)
        unseen = self._support(observations, fit, self._bells, self._squares)
        self._learn(normal, right, weight, square, supported)
        self._look_at_small(normal, excess, weight, SMEAR_SIGMAS * smeared)
        self._set_error(np.where(self._moving, HEIGHT_RATIO * np.maximum(size, MIN_DISPLACEMENT_MM), 0.0), unseen)
        return self.size

    def _look_at_small(self, normal: Array, excess: Array, weight: Array, smear: float) -> None:
        """Learn how far landmarks stand out from the others of their bell; stored until they are in place again.

        One alone may be a mismatch; not if another one within SMALL_MM moves in the same direction, even if less far.
        """
        shift = solve_symmetric3(normal + DISPLACEMENT_RIDGE * np.eye(3), np.ascontiguousarray(excess))
        size, square = np.linalg.norm(shift, axis=1) - smear, (shift * excess).sum(1)
        usable = (weight > 0) & (self._counts >= MIN_LANDMARK_SETS) & (size < MAX_SMALL_MM)
        top = np.flatnonzero(usable & (square > ONSET_CHI2) & (size > CLEAR_DISPLACEMENT_MM))
        self._small[usable & (size < MIN_DISPLACEMENT_MM)] = 0.0
        stands_out = np.zeros(len(size), bool)
        if len(top):
            neighbours = np.flatnonzero(usable & (square > END_CHI2) & (size > MIN_DISPLACEMENT_MM))
            distance = np.linalg.norm(self._points[top, None] - self._points[neighbours], axis=2)
            direction = shift / np.maximum(np.linalg.norm(shift, axis=1), 1e-9)[:, None]
            alike = direction[top] @ direction[neighbours].T > MIN_COSINE
            stands_out[top[((distance < SMALL_MM) & (top[:, None] != neighbours) & alike).any(1)]] = True
        twice = stands_out & self._stood_out
        self._small[twice], self._stood_out = (size + smear)[twice], stands_out

    def _set_error(self, heights: Array, unseen: Array) -> None:
        """Take the sigma, mm, of each bell (C,), by its displacement and as it is not seen."""
        sigma = np.maximum(heights, unseen)
        rows, top = np.flatnonzero(sigma), np.flatnonzero(self._small)
        variance, growth = BELL_HEIGHT_RATIO * sigma[rows] ** 2, BELL_HEIGHT_RATIO * 2 * sigma[rows] * TISSUE_SPEED
        support, limit = self._anchors[self._near @ self._support.present > 0], MAX_UNSEEN_MM**2
        centres, reach = self._centres[rows], self._reach[rows]
        self.error = LocalError(centres, variance, growth, reach, support, self._span, limit)
        if len(top):
            peak = (SMALL_RATIO * self._small[top]) ** 2
            self.error = self.error.add_bells(self._points[top], peak, SMALL_REACH_MM)

    def _take(self, surface_map: SurfaceMap) -> None:
        """Follow a map that was refined or has grown: rows keep their meaning, and landmarks their places."""
        points, count = surface_map.points, len(self._points)
        if points is self._points:
            return
        if count:
            change = points[:count] - self._points
            rigid = rigid_part(self._points, change, self._gate)
            self._place = self._place + rigid
            usual = self._normal + DISPLACEMENT_RIDGE * np.eye(3)
            self._right = self._right - (usual @ (change - rigid)[..., None])[..., 0]
        self._points, new = points, len(points) - count
        variance = np.diag(surface_map.covariance).reshape(-1, 3).max(1)
        self._drift_limit = MAX_USUAL_DRIFT_MM + 2 * np.sqrt(np.maximum(variance, 0.0))
        if new:
            self._normal = np.concatenate([self._normal, np.zeros((new, 3, 3))])
            self._right = np.concatenate([self._right, np.zeros((new, 3))])
            self._place = np.concatenate([self._place, np.full((new, 3), np.nan)])
            self._counts, self._small = (np.append(old, np.zeros(new)) for old in (self._counts, self._small))
            self._stood_out = np.append(self._stood_out, np.zeros(new, bool))
            self._centres = bell_centres(points, self._centres)
            added = np.zeros(len(self._centres) - len(self._usual))
            self._usual, self._learned = np.append(self._usual, added), np.append(self._learned, added)
            self._moving = np.append(self._moving, added > 0)
            self._reach = bell_reaches(points, self._centres)
            self._bells = np.ascontiguousarray(bells(points, self._centres, self._reach).T)
            self._squares = self._bells**2
            self._set_anchors(points)

    def _set_anchors(self, points: Array) -> None:
        """Take landmarks at (N, 3) mm as what shows the surface; those near each other stand for one another."""
        apart = ANCHOR_SHARE * self._span
        self._anchors = points[farthest_points(points, 0, MAX_ANCHORS, apart)]
        away = np.linalg.norm(points[:, None] - self._anchors, axis=2)
        self._near = np.zeros((len(self._anchors), len(points)))
        self._near[away.argmin(1), np.arange(len(points))] = 1.0

    def _landmarks(self, observations: Observations, fit: FrameFit, sigma: Array) -> tuple[Array, Array, Array, Array]:
        """Each landmark's displacement: normal equations (N, 3, 3) and (N, 3), weight (N,), right sides less usual."""
        precision = (sigma * fit.solution.scale) ** -2.0
        for camera in fit.outliers:
            precision[observations.camera == camera] = 0.0
        row = contiguous(observations.track, np.int64)
        jacobian = contiguous(fit.solution.jacobians)
        residual = contiguous(fit.solution.residuals)
        normal, right, square, views = displacement_sums(len(self._points), row, jacobian, residual, precision)
        usual = self._normal + DISPLACEMENT_RIDGE * np.eye(3)
        excess, excess_square, explained = unusual_displacements(normal, right, square, usual, self._right)
        agree = excess_square - explained < MAX_VIEW_SIGMAS**2 * (2 * views - 3) + NONLINEAR_SHARE * excess_square
        capped = np.minimum(1.0, MAX_LANDMARK_SIGMAS / np.sqrt(np.maximum(explained, 1e-9)))
        return normal, right, np.where((views >= MIN_VIEWS) & agree, capped, 0.0), excess

    def _means(self, normal: Array, excess: Array, weight: Array, counts: Mask) -> tuple[Array, Array, Mask]:
        """Mean displacement (C, 3) mm under each bell, its chi square (C,), and where enough landmarks count (C,).

        weight: (N,), of landmarks that count (N,). The chi square supposes that all of them have a weight of one.
        """
        count, ridge = len(weight), DISPLACEMENT_RIDGE * np.eye(3)
        flat, pulls = normal.reshape(count, 9), (weight * counts)[:, None]
        sums = self._bells @ np.concatenate([pulls * flat, pulls * excess, counts[:, None]], 1)
        spread = self._squares @ (counts[:, None] * np.concatenate([flat, np.ones((count, 1))], 1))
        pull = np.ascontiguousarray(sums[:, 9:12])
        shift = solve_symmetric3(sums[:, :9].reshape(-1, 3, 3) + ridge, pull)
        square = (solve_symmetric3(spread[:, :9].reshape(-1, 3, 3) + ridge, pull) * pull).sum(1)
        return shift, square, sums[:, 12] ** 2 > MIN_BELL_LANDMARKS * spread[:, 9]

    def _learn(self, normal: Array, right: Array, weight: Array, square: Array, supported: Mask) -> None:
        """Learn what is usual, except under bells that move by themselves."""
        resting = ~self._moving
        learned = weight > 0
        if self.active:
            learned &= self._bells[self._moving].max(0) < MIN_BELL_VALUE
        forgotten = learned / USUAL_MEMORY_SETS
        self._normal += (learned * weight)[:, None, None] * normal - forgotten[:, None, None] * self._normal
        self._right += (learned * weight)[:, None] * right - forgotten[:, None] * self._right
        self._counts += learned
        supported = supported & resting
        self._learned = np.minimum(self._learned + supported, USUAL_MEMORY_SETS)
        now = np.minimum(square / 3, MAX_USUAL_RISE * np.maximum(self._usual, 1.0))
        self._usual += supported * (now - self._usual) / np.maximum(self._learned, 1.0)
        self._bound()

    def _bound(self) -> None:
        """Keep usual displacements near the places where landmarks usually were at first."""
        damped = self._normal + DISPLACEMENT_RIDGE * np.eye(3)
        usual = solve_symmetric3(damped, self._right)
        first_time = (self._counts == PLACE_SETS) & np.isnan(self._place[:, 0])
        self._place[first_time] = (self._points + usual)[first_time]
        drift = self._points + usual - self._place
        far = np.flatnonzero((drift * drift).sum(1) > self._drift_limit**2)  # not where one is unknown
        if len(far):
            excess = drift[far] * (1 - self._drift_limit[far] / np.linalg.norm(drift[far], axis=1))[:, None]
            self._right[far] -= (damped[far] @ excess[..., None])[..., 0]


class SupportedPlaces:
    """Remembers which landmarks each camera usually finds, and where most of them are missing."""

    def __init__(self, cameras: int) -> None:
        self._rate, self._counts = np.zeros((cameras, 0)), np.zeros((cameras, 0))  # share found, and looks
        self._usual, self._lost_sets = np.zeros(0), np.zeros(0, np.int64)  # per bell: missing share; sets in a row
        self._supported = np.zeros(0)  # per bell, s, stamp at which it was last not lost
        self._bell_sums = np.zeros(0), np.zeros(0), np.zeros(0)  # expected landmarks (N,), their sum and count by bell
        self.present = np.zeros(0)  # (N,) 1 for landmarks that were found when they were last looked for, else 0

    def __call__(self, observations: Observations, fit: FrameFit, bell: Array, squares: Array) -> Array:
        """Sigma (K,) mm of the bells' places: 0 where landmarks are found. bell, squares: (K, N) and its squares."""
        self._extend(bell.shape[0], bell.shape[1], fit.stamp)
        found, sought = self._sights(observations, fit)
        expected = sought & (self._rate > MIN_USUAL_RATE) & (self._counts >= MIN_LANDMARK_SETS)
        found_expected = found & expected
        expected &= (found_expected.sum(1) >= MIN_PICTURE_SHARE * expected.sum(1))[:, None]
        views = expected.sum(0)
        counts, present = (views > 0) * 1.0, (found_expected & expected).sum(0) >= np.clip(views, 1, MIN_VIEWS)
        self.present = np.where(counts > 0, present, self.present)
        if not np.array_equal(self._bell_sums[0], counts) or len(self._bell_sums[1]) != len(bell):
            total = np.maximum(bell @ counts, 1e-9)
            self._bell_sums = counts, total, total**2 / np.maximum(squares @ counts, 1e-9)
        _, sums, weight = self._bell_sums
        missing = 1 - bell @ (counts * present) / sums
        judged = weight >= MIN_MISSING_LANDMARKS
        lost = judged & (missing >= MIN_MISSING_SHARE)
        if lost.any():
            lost &= weight * self._surprise(missing) > MISSING_SURPRISE
        self._lost_sets = np.where(lost, self._lost_sets + 1, np.where(judged, 0, self._lost_sets))
        self._supported = np.where(self._lost_sets > 0, self._supported, fit.stamp)
        self._learn(found, sought, missing, judged & ~lost, bell)
        unseen = BEYOND_REACH_MM + TISSUE_SPEED * (fit.stamp - self._supported)
        return np.where(self._lost_sets >= MISSING_SETS, np.minimum(unseen, MAX_UNSEEN_MM), 0.0)

    def _extend(self, count: int, landmarks: int, stamp: float) -> None:
        new_landmarks, new_bells = landmarks - self._rate.shape[1], count - len(self._usual)
        if new_landmarks > 0:
            wider = np.zeros((len(self._rate), new_landmarks))
            self.present = np.append(self.present, np.ones(new_landmarks))
            self._rate, self._counts = np.hstack([self._rate, wider]), np.hstack([self._counts, wider])
        if new_bells > 0:
            self._usual = np.append(self._usual, np.zeros(new_bells))
            self._lost_sets = np.append(self._lost_sets, np.zeros(new_bells, np.int64))
            self._supported = np.append(self._supported, np.full(new_bells, stamp))

    def _sights(self, observations: Observations, fit: FrameFit) -> tuple[Mask, Mask]:
        """Which landmarks each camera (C, N) has found where the pose puts them, and has looked for."""
        shape, missed = self._rate.shape, observations.missed
        camera, track = (contiguous(a, np.int64) for a in (observations.camera, observations.track))
        jacobian = contiguous(fit.solution.jacobians)
        residual = contiguous(fit.solution.residuals)
        agrees = fit.inlier if fit.shadowed is None else fit.inlier | fit.shadowed
        found, sought = landmark_sights(shape[0], shape[1], camera, track, jacobian, residual, agrees, NEAR_MM)
        sought[missed.camera, missed.track] = True
        outliers = list(fit.outliers)
        found[outliers], sought[outliers] = False, False
        return found, sought

    def _surprise(self, missing: Array) -> Array:
        """Kullback-Leibler divergence (K,), nats, of the missing shares from the usual ones; 0 below those."""
        usual, share = np.clip(self._usual, *USUAL_MISSING), np.clip(missing, 1e-6, 1 - 1e-6)
        nats = share * np.log(share / usual) + (1 - share) * np.log((1 - share) / (1 - usual))
        return np.where(share > usual, nats, 0.0)

    def _learn(self, found: Mask, sought: Mask, missing: Array, usual: Mask, bell: Array) -> None:
        """Learn which landmarks are usually found, except where they are missing now."""
        lost = self._lost_sets > 0
        if lost.any():
            sought = sought & (found | (bell[lost].max(0) < MIN_BELL_VALUE))
        self._counts += sought
        memory = np.where(self._counts > PLACE_SETS, RATE_MEMORY_SETS, np.maximum(self._counts, 1.0))
        self._rate += sought * (found - self._rate) / memory
        self._usual += usual * (missing - self._usual) / RATE_MEMORY_SETS


def rigid_part(points: Array, change: Array, gate: float) -> Array:
    """The part (N, 3) mm of a map's change (N, 3) at points (N, 3) that turns or shifts most landmarks alike.

    gate: mm, at which a landmark is an outlier: as in the fit of the pose, which takes that part up.
    """
    jacobian = se3.point_jacobians(points)  # (N, 3, 6)
    rigid = np.zeros_like(change)
    for _ in range(RIGID_STEPS):
        weight = 1 / (1 + ((change - rigid) ** 2).sum(1) / gate**2) ** 2  # Geman-McClure's
        weighted = (jacobian * weight[:, None, None]).reshape(-1, 6)
        rows = jacobian.reshape(-1, 6)
        step = np.linalg.solve(weighted.T @ rows + 1e-9 * np.eye(6), weighted.T @ change.ravel())
        rigid = (rows @ step).reshape(-1, 3)
    return rigid


def bell_reaches(points: Array, centres: Array) -> Array:
    """One sigma (C,) mm of the bells about centres (C, 3): wider where points (N, 3) are sparse."""
    away = np.linalg.norm(points - centres[:, None], axis=2)
    nth = min(BELL_NEIGHBOURS, len(points) - 1)
    return np.clip(NEIGHBOUR_SHARE * np.partition(away, nth, axis=1)[:, nth], BELL_SIGMA_MM, MAX_BELL_SIGMA_MM)


def bell_centres(points: Array, centres: Array) -> Array:
    """The centres (C, 3) and further farthest points (N, 3), until one is near each point or there are MAX_BELLS."""
    away = np.full(len(points), np.inf)
    for centre in centres:
        away = np.minimum(away, np.linalg.norm(points - centre, axis=1))
    spread = list(centres)
    while len(spread) < MAX_BELLS and away.max(initial=0.0) > BELL_SIGMA_MM:
        spread.append(points[int(np.argmax(away))])
        away = np.minimum(away, np.linalg.norm(points - spread[-1], axis=1))
    return np.array(spread).reshape(-1, 3)


@compiled("Tuple((b1[:,::1], b1[:,::1]))(i8, i8, i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], b1[::1], f8)")
def landmark_sights(
    cameras: int,
    landmarks: int,
    camera: Index,
    track: Index,
    jacobian: Array,
    residual: Array,
    agrees: Mask,
    near: float,
) -> tuple[Mask, Mask]:
    """Which landmarks each camera (C, L) has found where the pose puts them, and has found at all.

    camera, track: (N,). jacobian: (N, 2, 6). residual: (N, 2) px. agrees: (N,). near: mm off that count as found.
    """
    found, sought = np.zeros((cameras, landmarks), np.bool_), np.zeros((cameras, landmarks), np.bool_)
    for i in range(len(camera)):
        square, by_point = 0.0, 0.0
        for k in range(2):
            square += residual[i, k] * residual[i, k]
            for b in range(3):
                by_point += jacobian[i, k, 3 + b] * jacobian[i, k, 3 + b]
        sought[camera[i], track[i]] = True
        found[camera[i], track[i]] = agrees[i] or 2 * square < near * near * by_point
    return found, sought
