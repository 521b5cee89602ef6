"""A part of the surface that moves by itself: the residuals of one place, together, show a displacement.

The robust fit takes a fold of the skin for outliers, and rightly: the pose and its covariance stay those of the rest.
But outliers of tracking are independent from camera to camera and from landmark to landmark. So each landmark's
displacement is estimated from all cameras; landmarks whose cameras do not agree on one are set aside; the others are
averaged under bells over the surface, relative to the usual displacement there. A mean that chance does not explain is
a part that moves by itself. It has no pose: the reported covariance of every place grows by its displacement.
"""

from __future__ import annotations

import numpy as np

from estimation.observations import Observations
from estimation.online.fit import FrameFit
from estimation.runtime import CONTIGUOUS, compiled
from estimation.se3 import Array, Index, Mask
from estimation.surface_map import SurfaceMap, bells

BELL_SIGMA_MM = 6.0  # of a bell: about a dozen landmarks, and a fold of the skin
MAX_BELLS = 96  # spread over the surface, BELL_SIGMA_MM apart
MIN_VIEWS = 2  # cameras that must see a landmark: one alone may have lost it
MAX_VIEW_SIGMAS = 3.0  # to which one displacement must explain what all cameras see,
NONLINEAR_SHARE = 0.02  # and of the square of what they see: cameras expose apart, and perspective is no line
MAX_LANDMARK_SIGMAS = 3.0  # a landmark counts as no more: what strayed alike in two cameras is no part of the surface
USUAL_MEMORY_SETS = 100  # frame sets over which it is learned what is usual,
MIN_LANDMARK_SETS = 10  # and in which a landmark must have been seen before it counts
MAX_USUAL_RISE = 3.0  # times the usual, as which one frame set counts at most: a fold must not become usual
MIN_BELL_LANDMARKS = 4.0  # as which those under a bell must count
ONSET_CHI2 = 36.0  # three degrees of freedom: 7e-8, and there are dozens of bells; times what is usual there
END_CHI2 = 16.3  # likewise, 1e-3: it is over
MIN_DISPLACEMENT_MM = 0.2  # of a bell's mean: a fold twice as high, since it is no wider than the bell
SMEAR_SIGMAS = 3.0  # of the exposures, whose motion looks like a displacement: the pose cannot fit it everywhere
HEIGHT_RATIO = 3.0  # times the bell's mean: the height of a fold, and what it grows by until the arm has obeyed
DISPLACEMENT_RIDGE = 1.0  # mm^-2: prior of a landmark's place, also along a line that all its cameras share
DISPLACEMENT_FLOOR = 1e-3  # mm^-2: prior of a displacement along a line that all cameras look along


