"""Forecast of the surface's motion over the next half second, learned online from its past motion.

Experts (hold, constant velocity and the learned `Experts`) predict it; the `ExpertStack` weighs them by their delayed
errors, and the `IntervalCalibration` gives the covariance. All are trained for each horizon separately, with samples
SAMPLE_INTERVAL_S apart that are interpolated from the poses, so the camera's rate and jitter do not matter.

A forecast's error is known 0.1 s later at the earliest, when a patient who coughs has moved by millimetres. So a pose
with an innovation larger than usual, and larger than the forecast's covariance allows, shows a sudden motion
(`InnovationGate`). It is kept apart with a velocity of its own, which widens the covariance, and nothing is learned
from it; the regular motion is predicted as before, until the innovations are small again.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from estimation import se3
from estimation.forecast.experts import LAGS, ROTATION_LEVER_MM, Experts, ExpertStack, IntervalCalibration
from estimation.pose import Forecast, SurfacePose, body_twist
from estimation.runtime import compiled, contiguous
from estimation.se3 import Array

HORIZONS = np.array([0.1, 0.2, 0.3, 0.4, 0.5])  # s
SAMPLE_INTERVAL_S = 0.1  # between training samples; poses between them are only predicted from
MAX_POSE_GAP_S = 0.5  # between poses: a longer one restarts the history
WARMUP_DURATION_S = 8.0  # of learned samples, two breaths: before, the errors do not represent later ones
SPEED_MEMORY_S = 10.0  # in which the largest speed decays to a third
MIN_LEARNED_SAMPLES = 50  # before the first forecast
TANGENT_SCALE = np.array([ROTATION_LEVER_MM] * 3 + [1.0] * 3)  # rad to mm at the lever
MAX_PROBES = 10  # points at which the intervals are calibrated
STAMP_TOLERANCE_S = 1e-3  # rounding of stamps

MIN_TURN_COSINE = -0.9  # of an angle: beyond, its axis is lost in rounding
MIN_POSE_GAP_S = 0.01  # closer poses replace the last one, so that memory is bounded at any frame rate

# a sudden motion has an innovation above both of:
NOISE_RATIO = 5.0  # times the typical innovation
COVARIANCE_SIGMAS = 3.0  # of the first horizon, for the innovation extrapolated to it
INNOVATION_MEMORY_S = 4.0  # over which the typical innovation is averaged
VELOCITY_COVARIANCE_DECAY_S = 0.012  # time constant of the sudden velocity's covariance
DRIFT_DECAY_S = 0.1  # time constant of the sudden velocity: such motions stop as suddenly as they begin
END_AFTER_S = 0.1  # without a large innovation, after which a sudden motion has ended
MAX_OUTLIER_DURATION_S = 2.0  # of a sudden motion; after it, its innovations are typical ones
PSD_GROWTH_S = 1.0  # in which the least density grows by e, towards the pose's own


class PoseHistory:
    """The poses of the last `span` s, at most one in MIN_POSE_GAP_S."""

    def __init__(self, span: float) -> None:
        self._span = span
        self.clear()

    def clear(self) -> None:
        """Remove all poses."""
        self._stamps, self._poses = np.zeros(0), np.zeros((0, 4, 4))

    def add(self, stamp: float, pose: Array) -> None:
        """Add a pose (4, 4) newer than all before."""
        end = len(self._stamps)
        if end > 1 and stamp - self._stamps[-2] < MIN_POSE_GAP_S:
            end -= 1
        stamps = np.append(self._stamps[:end], stamp)
        # keeps one pose before the span, and at least two
        first = max(min(int(np.searchsorted(stamps, stamp - self._span, "right")) - 1, len(stamps) - 2), 0)
        self._stamps, self._poses = stamps[first:], np.concatenate([self._poses[first:end], pose[None]])

    @property
    def duration(self) -> float:
        """Time from the oldest pose to the newest, s."""
        return float(self._stamps[-1] - self._stamps[0]) if len(self._stamps) else 0.0

    def transform(self, moved: Array) -> None:
        """Move all poses by `moved` (4, 4), base frame."""
        self._poses = moved @ self._poses

    @property
    def newest(self) -> Array:
        """The last pose (4, 4); only where there is one."""
        return np.asarray(self._poses[-1])

    def increments(self, poses: Array, stamps: Array) -> Array:
        """Tangent vectors (N, 6) from poses (N, 4, 4), or one (4, 4), to the surface's poses at stamps (N,), s.

        Increments are interpolated linearly between two poses of the history; outside, its first or last pose is used.
        """
        known = self._stamps
        after = np.clip(np.searchsorted(known, stamps), 1, len(known) - 1)
        before = after - 1
        share = np.clip((stamps - known[before]) / (known[after] - known[before]), 0.0, 1.0)[:, None]
        ends = self._poses[np.stack([before, after])]  # (2, N, 4, 4)
        vectors = _increments(np.broadcast_to(poses, (len(stamps), 4, 4)), ends)
        return np.asarray((1 - share) * vectors[0] + share * vectors[1])


def _increments(a: Array, b: Array) -> Array:
    """log(inverse(a) @ b) (2, N, 6) of poses a (N, 4, 4) and b (2, N, 4, 4), compiled for turns below half a turn."""
    vectors, within = _short_increments(contiguous(a), contiguous(b))
    return vectors if within else np.asarray(se3.log(se3.inverse(a) @ b))


@compiled("Tuple((f8[:,:,::1], b1))(f8[:,:,::1], f8[:,:,:,::1])")
def _short_increments(a: Array, b: Array) -> tuple[Array, bool]:
    """`_increments`, and whether all turns are below MIN_TURN_COSINE's angle, where this is exact."""
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
    """Detects sudden motion by the innovation of each pose; in mm, rotations at a lever."""

    def __init__(self) -> None:
        self._typical, self._learning_time = 0.0, 0.0  # mm^2, and s over which it was averaged
        self._remaining = 0.0  # s until the sudden motion ends, without a further large innovation
        self._duration, self._mean_square = 0.0, 0.0  # s since its begin; mean squared innovation since, mm^2
        self.velocity = np.zeros(6)  # mm/s, of the sudden motion
        self.velocity_covariance = np.zeros((6, 6))  # mm^2/s^2, covariance of that velocity

    @property
    def active(self) -> bool:
        """Whether there is a sudden motion."""
        return self._remaining > 0

    def forget(self) -> None:
        """End the sudden motion; the typical innovation is kept."""
        self._remaining = self._duration = self._mean_square = 0.0
        self.velocity = np.zeros(6)

    def extrapolate(self, seconds: Array) -> tuple[Array, Array]:
        """Further displacement (H, 6), mm, by the sudden motion in `seconds` (H,), and its covariances (H, 6, 6)."""
        travel = DRIFT_DECAY_S * (1 - np.exp(-seconds / DRIFT_DECAY_S))
        velocity_square = np.outer(self.velocity, self.velocity)
        covariances = seconds[:, None, None] ** 2 * self.velocity_covariance
        covariances = covariances + (seconds - travel)[:, None, None] ** 2 * velocity_square
        return travel[:, None] * self.velocity, covariances

    def __call__(self, innovation: Array, seconds: float, ahead: float, covariance: Array) -> bool:
        """Whether the pose belongs to a sudden motion.

        innovation: (6,) mm, of the pose from the forecast `seconds` s before. covariance: (6, 6) mm^2 of that forecast
        `ahead` s ahead, by earlier errors.
        """
        change = innovation - self.velocity * seconds
        square, typical = float(change @ change), NOISE_RATIO**2 * self._typical
        allowed = COVARIANCE_SIGMAS**2 * np.trace(covariance)
        self.velocity_covariance *= np.exp(-seconds / VELOCITY_COVARIANCE_DECAY_S)
        if 0 < typical < square and square * (ahead / seconds) ** 2 > allowed:
            self._remaining = END_AFTER_S
        elif self.active and self.velocity @ self.velocity * ahead**2 < allowed:
            self._remaining -= seconds
        if not self.active:
            self._learning_time = min(self._learning_time + seconds, INNOVATION_MEMORY_S)
            clipped = min(square, typical) if typical else square
            self._typical += seconds / self._learning_time * (clipped - self._typical)
        if self._duration > MAX_OUTLIER_DURATION_S:
            self._typical, self._remaining = self._mean_square, 0.0
        if not self.active:
            self.forget()
            return False
        self.velocity_covariance += np.outer(change, change) / seconds**2
        self.velocity, self._duration = innovation / seconds, self._duration + seconds
        self._mean_square += (square - self._mean_square) * seconds / self._duration
        return True


