"""What windows say is parsed with suspicion, and what they are sent can always be parsed."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from operator_page import full_view

from hardware.operator.broadcast import pictures_bytes, plain, text
from hardware.operator.pictures import CameraPicture, Pictures
from hardware.operator.shared_state import Wish
from hardware.operator.words import LARGEST, Allowance, Ask, Shown, parsed

COUNTS = st.integers(0, LARGEST)


@given(st.sampled_from(list(Wish)), COUNTS, COUNTS)
def test_what_the_page_says_is_understood(wish: Wish, turn: int, tag: int) -> None:
    assert parsed(json.dumps({"ask": wish.value, "turn": turn, "tag": tag})) == Ask(wish, turn, tag)
    assert parsed(json.dumps({"shown": turn})) == Shown(turn)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)
NEARLY = st.fixed_dictionaries(
    {},
    optional={name: ANYTHING | COUNTS | st.sampled_from(list(Wish)) for name in ("ask", "turn", "tag", "shown", "x")},
)


@given(st.text(max_size=512) | (ANYTHING | NEARLY).map(json.dumps))
def test_anything_else_is_no_message_and_no_error(said: str) -> None:
    message = parsed(said)
    if isinstance(message, Ask):
        assert json.loads(said) == {"ask": message.wish.value, "turn": message.turn, "tag": message.tag}
    elif message is not None:
        assert json.loads(said) == {"shown": message.bundle}


@pytest.mark.parametrize(
    "said",
    [
        "", "null", "[]", "{}", "[" * 512, '{"ask":' * 60, '{"ask":"stop"}', '{"ask":"STOP","turn":1,"tag":1}',
        '{"ask":"stop","turn":-1,"tag":1}', '{"ask":"stop","turn":1.0,"tag":1}', '{"ask":"stop","turn":true,"tag":1}',
        '{"ask":"stop","turn":1,"tag":1,"x":1}', '{"ask":["stop"],"turn":1,"tag":1}', '{"shown":"1"}',
        '{"shown":9007199254740992}', "9" * 512, '{"shown":NaN}', '{"shown":1e3}',
    ],
)  # fmt: skip
def test_these_are_no_messages(said: str) -> None:
    assert parsed(said) is None


@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=300))
def test_no_course_of_messages_goes_beyond_the_allowance(gaps: list[float]) -> None:
    allowance, now, passed = Allowance(5.0, 0.0), 0.0, 0
    for gap in gaps:
        now += gap
        passed += allowance.take(now)
    assert passed <= 15 + 5 * now + 1e-6


@given(st.floats(), st.text())
def test_any_view_becomes_json_that_says_the_same(error: float, reason: str) -> None:
    view = full_view(reason=reason)
    assert view.motion is not None
    said = json.loads(text(view=view, error=error), parse_constant=lambda name: pytest.fail(name))
    assert said["view"]["reason"] == reason and said["view"]["stage"] == "print"
    assert said["view"]["tracking"]["state"] == "TRACKING" and said["view"]["offers"][0] == "confirm"
    if math.isfinite(error):
        assert said["error"] == pytest.approx(error, rel=1e-6, abs=1e-300)
    else:
        assert said["error"] is None


def test_arrays_and_their_holes_become_lists_and_nulls() -> None:
    assert plain(np.array([[1.0, np.nan], [np.inf, 2.0]])) == [[1.0, None], [None, 2.0]]
    assert plain(np.float32(0.25)) == 0.25 and plain(np.int64(3)) == 3


def test_pictures_stand_behind_a_head_that_tells_their_lengths() -> None:
    polygon = np.array([[1.25, 2.0], [3.0, 4.0]])
    pictures = Pictures(
        1.5,
        (CameraPicture("a", b"first", (polygon,)), CameraPicture("b", b"second!", near=b"it", crop=(1, 2, 3, 4))),
        np.eye(4),
    )
    data = pictures_bytes(pictures)
    size = int.from_bytes(data[:4], "little")
    head = json.loads(data[4 : 4 + size])
    assert [each["size"] for each in head["pictures"]] == [5, 7] and data[4 + size :] == b"firstsecond!it"
    assert [each["near"] for each in head["pictures"]] == [0, 2]
    assert [each["crop"] for each in head["pictures"]] == [None, [1, 2, 3, 4]]
    assert head["pictures"][0]["outline"] == [[1.2, 2.0, 3.0, 4.0]] and head["base_from_surface"] == np.eye(4).tolist()
