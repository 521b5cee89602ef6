"""The median of a plain array, at a tenth of the time that numpy's general one takes for a few hundred values."""

from __future__ import annotations

import numpy as np

from estimation.se3 import Array


def median(values: Array) -> float:
    """The upper median of values (N,), N > 0; nan if any of them is."""
    if np.isnan(values).any():
        return float("nan")
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
