"""Forecast of the surface's motion over the next half second, learned online from its past motion.

Experts (hold, constant velocity and the learned `Experts`) each predict it; the `ExpertStack` weighs them by their
delayed errors, and the `IntervalCalibration` gives the covariance. All are trained directly for each horizon, at
samples SAMPLE_INTERVAL_S apart that are interpolated from the poses as they come: the camera's rate and its jitter do
not matter. Nobody learns from what the `InnovationGate` sets aside: no forecast could have known it.

The error of a forecast is learned when its time has come, a tenth of a second later at the soonest. A patient who
coughs has moved by millimetres then. So a pose that is off the forecast of the one before, by more than poses usually
are and by more than the forecast's covariance allows, shows a new motion. Its displacement is set aside with a velocity
of its own, which widens the covariance; the known motion goes on underneath, until the surface moves by that alone.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.forecast.experts import LAGS, TURN_LEVER_MM, Experts, ExpertStack, IntervalCalibration
from estimation.pose import Forecast, SurfacePose, body_rate
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array

HORIZONS = np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # s
SAMPLE_INTERVAL_S = 0.1  # between samples learned from; a camera that is faster only predicts in between
MAX_POSE_GAP_S = 0.5  # without a pose, after which the surface may be anywhere
YOUNG_FORECASTS_S = 8.0  # of judged forecasts, two breaths: until then their errors do not represent those to come
SPEED_MEMORY_S = 10.0  # in which the fastest motion is forgotten to a third
MIN_JUDGED_SAMPLES = 50  # before the first forecast
TANGENT_SCALE = np.array([TURN_LEVER_MM] * 3 + [1.0] * 3)  # rad to mm at the lever
MAX_PROBES = 10  # points at which the intervals are judged
STAMP_TOLERANCE_S = 1e-3  # of stamps that are equal but for rounding

MIN_TURN_COSINE = -0.9  # of a turn: beyond, its axis is lost in rounding
MIN_POSE_GAP_S = 0.01  # poses nearer to the one before replace it, so that a faster camera keeps no shorter memory

# a pose is set aside where it is off its forecast by more than both of:
NOISE_RATIO = 5.0  # times the usual innovation
CLAIM_SIGMAS = 3.0  # times the sigma for the first horizon, if it went on like that
INNOVATION_MEMORY_S = 4.0  # over which the usual innovation is learned
UNKNOWN_DECAY_S = 0.012  # of the covariance of the new velocity
DRIFT_DECAY_S = 0.1  # of the velocity of what was set aside: what suddenly moves a surface as suddenly stops
END_AFTER_S = 0.1  # without an innovation until all is as before
ACCEPT_AFTER_S = 2.0  # after which what goes on surprising is usual
PSD_GROWTH_S = 1.0  # in which the kept density grows by e: what goes on for longer is the surface's own


class PoseHistory:
    """A window of poses over `span` s, of bounded memory: one pose in each MIN_POSE_GAP_S at most."""

    def __init__(self, span: float) -> None:
        self._span = span
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self._stamps, self._poses = np.zeros(0), np.zeros((0, 4, 4))

    def add(self, stamp: float, pose: Array) -> None:
        """Take a pose (4, 4) newer than all before."""
        end = len(self._stamps)
        if end > 1 and stamp - self._stamps[-2] < MIN_POSE_GAP_S:
            end -= 1
        stamps = np.append(self._stamps[:end], stamp)
        # one pose of before the span is kept, and two poses at least
        first = max(min(int(np.searchsorted(stamps, stamp - self._span, "right")) - 1, len(stamps) - 2), 0)
        self._stamps, self._poses = stamps[first:], np.concatenate([self._poses[first:end], pose[None]])

    @property
    def reach(self) -> float:
        """s from the oldest pose to the newest."""
        return float(self._stamps[-1] - self._stamps[0]) if len(self._stamps) else 0.0

    def carry(self, moved: Array) -> None:
        """Put all poses where they are carried by `moved` (4, 4), in the base frame."""
        self._poses = moved @ self._poses

    @property
    def newest(self) -> Array:
        """The last pose (4, 4); only where there is one."""
        return np.asarray(self._poses[-1])

    def increments(self, poses: Array, stamps: Array) -> Array:
        """Tangent vectors (N, 6) from poses (N, 4, 4), or one (4, 4) for all, to where the surface was at stamps (N,).

        Between two poses of the window the increment is taken as linear; outside, its end counts.
        """
        own = self._stamps
        after = np.clip(np.searchsorted(own, stamps), 1, len(own) - 1)
        before = after - 1
        share = np.clip((stamps - own[before]) / (own[after] - own[before]), 0.0, 1.0)[:, None]
        ends = self._poses[np.stack([before, after])]  # (2, N, 4, 4)
        vectors = _increments(np.broadcast_to(poses, (len(stamps), 4, 4)), ends)
        return np.asarray((1 - share) * vectors[0] + share * vectors[1])


def _increments(a: Array, b: Array) -> Array:
    """log(inverse(a) @ b) (2, N, 6) of poses a (N, 4, 4) and b (2, N, 4, 4), compiled for turns below half a turn."""
    vectors, within = _short_increments(contiguous(a), contiguous(b))
    return vectors if within else np.asarray(se3.log(se3.inverse(a) @ b))


@compiled("Tuple((f8[:,:,::1], b1))(f8[:,:,::1], f8[:,:,:,::1])")
def _short_increments(a: Array, b: Array) -> tuple[Array, bool]:
    """As `_increments`, and whether no turn came near half a turn, where this is not exact."""
    vectors, within = np.empty((2, len(a), 6)), True
    turn, shift = np.empty((3, 3)), np.empty(3)
    for end in range(2):
        for n in range(len(a)):
            here, there = a[n], b[end, n]
            for i in range(3):
                shift[i] = 0.0
                for k in range(3):
                    shift[i] += here[k, i] * (there[k, 3] - here[k, 3])
                for j in range(3):
                    turn[i, j] = here[0, i] * there[0, j] + here[1, i] * there[1, j] + here[2, i] * there[2, j]
            cosine = (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1) / 2
            within = within and cosine >= MIN_TURN_COSINE
            x, y, z = (turn[2, 1] - turn[1, 2]) / 2, (turn[0, 2] - turn[2, 0]) / 2, (turn[1, 0] - turn[0, 1]) / 2
            sine = np.sqrt(x * x + y * y + z * z)
            angle = np.arctan2(sine, cosine)
            stretch = angle / sine if angle >= 1e-4 else 1.0
            small = 1 / 12 + angle**2 / 720
            bend = small if angle < 0.05 else (1 - angle * (1 + cosine) / (2 * sine)) / angle**2
            x, y, z = stretch * x, stretch * y, stretch * z
            u, v, w = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
            out = vectors[end, n]
            out[0], out[1], out[2] = x, y, z
            out[3] = shift[0] - u / 2 + bend * (y * w - z * v)
            out[4] = shift[1] - v / 2 + bend * (z * u - x * w)
            out[5] = shift[2] - w / 2 + bend * (x * v - y * u)
    return vectors, within


class InnovationGate:
    """Watches how far each pose is off the forecast of the one before it; in mm, turns at a lever."""

    def __init__(self) -> None:
        self._usual, self._learned = 0.0, 0.0  # mm^2, and s over which it was learned
        self._left = 0.0  # s until all is as before, if nothing surprises any more
        self._lasted, self._squares = 0.0, 0.0  # s since the first innovation, and their mean square since, mm^2
        self.drift = np.zeros(6)  # mm/s, of what was set aside
        self.unknown = np.zeros((6, 6))  # mm^2/s^2, covariance of that velocity

    @property
    def active(self) -> bool:
        """Whether something is set aside."""
        return self._left > 0

    def forget(self) -> None:
        """Set nothing aside any more; what is usual is kept."""
        self._left = self._lasted = self._squares = 0.0
        self.drift = np.zeros(6)

    def ahead(self, seconds: Array) -> tuple[Array, Array]:
        """How far, (H, 6) mm, what was set aside moves on in `seconds` (H,), and its covariances (H, 6, 6)."""
        goes = DRIFT_DECAY_S * (1 - np.exp(-seconds / DRIFT_DECAY_S))
        stops = np.outer(self.drift, self.drift)
        doubt = seconds[:, None, None] ** 2 * self.unknown + (seconds - goes)[:, None, None] ** 2 * stops
        return goes[:, None] * self.drift, doubt

    def __call__(self, off: Array, seconds: float, ahead: float, claim: Array) -> bool:
        """Whether a pose is set aside from the known motion.

        off: (6,) mm, from the forecast of the known motion `seconds` s before. claim: (6, 6) mm^2, covariance of that
        forecast `ahead` s ahead, as learned from earlier errors.
        """
        new = off - self.drift * seconds
        square, known, allowed = float(new @ new), NOISE_RATIO**2 * self._usual, CLAIM_SIGMAS**2 * np.trace(claim)
        self.unknown *= np.exp(-seconds / UNKNOWN_DECAY_S)
        if 0 < known < square and square * (ahead / seconds) ** 2 > allowed:
            self._left = END_AFTER_S
        elif self.active and self.drift @ self.drift * ahead**2 < allowed:
            self._left -= seconds
        if not self.active:
            self._learned = min(self._learned + seconds, INNOVATION_MEMORY_S)
            self._usual += seconds / self._learned * ((min(square, known) if known else square) - self._usual)
        if self._lasted > ACCEPT_AFTER_S:
            self._usual, self._left = self._squares, 0.0
        if not self.active:
            self.forget()
            return False
        self.unknown += np.outer(new, new) / seconds**2
        self.drift, self._lasted = off / seconds, self._lasted + seconds
        self._squares += (square - self._squares) * seconds / self._lasted
        return True


class WarmupForecast:
    """Constant velocity before any forecast is learned, with covariances that one push does not widen for long.

    A pose's own covariance knows how lively the surface was in the last second, with whatever struck it. The calmer
    motion before goes on: the least density of late is kept, and trusted less as time goes by.

    twist: (6,) rad/s and mm/s, the velocity used. calmer: whether the covariance is less than the pose's own.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.twist, self.calmer = np.zeros(6), False
        self._known, self._psd = np.zeros((6, 6)), np.full(6, np.inf)

    def __call__(self, pose: SurfacePose, seconds: float, aside: Array | None, ahead: Array) -> Array:
        """Covariances (H, 6, 6) `ahead` (H,) s after a pose, `seconds` s newer than the last.

        aside: (6,) the velocity without what was set aside, None where nothing is. Afterwards what was known of it
        counts until the pose itself knows the velocity better.
        """
        grown = pose.twist_covariance
        if self.calmer or aside is not None:
            grown = self._known + seconds * np.diag(self._psd)
        if aside is not None:
            self.twist, self._known, self.calmer = aside, grown, True
        else:
            self._psd = np.minimum(pose.acceleration_psd, self._psd * np.exp(seconds / PSD_GROWTH_S))
            self.calmer = self.calmer and bool((self._psd < pose.acceleration_psd).any())
            if not self.calmer or np.trace(pose.twist_covariance[3:, 3:]) <= np.trace(grown[3:, 3:]):
                self.twist, grown = pose.twist, pose.twist_covariance
            self._known = grown
        span = ahead[:, None, None]
        return np.asarray(span**2 * self._known + span**3 / 3 * np.diag(self._psd))


