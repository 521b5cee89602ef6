"""The learning experts of the forecast, their stacking, and the calibration of its covariances.

Experts are autoregressions on the motion of the last seconds. All inputs are increments relative to the newest pose, so
nothing depends on the base frame, and all axes share them: the motion of one helps to predict another. Breathing is not
linear: there is a rest after each breath out, whose end only earlier breaths predict. Experts with random Fourier
features of the last shifts are regressions with a Gaussian kernel at the cost of linear ones (Rahimi and Recht 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dger, dsyr
from scipy.linalg.lapack import dposv

from estimation import se3
from estimation.pose import radius
from estimation.se3 import Array, Index

ROTATION_LEVER_MM = 60.0  # converts rotations to shifts: half of a surface patch
LINEAR_LAGS = np.array([0.033, 0.067, 0.1, 0.2, 0.3, 0.4, 0.5])  # s, not below a slow camera's period
LAGS = np.concatenate([LINEAR_LAGS, [0.8, 1.2, 2.0, 3.0]])  # s: of the Fourier features, over most of a breath
LAG_TENTH, LAG_HALF = 2, 6  # indices of 0.1 and 0.5 s in LAGS
ADAPTIVE_LAGS = [2, 3, 4, 6]  # indices of lags with coefficients that depend on the activity
SAMPLE_RATE_HZ = 10.0  # of the training samples
NOISE_RIDGE = 0.5  # ridge in variances of the noise
ROBUST_ERRORS = 2.0  # Huber's threshold in typical errors: a cough is not breathing
NOISE_MEMORY = 100.0  # samples over which the noise is averaged
MEDIAN_STEP = 0.02  # step of the typical error's logarithm towards the median, per sample
SLOW_MEMORY, QUICK_MEMORY = 600.0, 5.0  # samples over which typical and current motion are averaged
FEATURE_SEED = 20

STACK_MEMORY = 100.0  # samples over which errors count
PRIOR_SAMPLES = 3.0  # samples of the prior weights
AXIS_WEIGHTS = np.array([0.3] * 3 + [1.0] * 3)  # rotations have less weight: at the lever they are noisier

COVERAGE = 0.9  # share of errors within a radius
SHAPE_MEMORY = 300.0  # samples over which the shape is averaged
RECENT_MEMORY = 10.0  # samples over which recent errors are averaged
SIZE_RATE = 0.08  # learning rate of the size's logarithm
MIN_TYPICAL_SAMPLES = 10  # before errors are compared with typical ones
MAX_ERROR_RATIO = 100.0  # largest squared error by the typical one: bounds outliers


class Regression:
    """Linear regression of K outputs on N shared inputs, learned sample by sample.

    The sums decay, the ridge does not: without excitation the coefficients go to zero, there is no covariance windup,
    and the matrix stays positive definite.
    """

    def __init__(self, inputs: int, outputs: int, memory: float) -> None:
        """memory: samples over which a sample's weight falls to 1/e."""
        self.coefficients = np.zeros((inputs, outputs))
        self._keep = float(np.exp(-1 / memory))
        self._square = np.zeros((inputs, inputs), order="F")  # upper triangle
        self._product = np.zeros((inputs, outputs), order="F")

    def __call__(self, inputs: Array) -> Array:
        """Predicted outputs (K,) for inputs (N,)."""
        return np.asarray(inputs @ self.coefficients)

    def learn(self, inputs: Array, outputs: Array, weight: float) -> None:
        """Add a sample: inputs (N,), outputs (K,). Coefficients change at the next `solve`."""
        self._square *= self._keep
        self._product *= self._keep
        dsyr(weight, inputs, a=self._square, overwrite_a=1)
        dger(weight, inputs, outputs, a=self._product, overwrite_a=1)

    def solve(self, ridge: float) -> None:
        """Update the coefficients. ridge: variance of the noise by the prior variance of a coefficient."""
        square = self._square.copy(order="F")
        square[np.diag_indices(len(square))] += ridge
        _, solved, failed = dposv(square, self._product, lower=0, overwrite_a=1)
        if not failed and np.isfinite(solved).all():
            self.coefficients = solved


@dataclass(frozen=True, slots=True)
class ExpertSpec:
    """Settings of an expert."""

    memory: float  # s
    features: int = 0  # number of Fourier features
    max_lag: float = 0.0  # s, of the features
    kernel_width: float = 1.0  # in RMS shifts over half a second
    adaptive: bool = False  # whether coefficients depend on the activity of the motion


# over the last breaths; over minutes, with whole breaths and with parts of them; depending on the activity
EXPERT_SPECS = (
    ExpertSpec(10.0),
    ExpertSpec(300.0, 60, 3.0, 2.0),
    ExpertSpec(300.0, 60, 1.2, 0.7),
    ExpertSpec(300.0, 60, 3.0, 2.0, adaptive=True),
)


