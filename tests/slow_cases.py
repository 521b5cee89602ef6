"""Of many like cases the suite always tries some; `make slow` tries the others too."""

from __future__ import annotations

import pytest
from _pytest.mark import ParameterSet


def slowly(*cases: object) -> list[ParameterSet]:
    """Cases of a parametrized test that show more of what those beside them show."""
    return [pytest.param(case, marks=pytest.mark.slow) for case in cases]