class LocalMotion:
    """Remembers how the landmarks of one map usually lie, and whether a part of them is displaced now."""

    def __init__(self) -> None:
        self.size = 0.0  # mm, largest mean displacement under a bell while a part moves by itself, else 0
        self._points, self._centres = np.zeros((0, 3)), np.zeros((0, 3))
        self._bells = self._squares = np.zeros((0, 0))  # (C, N)
        # per landmark: normal equations of its usual displacement, and in how many frame sets it was seen
        self._normal, self._right, self._looks = np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0)
        self._usual, self._learned = np.zeros(0), np.zeros(0)  # per bell: mean chi square per axis, and looks

    @property
    def active(self) -> bool:
        """Whether a part of the surface moves by itself."""
        return self.size > 0

    @property
    def message(self) -> str:
        """For the operator, or ''."""
        return f"a part of the surface moves by itself, by {self.size:.1f} mm" if self.active else ""

    @property
    def covariance(self) -> Array:
        """(6, 6), what it adds to a pose's covariance while active: no place is known better than that part."""
        return np.diag([0.0] * 3 + [(HEIGHT_RATIO * max(self.size, MIN_DISPLACEMENT_MM)) ** 2] * 3)

    def __call__(
        self, observations: Observations, fit: FrameFit, sigma: Array, surface_map: SurfaceMap, smeared: float
    ) -> None:
        """Take an accepted fit to what was `seen`. sigma: (N,) px. Cameras that were left out count for nothing.

        smeared: mm that the surface moves in the time by which the cameras' exposures are unknown.
        """
        self._take(surface_map)
        normal, right, weight, plain = self._landmarks(observations, fit, sigma)
        moved, square, enough = self._means(normal, plain, weight, (weight > 0) & (self._looks >= MIN_LANDMARK_SETS))
        chance = square / np.maximum(self._usual, 1.0)
        far = np.linalg.norm(moved, axis=1)
        limit, least = (END_CHI2, MIN_DISPLACEMENT_MM / 2) if self.active else (ONSET_CHI2, MIN_DISPLACEMENT_MM)
        by_itself = enough & (chance > limit) & (far > least + SMEAR_SIGMAS * smeared)
        self.size = float(far[by_itself].max(initial=0.0))
        if not self.active:
            self._learn(normal, right, weight, square, enough)

    def _take(self, surface_map: SurfaceMap) -> None:
        """Follow a map that was refined or has grown: rows keep their meaning."""
        points, known = surface_map.points, len(self._points)
        if points is self._points:
            return
        change = points[:known] - self._points
        other = np.linalg.norm(change, axis=1) > MIN_DISPLACEMENT_MM / 2
        if known and np.linalg.norm(change.mean(0)) > MIN_DISPLACEMENT_MM / 4:  # which the pose had taken for a shift
            other[:] = True
        self._normal[other], self._right[other], self._looks[other] = 0.0, 0.0, 0.0
        self._points, further = points, len(points) - known
        if further:
            self._normal = np.concatenate([self._normal, np.zeros((further, 3, 3))])
            self._right = np.concatenate([self._right, np.zeros((further, 3))])
            self._looks = np.append(self._looks, np.zeros(further))
            self._centres = bell_centres(points, self._centres)
            more = np.zeros(len(self._centres) - len(self._usual))
            self._usual, self._learned = np.append(self._usual, more), np.append(self._learned, more)
            self._bells = np.ascontiguousarray(bells(points, self._centres, BELL_SIGMA_MM).T)
            self._squares = self._bells**2

    def _landmarks(self, observations: Observations, fit: FrameFit, sigma: Array) -> tuple[Array, Array, Array, Array]:
        """Each landmark's displacement: normal equations (N, 3, 3) and (N, 3), weight (N,), right sides less usual."""
        precision = (sigma * fit.solution.scale) ** -2.0
        for camera in fit.outliers:
            precision[observations.camera == camera] = 0.0
        row = np.require(observations.track, np.int64, CONTIGUOUS)
        jacobian = np.require(fit.solution.jacobians, float, CONTIGUOUS)
        residual = np.require(fit.solution.residuals, float, CONTIGUOUS)
        normal, right, square, views = displacement_sums(len(self._points), row, jacobian, residual, precision)
        usual = self._normal + DISPLACEMENT_RIDGE * np.eye(3)
        plain, about, explained = unusual_displacements(normal, right, square, usual, self._right)
        agree = about - explained < MAX_VIEW_SIGMAS**2 * (2 * views - 3) + NONLINEAR_SHARE * about
        capped = np.minimum(1.0, MAX_LANDMARK_SIGMAS / np.sqrt(np.maximum(explained, 1e-9)))
        return normal, right, np.where((views >= MIN_VIEWS) & agree, capped, 0.0), plain

    def _means(self, normal: Array, plain: Array, weight: Array, counts: Mask) -> tuple[Array, Array, Mask]:
        """Mean displacement (C, 3) mm under each bell, its chi square (C,), and where enough landmarks count (C,).

        weight: (N,), of landmarks that count (N,). The chi square supposes that all of them have a weight of one.
        """
        count, ridge = len(weight), DISPLACEMENT_RIDGE * np.eye(3)
        flat, pulls = normal.reshape(count, 9), (weight * counts)[:, None]
        sums = self._bells @ np.concatenate([pulls * flat, pulls * plain, counts[:, None]], 1)
        spread = self._squares @ (counts[:, None] * np.concatenate([flat, np.ones((count, 1))], 1))
        pull = np.ascontiguousarray(sums[:, 9:12])
        moved = solve_symmetric3(sums[:, :9].reshape(-1, 3, 3) + ridge, pull)
        square = (solve_symmetric3(spread[:, :9].reshape(-1, 3, 3) + ridge, pull) * pull).sum(1)
        return moved, square, sums[:, 12] ** 2 > MIN_BELL_LANDMARKS * spread[:, 9]

    def _learn(self, normal: Array, right: Array, weight: Array, square: Array, enough: Mask) -> None:
        """Learn what is usual, while nothing moves by itself."""
        seen = weight > 0
        forgets = seen / USUAL_MEMORY_SETS
        self._normal += weight[:, None, None] * normal - forgets[:, None, None] * self._normal
        self._right += weight[:, None] * right - forgets[:, None] * self._right
        self._looks += seen
        self._learned = np.minimum(self._learned + enough, USUAL_MEMORY_SETS)
        now = np.minimum(square / 3, MAX_USUAL_RISE * np.maximum(self._usual, 1.0))
        self._usual += enough * (now - self._usual) / np.maximum(self._learned, 1.0)


