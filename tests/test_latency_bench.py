"""The latency bench turns times into figures in ms, each under its own target."""

from __future__ import annotations

import numpy as np
import pytest

from hardware.bench.latency import latency_figures
from perception.tracking.step import STAGES


def figures(wall_ms: float, flow_share: float = 0.25) -> dict[str, tuple[float, str]]:
    wall = np.full((40, 1 + len(STAGES)), wall_ms / 1000)
    wall[round(40 * flow_share) :, 1 + STAGES.index("flow")] = 0.0
    found = latency_figures("x", wall, np.full(40, 0.002))
    return {f.what: (f.value, f.verdict) for f in found}


@pytest.mark.parametrize(
    ("ms", "verdicts"), [(7.9, ("met", "met", "met")), (12.0, ("MISSED", "met", "met")), (40.0, ("MISSED",) * 3)]
)
def test_latencies_are_judged_by_median_percentile_and_largest(ms: float, verdicts: tuple[str, ...]) -> None:
    found = figures(ms)
    for word, verdict in zip(("median", "99 %", "largest"), verdicts, strict=True):
        value, judged = found[f"x: pose after, {word}"]
        assert value == pytest.approx(ms) and judged == verdict


def test_processor_time_and_the_share_of_flow_are_told() -> None:
    found = figures(5.0)
    assert found["x: processor, median"][0] == pytest.approx(2.0)
    assert found["x: frame sets that asked for flow"][0] == pytest.approx(25.0)
    assert found["x: estimation alone, 99 %"] == (pytest.approx(5.0), "MISSED")


def test_a_surface_that_is_never_followed_has_no_latency() -> None:
    (only,) = latency_figures("x", np.zeros((0, 1 + len(STAGES))), np.zeros(0))
    assert np.isnan(only.value) and only.note