class Experts:
    """The experts of EXPERT_SPECS, with shared inputs; they predict the error of constant velocity."""

    def __init__(self, horizons: int) -> None:
        """horizons: H, their number."""
        draw = np.random.default_rng(FEATURE_SEED)
        self.count, self._horizons = len(EXPERT_SPECS), horizons
        self._features = [_draw_features(spec, draw) for spec in EXPERT_SPECS]
        self._models = []
        for spec in EXPERT_SPECS:
            count = 1 + 6 + 6 * len(LINEAR_LAGS) + spec.features + 6 * len(ADAPTIVE_LAGS) * spec.adaptive  # of `inputs`
            self._models.append(Regression(count, 6 * horizons, SAMPLE_RATE_HZ * spec.memory))
        self._next_model, self._count = 0, 0
        self._mean_square_shift = 0.0  # mm^2, mean square of half-second shifts
        self._curvature = np.zeros(
            2
        )  # mm, mean change of the shift per 0.1 s between tenths of a second: current, typical
        self._typical_errors, self._variances = np.zeros((self.count, horizons)), np.zeros(self.count)

    def __call__(self, inputs: list[Array]) -> Array:
        """Predictions (H, M, 6) of M experts for their inputs."""
        each = zip(self._models, inputs, strict=True)
        return np.stack([model(x).reshape(self._horizons, 6) for model, x in each], axis=1)

    def inputs(self, past: Array, twist: Array) -> list[Array]:
        """Each expert's inputs, from increments (L, 6) to the poses LAGS s ago, and the twist (6,)."""
        shift = float(np.sqrt(self._mean_square_shift))
        shifts = past[1:, 3:] / (shift or 1.0)
        linear = np.concatenate([[shift], twist / SAMPLE_RATE_HZ, past[: len(LINEAR_LAGS)].ravel()])
        current, typical = np.maximum(self._curvature, 1e-12)
        activity = float(np.clip(np.log(current / typical), -1.0, 3.0))  # of current by typical curvature
        adaptive = activity * past[ADAPTIVE_LAGS].ravel()
        out = []
        for spec, (directions, phases) in zip(EXPERT_SPECS, self._features, strict=True):
            angles = shifts.ravel()[: len(directions)] @ directions + phases
            features = shift * np.sqrt(2 / max(spec.features, 1)) * np.cos(angles)
            out.append(np.concatenate([linear, features, adaptive if spec.adaptive else adaptive[:0]]))
        return out

    def update_activity(self, past: Array) -> None:
        """Update the statistics of shift and curvature from a sample's increments (L, 6)."""
        self._count += 1
        square = float((past[LAG_HALF, 3:] ** 2).sum())
        self._mean_square_shift += (square - self._mean_square_shift) / min(self._count, SLOW_MEMORY)
        curvature = float(np.linalg.norm((past[LAG_TENTH + 1] - 2 * past[LAG_TENTH])[3:]))
        self._curvature += (curvature - self._curvature) / np.minimum(self._count, [QUICK_MEMORY, SLOW_MEMORY])

    def learn(self, inputs: list[Array], experts: Array, truth: Array) -> None:
        """Learn a sample: inputs, predictions of constant velocity and experts (H, 1 + M, 6), and the truth (H, 6)."""
        errors = np.sqrt(((truth[:, None] - experts[:, 1:]) ** 2).sum(2)).T  # (M, H)
        middle = errors[:, self._horizons // 2]
        if not self._variances.any():
            self._typical_errors, self._variances = errors + 1e-9, middle**2
        weights = np.minimum(1.0, ROBUST_ERRORS / np.maximum(np.median(errors / self._typical_errors, axis=1), 1e-9))
        self._typical_errors *= np.exp(MEDIAN_STEP * np.sign(errors - self._typical_errors))
        clipped = np.minimum(middle, 3 * self._typical_errors[:, self._horizons // 2])
        self._variances += (clipped**2 - self._variances) / NOISE_MEMORY
        target = (truth - experts[:, 0]).ravel()
        for model, x, weight in zip(self._models, inputs, weights.tolist(), strict=True):
            model.learn(x, target, weight)
        self._next_model = (self._next_model + 1) % self.count  # one expert a step, so that no step takes long
        self._models[self._next_model].solve(max(NOISE_RIDGE * float(self._variances[self._next_model]), 1e-12))


def _draw_features(spec: ExpertSpec, draw: np.random.Generator) -> tuple[Array, Array]:
    """Directions (3 L, W) over the last L shifts, and phases (W,), of an expert's W Fourier features."""
    lags = int((LAGS[1:] <= spec.max_lag).sum())
    directions = draw.normal(size=(3 * lags, spec.features)) / (spec.kernel_width * np.sqrt(max(lags, 1)))
    return directions, draw.uniform(0, 2 * np.pi, spec.features)


class ExpertStack:
    """Weights (H, E) of E experts for H horizons, by recursive ridge regression: stacking (Breiman 1996)."""

    def __init__(self, horizons: int, prior: Array) -> None:
        """prior: (E,) prior weights."""
        experts = len(prior)
        self.weights: Array = np.tile(prior, (horizons, 1))
        self._prior = PRIOR_SAMPLES * np.eye(experts), PRIOR_SAMPLES * prior
        self._square, self._product = np.zeros((horizons, experts, experts)), np.zeros((horizons, experts))
        self._mean_square, self._count = np.zeros(horizons), np.zeros(horizons)
        self._keep = float(np.exp(-1 / STACK_MEMORY))

    def __call__(self, experts: Array) -> Array:
        """The combined prediction (H, 6) of experts' (H, E, 6)."""
        return np.asarray((self.weights[:, :, None] * experts).sum(1))

    def learn(self, k: Index, experts: Array, truth: Array) -> None:
        """Learn predictions (K, E, 6) of horizons k (K,), each at most once, and the truth (K, 6)."""
        self._count[k] = np.minimum(self._count[k] + 1, 2 * STACK_MEMORY)
        self._mean_square[k] += ((truth**2).sum(1) - self._mean_square[k]) / self._count[k]
        weighted = experts * (AXIS_WEIGHTS / np.maximum(self._mean_square[k], 1e-12)[:, None])[:, None]
        self._square[k] = self._keep * self._square[k] + weighted @ np.swapaxes(experts, 1, 2)
        self._product[k] = self._keep * self._product[k] + (weighted @ truth[:, :, None])[..., 0]
        square, product = self._square + self._prior[0], self._product + self._prior[1]
        self.weights = np.asarray(np.linalg.solve(square, product[..., None])[..., 0], np.float64)


class IntervalCalibration:
    """Covariances (H, 6, 6) of errors of H horizons: shape by recent errors, size by the share of errors outside.

    The logarithm of the size follows that share (adaptive conformal inference, Gibbs and Candes 2021), so that in the
    long run it is reached whatever the errors' distribution. The ratio of the last second's errors to typical ones
    changes the size at once, so that an irregular breath or a cough does not widen all quiet breaths.
    """

    def __init__(self, horizons: int, points: Array) -> None:
        """points: (N, 3), in the errors' scale, at which errors are measured."""
        self._jacobians = se3.point_jacobians(points)  # (N, 3, 6)
        self._mean_gram = np.einsum("nij,nik->jk", self._jacobians, self._jacobians) / len(points)
        self._shape = np.tile(np.eye(6) * 1e-6, (horizons, 1, 1))
        self._count, self._log_scale, self._recent_ratio = np.zeros(horizons), np.zeros(horizons), np.ones(horizons)

    def __call__(self) -> tuple[Array, Array]:
        """The current covariances (H, 6, 6), and their radii (H, N) at the points."""
        widening = 0.5 + 0.25 * (self._recent_ratio + self._recent_ratio[0])
        covariances = self._shape * (widening * np.exp(2 * self._log_scale))[:, None, None]
        by_point = self._jacobians @ covariances[:, None] @ np.swapaxes(self._jacobians, 1, 2)
        return covariances, radius(by_point, COVERAGE)

    def learn(self, k: Index, error: Array, radii: Array) -> None:
        """Learn errors (K, 6) of horizons k (K,), each at most once, and the radii (K, N) that were predicted."""
        squares = ((self._jacobians @ error[:, None, :, None])[..., 0] ** 2).sum(-1)  # (K, N)
        outside = (squares > radii**2).mean(1)
        typical = (self._shape[k] * self._mean_gram).sum((1, 2))
        self._count[k] = np.minimum(self._count[k] + 1, SHAPE_MEMORY)
        established = self._count[k] > MIN_TYPICAL_SAMPLES
        ratio = np.where(established, np.minimum(squares.mean(1) / np.maximum(typical, 1e-12), MAX_ERROR_RATIO), 1.0)
        self._recent_ratio[k] += (ratio - self._recent_ratio[k]) / RECENT_MEMORY
        self._shape[k] += (error[:, :, None] * error[:, None] - self._shape[k]) / self._count[k][:, None, None]
        self._log_scale[k] += np.where(established, SIZE_RATE * (outside - (1 - COVERAGE)), 0.0)