class WarmupForecast:
    """Constant velocity before a forecast is learned, with covariances that a single push does not widen for long.

    A pose's acceleration density is that of the last second, pushes included. Here the least density of late is used,
    which grows back to the pose's own in time.

    twist: (6,) rad/s and mm/s, of the prediction. narrower: whether the covariance is below the pose's own.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Restart."""
        self.twist, self.narrower = np.zeros(6), False
        self._twist_covariance, self._psd = np.zeros((6, 6)), np.full(6, np.inf)

    def __call__(self, pose: SurfacePose, seconds: float, steady_twist: Array | None, ahead: Array) -> Array:
        """Covariances (H, 6, 6) `ahead` (H,) s after a pose, `seconds` s newer than the last.

        steady_twist: (6,) without the sudden motion; None where there is none. After a sudden motion it is used until
        the pose's own twist is more accurate.
        """
        covariance = pose.twist_covariance
        if self.narrower or steady_twist is not None:
            covariance = self._twist_covariance + seconds * np.diag(self._psd)
        if steady_twist is not None:
            self.twist, self._twist_covariance, self.narrower = steady_twist, covariance, True
        else:
            self._psd = np.minimum(pose.acceleration_psd, self._psd * np.exp(seconds / PSD_GROWTH_S))
            self.narrower = self.narrower and bool((self._psd < pose.acceleration_psd).any())
            if not self.narrower or np.trace(pose.twist_covariance[3:, 3:]) <= np.trace(covariance[3:, 3:]):
                self.twist, covariance = pose.twist, pose.twist_covariance
            self._twist_covariance = covariance
        times = ahead[:, None, None]
        return np.asarray(times**2 * self._twist_covariance + times**3 / 3 * np.diag(self._psd))


