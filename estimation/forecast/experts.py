"""The learning experts of the forecast, their stacking, and the calibration of its covariances.

Experts are autoregressions on what the surface did over the last seconds. All inputs are increments as seen from the
newest pose, so nothing depends on the base frame, and the axes share them: the motion of one helps to predict another.
Breathing is not linear (a rest after each breath out, whose end earlier breaths foretell better than any line): experts
with waves add random Fourier features of the last shifts, which make the regression one with a Gaussian kernel at the
price of a linear one (Rahimi and Recht 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dger, dsyr
from scipy.linalg.lapack import dposv

from estimation import se3
from estimation.pose import radius
from estimation.se3 import Array, Index

TURN_LEVER_MM = 60.0  # at which a turn counts like a shift: half of a surface patch
LINEAR_LAGS = np.array([0.033, 0.067, 0.1, 0.2, 0.3, 0.4, 0.5])  # s: below a slow camera's period they add nothing
LAGS = np.concatenate([LINEAR_LAGS, [0.8, 1.2, 2.0, 3.0]])  # s: the waves see most of a breath
LAG_TENTH, LAG_HALF = 2, 6  # places of 0.1 and 0.5 s among the lags
GRADED_LAGS = [2, 3, 4, 6]  # whose coefficients may change with the liveliness
SAMPLE_RATE_HZ = 10.0  # of the samples learned from
NOISE_RIDGE = 0.5  # variances of the noise: the features count about as without noise, and never run away
ROBUST_ERRORS = 2.0  # times the usual error, from which a sample counts by its distance only: a cough is not breathing
NOISE_MEMORY = 100.0  # samples over which the noise is measured
MEDIAN_STEP = 0.02  # of its logarithm a sample, by which the usual error follows the median
SLOW_MEMORY, QUICK_MEMORY = 600.0, 5.0  # samples: of what is usual, and of what is so just now
FEATURE_SEED = 20

STACK_MEMORY = 100.0  # samples over which errors count
PRIOR_SAMPLES = 3.0  # that the weights beforehand are worth
AXIS_WEIGHTS = np.array([0.3] * 3 + [1.0] * 3)  # turns count less than shifts: at the lever they are noisier

COVERAGE = 0.9  # of the errors that a radius is to hold
SHAPE_MEMORY = 300.0  # samples, for the shape
RECENT_MEMORY = 10.0  # samples, for how lively it is just now
SIZE_RATE = 0.08  # of the size's logarithm, per sample
MIN_USUAL_SAMPLES = 10  # before which nothing is usual
MAX_ERROR_RATIO = 100.0  # times the usual square of an error: one blunder is not more


class Regression:
    """Linear regression of K outputs on N shared inputs, learned sample by sample.

    The sums are forgotten, the ridge is not: without excitation the coefficients go to zero instead of the covariance
    winding up, and what is solved is positive definite by construction, after hours as after a second.
    """

    def __init__(self, inputs: int, outputs: int, memory: float) -> None:
        """memory: samples over which a sample's weight falls to 1/e."""
        self.coefficients = np.zeros((inputs, outputs))
        self._keep = float(np.exp(-1 / memory))
        self._square = np.zeros((inputs, inputs), order="F")  # upper triangle
        self._product = np.zeros((inputs, outputs), order="F")

    def __call__(self, inputs: Array) -> Array:
        """Outputs (K,) expected of inputs (N,)."""
        return np.asarray(inputs @ self.coefficients)

    def learn(self, inputs: Array, outputs: Array, weight: float) -> None:
        """Take a sample: inputs (N,), outputs (K,). Coefficients change at the next `solve` only."""
        self._square *= self._keep
        self._product *= self._keep
        dsyr(weight, inputs, a=self._square, overwrite_a=1)
        dger(weight, inputs, outputs, a=self._product, overwrite_a=1)

    def solve(self, ridge: float) -> None:
        """Bring the coefficients up to date. ridge: variance of the noise over that of a coefficient, beforehand."""
        square = self._square.copy(order="F")
        square[np.diag_indices(len(square))] += ridge
        _, solved, failed = dposv(square, self._product, lower=0, overwrite_a=1)
        if not failed and np.isfinite(solved).all():
            self.coefficients = solved


@dataclass(frozen=True, slots=True)
class ExpertSpec:
    """How an expert learns."""

    memory: float  # s
    waves: int = 0  # how many
    reach: float = 0.0  # s, of their lags
    width: float = 1.0  # of the kernel, in usual half-second moves
    graded: bool = False  # whether its coefficients change with the liveliness of the motion


