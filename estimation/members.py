"""The learning experts: autoregressions on what the surface did over the last seconds, plain and through waves.

All inputs are increments as seen from the newest pose, so nothing depends on the base frame, and the axes share them:
what one axis does tells of the others. Breathing is not linear (a rest after each breath out, whose end earlier breaths
foretell better than any line): members with waves add random Fourier features of the last shifts, which make the
regression one with a Gaussian kernel at the price of a linear one (Rahimi and Recht 2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.forecast.experts import Regression
from estimation.se3 import Array

LEVER = 60.0  # mm, at which a turn counts like a shift: half of a surface patch
LINEAR = np.array([0.033, 0.067, 0.1, 0.2, 0.3, 0.4, 0.5])  # s: below a slow camera's period they add nothing
LAGS = np.concatenate([LINEAR, [0.8, 1.2, 2.0, 3.0]])  # s: the waves see most of a breath
TENTH, HALF = 2, 6  # places of 0.1 and 0.5 s among the lags
GRADED = [2, 3, 4, 6]  # lags whose coefficients may change with the liveliness
RATE = 10.0  # samples learned from in a second
RIDGE = 0.5  # variances of the noise: the features count about as they would without noise, and never run away
ROBUST = 2.0  # times the usual error, from which a sample counts by its distance only: a cough is not breathing
NOISE = 100.0  # samples over which the noise is measured
FOLLOW = 0.02  # of its logarithm a sample, by which the usual error follows the median
SLOW, QUICK = 600.0, 5.0  # samples, for what is usual and what is so just now
DRAW = 20  # seed of the waves


@dataclass(frozen=True, slots=True)
class Kind:
    """A member. memory: s. waves: how many. reach: s of their lags. width: of the kernel, in usual half-second moves.

    graded: whether its coefficients change with the liveliness of the motion.
    """

    memory: float
    waves: int = 0
    reach: float = 0.0
    width: float = 1.0
    graded: bool = False


KINDS = (  # the last breaths alone; whole breaths and parts of them, for minutes; one that changes with the liveliness
    Kind(10.0),
    Kind(300.0, 60, 3.0, 2.0),
    Kind(300.0, 60, 1.2, 0.7),
    Kind(300.0, 60, 3.0, 2.0, graded=True),
)


class Members:
    """The experts of KINDS, over shared inputs. What they predict is what constant velocity leaves over."""

    def __init__(self, horizons: int) -> None:
        """horizons: H, for which they are trained together."""
        draw = np.random.default_rng(DRAW)
        self.count, self._horizons = len(KINDS), horizons
        self._waves = [_waves(kind, draw) for kind in KINDS]
        self._models = [Regression(_size(kind), 6 * horizons, RATE * kind.memory) for kind in KINDS]
        self._turn, self._seen = 0, 0
        self._move = 0.0  # mm^2, mean square of half-second shifts
        self._bend = np.zeros(2)  # mm, mean change of shift from one tenth of a second to the next: now, usually
        self._usual, self._noise = np.zeros((self.count, horizons)), np.zeros(self.count)

    def __call__(self, inputs: list[Array]) -> Array:
        """What the members expect (H, M, 6) of their inputs."""
        each = zip(self._models, inputs, strict=True)
        return np.stack([model(x).reshape(self._horizons, 6) for model, x in each], axis=1)

    def inputs(self, past: Array, twist: Array) -> list[Array]:
        """Each member's inputs, from increments (L, 6) to where the surface was LAGS s ago, and its twist (6,)."""
        move = float(np.sqrt(self._move))
        shifts = past[1:, 3:] / (move or 1.0)
        linear = np.concatenate([[move], twist / RATE, past[: len(LINEAR)].ravel()])
        graded = self._liveliness() * past[GRADED].ravel()
        out = []
        for kind, (directions, phases) in zip(KINDS, self._waves, strict=True):
            angles = shifts.ravel()[: len(directions)] @ directions + phases
            waves = move * np.sqrt(2 / max(kind.waves, 1)) * np.cos(angles)
            out.append(np.concatenate([linear, waves, graded if kind.graded else graded[:0]]))
        return out

    def watch(self, past: Array) -> None:
        """Follow how far and how smoothly the surface moves, from a sample's increments (L, 6)."""
        self._seen += 1
        self._move += (float((past[HALF, 3:] ** 2).sum()) - self._move) / min(self._seen, SLOW)
        bend = float(np.linalg.norm((past[TENTH + 1] - 2 * past[TENTH])[3:]))
        self._bend += (bend - self._bend) / np.minimum(self._seen, [QUICK, SLOW])

    def _liveliness(self) -> float:
        """Logarithm of how rough the motion is just now beside what is usual."""
        now, usual = np.maximum(self._bend, 1e-12)
        return float(np.clip(np.log(now / usual), -1.0, 3.0))

    def learn(self, inputs: list[Array], experts: Array, moved: Array) -> None:
        """Take a sample's inputs, what constant velocity and the members expected (H, 1 + M, 6), and the truth (H, 6).

        One member's coefficients are brought up to date at a time, so that no step is long.
        """
        errors = np.sqrt(((moved[:, None] - experts[:, 1:]) ** 2).sum(2)).T  # (M, H)
        middle = errors[:, self._horizons // 2]
        if not self._noise.any():
            self._usual, self._noise = errors + 1e-9, middle**2
        weights = np.minimum(1.0, ROBUST / np.maximum(np.median(errors / self._usual, axis=1), 1e-9))
        self._usual *= np.exp(FOLLOW * np.sign(errors - self._usual))
        self._noise += (np.minimum(middle, 3 * self._usual[:, self._horizons // 2]) ** 2 - self._noise) / NOISE
        target = (moved - experts[:, 0]).ravel()
        for model, x, weight in zip(self._models, inputs, weights.tolist(), strict=True):
            model.learn(x, target, weight)
        self._turn = (self._turn + 1) % self.count
        self._models[self._turn].solve(max(RIDGE * float(self._noise[self._turn]), 1e-12))


def _waves(kind: Kind, draw: np.random.Generator) -> tuple[Array, Array]:
    """Directions (3 L, W) over the last L shifts, and phases (W,), of a member's waves."""
    lags = int((LAGS[1:] <= kind.reach).sum())
    directions = draw.normal(size=(3 * lags, kind.waves)) / (kind.width * np.sqrt(max(lags, 1)))
    return directions, draw.uniform(0, 2 * np.pi, kind.waves)


def _size(kind: Kind) -> int:
    """How many inputs a member has."""
    return 1 + 6 + 6 * len(LINEAR) + kind.waves + 6 * len(GRADED) * kind.graded
