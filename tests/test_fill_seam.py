"""What every pattern keeps to, whatever the region."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from shapely.geometry import MultiPolygon, Polygon

from estimation.errors import InputError
from planning.fill.coverage import coverage
from planning.fill.fill import fill
from planning.fill.pace import Pace
from planning.fill.pattern import KINDS, Kind, Pattern
from planning.fill.region import region_of

ROUND = region_of(np.stack([9 * np.cos(np.arange(60) * 2 * np.pi / 60), 6 * np.sin(np.arange(60) * 2 * np.pi / 60)], 1))


@pytest.mark.parametrize("kind", KINDS)
def test_an_ellipse_is_covered_and_nothing_beside_it(kind: Kind) -> None:
    found = coverage(fill(ROUND, Pattern(kind), Pace()), ROUND)
    least = 0.94 if kind in ("zigzag", "raster", "hybrid") else 0.995
    assert found.covered > least and found.over < 0.001 and abs(found.double) < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_middle_lines_stay_inside_a_holed_region(kind: Kind) -> None:
    region = ROUND.difference(Polygon([(-2, -2), (3, -1), (1, 2)]))
    for bead in fill(region, Pattern(kind), Pace()):
        assert region.buffer(1e-6).contains(shapely.linestrings(bead.points))


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_filled_by_nothing(kind: Kind) -> None:
    assert fill(MultiPolygon(), Pattern(kind), Pace()) == []


def test_a_contour_that_crosses_itself_is_refused_with_the_place() -> None:
    with pytest.raises(InputError, match=r"Self-intersection\[1 1\]"):
        region_of(np.array([[0, 0], [2, 2], [2, 0], [0, 2]]))
