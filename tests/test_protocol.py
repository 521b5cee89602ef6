"""The wire and the arm's replies: golden bytes, round trips, no frame taken that encode could not make."""

from __future__ import annotations

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.driver import G1, G4, G54, Pause, Reply, ReplyKind
from hardware.arm.protocol import (
    FRAME_LENGTH,
    FRAME_TAILS,
    REPLY_LENGTH,
    THESIS_DIALECT,
    ControllerReset,
    Dialect,
    FrameStream,
    Instruction,
    Mode,
    Reset,
    decode,
    decode_reply,
    encode,
    encode_reply,
    reply_stream,
)

J5_FIRST = Dialect(motion_byte=0, slots=("J5", "J4", "J6"))
DRIVER = Dialect(motion_byte=0, origin_scale=10, pwm=1500.0)
DIALECTS = st.sampled_from([THESIS_DIALECT, J5_FIRST, DRIVER, Dialect(slots=("J5", "J6", "J4"))])
single = st.floats(-1000, 1000, width=32)
positive = st.floats(0.0078125, 10_000, width=32)
ZERO12, ZERO16, ZERO32, ZERO40 = "00" * 12, "00" * 16, "00" * 32, "00" * 40

GOLDEN: list[tuple[Instruction, Dialect, str]] = [
    (  # thesis: home X202.5 Y225 Z113 A0 B0 C0, here at 2500 mm/min and with angles 90 -45 180
        G1(np.array([202.5, 225, 113, np.pi / 2, -np.pi / 4, np.pi]), 2500 / 60),
        THESIS_DIALECT,
        "ee 31 01 00804a43 00006143 0000e242 0000b442 000034c2 00003443" + ZERO16 + "00401c45 ef",
    ),
    (
        G1(np.array([202.5, 225, 113, np.pi / 2, -np.pi / 4, np.pi]), 2500 / 60),
        J5_FIRST,
        "ee 31 00 00804a43 00006143 0000e242 000034c2 0000b442 00003443" + ZERO16 + "00401c45 ef",
    ),
    (G4(0.001), THESIS_DIALECT, "ee 36 00 0000803f" + ZERO40 + "ef"),
    (G54(np.array([1.0, -2, 0.5])), THESIS_DIALECT, "fc 14 01 0000803f 000000c0 0000003f" + ZERO32 + "fd"),
    (
        G1(np.array([202.5, 225, 113, 0, 0, 0]), 2500 / 60),
        DRIVER,
        "ee 31 00 00804a43 00006143 0000e242" + ZERO12 + "0080bb44" + ZERO12 + "00401c45 ef",
    ),
    (G54(np.array([1.0, -2, 0.5])), DRIVER, "fc 14 01 00002041 0000a0c1 0000a040" + ZERO32 + "fd"),
    (Pause(), THESIS_DIALECT, "fc 1e 03 02" + ZERO40 + "000000 fd"),
    (Reset(), THESIS_DIALECT, "fc 0c 03" + ZERO40 + "00000000 fd"),
    (ControllerReset(), THESIS_DIALECT, "fc 0c 06 00" + ZERO40 + "000000 fd"),
    (Mode(0), THESIS_DIALECT, "fc 1e 09 00" + ZERO40 + "000000 fd"),
    (Mode(9), DRIVER, "fc 1e 09 09" + ZERO40 + "000000 fd"),
]


@pytest.mark.parametrize(("instruction", "dialect", "expected"), GOLDEN)
def test_golden_bytes(instruction: Instruction, dialect: Dialect, expected: str) -> None:
    frame = encode(instruction, dialect)
    assert frame.hex() == expected.replace(" ", "") and len(frame) == FRAME_LENGTH


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


@pytest.mark.parametrize(
    "instruction", [i for i, _, _ in GOLDEN if isinstance(i, Pause | Reset | ControllerReset | Mode)]
)
@given(dialect=DIALECTS)
def test_a_control_frame_comes_back_in_any_dialect(instruction: Instruction, dialect: Dialect) -> None:
    assert decode(encode(instruction, dialect), dialect) == instruction