def bell_centres(points: Array, centres: Array) -> Array:
    """The centres (C, 3) and further farthest points (N, 3), until one is near each point or there are MAX_BELLS."""
    away = np.full(len(points), np.inf)
    for centre in centres:
        away = np.minimum(away, np.linalg.norm(points - centre, axis=1))
    chosen = list(centres)
    while len(chosen) < MAX_BELLS and away.max(initial=0.0) > BELL_SIGMA_MM:
        chosen.append(points[int(np.argmax(away))])
        away = np.minimum(away, np.linalg.norm(points - chosen[-1], axis=1))
    return np.array(chosen).reshape(-1, 3)


@compiled("Tuple((f8[:,:,::1], f8[:,::1], f8[::1], i8[::1]))(i8, i8[::1], f8[:,:,::1], f8[:,::1], f8[::1])")
def displacement_sums(
    landmarks: int, landmark: Index, jacobian: Array, residual: Array, precision: Array
) -> tuple[Array, Array, Array, Index]:
    """Normal equations (L, 3, 3) and (L, 3) of each landmark's own displacement in the surface frame, mm.

    Then the weighted square (L,) of its residuals (N, 2) px, predicted minus seen, and how many cameras see it (L,).
    landmark: (N,) below L. precision: (N,) px^-2, 0 for tracks that do not count.
    """
    normal, right = np.zeros((landmarks, 3, 3)), np.zeros((landmarks, 3))
    square, views = np.zeros(landmarks), np.zeros(landmarks, np.int64)
    for i in range(len(landmark)):
        own, weight = landmark[i], precision[i]
        views[own] += weight > 0
        for k in range(2):
            left = -residual[i, k]
            square[own] += weight * left * left
            for a in range(3):
                scaled = weight * jacobian[i, k, 3 + a]
                right[own, a] += scaled * left
                for b in range(3):
                    normal[own, a, b] += scaled * jacobian[i, k, 3 + b]
    return normal, right, square, views


@compiled("f8[:,::1](f8[:,:,::1], f8[:,::1])")
def solve_symmetric3(normal: Array, right: Array) -> Array:
    """Solutions (N, 3) of positive definite normal equations (N, 3, 3) and (N, 3): Cramer's rule."""
    out = np.empty_like(right)
    for i in range(len(right)):
        m, r = normal[i], right[i]
        p, q, s = m[1, 1] * m[2, 2] - m[1, 2] ** 2, m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2], m[0, 1] * m[1, 2]
        s -= m[0, 2] * m[1, 1]
        t, u, v = m[0, 0] * m[2, 2] - m[0, 2] ** 2, m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1]
        v -= m[0, 1] ** 2
        whole = m[0, 0] * p + m[0, 1] * q + m[0, 2] * s
        out[i, 0] = (p * r[0] + q * r[1] + s * r[2]) / whole
        out[i, 1] = (q * r[0] + t * r[1] + u * r[2]) / whole
        out[i, 2] = (s * r[0] + u * r[1] + v * r[2]) / whole
    return out


@compiled("Tuple((f8[:,::1], f8[::1], f8[::1]))(f8[:,:,::1], f8[:,::1], f8[::1], f8[:,:,::1], f8[:,::1])")
def unusual_displacements(
    normal: Array, right: Array, square: Array, usual_normal: Array, usual_right: Array
) -> tuple[Array, Array, Array]:
    """What landmarks' displacements are beside their usual ones, all from `displacement_sums`; usual_normal: definite.

    The right sides (L, 3) without what is usual, the square (L,) of the residuals about that, and how much of it (L,)
    a displacement explains.
    """
    usual = solve_symmetric3(usual_normal, usual_right)
    plain, about = right.copy(), square.copy()
    for i in range(len(right)):
        for a in range(3):
            for b in range(3):
                plain[i, a] -= normal[i, a, b] * usual[i, b]
            about[i] -= (right[i, a] + plain[i, a]) * usual[i, a]
    ridged = normal.copy()
    for a in range(3):
        ridged[:, a, a] += DISPLACEMENT_FLOOR
    moved = solve_symmetric3(ridged, plain)
    return plain, about, (moved * plain).sum(1)