@dataclass(slots=True)
class _Sample:
    """A training sample: a past pose and its predictions."""

    stamp: float
    pose: Array
    inputs: list[Array]
    experts: Array  # (H, E, 6)
    expected: Array  # (H, 6)
    radii: Array  # (H, N)
    resolved: int = 0  # number of horizons with known truth
    disturbed: bool = False  # by a sudden motion
    increments: Array = field(default_factory=lambda: np.zeros((len(HORIZONS), 6)))


class Predictor:
    """Forecasts one surface's motion, learning from its poses."""

    def __init__(self, points: Array | None = None) -> None:
        """points: (N, 3) mm, surface frame, for which the intervals are calibrated."""
        if points is None:
            points = ROTATION_LEVER_MM * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        probes = points[:: -(-len(points) // MAX_PROBES)]
        self._experts = Experts(len(HORIZONS))
        count = self._experts.count
        self._history = PoseHistory(LAGS[-1] + SAMPLE_INTERVAL_S)
        self._stack = ExpertStack(len(HORIZONS), np.concatenate([np.zeros(2), np.full(count, 1 / count)]))
        self._intervals = IntervalCalibration(len(HORIZONS), probes / ROTATION_LEVER_MM)
        self._samples: deque[_Sample] = deque()
        self._learned_samples = 0
        self._last_stamp = -np.inf
        self._gate, self._warmup = InnovationGate(), WarmupForecast()
        self._fastest = 0.0  # mm/s at the lever, in the last breaths
        self._last: tuple[Forecast, Array] | None = None  # the newest forecast; covariance of its first horizon, mm^2

    def add(self, pose: SurfacePose, shared_covariance: Array | None = None) -> Forecast | None:
        """Learn from a measured pose, newer than those before; its forecast, None while too little is learned.

        shared_covariance: (6, 6), part of the pose's covariance by errors that all poses share, which no innovation
        shows.
        """
        if not (np.isfinite(pose.base_from_surface).all() and np.isfinite(pose.twist).all()):
            return None
        if not 0 < pose.stamp - self._last_stamp <= MAX_POSE_GAP_S:
            self._history.clear()
            self._samples.clear()
            self._gate.forget()
            self._warmup.forget()
            self._last = None
        shared_covariance = np.zeros((6, 6)) if shared_covariance is None else shared_covariance
        seconds, twist = pose.stamp - self._last_stamp, self._steady_twist(pose)
        self._last_stamp = pose.stamp
        return self._learned_forecast(pose, twist, shared_covariance) or self._warmup_forecast(pose, seconds, twist)

    def _learned_forecast(self, pose: SurfacePose, twist: Array, shared_covariance: Array) -> Forecast | None:
        """Learn from the pose; its learned forecast, None while too little is learned."""
        self._history.add(pose.stamp, pose.base_from_surface)
        if self._history.duration < SAMPLE_INTERVAL_S / 2:
            return None
        waiting = ((s, k) for s in self._samples for k in range(s.resolved, len(HORIZONS)))
        due = [(s, k) for s, k in waiting if s.stamp + HORIZONS[k] <= pose.stamp + STAMP_TOLERANCE_S]
        ends, now = [s.stamp + HORIZONS[k] for s, k in due], np.broadcast_to(pose.base_from_surface, (len(LAGS), 4, 4))
        starts = np.concatenate([np.array([s.pose for s, _ in due]).reshape(-1, 4, 4), now])
        moved = self._history.increments(starts, np.concatenate([ends, pose.stamp - LAGS])) * TANGENT_SCALE
        self._learn(due, moved[: len(due)])
        if self._history.duration < LAGS[-1] - STAMP_TOLERANCE_S:
            return None
        return self._forecast(pose, twist, moved[len(due) :], shared_covariance)

    def _warmup_forecast(self, pose: SurfacePose, seconds: float, twist: Array) -> Forecast | None:
        """The forecast by constant velocity; returned only where its covariance is narrower than the pose's own."""
        covariances = self._warmup(pose, seconds, twist if self._gate.active else None, HORIZONS)
        forecast = Forecast(HORIZONS, HORIZONS[:, None] * self._warmup.twist, covariances)
        self._last = forecast, covariances[0] * np.outer(TANGENT_SCALE, TANGENT_SCALE)
        if not self._warmup.narrower:
            return None
        return self._with_drift(replace(forecast, covariances=covariances + pose.covariance))

    def _steady_twist(self, pose: SurfacePose) -> Array:
        """The twist (6,) without sudden motion, which is also removed from the history and the samples."""
        if self._last is None:
            return pose.twist
        (forecast, covariance), seconds = self._last, pose.stamp - self._last_stamp
        steps, rates = forecast.at(np.array([seconds]))
        step, rate = self._bounded(steps[0], rates[0], seconds)
        predicted = self._history.newest @ se3.exp(step)
        innovation = se3.log(se3.inverse(predicted) @ pose.base_from_surface) * TANGENT_SCALE
        if not self._gate(innovation, seconds, float(HORIZONS[0]), covariance):
            self._fastest = max(_length_mm(pose.twist), self._fastest * np.exp(-seconds / SPEED_MEMORY_S))
            return pose.twist
        moved = pose.base_from_surface @ se3.inverse(predicted)
        self._history.transform(moved)
        for sample in self._samples:
            sample.pose, sample.disturbed = moved @ sample.pose, True
        return body_twist(step, rate)

    def _bounded(self, step: Array, rate: Array, seconds: float) -> tuple[Array, Array]:
        """A step (6,) of `seconds` s and its rate, limited to the largest recent speed: repeated forecasts diverge."""
        faster = max(_length_mm(step) / seconds, _length_mm(rate)) / max(self._fastest, 1e-9)
        return (step, rate) if faster <= 1 else (step / faster, rate / faster)

    def _forecast(self, pose: SurfacePose, twist: Array, past: Array, shared_covariance: Array) -> Forecast | None:
        twist = twist * TANGENT_SCALE
        inputs = self._experts.inputs(past, twist)
        ahead = (HORIZONS[:, None] * twist)[:, None]  # (H, 1, 6)
        experts = np.concatenate([np.zeros_like(ahead), ahead, self._experts(inputs) + ahead], axis=1)
        expected = self._stack(experts)
        spread, radii = self._intervals()
        due = not self._samples or pose.stamp - self._samples[-1].stamp > SAMPLE_INTERVAL_S - STAMP_TOLERANCE_S
        if due and not self._gate.active:
            self._experts.update_activity(past)
            self._samples.append(_Sample(pose.stamp, pose.base_from_surface, inputs, experts, expected, radii))
        if self._learned_samples < MIN_LEARNED_SAMPLES:
            return None
        # fading with the first breaths: white noise on acceleration, since errors of one phase of a breath do not
        # represent other phases
        immaturity = max(0.0, 1 - self._learned_samples * SAMPLE_INTERVAL_S / WARMUP_DURATION_S)
        span = HORIZONS[:, None, None]
        unseen = immaturity**2 * (span**2 * pose.twist_covariance + span**3 / 3 * np.diag(pose.acceleration_psd))
        covariances = spread / np.outer(TANGENT_SCALE, TANGENT_SCALE) + shared_covariance + unseen
        known = Forecast(HORIZONS, expected / TANGENT_SCALE, covariances)
        self._last = known, spread[0] + shared_covariance * np.outer(TANGENT_SCALE, TANGENT_SCALE)
        return self._with_drift(known)

    def _with_drift(self, known: Forecast) -> Forecast:
        """The forecast with the sudden motion added."""
        drift, drift_covariance = self._gate.extrapolate(HORIZONS)
        covariances = known.covariances + drift_covariance / np.outer(TANGENT_SCALE, TANGENT_SCALE)
        return Forecast(HORIZONS, known.increments + drift / TANGENT_SCALE, covariances)

    def _learn(self, due: list[tuple[_Sample, int]], moved: Array) -> None:
        """Learn from samples and horizons that are due, with their true increments (K, 6)."""
        for (sample, j), vector in zip(due, moved, strict=True):
            sample.increments[j], sample.resolved = vector, j + 1
        fair = [(sample, k) for sample, k in due if not sample.disturbed]
        for batch in _batches_by_horizon(fair):
            pairs = [fair[i] for i in batch]
            k = np.array([j for _, j in pairs])
            truth = np.stack([sample.increments[j] for sample, j in pairs])
            self._stack.learn(k, np.stack([sample.experts[j] for sample, j in pairs]), truth)
            error = truth - np.stack([sample.expected[j] for sample, j in pairs])
            self._intervals.learn(k, error, np.stack([sample.radii[j] for sample, j in pairs]))
        while self._samples and self._samples[0].resolved == len(HORIZONS):
            sample = self._samples.popleft()
            if not sample.disturbed:
                self._experts.learn(sample.inputs, sample.experts[:, 1:], sample.increments)
                self._learned_samples += 1


def _length_mm(vector: Array) -> float:
    """Length of a tangent vector (6,), mm, rotations at the lever."""
    return float(np.linalg.norm(vector * TANGENT_SCALE))


def _batches_by_horizon(due: list[tuple[_Sample, int]]) -> list[list[int]]:
    """Indices into `due` in batches with each horizon at most once, older samples first."""
    batches: list[list[int]] = []
    for i, (_, k) in enumerate(due):
        free = [b for b in batches if all(due[j][1] != k for j in b)]
        if free:
            free[0].append(i)
        else:
            batches.append([i])
    return batches