@given(st.lists(st.floats(-1e30, 1e30), min_size=3, max_size=3), st.floats(1e-30, 1e30), DIALECTS)
def test_pauses_and_origins_return_to_single_precision(origin: list[float], duration: float, dialect: Dialect) -> None:
    frame = encode(G54(np.array(origin)), dialect)
    back = decode(frame, dialect)
    assert encode(back, dialect) == frame
    assert isinstance(back, G54) and np.allclose(back.origin, origin, rtol=6e-8, atol=1e-37)
    pause = decode(encode(G4(duration)))
    assert isinstance(pause, G4) and pause.duration == pytest.approx(duration, rel=6e-8)


@given(st.binary(min_size=0, max_size=60), DIALECTS)
def test_noise_is_no_frame(noise: bytes, dialect: Dialect) -> None:
    with pytest.raises(InputError):
        decode(noise, dialect)


@given(
    st.sampled_from([encode(i, d) for i, d, _ in GOLDEN]),
    st.lists(st.tuples(st.integers(0, FRAME_LENGTH - 1), st.integers(0, 255)), min_size=1, max_size=6),
    DIALECTS,
)
def test_every_frame_taken_is_one_encode_makes(frame: bytes, changes: list[tuple[int, int]], dialect: Dialect) -> None:
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
        decode(encode(GOLDEN[0][0], J5_FIRST), THESIS_DIALECT)


@pytest.mark.parametrize(
    "wrong",
    [
        *(
            G1(np.array(axes), 5.0)
            for axes in ([np.nan, 0, 0, 0, 0, 0], [0, 0, 0, np.inf, 0, 0], [1e39, 0, 0, 0, 0, 0])
        ),
        *(G1(np.zeros(6), feed) for feed in (0.0, -1.0, np.nan, 1e-60)),
        *(G4(duration) for duration in (0.0, -0.001, np.inf)),
        *(G54(np.array([0, np.nan, 0])), Mode(1), Mode(-9)),
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
    with pytest.raises(InputError, match="origin_scale"):
        Dialect(origin_scale=100)
    with pytest.raises(InputError, match="pwm"):
        Dialect(pwm=1499.0)


FRAMES = [encode(instruction) for instruction, dialect, _ in GOLDEN if dialect is THESIS_DIALECT]


def whole(data: bytes, cuts: list[int]) -> tuple[list[bytes], bytes]:
    """What a stream makes of bytes cut at these places: frames, encoded again, and stray bytes."""
    stream = FrameStream(FRAME_LENGTH, FRAME_TAILS, decode)
    frames: list[bytes] = []
    stray = b""
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    for start, end in pairwise(edges):
        taken, lost = stream(data[start:end])
        frames += [encode(instruction) for instruction in taken]
        stray += lost
    assert len(stray) + FRAME_LENGTH * len(frames) + len(stream._rest) == len(data)
    return frames, stray


@given(st.lists(st.sampled_from(FRAMES), max_size=6), st.lists(st.integers(0, 10_000), max_size=20))
def test_frames_come_out_of_a_stream_however_it_is_cut(frames: list[bytes], cuts: list[int]) -> None:
    assert whole(b"".join(frames), cuts) == (frames, b"")


@given(
    st.lists(st.one_of(st.sampled_from(FRAMES), st.binary(max_size=60)), max_size=6),
    st.lists(st.integers(0, 10_000), max_size=20),
)
def test_what_a_stream_finds_does_not_depend_on_how_it_is_cut(pieces: list[bytes], cuts: list[int]) -> None:
    data = b"".join(pieces)
    assert whole(data, cuts) == whole(data, [])


@given(st.sampled_from(FRAMES), st.binary(max_size=200).filter(lambda b: not set(b) & set(FRAME_TAILS)))
def test_a_frame_behind_noise_without_a_header_is_found(frame: bytes, noise: bytes) -> None:
    assert whole(noise + frame, []) == ([frame], noise)


@pytest.mark.parametrize("lost", range(FRAME_LENGTH))
def test_a_frame_that_lost_a_byte_costs_no_other(lost: int) -> None:
    torn = FRAMES[0][:lost] + FRAMES[0][lost + 1 :]
    assert whole(torn + FRAMES[1] + FRAMES[2], []) == ([FRAMES[1], FRAMES[2]], torn)


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
def test_replies_golden_bytes(kind: ReplyKind, values: list[float], expected: str) -> None:
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
def test_replies_a_wrong_byte_in_a_fixed_place_is_refused(place: int, value: int) -> None:
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
def test_stray_bytes_cost_no_reply(replies: list[tuple[ReplyKind, list[int]]], step: int, data: st.DataObject) -> None:
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
