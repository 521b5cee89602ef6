"""What lines to lay, and what the nozzle can lay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from estimation.errors import InputError

Kind = Literal["zigzag", "raster", "contour", "spiral", "hybrid", "best"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, slots=True)
class Pattern:
    """How a region is filled.

    kind: see docs/patterns.md. width: mm, of a nominal bead. overlap: share of the width by which neighbours overlap.
    inset: mm left free along the contour. angle: of the lines of zigzag, raster and hybrid, rad from the x axis;
    "shorter" takes the shorter of horizontal and vertical (thesis 5.3), "fastest" the fastest of `angles` many.
    rims: closed lines around the lines of hybrid. narrowest, widest: what the nozzle can lay, times the width.
    start: direction of the side to begin at; (-1, 1) is the top left where y points up. seam: 0 to 1, where on a
    closed line printing begins, counted along it from the point farthest in `start`; another one in each layer keeps
    seams from lying over one another.
    """

    kind: Kind = "best"
    width: float = 0.4
    overlap: float = 0.0
    inset: float = 0.0
    angle: float | Literal["shorter", "fastest"] = "fastest"
    angles: int = 12
    rims: int = 1
    narrowest: float = 0.5
    widest: float = 1.75
    start: tuple[float, float] = (-1.0, 1.0)
    seam: float = 0.0

    def __post_init__(self) -> None:
        _require(self.kind in KINDS, "kind", self.kind, " | ".join(KINDS))
        _require(0.01 <= self.width <= 20, "width", self.width, "0.01 to 20 mm")
        _require(0 <= self.overlap <= 0.9, "overlap", self.overlap, "0 to 0.9 of the width")
        _require(0 <= self.inset <= 100, "inset", self.inset, "0 to 100 mm")
        worded = self.angle in ("shorter", "fastest")
        _require(worded or math.isfinite(float(self.angle)), "angle", self.angle, "rad, shorter or fastest")
        _require(1 <= self.angles <= 360, "angles", self.angles, "1 to 360")
        _require(0 <= self.rims <= 100, "rims", self.rims, "0 to 100")
        _require(0.1 <= self.narrowest <= 1, "narrowest", self.narrowest, "0.1 to 1")
        _require(1 <= self.widest <= 4, "widest", self.widest, "1 to 4")
        _require(0 < math.hypot(*self.start) < math.inf, "start", self.start, "a direction")
        _require(0 <= self.seam <= 1, "seam", self.seam, "0 to 1")

    @property
    def spacing(self) -> float:
        """From line to line, mm."""
        return self.width * (1 - self.overlap)


def _require(fine: bool, what: str, got: object, allowed: str) -> None:
    if not fine:
        raise InputError("pattern", what, got, allowed)
