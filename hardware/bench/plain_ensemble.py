"""A plain ensemble for comparison: eight recursive-least-squares autoregressions, hold and constant velocity.

Every coordinate by itself: increments since each lag are regressed on the increment ahead, directly for each horizon
(four reaches of the lags, two forgetting factors). The ten are weighted by the exponential of their delayed squared
errors over the last seconds, relative to the best one's.
"""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array

REACHES = (0.5, 1.0, 2.0, 4.0)  # s
FORGETTING = (0.995, 0.9995)  # a sample
MOST_LAGS = 12
RIDGE = 1.0  # mm^2
MEMORY, SHARPNESS = 50.0, 2.0  # samples over which errors count; 2 times the best one's error weighs exp(-2)


def plain_forecasts(values: Array, step: float, ahead: tuple[int, ...]) -> Array:
    """Increments (H, T, C) expected of values (T, C), mm, `step` s apart, over each of H numbers of samples ahead."""
    experts = [autoregression(values, lags, keep, ahead) for lags in _lags(step) for keep in FORGETTING]
    velocity = np.concatenate([np.zeros_like(values[:1]), np.diff(values, axis=0)])
    steady = np.asarray(ahead)[:, None, None] * velocity
    return weighted(values, np.stack([*experts, np.zeros_like(steady), steady]), ahead)


def _lags(step: float) -> list[list[int]]:
    """Four sets of lags in samples: every one up to half a second, sparser from there."""
    sets = []
    for reach in REACHES:
        most = max(2, round(reach / step))
        sets.append(sorted({round(x) for x in np.geomspace(1, most, min(most, MOST_LAGS))}))
    return sets


def autoregression(values: Array, lags: list[int], keep: float, ahead: tuple[int, ...]) -> Array:
    """Increments (H, T, C) that one autoregression per coordinate expects, trained on what is known at each time."""
    count, width = values.shape
    first, delay = max(lags), max(ahead)
    inputs = np.zeros((count, width, len(lags)))
    for i, lag in enumerate(lags):
        inputs[lag:, :, i] = values[lag:] - values[:-lag]
    gain = np.tile(np.eye(len(lags)) / RIDGE, (width, 1, 1))
    slopes = np.zeros((width, len(lags), len(ahead)))
    out = np.zeros((len(ahead), count, width))
    for t in range(first, count):
        if t - delay >= first:
            then = t - delay
            x, truth = inputs[then], np.stack([values[then + h] - values[then] for h in ahead], -1)  # (C, L), (C, H)
            pull = (gain @ x[..., None])[..., 0]
            share = pull / (keep + (x * pull).sum(1))[:, None]
            slopes += share[..., None] * (truth - (x[:, None] @ slopes)[:, 0])[:, None]
            gain = (gain - share[..., None] * pull[:, None]) / keep
        out[:, t] = (inputs[t][:, None] @ slopes)[:, 0].T
    return out


def weighted(values: Array, experts: Array, ahead: tuple[int, ...]) -> Array:
    """Experts' increments (E, H, T, C) combined (H, T, C) by exponential weights of their errors so far."""
    out = np.zeros(experts.shape[1:])
    for k, h in enumerate(ahead):
        square = np.zeros((len(experts), values.shape[1]))
        for t in range(values.shape[0]):
            if t >= h:
                square += ((experts[:, k, t - h] - (values[t] - values[t - h])) ** 2 - square) / MEMORY
            best = square.min(0)
            weights = np.exp(-SHARPNESS * (square - best) / np.maximum(best, 1e-9))
            out[k, t] = (weights / weights.sum(0) * experts[:, k, t]).sum(0)
    return out
