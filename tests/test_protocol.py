"""The wire: golden bytes, round trips, and no frame taken that encode could not have made."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.protocol import G1, G4, G54, LENGTH, THESIS, Dialect, Instruction, decode, encode

J5_FIRST = Dialect(motion_byte=0, slots=("J5", "J4", "J6"))
DIALECTS = st.sampled_from([THESIS, J5_FIRST, Dialect(slots=("J5", "J6", "J4"))])
single = st.floats(-1000, 1000, width=32)
positive = st.floats(0.0078125, 10_000, width=32)
ZERO16, ZERO32, ZERO40 = "00" * 16, "00" * 32, "00" * 40

GOLDEN: list[tuple[Instruction, Dialect, str]] = [
    (  # thesis: home X202.5 Y225 Z113 A0 B0 C0, here at 2500 mm/min and with angles 90 -45 180
        G1(np.array([202.5, 225, 113, np.pi / 2, -np.pi / 4, np.pi]), 2500 / 60),
        THESIS,
        "ee 31 01 00804a43 00006143 0000e242 0000b442 000034c2 00003443" + ZERO16 + "00401c45 ef",
    ),
    (
        G1(np.array([202.5, 225, 113, np.pi / 2, -np.pi / 4, np.pi]), 2500 / 60),
        J5_FIRST,
        "ee 31 00 00804a43 00006143 0000e242 000034c2 0000b442 00003443" + ZERO16 + "00401c45 ef",
    ),
    (G4(0.001), THESIS, "ee 36 00 0000803f" + ZERO40 + "ef"),
    (G54(np.array([1.0, -2, 0.5])), THESIS, "fc 14 01 0000803f 000000c0 0000003f" + ZERO32 + "fd"),
]


@pytest.mark.parametrize(("instruction", "dialect", "expected"), GOLDEN)
def test_golden_bytes(instruction: Instruction, dialect: Dialect, expected: str) -> None:
    frame = encode(instruction, dialect)
    assert frame.hex() == expected.replace(" ", "")
    assert len(frame) == LENGTH


def test_the_fields_stand_where_the_thesis_puts_them() -> None:
    frame = encode(G1(np.array([1.0, 2, 3, *np.deg2rad([4, 5, 6])]), 7.0))
    places = {3: 1, 7: 2, 11: 3, 15: 4, 19: 5, 23: 6, 43: 420}
    for start, value in places.items():
        assert struct.unpack("<f", frame[start : start + 4])[0] == pytest.approx(value, rel=1e-7)
    assert not any(frame[27:43])


@given(st.lists(single, min_size=6, max_size=6), positive, DIALECTS)
def test_a_move_comes_back_to_single_precision(numbers: list[float], feed_mm_min: float, dialect: Dialect) -> None:
    move = G1(np.array([*numbers[:3], *np.deg2rad(numbers[3:])]), feed_mm_min / 60)
    frame = encode(move, dialect)
    back = decode(frame, dialect)
    assert isinstance(back, G1)
    assert np.allclose(back.axes, move.axes, rtol=1e-12, atol=0)  # the numbers were binary32 in the frame's units
    assert back.feed == pytest.approx(move.feed, rel=1e-12)
    assert encode(back, dialect) == frame


@given(st.lists(st.floats(-1e30, 1e30), min_size=3, max_size=3), st.floats(1e-30, 1e30))
def test_pauses_and_origins_come_back_to_single_precision(origin: list[float], duration: float) -> None:
    back = decode(encode(G54(np.array(origin))))
    assert isinstance(back, G54)
    assert np.allclose(back.origin, origin, rtol=6e-8, atol=1e-37)
    pause = decode(encode(G4(duration)))
    assert isinstance(pause, G4)
    assert pause.duration == pytest.approx(duration, rel=6e-8)


@given(st.binary(min_size=0, max_size=60), DIALECTS)
def test_noise_is_no_frame(noise: bytes, dialect: Dialect) -> None:
    with pytest.raises(InputError):
        decode(noise, dialect)


@given(
    st.sampled_from([frame for frame in (encode(i, d) for i, d, _ in GOLDEN[:1] + GOLDEN[2:])]),
    st.lists(st.tuples(st.integers(0, LENGTH - 1), st.integers(0, 255)), min_size=1, max_size=6),
    DIALECTS,
)
def test_every_frame_taken_is_one_that_encode_makes(
    frame: bytes, changes: list[tuple[int, int]], dialect: Dialect
) -> None:
    changed = bytearray(frame)
    for place, value in changes:
        changed[place] = value
    try:
        instruction = decode(bytes(changed), dialect)
    except InputError as error:
        assert "allowed" in str(error)
    else:
        assert encode(instruction, dialect) == bytes(changed)


@pytest.mark.parametrize("place", [0, 1, 2, 27, 35, 42, 47])
def test_a_wrong_byte_in_a_fixed_place_is_refused(place: int) -> None:
    frame = bytearray(encode(GOLDEN[0][0]))
    frame[place] ^= 0x40
    with pytest.raises(InputError):
        decode(bytes(frame))


def test_dialects_do_not_understand_each_others_moves() -> None:
    with pytest.raises(InputError, match="header"):
        decode(encode(GOLDEN[0][0], J5_FIRST), THESIS)


@pytest.mark.parametrize(
    "wrong",
    [
        G1(np.array([np.nan, 0, 0, 0, 0, 0]), 5.0),
        G1(np.array([0, 0, 0, np.inf, 0, 0]), 5.0),
        G1(np.array([1e39, 0, 0, 0, 0, 0]), 5.0),
        G1(np.zeros(6), 0.0),
        G1(np.zeros(6), -1.0),
        G1(np.zeros(6), np.nan),
        G1(np.zeros(6), 1e-60),
        G4(0.0),
        G4(-0.001),
        G4(np.inf),
        G54(np.array([0, np.nan, 0])),
    ],
)
def test_what_no_frame_can_hold_is_refused(wrong: Instruction) -> None:
    with pytest.raises(InputError, match="allowed"):
        encode(wrong)


def test_dialects_are_checked() -> None:
    with pytest.raises(InputError, match="motion_byte"):
        Dialect(motion_byte=2)
    with pytest.raises(InputError, match="slots"):
        Dialect(slots=("J4", "J4", "J6"))
