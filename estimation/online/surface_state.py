"""Motion detection: whether the surface has left its place of rest, and since when (thesis 1.3: 300 um or 0.1 degree).

While the surface is at rest its measured poses scatter about one place, which the mean of the first ones gives. A
movement is a mean of the newest poses that lies away from it by more than chance allows: a generalised likelihood
ratio over unknown size, direction and onset (Basseville and Nikiforov 1993, 2.4.3), for turns and for shifts apart.
How much chance allows is learned while at rest, for each number of poses averaged: a covariance that is wrong by a
factor, and noise that lasts over frames, both show there. The place of rest is not moved along, so a slow drift adds
up until it is seen.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from estimation import se3
from estimation.pose import SurfaceMotion
from estimation.se3 import Array

AVERAGED = (2, 4, 8)  # newest poses looked at together; one alone may be a glitch
BEFORE = 16  # poses before the newest ones, against which a step is seen too: what lasts in the noise is alike in both
REST = 32  # poses, a second of three cameras, whose mean is the place of rest
BLOCK = 8  # poses: a part of them, whose mean must lie near that of all
SURE = 0.01  # of what must be flagged: no pose is known better
HISTORY = 4 * REST  # poses in which the onset is looked for


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """What counts as a movement, and how sure it must be.

    A movement is flagged from half of `moved` or `turned` on where it is beyond chance, so that half of it is left
    for noise; the surface is at rest when a second's poses stay within an eighth. That are the two thresholds.
    """

    moved: float = 0.3  # mm, thesis 1.3
    turned: float = float(np.deg2rad(0.1))  # rad, thesis 1.3
    flagged: float = 0.5  # of both
    settled: float = 0.125  # of both
    chance: float = 31.0  # chi-square of three degrees of freedom: 8e-7 a look, half a look an hour
    agree: float = 0.4  # of their mean: so far both halves of the poses must have gone, or it was a glitch
    memory: float = 1800.0  # poses, a minute, over which the noise is learned
    steady: float = 300.0  # poses, ten seconds: what is slower is no noise, but drift


class MotionDetector:
    """Watches the measured poses of one surface; one call a pose, about 0.2 ms."""

    def __init__(self, centre: Array, settings: MotionSettings | None = None) -> None:
        """centre: (3,) mm, surface frame, the place whose shift counts."""
        self.settings = settings or MotionSettings()
        self._centre, self._at_centre = centre.copy(), np.hstack([-se3.hat(centre), np.eye(3)])
        self._wanted = np.array([self.settings.turned, self.settings.moved])
        self._least = (SURE * self._wanted[:, None, None]) ** 2 * np.eye(3)
        self._anchor: Array | None = None  # the first base_from_surface, from which turns and shifts are counted
        self._stamps: deque[float] = deque(maxlen=HISTORY)
        self._states = _Rows()  # turn, rad, and shift, mm
        self._claims = _Rows(3)  # (2, 3, 3) covariances of them
        self._rest: Array | None = None  # (2, 3)
        self._noise = _Noise(self.settings)
        self._motion = SurfaceMotion()

    @property
    def motion(self) -> SurfaceMotion:
        """The last answer."""
        return self._motion

    def __call__(self, stamp: float, base_from_surface: Array, covariance: Array) -> SurfaceMotion:
        """What a measured pose (4, 4) with covariance (6, 6) at `stamp`, s, says of the surface's motion.

        The pose is that of one frame set alone: a smoothed one follows a step too late. Its covariance is that of the
        tracks' noise: what late cameras add grows with the very speed that is to be seen.
        """
        if self._anchor is None:
            self._anchor = base_from_surface.copy()
        self._stamps.append(stamp)
        self._states.append(self._state(self._anchor, base_from_surface))
        self._claims.append(self._claim(self._anchor, base_from_surface, covariance))
        if self._motion.moving:
            self._settle()
        else:
            self._watch()
        return self._motion

    def _state(self, anchor: Array, base_from_surface: Array) -> Array:
        """Turn and shift of the centre (2, 3) since the anchor, in the anchor's own axes."""
        back = anchor[:3, :3].T
        turn = se3.log(se3.inverse(anchor) @ base_from_surface)[:3]
        there, here = (t[:3, :3] @ self._centre + t[:3, 3] for t in (anchor, base_from_surface))
        return np.stack([turn, back @ (here - there)])

    def _claim(self, anchor: Array, base_from_surface: Array, covariance: Array) -> Array:
        """Covariances (2, 3, 3) of turn and shift, as the pose's own says."""
        turn = anchor[:3, :3].T @ base_from_surface[:3, :3]
        both = np.stack([covariance[:3, :3], self._at_centre @ covariance @ self._at_centre.T])
        return np.asarray(turn @ both @ turn.T + self._least)

    def _sizes(self, states: Array) -> Array:
        """Lengths (..., 2) of turns and shifts (..., 2, 3), in parts of what must be flagged."""
        return np.asarray(np.sqrt((states * states).sum(-1)) / self._wanted)

    # -- moving: until it settles

    def _settle(self) -> None:
        """At rest again once the means of the last second's parts stay together."""
        if len(self._claims) < REST:
            return self._tell(moving=True, onset=self._motion.onset)
        newest = self._states.newest(REST)
        claim = self._claims.newest(REST).mean(0)
        rest = newest.mean(0)
        away = newest.reshape(-1, BLOCK, 2, 3).mean(1) - rest
        white = self._noise.white(newest, claim)
        spread = 3.5 * np.sqrt(white * np.trace(claim, axis1=1, axis2=2) / BLOCK)
        allowed = np.maximum(self.settings.settled, spread / self._wanted)
        if (self._sizes(away).max(0) > allowed).any():
            return self._tell(moving=True, onset=self._motion.onset)
        self._rest = rest
        self._noise.begin(newest, claim, white)
        return self._tell(moving=False, onset=self._motion.onset)

    # -- at rest: until it moves

    def _watch(self) -> None:
        assert self._rest is not None
        newest = self._states.newest(REST)
        claim = self._claims.newest(AVERAGED[0]).mean(0)
        away = self._sizes(newest[-AVERAGED[0] :].mean(0) - self._rest) > self.settings.flagged
        looks = [(count, self._rest, self._noise.variance(count)) for count in AVERAGED]
        for count, since, variance in [*looks, (AVERAGED[0], _before(newest), self._noise.step)]:
            part = newest[-count:] - since
            kind = self._moved(part, claim, variance)
            if kind is not None and (since is self._rest or away[kind]):  # not where those before hold a wrong pose
                self._claims.clear()  # rest is a second of poses that are all later
                return self._tell(moving=True, onset=self._onset(since, part.mean(0), kind))
        self._noise.learn(newest, claim)
        return self._tell(moving=False, onset=self._motion.onset)

    def _moved(self, part: Array, claim: Array, variance: Array) -> int | None:
        """0 where the newest poses' mean has turned, 1 where it has shifted, None where it is at rest.

        part: (count, 2, 3) since rest, or since just before. variance: (2,) of their mean, in parts of the claim.
        """
        count, mean = len(part), part.mean(0)
        sizes = self._sizes(mean)
        for kind in np.flatnonzero(sizes > self.settings.flagged):
            spread = claim[kind] * variance[kind]
            halves = part[:, kind].reshape(2, -1, 3).sum(1) / (count / 2)
            along = halves @ mean[kind] / (mean[kind] @ mean[kind])
            least = min(self.settings.agree, self.settings.flagged / sizes[kind])
            if along.min() >= least and mean[kind] @ np.linalg.solve(spread, mean[kind]) > self.settings.chance:
                return int(kind)
        return None

    def _onset(self, since: Array, moved: Array, kind: int) -> float:
        """Stamp of the first pose of the movement: from it on all have gone a quarter of the way.

        That of the newest pose where that one is nearly back.
        """
        along = (self._states.newest(HISTORY)[:, kind] - since[kind]) @ moved[kind] / (moved[kind] @ moved[kind])
        before = np.flatnonzero(along < 0.25)
        return self._stamps[min(int(before[-1]) + 1, len(along) - 1) if len(before) else 0]

    def _tell(self, moving: bool, onset: float) -> None:
        since = np.zeros((2, 3)) if self._rest is None else self._rest
        newest = self._states.newest(AVERAGED[0]).mean(0) - since
        turned, moved = np.linalg.norm(newest, axis=1).tolist()
        self._motion = SurfaceMotion(moving, onset, moved, turned)


