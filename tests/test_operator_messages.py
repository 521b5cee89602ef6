"""Messages of windows are parsed with suspicion; requests are bounded, in order, a stop always comes through."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import pickle
import signal
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.rig import Camera, Rig
from hardware.files.region_table import MAX_CORNERS
from hardware.operator import shared_state as limits
from hardware.operator.broadcast import (
    MAX_BROWSER_INTEGER,
    RateLimiter,
    RequestMessage,
    ShownMessage,
    parse_message,
    pictures_bytes,
    plain,
    text,
)
from hardware.operator.shared_state import (
    MAX_PATH_POINTS,
    MAX_TRIANGLES,
    OTHER_REQUEST_SLOTS,
    REQUEST_SLOTS,
    CameraPicture,
    OperatorLink,
    OperatorRequest,
    PagePictures,
    PageScene,
    RequestLine,
    scene_from,
)
from hardware.operator.view import CALMING_WISHES, MAX_MOVE_DEG, MAX_MOVE_MM, MoveRequest, Wish, refusal
from planning.path import Path
from tests.operator_page import full_view

COUNTS = st.integers(0, MAX_BROWSER_INTEGER)


BARE = [wish for wish in Wish if wish not in (Wish.MOVE, Wish.OUTLINE)]  # wishes that carry nothing


@given(st.sampled_from(BARE), COUNTS, COUNTS)
def test_what_the_page_says_is_understood(wish: Wish, turn: int, tag: int) -> None:
    assert parse_message(json.dumps({"ask": wish.value, "turn": turn, "tag": tag})) == RequestMessage(wish, turn, tag)
    assert parse_message(json.dumps({"shown": turn})) == ShownMessage(turn)


FAR = st.floats(-MAX_MOVE_MM, MAX_MOVE_MM) | st.integers(-100, 100)


@given(FAR, FAR, st.floats(-MAX_MOVE_DEG, MAX_MOVE_DEG), COUNTS, COUNTS)
def test_a_move_is_understood_and_comes_through_the_line_to_the_last_digit(
    x: float, y: float, turn_deg: float, turn: int, tag: int
) -> None:
    said = parse_message(json.dumps({"ask": "move", "turn": turn, "tag": tag, "move": [x, y, turn_deg]}))
    move = MoveRequest(float(x), float(y), turn_deg)
    assert said == RequestMessage(Wish.MOVE, turn, tag, move)
    line = RequestLine()
    line.ask(said.wish, said.turn, said.move)
    assert line.take() == [OperatorRequest(1, Wish.MOVE, turn, move)]


@pytest.mark.parametrize("wish", BARE)
def test_no_other_wish_carries_a_move_or_an_outline(wish: Wish) -> None:
    for more in ({"move": [1, 2, 3]}, {"move": None}, {"outline": {}}, {"outline": None}):
        assert parse_message(json.dumps({"ask": wish.value, "turn": 1, "tag": 1, **more})) is None


def test_a_move_carries_no_outline_and_an_outline_no_move() -> None:
    asked = {"turn": 1, "tag": 1, "move": [1, 2, 3], "outline": {}}
    assert parse_message(json.dumps({"ask": "move", **asked})) is None
    assert parse_message(json.dumps({"ask": "outline", **asked})) is None


@pytest.mark.parametrize("outline", [None, [], "camera0", 3, True, [["camera0", [1, 2]]]])
def test_an_outline_that_is_no_table_is_no_message(outline: object) -> None:
    assert parse_message(json.dumps({"ask": "outline", "turn": 1, "tag": 1, "outline": outline})) is None
    assert parse_message(json.dumps({"ask": "outline", "turn": 1, "tag": 1})) is None


CORNERS = st.lists(st.tuples(st.floats(0, 4000), st.floats(0, 4000)), min_size=3, max_size=MAX_CORNERS).map(tuple)


@given(st.dictionaries(st.text(min_size=1, max_size=8), CORNERS, min_size=1, max_size=6), COUNTS, COUNTS)
def test_an_outline_comes_through_with_its_request_to_the_last_digit(
    outline: dict[str, tuple[tuple[float, float], ...]], turn: int, tag: int
) -> None:
    said = parse_message(json.dumps({"ask": "outline", "turn": turn, "tag": tag, "outline": outline}))
    assert isinstance(said, RequestMessage) and said.outline is not None
    assert {name: tuple(map(tuple, corners)) for name, corners in said.outline.items()} == outline
    LINK.take()
    number = LINK.ask(Wish.OUTLINE, turn, None, tuple(outline.items()))
    assert LINK.take() == [OperatorRequest(number, Wish.OUTLINE, turn, None, tuple(outline.items()))]


LINK = OperatorLink()


def test_an_outline_goes_with_its_own_request_and_with_no_other() -> None:
    link, first, second = OperatorLink(), (("a", ((1.0, 2.0),)),), (("b", ((3.0, 4.0),)),)
    one = link.ask(Wish.OUTLINE, 1, None, first)
    move = link.ask(Wish.MOVE, 1, MoveRequest(1, 0, 0))
    two = link.ask(Wish.OUTLINE, 1, None, second)
    assert [(each.number, each.outline) for each in link.take()] == [(one, ()), (move, ()), (two, second)]
    for _ in range(REQUEST_SLOTS):
        link.ask(Wish.HOME, 1)
    assert link.ask(Wish.OUTLINE, 1, None, first) is None  # no room, and its outline is nobody's
    link.take()
    assert link.ask(Wish.MOVE, 1, MoveRequest(2, 0, 0)) and link.take()[0].outline == ()


@pytest.mark.parametrize(
    "move",
    [
        "null", "1", "[]", "[1,2]", "[1,2,3,4]", '["1",2,3]', "[true,2,3]", "[null,2,3]", "[[1],2,3]", "{}",
        "[NaN,0,0]",
        "[0,Infinity,0]", "[0,0,-Infinity]", "[100.001,0,0]", "[0,-100.001,0]", "[0,0,180.001]", "[1e999,0,0]",
        f"[{10**400},0,0]", "[0,0,1e300]",
    ],
)  # fmt: skip
def test_a_move_that_is_not_three_figures_within_bounds_is_no_message(move: str) -> None:
    assert parse_message(f'{{"ask":"move","turn":1,"tag":1,"move":{move}}}') is None
    assert parse_message('{"ask":"move","turn":1,"tag":1}') is None


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)
NEARLY = st.fixed_dictionaries(
    {},
    optional={
        name: ANYTHING | COUNTS | st.sampled_from(list(Wish))
        for name in ("ask", "turn", "tag", "shown", "move", "outline", "x")
    },
)


@given(st.text(max_size=512) | (ANYTHING | NEARLY).map(json.dumps))
def test_anything_else_is_no_message_and_no_error(said: str) -> None:
    message = parse_message(said)
    if isinstance(message, RequestMessage):
        move = {} if message.move is None else {"move": list(astuple(message.move))}
        told, outline = json.loads(said), message.outline
        assert json.dumps(told.pop("outline", None)) == json.dumps(outline)  # as texts: NaN is like itself
        assert told == {"ask": message.wish.value, "turn": message.turn, "tag": message.tag} | move
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
    assert parse_message(said) is None


@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=300))
def test_no_course_of_messages_goes_beyond_the_allowance(gaps: list[float]) -> None:
    allowance, now, passed = RateLimiter(5.0, 0.0), 0.0, 0
    for gap in gaps:
        now += gap
        passed += allowance.take(now)
    assert passed <= 15 + 5 * now + 1e-6


@given(st.floats(), st.text())
def test_any_view_becomes_json_that_says_the_same(error: float, reason: str) -> None:
    view = full_view(reason=reason)
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
    pictures = PagePictures(
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


QUEUED = [wish for wish in Wish if wish is not Wish.STOP]


@given(st.lists(st.one_of(st.sampled_from(QUEUED), st.none()), max_size=80))
def test_requests_come_in_order_and_those_that_found_no_room_were_refused(steps: list[Wish | None]) -> None:
    line, asked, taken, waiting = RequestLine(), [], [], 0
    for turn, step in enumerate(steps):
        if step is None:
            taken += line.take()
            waiting = 0
            continue
        number = line.ask(step, turn)
        assert (number is None) == (waiting >= (REQUEST_SLOTS if step in CALMING_WISHES else OTHER_REQUEST_SLOTS))
        if number is not None:
            asked.append(OperatorRequest(number, step, turn, MoveRequest(0, 0, 0) if step is Wish.MOVE else None))
            waiting += 1
    assert taken + line.take() == asked
    assert [r.number for r in asked] == list(range(1, len(asked) + 1))


@given(st.lists(st.sampled_from([wish for wish in QUEUED if wish not in CALMING_WISHES]), max_size=3 * REQUEST_SLOTS))
def test_a_flood_of_what_leads_elsewhere_leaves_room_for_what_leads_to_rest(flood: list[Wish]) -> None:
    line = RequestLine()
    for wish in flood:
        line.ask(wish, 1)
    assert line.ask(Wish.PAUSE, 1) is not None and line.ask(Wish.END, 1) is not None
    assert [r.wish for r in line.take()][-2:] == [Wish.PAUSE, Wish.END]


@given(st.integers(0, 3 * REQUEST_SLOTS), st.integers(1, 3), st.integers(0, 3 * REQUEST_SLOTS))
def test_a_stop_finds_room_in_any_line_and_voids_what_came_with_it(before: int, stops: int, after: int) -> None:
    line = RequestLine()
    for _ in range(before):
        line.ask(Wish.RESUME, 1)
    assert all(line.ask(Wish.STOP, 0) is not None for _ in range(stops))
    last = line.last_stop
    for _ in range(after):
        line.ask(Wish.START, 1)
    assert line.take() == [OperatorRequest(last, Wish.STOP, 0)] and line.take() == []
    line.ask(Wish.PAUSE, 2)
    assert [r.wish for r in line.take()] == [Wish.PAUSE]


def test_another_process_that_holds_the_line_sees_the_last_stop() -> None:
    line = RequestLine()
    child = multiprocessing.get_context("spawn").Process(target=_stop, args=(line,))
    child.start()
    child.join(20)
    assert line.last_stop == 1 and line.take() == [OperatorRequest(1, Wish.STOP, 0)]


@pytest.mark.slow
def test_a_page_that_is_killed_while_it_asks_leaves_a_line_that_still_works() -> None:
    line = RequestLine()
    context = multiprocessing.get_context("fork")
    for _ in range(10):
        child = context.Process(target=_ask_for_ever, args=(line,))
        child.start()
        before = line.last_stop
        while line.last_stop < before + 50:
            line.take()
        os.kill(child.pid, signal.SIGKILL)
        child.join(5)
        line.take()
        number = line.ask(Wish.HOME, 7)
        assert [(r.number, r.wish, r.turn) for r in line.take()] == [(number, Wish.HOME, 7)]


@pytest.mark.parametrize("wish", list(Wish))
def test_a_window_that_shows_what_is_no_longer_so_may_only_stop_pause_and_end(wish: Wish) -> None:
    assert (refusal(wish, 3, list(Wish), 4) == "") == (wish in (Wish.STOP, Wish.PAUSE, Wish.END))
    assert refusal(wish, 4, list(Wish), 4) == ""


@pytest.mark.parametrize("wish", list(Wish))
def test_what_is_not_offered_is_refused_but_for_a_stop(wish: Wish) -> None:
    assert (refusal(wish, 4, [], 4) == "") == (wish is Wish.STOP)


def _stop(line: RequestLine) -> None:
    line.ask(Wish.STOP, 0)


def _ask_for_ever(line: RequestLine) -> None:
    while True:
        line.ask(Wish.STOP, 0)
        line.ask(Wish.PAUSE, 0)


RIG = Rig((Camera("camera0", (640, 360), np.diag([500.0, 500.0, 1.0]), np.zeros(5), np.eye(4)),))


def printed_path(count: int) -> Path:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * 0.01
    extrude = np.arange(count) % 997 != 0
    plain = np.zeros(count)
    return Path(poses, plain + 5, plain.astype(int), plain + 20, plain.astype(int), extrude)


def dome(side: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(-40, 40, side), np.linspace(-30, 30, side))
    points = np.column_stack([x.ravel(), y.ravel(), 15 - (x**2 + y**2).ravel() / 150])
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    return points, np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])


@pytest.mark.parametrize("count", [2, 300, MAX_PATH_POINTS, 50_000])
def test_a_path_is_thinned_to_what_can_be_drawn_and_keeps_its_ends_and_its_gaps(count: int) -> None:
    path = printed_path(count)
    scene = scene_from(RIG, path)
    assert len(scene.path) <= 1.5 * MAX_PATH_POINTS
    assert scene.checkpoint[0] == 0 and scene.checkpoint[-1] == count - 1
    assert (np.diff(scene.checkpoint) > 0).all()
    assert np.array_equal(scene.path, path.surface_from_nozzle[scene.checkpoint, :3, 3])
    assert np.count_nonzero(~scene.extrude) == np.count_nonzero(~path.extrude)


def test_a_fine_surface_is_drawn_with_few_triangles_that_lie_on_it() -> None:
    points, triangles = dome(150)
    scene = scene_from(RIG, None, points, triangles)
    assert MAX_TRIANGLES / 4 < len(scene.triangles) <= MAX_TRIANGLES
    x, y, z = scene.surface.T
    assert np.abs(z - (15 - (x**2 + y**2) / 150)).max() < 0.3
    assert np.ptp(x) > 75 and np.ptp(y) > 55


def test_a_small_surface_stays_as_it_is() -> None:
    points, triangles = dome(10)
    scene = scene_from(RIG, None, points, triangles)
    assert np.array_equal(scene.surface, points) and np.array_equal(scene.triangles, triangles)


def test_points_without_triangles_are_thinned_too() -> None:
    assert len(scene_from(RIG, None, np.random.default_rng(1).normal(size=(90_000, 3))).surface) == MAX_TRIANGLES


def test_the_largest_scene_and_pictures_fit_their_places() -> None:
    link = OperatorLink()
    scene = scene_from(RIG, printed_path(50_000), *dome(150))
    assert len(pickle.dumps(scene)) < limits.SCENE_CAPACITY
    link.scene.put(scene)
    link.pictures.put(PagePictures(1.0, tuple(CameraPicture(f"camera{k}", bytes(200_000)) for k in range(3))))
    got = link.scene.get()
    assert isinstance(got, PageScene) and np.array_equal(got.path, scene.path)
