"""How evenly a machine works: what is slow is told from what is usual, by the time that it takes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.doctor import machine
from hardware.evenness import SLOW, Evenness, evenness, judged
from hardware.operator.view import Verdict
from hardware.process.clock import SimClock, WallClock


@given(st.integers(20, 200), st.integers(0, 9), st.floats(1e-4, 1e-2), st.floats(1.01, 20.0))
def test_slow_pieces_count_by_the_time_that_they_take(usual: int, slow: int, piece: float, factor: float) -> None:
    spent = np.array([piece] * usual + [factor * SLOW * piece] * slow)
    found = judged(spent)
    assert found.usual == pytest.approx(piece) and found.largest == spent.max()
    assert found.slow == pytest.approx(spent[usual:].sum() / spent.sum())


def test_work_is_done_and_a_machine_without_time_is_even() -> None:
    found = evenness(WallClock(), 20)
    assert 0 < found.usual <= found.largest and 0 <= found.slow < 1
    assert evenness(SimClock(), 5) == Evenness(0.0, 0.0, 0.0)


@pytest.mark.parametrize(("slow", "verdict"), [(0.0, Verdict.PASS), (0.02, Verdict.WARN)])
def test_the_doctor_says_so(slow: float, verdict: Verdict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "evenness", lambda clock, pieces: Evenness(0.001, 0.03, slow))
    check = machine.evenness_check(SimClock())
    assert check.verdict is verdict and "30 ms" in check.found and bool(check.remedy) == (verdict is Verdict.WARN)
