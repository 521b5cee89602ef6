"""The bench of growth: slopes are those of the law, every point stands in the table and on the page."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from hardware.bench import growth
from hardware.bench.growth import Axis, axes_for, figures, page, slope


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_slope_is_the_power_of_the_law(power: float) -> None:
    values = (1.0, 3.0, 10.0, 40.0)
    assert slope(values, 7 * np.array(values) ** power) == pytest.approx(power, abs=1e-9)
    assert slope(values, np.array([7.0, np.nan, 7 * 10.0**power, np.nan])) == pytest.approx(power, abs=1e-9)
    assert np.isnan(slope(values, np.full(4, np.nan)))


def test_each_point_is_told_and_drawn() -> None:
    axis = Axis("tracks", "landmarks", "a pose", (10, 20, 40), lambda n: (n, 2 * n))
    costs = np.array([axis.cost(n) for n in axis.values])
    told = figures(axis, costs)
    assert [f.value for f in told[:3]] == [10, 20, 40] and told[3].value == pytest.approx(1.0)
    assert page([(axis, costs)]).count("<circle") >= 6


def test_a_short_run_measures_every_axis_but_the_rendered_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "MINUTES", (0.02, 0.03))
    short = tuple(Axis(a.name, a.unit, a.what, a.values[:2], a.cost) for a in axes_for(0.8))
    monkeypatch.setattr(growth, "axes_for", lambda seconds: short)
    found = growth.run(argparse.Namespace(seconds=0.8, no_pictures=True, out=tmp_path))
    assert len(found) == 4 * 3 and all(f.value > 0 for f in found if "median" in f.what)
    assert not any(f.what.startswith("pixels") for f in found)
    assert "Minutes" in (tmp_path / "growth.html").read_text()
