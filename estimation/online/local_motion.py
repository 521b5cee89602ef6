"""A part of the surface that moves by itself: the residuals of one place, together, ask for a displacement.

The robust fit takes a fold of the skin for outliers, and rightly: the pose stays that of the rest, and its claim with
it. But outliers of tracking are independent from camera to camera and from landmark to landmark. So each landmark's
displacement is solved for from all cameras, those are set aside whose cameras do not agree on one, and what is left is
averaged under bells over the surface, beside what is usual there. A mean that chance does not explain is a part that
moves by itself. It has no pose: what is claimed of any place grows by what it moved.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.fit import Fit
from estimation.observations import Observations
from estimation.runtime import NEW
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.track_loops import displacement_sums, solutions, unusual
from estimation.warp import bells

REACH = 6.0  # mm, one sigma of a bell: about a dozen landmarks, and a fold of the skin
CENTRES = 96  # of bells, at most: spread over the surface, REACH apart
VIEWS = 2  # cameras that must see a landmark: one alone may have lost it
AGREE = 3.0  # sigmas to which one displacement must explain what all cameras see,
CURVED = 0.02  # and of the square of what they see: cameras expose apart, and perspective is no line
CAPPED = 3.0  # sigmas at most as which a landmark counts: what strayed alike in two cameras is no part of the surface
KNOWN = 100  # frame sets over which it is learned what is usual,
FIRST = 10  # and in which a landmark must have been seen before it tells anything
RISES = 3.0  # times what was usual as which one frame set counts at most: a fold that begins is not to become usual
FEW = 4.0  # landmarks as which those under a bell must count
CHANCE = 36.0  # chi square of three: 7e-8, and there are dozens of bells; times what is usual there
OVER = 16.3  # likewise, 1e-3: it is over
LEAST = 0.2  # mm, of a bell's mean: a fold twice as high, since it is no wider than the bell
LATE = 3.0  # sigmas of the exposures, whose motion looks like a displacement: the pose cannot fit it everywhere
UNSEEN = 3.0  # times the bell's mean: the height of a fold, and what it grows by until the arm has obeyed
RIDGE = 1.0  # mm^-2: a landmark's place is known as well beforehand, also along a line that all its cameras share

Rows = NDArray[np.bool_]


class LocalMotion:
    """Remembers how the landmarks of one map usually lie, and whether a part of them is displaced now.

    size: mm, of the largest mean displacement under a bell while a part moves by itself, else 0.
    """

    def __init__(self) -> None:
        self.size = 0.0
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
    def said(self) -> str:
        """What is to be said of it, or ''."""
        return f"a part of the surface moves by itself, by {self.size:.1f} mm" if self.active else ""

    @property
    def covariance(self) -> Array:
        """(6, 6), what it adds to the claim of a pose while active: no place is known better than that part."""
        return np.diag([0.0] * 3 + [(UNSEEN * max(self.size, LEAST)) ** 2] * 3)

    def __call__(self, seen: Observations, fit: Fit, sigma: Array, surface_map: SurfaceMap, smeared: float) -> None:
        """Take an accepted fit to what was `seen`. sigma: (N,) px. Cameras that were left out count for nothing.

        smeared: mm that the surface moves in the time by which the cameras' exposures are unknown.
        """
        self._take(surface_map)
        normal, right, weight, plain = self._landmarks(seen, fit, sigma)
        moved, square, enough = self._means(normal, plain, weight, (weight > 0) & (self._looks >= FIRST))
        chance = square / np.maximum(self._usual, 1.0)
        far = np.linalg.norm(moved, axis=1)
        limit, least = (OVER, LEAST / 2) if self.active else (CHANCE, LEAST)
        by_itself = enough & (chance > limit) & (far > least + LATE * smeared)
        self.size = float(far[by_itself].max(initial=0.0))
        if not self.active:
            self._learn(normal, right, weight, square, enough)

    def _take(self, surface_map: SurfaceMap) -> None:
        """Follow a map that was refined or has grown: rows keep their meaning."""
        points, known = surface_map.points, len(self._points)
        if points is self._points:
            return
        change = points[:known] - self._points
        other = np.linalg.norm(change, axis=1) > LEAST / 2
        if known and np.linalg.norm(change.mean(0)) > LEAST / 4:  # the pose took a part of that error for a shift
            other[:] = True
        self._normal[other], self._right[other], self._looks[other] = 0.0, 0.0, 0.0
        self._points, further = points, len(points) - known
        if further:
            self._normal = np.concatenate([self._normal, np.zeros((further, 3, 3))])
            self._right = np.concatenate([self._right, np.zeros((further, 3))])
            self._looks = np.append(self._looks, np.zeros(further))
            self._centres = covering(points, self._centres)
            more = np.zeros(len(self._centres) - len(self._usual))
            self._usual, self._learned = np.append(self._usual, more), np.append(self._learned, more)
            self._bells = np.ascontiguousarray(bells(points, self._centres, REACH).T)
            self._squares = self._bells**2

    def _landmarks(self, seen: Observations, fit: Fit, sigma: Array) -> tuple[Array, Array, Array, Array]:
        """Of each landmark: normal equations (N, 3, 3) and (N, 3) of its displacement, its weight (N,), 0 to 1.

        The last are the right sides (N, 3) without what is usual.
        """
        precision = (sigma * fit.solution.scale) ** -2.0
        for camera in fit.odd:
            precision[seen.camera == camera] = 0.0
        row, jacobian = np.require(seen.track, np.int64, NEW), np.require(fit.solution.jacobians, float, NEW)
        residual = np.require(fit.solution.residuals, float, NEW)
        normal, right, square, views = displacement_sums(len(self._points), row, jacobian, residual, precision)
        plain, about, explained = unusual(normal, right, square, self._normal + RIDGE * np.eye(3), self._right)
        agree = about - explained < AGREE**2 * (2 * views - 3) + CURVED * about
        capped = np.minimum(1.0, CAPPED / np.sqrt(np.maximum(explained, 1e-9)))
        return normal, right, np.where((views >= VIEWS) & agree, capped, 0.0), plain

    def _means(self, normal: Array, plain: Array, weight: Array, counts: Rows) -> tuple[Array, Array, Rows]:
        """Mean displacement (C, 3) mm under each bell, its chi square (C,), and where enough landmarks tell (C,).

        weight: (N,), of landmarks that count (N,). By chance they would all have a weight of one: the square is that
        of their pull, however little some of them may pull.
        """
        count, ridge = len(weight), RIDGE * np.eye(3)
        flat, pulls = normal.reshape(count, 9), (weight * counts)[:, None]
        sums = self._bells @ np.concatenate([pulls * flat, pulls * plain, counts[:, None]], 1)
        spread = self._squares @ (counts[:, None] * np.concatenate([flat, np.ones((count, 1))], 1))
        pull = np.ascontiguousarray(sums[:, 9:12])
        moved = solutions(sums[:, :9].reshape(-1, 3, 3) + ridge, pull)
        square = (solutions(spread[:, :9].reshape(-1, 3, 3) + ridge, pull) * pull).sum(1)
        return moved, square, sums[:, 12] ** 2 > FEW * spread[:, 9]

    def _learn(self, normal: Array, right: Array, weight: Array, square: Array, enough: Rows) -> None:
        """Take what was seen while nothing moved by itself for what is usual."""
        seen = weight > 0
        forgets = seen / KNOWN
        self._normal += weight[:, None, None] * normal - forgets[:, None, None] * self._normal
        self._right += weight[:, None] * right - forgets[:, None] * self._right
        self._looks += seen
        self._learned = np.minimum(self._learned + enough, KNOWN)
        now = np.minimum(square / 3, RISES * np.maximum(self._usual, 1.0))
        self._usual += enough * (now - self._usual) / np.maximum(self._learned, 1.0)


def covering(points: Array, centres: Array) -> Array:
    """Centres (C, 3), those given first, of which one is within REACH of every point (N, 3), CENTRES at most.

    The others are points, each the farthest from those before.
    """
    away = np.full(len(points), np.inf)
    for centre in centres:
        away = np.minimum(away, np.linalg.norm(points - centre, axis=1))
    chosen = list(centres)
    while len(chosen) < CENTRES and away.max(initial=0.0) > REACH:
        chosen.append(points[int(np.argmax(away))])
        away = np.minimum(away, np.linalg.norm(points - chosen[-1], axis=1))
    return np.array(chosen).reshape(-1, 3)
