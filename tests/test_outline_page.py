"""The wound's outline corrected on the page in a real browser: what is dragged there is what the run is asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hardware.operator.shared_state import CameraPicture, OperatorRequest, PagePictures, scene_from
from hardware.operator.view import STAGE_OFFERS, PlacementView, RequestAnswer, RunStage, Wish
from tests.browser import Browser, Page
from tests.operator_page import Served, full_view
from tests.printed_sheet import SIZE, rig
from tests.test_path_page import click, drag

NAMES = [camera.name for camera in rig().cameras]
FOUND = np.array([[200.0, 90.0], [290.0, 100.0], [280.0, 170.0], [210.0, 160.0]])  # px
OUTLINES = {name: FOUND + 5.0 * k for k, name in enumerate(NAMES)}
SLACK = 1.0  # px of the camera: half a pixel of the window, both ways
GREY = cv2.imencode(".jpg", np.full((SIZE[1], SIZE[0], 3), 140, np.uint8))[1].tobytes()


class Outlined:
    """A run at its question whether the path lies right, which would take an outline; `page` is its window."""

    def __init__(self, browser: Browser) -> None:
        self.served, self.turn = Served(), 0
        self.served.link.scene.put(scene_from(rig()))
        self.page = browser.page(self.served.address, (1400, 900))
        self.page.until('document.body.dataset.news === "wait"')
        self.show()
        self.page.until('document.body.dataset.news === "live"')

    def show(self, outlined: bool = True, stage: RunStage = RunStage.CONFIRM, **changed: object) -> None:
        """Put the next view."""
        self.turn += 1
        offers = tuple(w for w in STAGE_OFFERS[stage] if outlined or w is not Wish.OUTLINE)
        placement = PlacementView("scan", "placed by the scan", True, False, True, np.eye(4))
        given = {"offers": offers, "placement": placement, "motion": None, "checks": (), **changed}
        self.served.put(full_view(1.0 + self.turn, self.turn, stage, **given))
        self.page.until(f"document.body.dataset.turn === '{self.turn}'")

    def sheet(self, outlines: dict[str, np.ndarray], stamp: float = 1.0) -> None:
        """Put pictures with an outline in some of them."""
        pictures = [CameraPicture(name, GREY, (outlines[name],) if name in outlines else ()) for name in NAMES]
        self.served.link.sheet.put(PagePictures(stamp, tuple(pictures)))

    def open(self, outlines: dict[str, np.ndarray] = OUTLINES, near: bool = False) -> Page:
        """Begin to correct it."""
        self.sheet(outlines)
        self.page.until('!document.getElementById("outline").hidden')
        self.page.click("#outline button")
        if not near:
            self.page.js('document.querySelector("[data-near=no]").click()')
        self.page.until(f'document.querySelector("[data-camera={NAMES[0]}] canvas")?.dataset.drawn === "outline"')
        self.page.js("new Promise((done) => setTimeout(done, 250))")  # until it is laid out
        return self.page

    def place(
        self, pixel: np.ndarray, camera: str = NAMES[0], part: tuple[float, ...] = (0.0, 0.0, *SIZE)
    ) -> np.ndarray:
        """Where a pixel of a camera is in the window; part: of the picture that is shown, x y width height."""
        left, top, width, height = self.page.js(
            f"(() => {{ const r = document.querySelector('[data-camera={camera}] canvas').getBoundingClientRect();"
            " return [r.x, r.y, r.width, r.height]; })()"
        )
        size = np.array(part[2:])
        scale = min(np.array([width, height]) / size)
        corner = np.array([left, top]) + (np.array([width, height]) - scale * size) / 2
        return np.asarray(corner + scale * (np.asarray(pixel) - part[:2] + 0.5))

    def large(self, camera: str) -> None:
        """Make a picture the large one."""
        self.page.click(f"[data-camera={camera}] canvas")
        self.page.until(f"document.querySelector('[data-camera={camera}]').classList.contains('chosen')")
        self.page.js("new Promise((done) => setTimeout(done, 250))")

    def points(self, camera: str = NAMES[0]) -> np.ndarray:
        """The outline as it is drawn, (N, 2) px."""
        self.page.js("new Promise((done) => setTimeout(done, 80))")
        said = self.page.js(f"document.querySelector('[data-camera={camera}] canvas').dataset.points")
        return np.array(json.loads(said), float).reshape(-1, 2)

    def use(self) -> OperatorRequest:
        """Press the button, and take what is asked."""
        self.page.click("[data-outline=use]")
        self.page.js("new Promise((done) => setTimeout(done, 150))")
        (request,) = self.served.link.take()
        assert request.wish is Wish.OUTLINE and request.turn == self.turn
        return request

    def close(self) -> None:
        self.page.close()
        self.served.end()
        self.served.listener.close()


@pytest.fixture
def run(browser: Browser) -> Iterator[Outlined]:
    made = Outlined(browser)
    yield made
    made.close()


def said(request: OperatorRequest) -> dict[str, np.ndarray]:
    return {name: np.array(corners) for name, corners in request.outline}


def near(one: np.ndarray, other: np.ndarray) -> bool:
    return one.shape == other.shape and bool(np.abs(one - other).max() <= SLACK)


def test_a_point_that_is_dragged_is_asked_for_where_it_was_let_go_and_no_other_point_moves(run: Outlined) -> None:
    page, goal = run.open(), np.array([340.0, 75.0])
    assert page.js('document.getElementById("go").disabled') and page.js('document.getElementById("placing").hidden')
    drag(page, run.place(FOUND[1]), run.place(goal))
    run.large(NAMES[2])
    drag(page, run.place(OUTLINES[NAMES[2]][0], NAMES[2]), run.place(goal, NAMES[2]))
    wanted = {name: corners.copy() for name, corners in OUTLINES.items()}
    wanted[NAMES[0]][1] = wanted[NAMES[2]][0] = goal
    found = said(run.use())
    assert found.keys() == wanted.keys() and all(near(found[name], wanted[name]) for name in NAMES)
    assert np.array_equal(found[NAMES[1]], wanted[NAMES[1]])


@pytest.mark.slow
@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(index=st.integers(0, 3), x=st.floats(-0.4, 0.4), y=st.floats(-0.4, 0.4))
def test_a_point_follows_the_pointer_in_the_near_picture_too(run: Outlined, index: int, x: float, y: float) -> None:
    if not run.page.js('document.body.dataset.outlining === "yes"'):
        run.open(near=True)
    if not run.page.js('document.querySelector("[data-outline=found]").disabled'):
        run.page.click("[data-outline=found]")
    box = np.array([FOUND.min(0), FOUND.max(0)])
    width = max(2 * (box[1] - box[0])[0], 2 * (box[1] - box[0])[1] * SIZE[0] / SIZE[1])  # twice its box, in its shape
    size = np.array([width, width * SIZE[1] / SIZE[0]])
    part = (*(box.mean(0) - size / 2), *size)
    goal = box.mean(0) + np.array([x, y]) * size
    drag(run.page, run.place(FOUND[index], part=part), run.place(goal, part=part))
    wanted = FOUND.copy()
    wanted[index] = goal
    assert near(run.points(), wanted)


@pytest.mark.slow
def test_the_path_does_not_move_while_the_outline_is_corrected_and_does_so_afterwards(run: Outlined) -> None:
    page = run.open()
    assert page.js("document.body.dataset.movable") == "no"
    page.key("ArrowLeft", "ArrowLeft")
    drag(page, run.place(np.array([60.0, 40.0])), run.place(np.array([90.0, 60.0])))
    page.js("new Promise((done) => setTimeout(done, 400))")
    assert run.served.link.take() == [] and np.array_equal(run.points(), FOUND)
    page.click("[data-outline=leave]")
    page.until('document.body.dataset.movable === "yes" && !document.getElementById("go").disabled')
    page.key("ArrowLeft", "ArrowLeft")
    assert [request.wish for request in run.served.taken()] == [Wish.MOVE]


@pytest.mark.slow
def test_the_line_gives_a_new_point_delete_takes_one_and_undo_brings_each_back(run: Outlined) -> None:
    page, middle = run.open(), (FOUND[0] + FOUND[1]) / 2
    drag(page, run.place(middle), run.place(middle - [0, 30]))
    more = np.insert(FOUND, 1, middle - [0, 30], axis=0)
    assert near(run.points(), more)
    click(page, run.place(FOUND[2]))
    assert near(run.points(), more)
    page.key("Delete", "Delete")
    assert near(run.points(), np.delete(more, 3, axis=0))
    page.click("[data-outline=undo]")
    assert near(run.points(), more)
    page.click("[data-outline=undo]")
    assert np.array_equal(run.points(), FOUND)
    page.until('document.querySelector("[data-outline=undo]").disabled')
    click(page, run.place(FOUND[3]))
    page.click("[data-outline=remove]")
    assert np.array_equal(run.points(), FOUND[:3])
    page.click("[data-outline=found]")
    assert np.array_equal(run.points(), FOUND)


@pytest.mark.slow
def test_keys_choose_a_point_and_move_it_by_a_pixel_or_ten(run: Outlined) -> None:
    page, wanted = run.open(), FOUND.copy()
    page.key("Period", ".")
    page.key("Period", ".")
    page.key("ArrowRight", "ArrowRight")
    page.key("ArrowUp", "ArrowUp")
    wanted[1] += [1, -1]
    assert np.array_equal(run.points(), wanted)
    page.key("Comma", ",")
    page.key("Comma", ",")
    kind = {"code": "ArrowDown", "key": "ArrowDown", "modifiers": 8}
    page._tell("Input.dispatchKeyEvent", type="keyDown", **kind)
    wanted[3] += [0, 10]
    assert np.array_equal(run.points(), wanted)
    page.key("Escape", "Escape")
    page.until('document.getElementById("outlining").hidden')
    assert run.served.link.take() == []


def test_the_space_bar_stops_while_the_outline_is_corrected(run: Outlined) -> None:
    run.open().key("Space", " ")
    assert [request.wish for request in run.served.taken()] == [Wish.STOP]


def test_a_finger_drags_a_point_as_a_mouse_does(run: Outlined) -> None:
    page, goal = run.open(), np.array([150.0, 60.0])
    page.drag_finger(run.place(FOUND[0]), run.place(goal))
    assert near(run.points(), np.vstack([goal, FOUND[1:]]))


def test_where_no_wound_was_found_it_is_drawn_in_two_pictures_or_more(run: Outlined) -> None:
    page = run.open({})
    assert "no wound was found" in page.text("#outlining .verdict span").lower()
    for count, camera in enumerate(NAMES[:2]):
        if count:
            run.large(camera)
        for corner in FOUND[:3]:
            page.until('document.querySelector("[data-outline=use]").disabled')
            click(page, run.place(corner, camera))
        assert near(run.points(camera), FOUND[:3])
    page.until('!document.querySelector("[data-outline=use]").disabled')
    found = said(run.use())
    assert found.keys() == set(NAMES[:2]) and all(near(each, FOUND[:3]) for each in found.values())


def test_an_outline_whose_edges_cross_is_refused_in_words_and_stays_to_be_put_right(run: Outlined) -> None:
    page = run.open()
    drag(page, run.place(FOUND[0]), run.place(np.array([330.0, 150.0])))
    page.click("[data-outline=use]")
    page.until('document.getElementById("toast").textContent.includes("meet")')
    assert run.served.link.take() == [] and page.js("document.body.dataset.outlining") == "yes"
    assert not near(run.points(), FOUND)


def test_what_the_run_answers_is_told_and_the_editor_goes_when_the_run_takes_none_any_more(run: Outlined) -> None:
    page = run.open()
    number = run.use().number
    run.show(answer=RequestAnswer(number, Wish.OUTLINE, False, "another outline came at the same time"))
    page.until('document.getElementById("toast").textContent.includes("another outline")')
    assert page.js("document.body.dataset.outlining") == "yes"
    run.show(stage=RunStage.FIND, placement=None)
    page.until('document.body.dataset.outlining === "no" && document.getElementById("outline").hidden')
    page.until(f'document.querySelector("[data-camera={NAMES[0]}] canvas").dataset.drawn !== "outline"')
    run.sheet({name: FOUND + 9.0 for name in NAMES}, 2.0)
    run.show()
    page.until('!document.getElementById("outline").hidden')
    assert page.js("document.body.dataset.outlining") == "no"
    page.click("#outline button")
    page.until('document.body.dataset.outlining === "yes"')
    assert np.array_equal(run.points(), FOUND + 9.0)


def test_without_pictures_or_where_the_run_takes_no_outline_there_is_no_button(run: Outlined) -> None:
    assert run.page.js('document.getElementById("outline").hidden')
    run.show(outlined=False)
    run.sheet(OUTLINES)
    run.page.js("new Promise((done) => setTimeout(done, 500))")
    assert run.page.js('document.getElementById("outline").hidden')