# the last breaths alone; whole breaths and parts of them, for minutes; one that changes with the liveliness
EXPERT_SPECS = (
    ExpertSpec(10.0),
    ExpertSpec(300.0, 60, 3.0, 2.0),
    ExpertSpec(300.0, 60, 1.2, 0.7),
    ExpertSpec(300.0, 60, 3.0, 2.0, graded=True),
)


class Experts:
    """The experts of EXPERT_SPECS, over shared inputs; they predict what constant velocity leaves over."""

    def __init__(self, horizons: int) -> None:
        """horizons: H, for which they are trained together."""
        draw = np.random.default_rng(FEATURE_SEED)
        self.count, self._horizons = len(EXPERT_SPECS), horizons
        self._waves = [_waves(spec, draw) for spec in EXPERT_SPECS]
        self._models = []
        for spec in EXPERT_SPECS:
            count = 1 + 6 + 6 * len(LINEAR_LAGS) + spec.waves + 6 * len(GRADED_LAGS) * spec.graded  # of `inputs`
            self._models.append(Regression(count, 6 * horizons, SAMPLE_RATE_HZ * spec.memory))
        self._turn, self._count = 0, 0
        self._move = 0.0  # mm^2, mean square of half-second shifts
        self._bend = np.zeros(2)  # mm, mean change of shift from one tenth of a second to the next: now, usually
        self._usual, self._noise = np.zeros((self.count, horizons)), np.zeros(self.count)

    def __call__(self, inputs: list[Array]) -> Array:
        """What the experts expect (H, M, 6) of their inputs."""
        each = zip(self._models, inputs, strict=True)
        return np.stack([model(x).reshape(self._horizons, 6) for model, x in each], axis=1)

    def inputs(self, past: Array, twist: Array) -> list[Array]:
        """Each expert's inputs, from increments (L, 6) to where the surface was LAGS s ago, and its twist (6,)."""
        move = float(np.sqrt(self._move))
        shifts = past[1:, 3:] / (move or 1.0)
        linear = np.concatenate([[move], twist / SAMPLE_RATE_HZ, past[: len(LINEAR_LAGS)].ravel()])
        now, usual = np.maximum(self._bend, 1e-12)
        liveliness = float(np.clip(np.log(now / usual), -1.0, 3.0))  # how rough the motion is now, beside what is usual
        graded = liveliness * past[GRADED_LAGS].ravel()
        out = []
        for spec, (directions, phases) in zip(EXPERT_SPECS, self._waves, strict=True):
            angles = shifts.ravel()[: len(directions)] @ directions + phases
            waves = move * np.sqrt(2 / max(spec.waves, 1)) * np.cos(angles)
            out.append(np.concatenate([linear, waves, graded if spec.graded else graded[:0]]))
        return out

    def watch(self, past: Array) -> None:
        """Follow how far and how smoothly the surface moves, from a sample's increments (L, 6)."""
        self._count += 1
        self._move += (float((past[LAG_HALF, 3:] ** 2).sum()) - self._move) / min(self._count, SLOW_MEMORY)
        bend = float(np.linalg.norm((past[LAG_TENTH + 1] - 2 * past[LAG_TENTH])[3:]))
        self._bend += (bend - self._bend) / np.minimum(self._count, [QUICK_MEMORY, SLOW_MEMORY])

    def learn(self, inputs: list[Array], experts: Array, moved: Array) -> None:
        """Take a sample: inputs, expectations of constant velocity and experts (H, 1 + M, 6), and the truth (H, 6)."""
        errors = np.sqrt(((moved[:, None] - experts[:, 1:]) ** 2).sum(2)).T  # (M, H)
        middle = errors[:, self._horizons // 2]
        if not self._noise.any():
            self._usual, self._noise = errors + 1e-9, middle**2
        weights = np.minimum(1.0, ROBUST_ERRORS / np.maximum(np.median(errors / self._usual, axis=1), 1e-9))
        self._usual *= np.exp(MEDIAN_STEP * np.sign(errors - self._usual))
        self._noise += (np.minimum(middle, 3 * self._usual[:, self._horizons // 2]) ** 2 - self._noise) / NOISE_MEMORY
        target = (moved - experts[:, 0]).ravel()
        for model, x, weight in zip(self._models, inputs, weights.tolist(), strict=True):
            model.learn(x, target, weight)
        self._turn = (self._turn + 1) % self.count  # one expert is solved at a time, so that no step is long
        self._models[self._turn].solve(max(NOISE_RIDGE * float(self._noise[self._turn]), 1e-12))


def _waves(spec: ExpertSpec, draw: np.random.Generator) -> tuple[Array, Array]:
    """Directions (3 L, W) over the last L shifts, and phases (W,), of an expert's waves."""
    lags = int((LAGS[1:] <= spec.reach).sum())
    directions = draw.normal(size=(3 * lags, spec.waves)) / (spec.width * np.sqrt(max(lags, 1)))
    return directions, draw.uniform(0, 2 * np.pi, spec.waves)


class ExpertStack:
    """Weights (H, E) of E experts for H horizons, by recursive ridge regression: stacking (Breiman 1996)."""

    def __init__(self, horizons: int, prior: Array) -> None:
        """prior: (E,) the weights beforehand."""
        experts = len(prior)
        self.weights: Array = np.tile(prior, (horizons, 1))
        self._belief = PRIOR_SAMPLES * np.eye(experts), PRIOR_SAMPLES * prior
        self._square, self._product = np.zeros((horizons, experts, experts)), np.zeros((horizons, experts))
        self._size, self._count = np.zeros(horizons), np.zeros(horizons)
        self._keep = float(np.exp(-1 / STACK_MEMORY))

    def __call__(self, experts: Array) -> Array:
        """The combined prediction (H, 6) of experts' (H, E, 6)."""
        return np.asarray((self.weights[:, :, None] * experts).sum(1))

    def learn(self, k: Index, experts: Array, truth: Array) -> None:
        """Take what the experts (K, E, 6) said of horizons k (K,), each once, and the truth (K, 6)."""
        self._count[k] = np.minimum(self._count[k] + 1, 2 * STACK_MEMORY)
        self._size[k] += ((truth**2).sum(1) - self._size[k]) / self._count[k]
        weighted = experts * (AXIS_WEIGHTS / np.maximum(self._size[k], 1e-12)[:, None])[:, None]
        self._square[k] = self._keep * self._square[k] + weighted @ np.swapaxes(experts, 1, 2)
        self._product[k] = self._keep * self._product[k] + (weighted @ truth[:, :, None])[..., 0]
        square, product = self._square + self._belief[0], self._product + self._belief[1]
        self.weights = np.asarray(np.linalg.solve(square, product[..., None])[..., 0], np.float64)


class IntervalCalibration:
    """Covariances (H, 6, 6) of errors of H horizons: shape from recent errors, size from how often they were left.

    The size follows the share of errors outside (Gibbs and Candes 2021, adaptive conformal inference, on its
    logarithm): in the long run the share holds whatever the errors' distribution. The last second's errors against the
    usual ones widen or narrow it at once, so that not all quiet breaths pay for an irregular one or a cough.
    """

    def __init__(self, horizons: int, points: Array) -> None:
        """points: (N, 3), in the errors' own scale, at which errors are judged."""
        self._at = se3.point_jacobians(points)  # (N, 3, 6)
        self._mean = np.einsum("nij,nik->jk", self._at, self._at) / len(points)
        self._shape = np.tile(np.eye(6) * 1e-6, (horizons, 1, 1))
        self._count, self._size, self._recent = np.zeros(horizons), np.zeros(horizons), np.ones(horizons)

    def __call__(self) -> tuple[Array, Array]:
        """The covariances (H, 6, 6) now, and the radii (H, N) that they claim at the points."""
        recent = 0.5 + 0.25 * (self._recent + self._recent[0])
        spread = self._shape * (recent * np.exp(2 * self._size))[:, None, None]
        return spread, radius(self._at @ spread[:, None] @ np.swapaxes(self._at, 1, 2), COVERAGE)

    def learn(self, k: Index, error: Array, claimed: Array) -> None:
        """Take errors (K, 6) of horizons k (K,), each once, and the radii (K, N) that were claimed for them."""
        squares = ((self._at @ error[:, None, :, None])[..., 0] ** 2).sum(-1)  # (K, N)
        outside = (squares > claimed**2).mean(1)
        usual = (self._shape[k] * self._mean).sum((1, 2))
        self._count[k] = np.minimum(self._count[k] + 1, SHAPE_MEMORY)
        settled = self._count[k] > MIN_USUAL_SAMPLES
        ratio = np.where(settled, np.minimum(squares.mean(1) / np.maximum(usual, 1e-12), MAX_ERROR_RATIO), 1.0)
        self._recent[k] += (ratio - self._recent[k]) / RECENT_MEMORY
        self._shape[k] += (error[:, :, None] * error[:, None] - self._shape[k]) / self._count[k][:, None, None]
        self._size[k] += np.where(settled, SIZE_RATE * (outside - (1 - COVERAGE)), 0.0)
