"""The unit of a scan: files do not state it, so its size must be that of a piece of a body."""

from __future__ import annotations

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}  # mm of each
SMALLEST, LARGEST = 20.0, 1000.0  # mm: the longest side of a scan with skin around a wound, from a finger to a leg


def in_mm(vertices: Array, triangles: Array, unit: str, where: object) -> Array:
    """Vertices (V, 3) in mm; InputError where the scan is too small or too large, with the units that would fit."""
    used = vertices[np.unique(np.clip(triangles, 0, len(vertices) - 1))]
    used = used[np.isfinite(used).all(axis=1)]
    if not len(used):
        raise InputError(where, "vertices", "none that is finite", "a scan with finite coordinates")
    low, high = np.percentile(used, [1, 99], axis=0)  # a stray vertex says nothing of the size
    longest = float((high - low).max())
    size = longest * UNITS[unit]
    if SMALLEST <= size <= LARGEST:
        return np.asarray(vertices * UNITS[unit])
    fitting = [name for name, mm in UNITS.items() if SMALLEST <= longest * mm <= LARGEST]
    hint = " or ".join(f"--unit {name} ({longest * UNITS[name]:.0f} mm)" for name in fitting)
    allowed = f"{SMALLEST:g} to {LARGEST:g} mm" + (f"; its numbers look like another unit: say {hint}" if hint else "")
    raise InputError(where, "size of the scan", f"{size:.4g} mm along its longest side, read as {unit}", allowed)
