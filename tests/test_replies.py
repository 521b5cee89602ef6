"""The arm's replies: golden bytes, round trips, and a reader that lives with the stray bytes of the thesis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.replies import REPLY_LENGTH, Reply, ReplyKind, decode_reply, encode_reply, reply_stream

counts = st.lists(st.integers(-32_767, 32_767), min_size=3, max_size=3)
kinds = st.sampled_from(list(ReplyKind))


def reply(kind: ReplyKind, numbers: list[int]) -> bytes:
    return bytes([0xCE, *b"".join(n.to_bytes(2, "big", signed=True) for n in numbers), kind, 0xCF])


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        (ReplyKind.PLACE, [202.5, 225, 113], "ce 07e9 08ca 046a 00 cf"),
        (ReplyKind.TOOL, np.deg2rad([90, -45, 0.01]), "ce 2328 ee6c 0001 01 cf"),
        (ReplyKind.ARM, np.deg2rad([0, 1, -1]), "ce 0000 0064 ff9c 02 cf"),
        (ReplyKind.ORIGIN, [-0.1, 0.04, 3276.7], "ce ffff 0000 7fff 03 cf"),
    ],
)
def test_golden_bytes(kind: ReplyKind, values: list[float], expected: str) -> None:
    assert encode_reply(Reply(kind, np.array(values))) == bytes.fromhex(expected)


@given(kinds, counts)
def test_every_reply_comes_back_byte_for_byte(kind: ReplyKind, numbers: list[int]) -> None:
    frame = reply(kind, numbers)
    back = decode_reply(frame)
    assert back.kind == kind
    assert encode_reply(back) == frame


@given(kinds, st.lists(st.floats(-5.7, 5.7), min_size=3, max_size=3))
def test_values_come_back_to_half_of_what_is_counted(kind: ReplyKind, values: list[float]) -> None:
    back = decode_reply(encode_reply(Reply(kind, np.array(values))))
    half = 0.05 if kind in (ReplyKind.PLACE, ReplyKind.ORIGIN) else np.deg2rad(0.005)
    assert np.abs(back.values - values).max() <= half * (1 + 1e-9)


@given(st.binary(max_size=12))
def test_bytes_taken_as_a_reply_are_one(noise: bytes) -> None:
    try:
        back = decode_reply(noise)
    except InputError as error:
        assert "allowed" in str(error)
    else:
        assert encode_reply(back) == noise


@pytest.mark.parametrize(("place", "value"), [(0, 0xCF), (7, 4), (7, 255), (8, 0xCE), (1, 0x80)])
def test_a_wrong_byte_in_a_fixed_place_is_refused(place: int, value: int) -> None:
    frame = bytearray(REPLY_LENGTH)
    frame[0], frame[8] = 0xCE, 0xCF
    decode_reply(bytes(frame))
    frame[place] = value
    with pytest.raises(InputError):
        decode_reply(bytes(frame))


@pytest.mark.parametrize("wrong", [3276.75, -3276.75, np.nan, np.inf])
def test_what_no_reply_can_hold_is_refused(wrong: float) -> None:
    encode_reply(Reply(ReplyKind.PLACE, np.array([3276.7, -3276.7, 0])))
    with pytest.raises(InputError, match="place"):
        encode_reply(Reply(ReplyKind.PLACE, np.array([0, wrong, 0])))


@given(st.lists(st.tuples(kinds, counts), max_size=6), st.integers(1, 20), st.data())
def test_single_stray_bytes_between_replies_cost_none(
    replies: list[tuple[ReplyKind, list[int]]], step: int, data: st.DataObject
) -> None:
    strays = [data.draw(st.binary(max_size=1)) for _ in replies]
    frames = [reply(*r) for r in replies]
    sent = b"".join(stray + frame for stray, frame in zip(strays, frames, strict=True))
    stream, back, lost = reply_stream(), [], b""
    for start in range(0, len(sent), step):
        taken, stray = stream(sent[start : start + step])
        back += [encode_reply(r) for r in taken]
        lost += stray
    assert back == frames
    assert lost == b"".join(strays)
