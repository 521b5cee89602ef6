"""What several runs over worlds of one kind come to together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.se3 import Array
from estimation.synthetic.follow import Followed

WITHIN = 1.96  # standard deviations of 95 % of a normal error


@dataclass(frozen=True, slots=True)
class Pooled:
    """RMSE and RMS bounds of the measured poses, mm and degrees over the three axes together, and their consistency.

    bound: of single frame sets. filtered: with those before them, for motion that is white noise on acceleration.
    nees, twist_nees: means over 6. inside: share of the six axes' errors inside their 95 % intervals. measured: share.
    """

    error_mm: float
    error_deg: float
    bound_mm: float
    bound_deg: float
    filtered_mm: float
    filtered_deg: float
    nees: float
    twist_nees: float
    inside: float
    measured: float

    def __str__(self) -> str:
        """All of it in one line."""
        error, turn = self.error_mm / self.bound_mm, self.error_deg / self.bound_deg
        return (
            f"{self.error_mm:7.4f} mm x{error:5.2f} {self.error_deg:7.4f} deg x{turn:5.2f}  NEES/6 {self.nees:6.2f}"
            f"  twist {self.twist_nees:6.2f}  inside {self.inside:.3f}  measured {self.measured:.3f}"
        )


def pooled(runs: Sequence[Followed]) -> Pooled:
    """The figures of `runs`, at least one of which was measured somewhere."""
    kept = [run.measured for run in runs]
    errors = np.concatenate([run.errors[m] for run, m in zip(runs, kept, strict=True)])
    covariances = np.concatenate([run.covariances[m] for run, m in zip(runs, kept, strict=True)])
    bounds = np.concatenate([run.bounds[m] for run, m in zip(runs, kept, strict=True)])
    filtered = np.concatenate([run.filtered_bounds()[m] for run, m in zip(runs, kept, strict=True)])
    twists = [(run.twist_errors[m], run.twist_covariances[m]) for run, m in zip(runs, kept, strict=True)]
    claimed = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return Pooled(
        error_mm=_rms(errors[:, 3:]),
        error_deg=float(np.degrees(_rms(errors[:, :3]))),
        bound_mm=_rms_of(bounds, 3),
        bound_deg=float(np.degrees(_rms_of(bounds, 0))),
        filtered_mm=_rms_of(filtered, 3),
        filtered_deg=float(np.degrees(_rms_of(filtered, 0))),
        nees=float(nees(errors, covariances).mean() / 6),
        twist_nees=float(np.concatenate([nees(*pair) for pair in twists]).mean() / 6),
        inside=float(np.mean(np.abs(errors) <= WITHIN * claimed)),
        measured=float(np.concatenate(kept).mean()),
    )


def nees(errors: Array, covariances: Array) -> Array:
    """Normalised estimation errors squared (N,) of errors (N, 6) under covariances (N, 6, 6)."""
    return np.asarray(np.einsum("ni,nij,nj->n", errors, np.linalg.pinv(covariances, hermitian=True), errors))


def _rms(vectors: Array) -> float:
    """Root mean square length of vectors (N, D)."""
    return float(np.sqrt((vectors**2).sum(1).mean()))


def _rms_of(covariances: Array, first: int) -> float:
    """Root mean square length that covariances (N, 6, 6) stand for along three axes from `first` on."""
    return float(np.sqrt(np.trace(covariances[:, first : first + 3, first : first + 3], axis1=1, axis2=2).mean()))