def _before(newest: Array) -> Array:
    """The mean (2, 3) of the poses just before the newest ones."""
    return np.asarray(newest[-BEFORE - AVERAGED[0] : -AVERAGED[0]].mean(0))


class _Rows:
    """The newest HISTORY arrays (2, 3), or of more axes, in one piece."""

    def __init__(self, *more: int) -> None:
        """more: lengths of the axes after those."""
        self._room = np.empty((8 * HISTORY, 2, 3, *more))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def clear(self) -> None:
        self._count = 0

    def append(self, row: Array) -> None:
        if self._count == len(self._room):
            self._room[:HISTORY] = self._room[-HISTORY:]
            self._count = HISTORY
        self._room[self._count] = row
        self._count += 1

    def newest(self, count: int) -> Array:
        """The last `count` (M, 2, 3, ...), or as many as there are."""
        return self._room[max(self._count - min(count, HISTORY), 0) : self._count]


class _Noise:
    """How far means of poses scatter at rest, in parts of what one pose's covariance claims; turn and shift apart."""

    COUNTS = (*AVERAGED, REST)
    TRUST = 60.0  # poses that the first second's scatter is worth
    LEAST = 0.01  # of the variance claimed; no covariance is wider than that
    MOST = 4.0  # times the noise known: a movement that is not yet flagged must not pass for noise

    def __init__(self, settings: MotionSettings) -> None:
        self._settings = settings
        self._sum = np.ones((len(self.COUNTS), 2)) / np.array(self.COUNTS)[:, None]
        self._step = np.full(2, 1 / AVERAGED[0] + 1 / BEFORE)  # of the newest poses' mean since just before
        self._weight = 0.0
        self._mean = np.zeros((2, 3))  # of the last seconds: noise is counted from here, not from the place of rest

    def white(self, states: Array, claim: Array) -> Array:
        """Variance (2,) of single poses (N, 2, 3) by their second differences, in parts of the claim (2, 3, 3)."""
        change = np.diff(states, 2, axis=0)
        return self._parts(change, claim) / 6

    def begin(self, states: Array, claim: Array, white: Array) -> None:
        """The surface has come to rest: poses (REST, 2, 3) of it, and their white noise (2,)."""
        self._mean = states.mean(0)
        if self._weight:
            return
        both = np.maximum(white, self._parts(states - self._mean, claim))
        self._sum = np.maximum(both, self.LEAST) / np.array(self.COUNTS)[:, None]
        self._step = np.maximum(both, self.LEAST) * (1 / AVERAGED[0] + 1 / BEFORE)
        self._weight = self.TRUST

    def learn(self, newest: Array, claim: Array) -> None:
        """Take the newest poses (REST, 2, 3) at rest."""
        self._mean = self._mean + (newest[-1] - self._mean) / self._settings.steady
        away = np.stack([newest[-count:].sum(0) / count for count in self.COUNTS]) - self._mean
        seen = np.einsum("nki,kij,nkj->nk", away, np.linalg.inv(claim), away) / 3
        seen = np.minimum(seen, self.MOST * self._sum)
        self._weight = min(self._weight + 1, self._settings.memory)
        self._sum = self._sum + (seen - self._sum) / self._weight
        step = self._parts((newest[-AVERAGED[0] :].mean(0) - _before(newest))[None], claim)
        self._step = self._step + (np.minimum(step, self.MOST * self._step) - self._step) / self._weight

    def variance(self, count: int) -> Array:
        """(2,) of a mean of `count` poses against the place of rest, in parts of one pose's claim."""
        return np.asarray(self._sum[self.COUNTS.index(count)] + self._sum[-1])

    @property
    def step(self) -> Array:
        """(2,) of the newest poses' mean since just before, likewise."""
        return self._step

    @staticmethod
    def _parts(away: Array, claim: Array) -> Array:
        """Mean square (2,) of deviations (N, 2, 3) in parts of their claimed covariance (2, 3, 3)."""
        told = np.linalg.inv(claim)
        return np.asarray(np.einsum("nki,kij,nkj->k", away, told, away) / (3 * len(away)))