@dataclass(slots=True)
class _Sample:
    """A past instant, and what was expected of it."""

    stamp: float
    pose: Array
    inputs: list[Array]
    experts: Array  # (H, E, 6)
    expected: Array  # (H, 6)
    claimed: Array  # (H, N)
    known: int = 0  # horizons whose truth has come
    spoilt: bool = False  # something was set aside since
    moved: Array = field(default_factory=lambda: np.zeros((len(HORIZONS), 6)))


class Predictor:
    """Takes the poses of one surface as they come and gives each a forecast, once it has seen enough."""

    def __init__(self, points: Array | None = None) -> None:
        """points: (N, 3) mm of the surface, for which the intervals shall hold."""
        if points is None:
            points = TURN_LEVER_MM * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        probes = points[:: -(-len(points) // MAX_PROBES)]
        self._experts = Experts(len(HORIZONS))
        count = self._experts.count
        self._history = PoseHistory(LAGS[-1] + SAMPLE_INTERVAL_S)
        self._stack = ExpertStack(len(HORIZONS), np.concatenate([np.zeros(2), np.full(count, 1 / count)]))
        self._intervals = IntervalCalibration(len(HORIZONS), probes / TURN_LEVER_MM)
        self._samples: deque[_Sample] = deque()
        self._judged = 0
        self._before = -np.inf
        self._gate, self._warmup = InnovationGate(), WarmupForecast()
        self._fastest = 0.0  # mm/s at the lever, of the last breaths
        self._last: tuple[Forecast, Array] | None = None  # the newest forecast, and what was claimed of it, mm^2

    def add(self, pose: SurfacePose, lasting: Array | None = None) -> Forecast | None:
        """Learn from a measured pose, newer than those before, and forecast from it; None while too little is known.

        lasting: (6, 6), the part of the pose's covariance that is the same error in every pose: no later pose shows it.
        """
        if not (np.isfinite(pose.base_from_surface).all() and np.isfinite(pose.twist).all()):
            return None
        if not 0 < pose.stamp - self._before <= MAX_POSE_GAP_S:
            self._history.clear()
            self._samples.clear()
            self._gate.forget()
            self._warmup.forget()
            self._last = None
        lasting = np.zeros((6, 6)) if lasting is None else lasting
        seconds, twist = pose.stamp - self._before, self._known_twist(pose)
        self._before = pose.stamp
        return self._learned_forecast(pose, twist, lasting) or self._warmup_forecast(pose, seconds, twist)

    def _learned_forecast(self, pose: SurfacePose, twist: Array, lasting: Array) -> Forecast | None:
        """Learn from the pose, and forecast by what is learned; None while too little is known."""
        self._history.add(pose.stamp, pose.base_from_surface)
        if self._history.reach < SAMPLE_INTERVAL_S / 2:
            return None
        waiting = ((s, k) for s in self._samples for k in range(s.known, len(HORIZONS)))
        due = [(s, k) for s, k in waiting if s.stamp + HORIZONS[k] <= pose.stamp + STAMP_TOLERANCE_S]
        ends, now = [s.stamp + HORIZONS[k] for s, k in due], np.broadcast_to(pose.base_from_surface, (len(LAGS), 4, 4))
        starts = np.concatenate([np.array([s.pose for s, _ in due]).reshape(-1, 4, 4), now])
        moved = self._history.increments(starts, np.concatenate([ends, pose.stamp - LAGS])) * TANGENT_SCALE
        self._learn(due, moved[: len(due)])
        if self._history.reach < LAGS[-1] - STAMP_TOLERANCE_S:
            return None
        return self._forecast(pose, twist, moved[len(due) :], lasting)

    def _warmup_forecast(self, pose: SurfacePose, seconds: float, twist: Array) -> Forecast | None:
        """Constant velocity, by which the next pose is judged; given only where the pose's covariance is wider."""
        claims = self._warmup(pose, seconds, twist if self._gate.active else None, HORIZONS)
        forecast = Forecast(HORIZONS, HORIZONS[:, None] * self._warmup.twist, claims)
        self._last = forecast, claims[0] * np.outer(TANGENT_SCALE, TANGENT_SCALE)
        if not self._warmup.calmer:
            return None
        return self._with_drift(replace(forecast, covariances=claims + pose.covariance))

    def _known_twist(self, pose: SurfacePose) -> Array:
        """The twist (6,) without sudden motion. The past is shifted as if the surface had always been there."""
        if self._last is None:
            return pose.twist
        (forecast, claim), seconds = self._last, pose.stamp - self._before
        steps, rates = forecast.at(np.array([seconds]))
        step, rate = self._bounded(steps[0], rates[0], seconds)
        foretold = self._history.newest @ se3.exp(step)
        off = se3.log(se3.inverse(foretold) @ pose.base_from_surface) * TANGENT_SCALE
        if not self._gate(off, seconds, float(HORIZONS[0]), claim):
            self._fastest = max(_size(pose.twist), self._fastest * np.exp(-seconds / SPEED_MEMORY_S))
            return pose.twist
        moved = pose.base_from_surface @ se3.inverse(foretold)
        self._history.carry(moved)
        for sample in self._samples:
            sample.pose, sample.spoilt = moved @ sample.pose, True
        return body_rate(step, rate)

    def _bounded(self, step: Array, rate: Array, seconds: float) -> tuple[Array, Array]:
        """A step (6,) of `seconds` s and its rate, no faster than of late: forecasts of forecasts may run away."""
        faster = max(_size(step) / seconds, _size(rate)) / max(self._fastest, 1e-9)
        return (step, rate) if faster <= 1 else (step / faster, rate / faster)

    def _forecast(self, pose: SurfacePose, twist: Array, past: Array, lasting: Array) -> Forecast | None:
        twist = twist * TANGENT_SCALE
        inputs = self._experts.inputs(past, twist)
        ahead = (HORIZONS[:, None] * twist)[:, None]  # (H, 1, 6)
        experts = np.concatenate([np.zeros_like(ahead), ahead, self._experts(inputs) + ahead], axis=1)
        expected = self._stack(experts)
        spread, claimed = self._intervals()
        due = not self._samples or pose.stamp - self._samples[-1].stamp > SAMPLE_INTERVAL_S - STAMP_TOLERANCE_S
        if due and not self._gate.active:
            self._experts.watch(past)
            self._samples.append(_Sample(pose.stamp, pose.base_from_surface, inputs, experts, expected, claimed))
        if self._judged < MIN_JUDGED_SAMPLES:
            return None
        # added while few errors are known, fading with the first breaths: white noise on acceleration, since errors of
        # one phase of a breath say little of others
        young = max(0.0, 1 - self._judged * SAMPLE_INTERVAL_S / YOUNG_FORECASTS_S)
        span = HORIZONS[:, None, None]
        unseen = young**2 * (span**2 * pose.twist_covariance + span**3 / 3 * np.diag(pose.acceleration_psd))
        covariances = spread / np.outer(TANGENT_SCALE, TANGENT_SCALE) + lasting + unseen
        known = Forecast(HORIZONS, expected / TANGENT_SCALE, covariances)
        self._last = known, spread[0] + lasting * np.outer(TANGENT_SCALE, TANGENT_SCALE)
        return self._with_drift(known)

    def _with_drift(self, known: Forecast) -> Forecast:
        """The forecast, plus the motion that was set aside."""
        sudden, doubt = self._gate.ahead(HORIZONS)
        covariances = known.covariances + doubt / np.outer(TANGENT_SCALE, TANGENT_SCALE)
        return Forecast(HORIZONS, known.increments + sudden / TANGENT_SCALE, covariances)

    def _learn(self, due: list[tuple[_Sample, int]], moved: Array) -> None:
        """Compare what was expected with what came, (K, 6), horizon by horizon as its time comes."""
        for (sample, j), vector in zip(due, moved, strict=True):
            sample.moved[j], sample.known = vector, j + 1
        fair = [(sample, k) for sample, k in due if not sample.spoilt]
        for batch in _once_each(fair):
            pairs = [fair[i] for i in batch]
            k = np.array([j for _, j in pairs])
            truth = np.stack([sample.moved[j] for sample, j in pairs])
            self._stack.learn(k, np.stack([sample.experts[j] for sample, j in pairs]), truth)
            error = truth - np.stack([sample.expected[j] for sample, j in pairs])
            self._intervals.learn(k, error, np.stack([sample.claimed[j] for sample, j in pairs]))
        while self._samples and self._samples[0].known == len(HORIZONS):
            sample = self._samples.popleft()
            if not sample.spoilt:
                self._experts.learn(sample.inputs, sample.experts[:, 1:], sample.moved)
                self._judged += 1


def _size(vector: Array) -> float:
    """Of a tangent vector (6,), mm, turns at the lever."""
    return float(np.linalg.norm(vector * TANGENT_SCALE))


def _once_each(due: list[tuple[_Sample, int]]) -> list[list[int]]:
    """The places in `due` in batches, of which each has a horizon once at most, older samples first."""
    batches: list[list[int]] = []
    for i, (_, k) in enumerate(due):
        free = [b for b in batches if all(due[j][1] != k for j in b)]
        if free:
            free[0].append(i)
        else:
            batches.append([i])
    return batches
