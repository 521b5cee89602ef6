"""Where the surface will be in the next half second, learned from its own motion while it is followed.

Experts (hold, constant velocity and the `Members`) each say where it will be; the `Stack` weighs them by their delayed
errors, and the `Intervals` say how far off that was. All are trained directly for each horizon, at samples STEP s apart
that are interpolated from the poses as they come: the camera's rate and its jitter do not matter. What is a `Surprise`
nobody learns from: no forecast could have known, and the next ones are not worse for it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.calibration import Intervals
from estimation.early import Early
from estimation.forecast import Forecast, body_rate, prepare
from estimation.forecast.innovation_gate import Surprise
from estimation.history import History
from estimation.members import LAGS, LEVER, Members
from estimation.pose import SurfacePose
from estimation.se3 import Array
from estimation.stacking import Stack

HORIZONS = np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # s
STEP = 0.1  # s between samples learned from; a camera that is faster only predicts in between
GAP = 0.5  # s without a pose, after which the surface may be anywhere
YOUNG = 8.0  # s of judged forecasts, two breaths: until then errors still to come are not known by those seen
BREATHS = 10.0  # s in which the fastest motion seen is forgotten to a third
SETTLE = 50  # samples judged before the first forecast
SCALE = np.array([LEVER] * 3 + [1.0] * 3)  # rad to mm at the lever
PROBES = 10  # points at most, at which the intervals are judged
EARLY = 1e-3  # s: stamps that are equal but for rounding


@dataclass(slots=True)
class _Sample:
    """A past instant, and what was expected of it. known: horizons whose truth has come. spoilt: surprised since."""

    stamp: float
    pose: Array
    inputs: list[Array]
    experts: Array  # (H, E, 6)
    expected: Array  # (H, 6)
    claimed: Array  # (H, N)
    known: int = 0
    spoilt: bool = False
    moved: Array = field(default_factory=lambda: np.zeros((len(HORIZONS), 6)))


class Predictor:
    """Takes the poses of one surface as they come and gives each a forecast, once it has seen enough."""

    def __init__(self, points: Array | None = None) -> None:
        """points: (N, 3) mm of the surface, for which the intervals shall hold."""
        if points is None:
            points = LEVER * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        prepare(HORIZONS)  # before the first frame set: the first forecast comes in the middle of a run
        probes = points[:: -(-len(points) // PROBES)]
        self._members = Members(len(HORIZONS))
        count = self._members.count
        self._history = History(LAGS[-1] + STEP)
        self._stack = Stack(len(HORIZONS), np.concatenate([np.zeros(2), np.full(count, 1 / count)]))
        self._intervals = Intervals(len(HORIZONS), probes / LEVER)
        self._samples: deque[_Sample] = deque()
        self._judged = 0
        self._before = -np.inf
        self._surprise, self._early = Surprise(), Early()
        self._fastest = 0.0  # mm/s at the lever, of the last breaths
        self._last: tuple[Forecast, Array] | None = None  # the newest forecast, and what was claimed of it, mm^2

    def add(self, pose: SurfacePose, lasting: Array | None = None) -> Forecast | None:
        """Learn from a measured pose, newer than those before, and forecast from it; None while too little is known.

        lasting: (6, 6), the part of the pose's covariance that is the same error in every pose: no later pose shows it.
        """
        if not (np.isfinite(pose.base_from_surface).all() and np.isfinite(pose.twist).all()):
            return None
        if not 0 < pose.stamp - self._before <= GAP:
            self._history.clear()
            self._samples.clear()
            self._surprise.forget()
            self._early.forget()
            self._last = None
        lasting = np.zeros((6, 6)) if lasting is None else lasting
        seconds, twist = pose.stamp - self._before, self._heed(pose)
        self._before = pose.stamp
        return self._learned(pose, twist, lasting) or self._unlearned(pose, seconds, twist)

    def _learned(self, pose: SurfacePose, twist: Array, lasting: Array) -> Forecast | None:
        """Learn from the pose, and forecast by what is learned; None while too little is known."""
        self._history.add(pose.stamp, pose.base_from_surface)
        if self._history.reach < STEP / 2:
            return None
        due = self._due(pose.stamp)
        ends, now = [s.stamp + HORIZONS[k] for s, k in due], np.broadcast_to(pose.base_from_surface, (len(LAGS), 4, 4))
        starts = np.concatenate([np.array([s.pose for s, _ in due]).reshape(-1, 4, 4), now])
        moved = self._history.increments(starts, np.concatenate([ends, pose.stamp - LAGS])) * SCALE
        self._learn(due, moved[: len(due)])
        if self._history.reach < LAGS[-1] - EARLY:
            return None
        return self._forecast(pose, twist, moved[len(due) :], lasting)

    def _unlearned(self, pose: SurfacePose, seconds: float, twist: Array) -> Forecast | None:
        """Constant velocity, by which the next pose is judged; said only where the pose itself claims too much."""
        claims = self._early(pose, seconds, twist if self._surprise.active else None, HORIZONS)
        self._last = (
            Forecast(HORIZONS, HORIZONS[:, None] * self._early.twist, claims),
            claims[0] * np.outer(SCALE, SCALE),
        )
        if not self._early.calmer:
            return None
        return self._with_surprise(replace(self._last[0], covariances=claims + pose.covariance))

    def _heed(self, pose: SurfacePose) -> Array:
        """The twist (6,) that forecasts reckon with: what suddenly moves the surface is set aside.

        The past goes along with it, as if the surface had been there all the time.
        """
        if self._last is None:
            return pose.twist
        (forecast, claim), seconds = self._last, pose.stamp - self._before
        steps, rates = forecast.at(np.array([seconds]))
        step, rate = self._bounded(steps[0], rates[0], seconds)
        foretold = self._history.newest @ se3.exp(step)
        off = se3.log(se3.inverse(foretold) @ pose.base_from_surface) * SCALE
        if not self._surprise(off, seconds, float(HORIZONS[0]), claim):
            self._fastest = max(_size(pose.twist), self._fastest * np.exp(-seconds / BREATHS))
            return pose.twist
        moved = pose.base_from_surface @ se3.inverse(foretold)
        self._history.carry(moved)
        for sample in self._samples:
            sample.pose, sample.spoilt = moved @ sample.pose, True
        return body_rate(step, rate)

    def _bounded(self, step: Array, rate: Array, seconds: float) -> tuple[Array, Array]:
        """A step (6,) of `seconds` s, and its rate, no faster than the surface lately was.

        What is set aside for a second is foretold from what was foretold: a young regression may run away in that.
        """
        faster = max(_size(step) / seconds, _size(rate)) / max(self._fastest, 1e-9)
        return (step, rate) if faster <= 1 else (step / faster, rate / faster)

    def _due(self, now: float) -> list[tuple[_Sample, int]]:
        """The samples and horizons whose time has come."""
        waiting = ((s, k) for s in self._samples for k in range(s.known, len(HORIZONS)))
        return [(s, k) for s, k in waiting if s.stamp + HORIZONS[k] <= now + EARLY]

    def _forecast(self, pose: SurfacePose, twist: Array, past: Array, lasting: Array) -> Forecast | None:
        twist = twist * SCALE
        inputs = self._members.inputs(past, twist)
        ahead = (HORIZONS[:, None] * twist)[:, None]  # (H, 1, 6)
        experts = np.concatenate([np.zeros_like(ahead), ahead, self._members(inputs) + ahead], axis=1)
        expected = self._stack(experts)
        spread, claimed = self._intervals()
        due = not self._samples or pose.stamp - self._samples[-1].stamp > STEP - EARLY
        if due and not self._surprise.active:
            self._members.watch(past)
            self._samples.append(_Sample(pose.stamp, pose.base_from_surface, inputs, experts, expected, claimed))
        if self._judged < SETTLE:
            return None
        covariances = spread / np.outer(SCALE, SCALE) + lasting + self._unseen(pose)
        known = Forecast(HORIZONS, expected / SCALE, covariances)
        self._last = known, spread[0] + lasting * np.outer(SCALE, SCALE)
        return self._with_surprise(known)

    def _with_surprise(self, known: Forecast) -> Forecast:
        """The forecast with what was set aside on top."""
        sudden, doubt = self._surprise.ahead(HORIZONS)
        covariances = known.covariances + doubt / np.outer(SCALE, SCALE)
        return Forecast(HORIZONS, known.increments + sudden / SCALE, covariances)

    def _unseen(self, pose: SurfacePose) -> Array:
        """Covariances (H, 6, 6) of what errors seen so far do not tell, fading as the first breaths are seen.

        It is what white noise on acceleration makes of the twist: errors of one phase of a breath say little of others.
        """
        young = max(0.0, 1 - self._judged * STEP / YOUNG)
        ahead = HORIZONS[:, None, None]
        return young**2 * (ahead**2 * pose.twist_covariance + ahead**3 / 3 * np.diag(pose.acceleration_psd))

    def _learn(self, due: list[tuple[_Sample, int]], moved: Array) -> None:
        """Compare what was expected with what came, (K, 6), horizon by horizon as its time comes."""
        for (sample, j), vector in zip(due, moved, strict=True):
            sample.moved[j], sample.known = vector, j + 1
        fair = [(sample, k) for sample, k in due if not sample.spoilt]
        for batch in _once_each(fair):
            samples, k = [fair[i][0] for i in batch], np.array([fair[i][1] for i in batch])
            pairs = list(zip(samples, k.tolist(), strict=True))
            truth = np.stack([sample.moved[j] for sample, j in pairs])
            self._stack.learn(k, np.stack([sample.experts[j] for sample, j in pairs]), truth)
            error = truth - np.stack([sample.expected[j] for sample, j in pairs])
            self._intervals.learn(k, error, np.stack([sample.claimed[j] for sample, j in pairs]))
        while self._samples and self._samples[0].known == len(HORIZONS):
            sample = self._samples.popleft()
            if not sample.spoilt:
                self._members.learn(sample.inputs, sample.experts[:, 1:], sample.moved)
                self._judged += 1


def _size(vector: Array) -> float:
    """Of a tangent vector (6,), mm, turns at the lever."""
    return float(np.linalg.norm(vector * SCALE))


def _once_each(due: list[tuple[_Sample, int]]) -> Iterator[list[int]]:
    """The places in `due` in batches, of which each has a horizon once at most, older samples first."""
    batches: list[list[int]] = []
    for i, (_, k) in enumerate(due):
        free = [b for b in batches if all(due[j][1] != k for j in b)]
        if free:
            free[0].append(i)
        else:
            batches.append([i])
    yield from batches
