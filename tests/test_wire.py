"""The line: a byte takes ten bits, and none overtakes another."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.simulator.wire import Wire

sends = st.lists(st.tuples(st.integers(0, 100), st.floats(0, 1)), min_size=1, max_size=10)


def test_a_frame_takes_4_17_ms_at_115200() -> None:
    assert Wire(115_200).send(bytes(48), 2.0)[-1] - 2.0 == pytest.approx(48 * 10 / 115_200, abs=1e-12)
    assert Wire(9600).send(bytes(48), 0.0)[-1] == pytest.approx(0.05)


@given(sends)
def test_bytes_keep_their_order_and_distance(pieces: list[tuple[int, float]]) -> None:
    wire, now, arrivals = Wire(1000.0), 0.0, np.zeros(0)
    for size, wait in pieces:
        now += wait
        sent = wire.send(bytes(size), now)
        assert len(sent) == size
        assert (sent >= now + 0.01 - 1e-12).all()
        arrivals = np.append(arrivals, sent)
    assert (np.diff(arrivals) >= 0.01 - 1e-12).all()
    assert wire.free == (arrivals[-1] if len(arrivals) else -math.inf)


@given(sends)
def test_a_line_without_delay_delivers_at_once(pieces: list[tuple[int, float]]) -> None:
    wire, now = Wire(math.inf), 0.0
    for size, wait in pieces:
        now += wait
        assert (wire.send(bytes(size), now) == now).all()


def test_a_busy_line_makes_the_next_frame_wait() -> None:
    wire = Wire(1000.0)
    assert wire.send(b"ab", 1.0).tolist() == pytest.approx([1.01, 1.02])
    assert wire.send(b"c", 1.005).tolist() == pytest.approx([1.03])
    assert wire.send(b"d", 2.0).tolist() == pytest.approx([2.01])


@pytest.mark.parametrize("baud", [0.0, -1.0, math.nan])
def test_a_baud_rate_that_makes_no_sense_is_refused(baud: float) -> None:
    with pytest.raises(InputError, match="baud"):
        Wire(baud)
