"""From a region of the plane to the ordered, extruded lines that fill it (thesis 5.2 and 5.3)."""

from __future__ import annotations

from typing import Literal, get_args

PatternKind = Literal["zigzag", "raster", "contour", "spiral", "hybrid", "best"]
PATTERN_KINDS: tuple[PatternKind, ...] = get_args(PatternKind)

__all__ = ["PATTERN_KINDS", "PatternKind", "bead", "fill", "rings", "spiral"]
