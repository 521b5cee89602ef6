"""The servo: exact where it claims to be, and never beyond its limit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.se3 import Array
from hardware.simulator.polyline import Polyline
from hardware.simulator.servo import STEP, Servo
from tests.virtual_arm import HOME

GRID = np.arange(3001) * 0.001
stretches = st.lists(
    st.tuples(st.floats(0.001, 0.4), st.lists(st.floats(-100, 100), min_size=6, max_size=6)), min_size=1, max_size=8
)


def line_of(parts: list[tuple[float, list[float]]]) -> Polyline:
    """A line from home at 0 s: for so many s at such a slope, one after the other, then rest."""
    line, now, axes = Polyline(0.0, HOME), 0.0, HOME
    for duration, slope in parts:
        line.append(now, axes, np.array(slope))
        now, axes = now + duration, axes + duration * np.array(slope)
    line.append(now, axes, np.zeros(6))
    return line


def executed(line: Polyline, dead_time: float = 0.0, tau: float = 0.0, most: Array | None = None) -> Array:
    return Servo(line, dead_time, tau, most).at(GRID, 3.0)


@settings(max_examples=25)
@given(stretches)
def test_without_dead_time_lag_and_limit_it_is_the_setpoint_itself(parts: list[tuple[float, list[float]]]) -> None:
    line = line_of(parts)
    assert (executed(line) == line.at(GRID)).all()


@settings(max_examples=25)
@given(stretches, st.integers(1, 300), st.sampled_from([None, np.array([3000.0, 60])]))
def test_dead_time_is_a_shift(parts: list[tuple[float, list[float]]], late: int, most: Array | None) -> None:
    line = line_of(parts)
    shifted = executed(line, late / 1000, 0.02, most)
    apart = np.abs(shifted[late:] - executed(line, 0.0, 0.02, most)[:-late]).max()
    assert apart < (1e-9 if most is None else 2 * 0.2 * STEP)  # the limit's step of a bend may be the next one
    assert (shifted[:late] == HOME).all()


@pytest.mark.parametrize("most", [None, np.array([3000.0, 60])])
@pytest.mark.parametrize("tau", [0.0, 0.02])
def test_nothing_moves_before_the_dead_time_is_over(tau: float, most: Array | None) -> None:
    moved = executed(line_of([(1.0, [50.0] * 6)]), 0.1, tau, most)
    assert (moved[:100] == HOME).all()
    assert (moved[102] > HOME).all()


@settings(max_examples=20)
@given(stretches, st.floats(0.002, 0.3))
def test_lag_is_the_solution_of_its_equation(parts: list[tuple[float, list[float]]], tau: float) -> None:
    line = line_of(parts)
    fine = np.arange(30_001) * 0.0001
    y, u = Servo(line, 0.0, tau, None).at(fine, 3.0), line.at(fine)
    rise = np.cumsum((((u - y)[1:] + (u - y)[:-1]) / 2) * 0.0001 / tau, axis=0)
    assert np.abs(y[1:] - (HOME + rise)).max() < 1e-3


def test_a_steady_setpoint_is_followed_a_lag_behind() -> None:
    line = line_of([(3.0, [50.0, 0, 0, 1, 0, 0])])
    behind = line.at(GRID) - executed(line, dead_time=0.01, tau=0.02)
    assert behind[1000] == pytest.approx([1.5, 0, 0, 0.03, 0, 0])


@settings(max_examples=25)
@given(stretches, st.floats(0, 0.05), st.floats(100, 5000))
def test_the_limit_is_never_passed(parts: list[tuple[float, list[float]]], tau: float, most: float) -> None:
    moved = executed(line_of(parts), tau=tau, most=np.array([most, most / 50]))
    bend = np.diff(moved, 2, axis=0) / STEP**2
    assert np.linalg.norm(bend[:, :3], axis=1).max() <= most * (1 + 1e-6) + 1e-4
    assert np.linalg.norm(bend[:, 3:], axis=1).max() <= most / 50 * (1 + 1e-6) + 1e-4


@pytest.mark.slow
@settings(max_examples=25)
@given(stretches, st.floats(0.005, 0.05))
def test_a_limit_that_is_not_reached_changes_next_to_nothing(
    parts: list[tuple[float, list[float]]], tau: float
) -> None:
    line, most = line_of(parts), np.array([2 * 200 / tau, 2 * 200 / tau])
    apart = executed(line, tau=tau, most=most) - executed(line, tau=tau)
    assert np.abs(apart).max() <= most[0] * STEP**2


def test_a_limited_arm_starts_slowly_catches_up_and_comes_to_rest_without_overshoot_of_a_far_target() -> None:
    line = Polyline(0.0, HOME)
    line.append(0.001, HOME, np.array([20_000.0, 0, 0, 0, 0, 0]))
    line.append(0.002, HOME + [20, 0, 0, 0, 0, 0], np.zeros(6))
    moved = executed(line, most=np.array([1000.0, 10]))[:, 0] - HOME[0]
    assert moved[101] == pytest.approx(1000 * 0.1**2 / 2, rel=0.05)
    quickest = 2 * np.sqrt(20 / 1000)
    assert np.argmax(moved > 20 - 1e-3) * 0.001 == pytest.approx(quickest, rel=0.05)
    assert moved.max() <= 20 + 1e-3
    assert moved[-1] == pytest.approx(20, abs=1e-9)


def test_a_line_that_stops_is_cut_at_that_instant() -> None:
    line = line_of([(1.0, [10.0] * 6), (1.0, [20.0] * 6)])
    line.stop(1.5)
    assert line.at(np.array([0.5, 1.5, 3.0])) == pytest.approx(HOME + np.array([[5.0], [20], [20]]))
    assert len(line) == 3
