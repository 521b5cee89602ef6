"""The path moved on the page in a real browser: drag, handle, keys, buttons and three points put it where they say."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.rig import Camera, Rig, distort, pixels_from_points
from estimation.se3 import Array
from hardware.files.images import encode
from hardware.operator.shared_state import CameraPicture, OperatorRequest, PagePictures, scene_from
from hardware.operator.view import STAGE_OFFERS, PlacementView, RequestAnswer, RunStage, Wish
from planning.placement import PathPlacement, PlacedBy, SurfaceMove, moved_along, tangent_of
from tests.browser import Browser, Page
from tests.moving_surfaces import raster
from tests.operator_page import Served, full_view
from tests.slow_cases import slowly

SIZE = (640, 360)
PLACE = se3.make(np.diag([1.0, -1.0, -1.0]) @ se3.exp_rotation([0.5, 0.2, 0.3]), [60.0, 160.0, 280.0])  # seen aslant
MATRIX = np.array([[900.0, 0, 331.0], [0, 905.0, 171.0], [0, 0, 1]])
CAMERA = Camera("camera0", SIZE, MATRIX, np.array([-0.21, 0.06, 0.0012, -0.0008, 0.01]), PLACE)
SIDE = np.linspace(-60, 60, 25)
X, Y = (part.ravel() for part in np.meshgrid(SIDE, SIDE))
GROUND = np.column_stack([X, Y, -(X**2) / 300 - Y**2 / 200])  # (625, 3) mm, surface frame
POSE = se3.make(se3.exp_rotation([0.1, -0.05, 0.4]), [5.0, -3.0, 20.0])  # base_from_surface
PATH = raster(20.0, lines=5)
GUESS = PathPlacement(np.eye(4), PlacedBy.REGION, "placed by the region, move it: a guess", False, True)
SLACK_MM = 0.35  # a pixel of the page on the surface, and what the surface bends beside its plane


class Moved:
    """A run at its question whether the path lies right; it follows moves as a live run does."""

    def __init__(self, browser: Browser) -> None:
        self.served, self.placement, self.moves, self.turn, self.stamp = Served(), GUESS, 0, 1, 1.0
        self.answer: RequestAnswer | None = None
        self._aim()
        self.show()
        self.page = browser.page(self.served.address, (1440, 900))
        jpeg = encode(np.full((SIZE[1], SIZE[0], 3), 128, np.uint8), 90)[1]
        self.page.until('document.body.dataset.news === "live"')
        self.served.link.pictures.put(PagePictures(1.0, (CameraPicture("camera0", jpeg),), POSE))
        self.page.until('document.querySelector("[data-camera=camera0] canvas").dataset.drawn === "path"')
        self.page.until('document.body.dataset.movable === "yes"')

    def _aim(self) -> None:
        """Turn the camera so that it looks at the middle of the path."""
        ahead = POSE[:3, 3] - PLACE[:3, 3]
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.3, 1.0])
        right /= np.linalg.norm(right)
        self.camera = replace(
            CAMERA, base_from_camera=se3.make(np.column_stack([right, np.cross(ahead, right), ahead]), PLACE[:3, 3])
        )

    def show(self) -> None:
        lies = self.placement.surface_from_path
        path = replace(PATH, surface_from_nozzle=lies @ PATH.surface_from_nozzle)
        self.served.link.scene.put(scene_from(Rig((self.camera,)), path, GROUND))
        frame = tangent_of(self.placement, PATH, GROUND)
        placed = PlacementView(
            self.placement.by.value, self.placement.verdict, False, self.moves > 0, self.moves > 0, frame
        )
        offers = tuple(w for w in STAGE_OFFERS[RunStage.CONFIRM] if self.moves or w is not Wish.CONFIRM)
        self.served.put(
            full_view(
                self.stamp,
                self.turn,
                RunStage.CONFIRM,
                offers=offers,
                placement=placed,
                answer=self.answer,
                motion=None,
                checks=(),
            )
        )

    def follow(self) -> OperatorRequest:
        """Take one request to move, and follow it."""
        (request,) = self.served.taken()
        assert request.wish is Wish.MOVE and request.turn == self.turn
        by = SurfaceMove(request.move.x_mm, request.move.y_mm, np.deg2rad(request.move.turn_deg))
        lies = moved_along(self.placement, PATH, GROUND, by)
        self.placement = replace(self.placement, surface_from_path=lies, by=PlacedBy.HAND)
        self.answer = RequestAnswer(request.number, Wish.MOVE, True)
        self.moves, self.turn, self.stamp = self.moves + 1, self.turn + 1, self.stamp + 1
        self.show()
        self.page.until(f"document.body.dataset.turn === '{self.turn}'")
        return request

    def still(self) -> None:
        """Nothing was asked."""
        self.page.js("new Promise((done) => setTimeout(done, 400))")
        assert self.served.link.requests.take() == []

    def spot(self, points_surface: Array) -> Array:
        """Where points (N, 3) of the surface are in the window, (N, 2) css px."""
        pixels = pixels_from_points(self.camera, se3.transform_points(POSE, points_surface))[0]
        box = self.page.js(
            '(() => { const r = document.querySelector("[data-camera=camera0] canvas").getBoundingClientRect();'
            " return [r.x, r.y, r.width, r.height]; })()"
        )
        scale = min(box[2] / SIZE[0], box[3] / SIZE[1])
        corner = np.array(box[:2]) + (np.array(box[2:]) - scale * np.array(SIZE)) / 2
        return np.asarray(corner + scale * (pixels + 0.5))

    @property
    def middle(self) -> Array:
        """The path's middle (3,), surface frame."""
        return tangent_of(self.placement, PATH, GROUND)[:3, 3]

    def close(self) -> None:
        self.page.close()
        self.served.end()
        self.served.listener.close()


def ground_at(x: float, y: float) -> Array:
    return np.array([x, y, -(x**2) / 300 - y**2 / 200])


@pytest.fixture
def run(browser: Browser) -> Iterator[Moved]:
    made = Moved(browser)
    yield made
    made.close()


def mouse(page: Page, kind: str, place: Array) -> None:
    down = {"button": "left", "buttons": 1, "clickCount": 1}
    page._tell("Input.dispatchMouseEvent", type=kind, x=float(place[0]), y=float(place[1]), **down)


def drag(page: Page, begin: Array, end: Array) -> None:
    mouse(page, "mousePressed", begin)
    for share in (0.3, 0.7, 1.0):
        mouse(page, "mouseMoved", begin + share * (end - begin))
    mouse(page, "mouseReleased", end)


def click(page: Page, place: Array) -> None:
    mouse(page, "mousePressed", place)
    mouse(page, "mouseReleased", place)


def test_the_path_is_dragged_to_where_the_pointer_lets_it_go_and_may_then_be_confirmed(run: Moved) -> None:
    assert run.page.js('document.getElementById("go").disabled')
    assert "a guess" in run.page.text("#placing b").lower()
    begin, goal = run.middle, ground_at(11.0, -7.0)
    drag(run.page, *run.spot(np.stack([begin, goal])))
    run.follow()
    assert (
        np.linalg.norm((run.middle - goal)[:2]) < SLACK_MM + 0.5
    )  # the pointer is on a plane, the surface bends off it
    run.page.until('!document.getElementById("go").disabled')
    assert run.page.js("document.querySelector('[data-camera=camera0]').classList.contains('chosen')")
    run.still()


@pytest.mark.slow
def test_the_handle_turns_the_path_about_its_middle(run: Moved) -> None:
    frame = tangent_of(run.placement, PATH, GROUND)
    flat = se3.transform_points(se3.inverse(frame), PATH.surface_from_nozzle[:, :3, 3])
    far = np.linalg.norm(flat[:, :2], axis=1).max() + 4
    angle = np.deg2rad(35.0)
    ends = np.array([[far, 0, 0], [far * np.cos(angle), far * np.sin(angle), 0]])
    before = run.middle
    drag(run.page, *run.spot(se3.transform_points(frame, ends)))
    assert run.follow().move.turn_deg == pytest.approx(35.0, abs=1.5)
    assert run.middle == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize(
    ("code", "way"),
    [
        ("ArrowLeft", (-1, 0)),
        ("ArrowDown", (0, 1)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("ArrowRight", (1, 0)), ("ArrowUp", (0, -1)))),
    ],
)
def test_arrow_keys_move_it_a_millimetre_as_the_picture_shows_it(run: Moved, code: str, way: tuple[int, int]) -> None:
    before = run.middle
    seen = run.spot(before[None])[0]
    run.page.key(code, code)
    request = run.follow()
    assert np.hypot(request.move.x_mm, request.move.y_mm) == pytest.approx(1.0, abs=2e-3)
    shift = run.spot(run.middle[None])[0] - seen
    assert shift / np.linalg.norm(shift) == pytest.approx(way, abs=0.1)
    assert np.linalg.norm(run.middle - before) == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_many_presses_are_few_requests_and_nothing_of_them_is_lost(run: Moved) -> None:
    run.page.click("[data-step='5']")
    for _ in range(3):
        run.page.click("[data-move=right]")
    run.page.key("Comma", ",")
    far, turned, count = 0.0, 0.0, 0
    while count < 4 and turned == 0:
        move = run.follow().move
        far, turned, count = far + float(np.hypot(move.x_mm, move.y_mm)), turned + move.turn_deg, count + 1
    assert far == pytest.approx(15.0, abs=0.1) and abs(turned) == pytest.approx(5.0, abs=1e-3)
    run.still()


def test_what_the_run_has_not_yet_moved_is_not_confirmed(run: Moved) -> None:
    run.page.key("ArrowLeft", "ArrowLeft")
    run.follow()
    run.page.until('!document.getElementById("go").disabled')
    run.page.key("ArrowRight", "ArrowRight")
    run.page.until('document.getElementById("go").disabled')
    run.page.click("#go")
    run.follow()  # one request, and none to confirm
    run.page.until('!document.getElementById("go").disabled')


def test_three_points_of_the_path_are_laid_on_three_places(run: Moved) -> None:
    turn, shift = 0.5, np.array([9.0, -6.0])
    corners = PATH.surface_from_nozzle[[0, 1, -1], :3, 3]
    c, s = np.cos(turn), np.sin(turn)
    goals = np.array([ground_at(*(np.array([[c, -s], [s, c]]) @ p[:2] + shift)) for p in corners])
    run.page.click("#placing .three")
    for place in run.spot(corners):
        click(run.page, place)
    run.page.until('document.querySelector("#placing .verdict").textContent.includes("point 1 of 3 belongs")')
    for place in run.spot(goals):
        click(run.page, place)
    move = run.follow().move
    assert move.turn_deg == pytest.approx(np.rad2deg(turn), abs=2.0)
    lies = se3.transform_points(run.placement.surface_from_path, corners)
    assert np.linalg.norm((lies - goals)[:, :2], axis=1).max() < 1.0
    run.page.until('document.getElementById("toast").textContent.includes("fit to")')


def test_a_click_is_no_drag_and_what_is_refused_is_drawn_no_longer(run: Moved) -> None:
    click(run.page, run.spot(run.middle[None])[0])
    run.still()
    run.page.key("ArrowLeft", "ArrowLeft")
    (request,) = run.served.taken()
    run.answer = RequestAnswer(request.number, Wish.MOVE, False, "nothing of the surface is mapped there")
    run.stamp += 1
    run.show()
    run.page.until('document.getElementById("toast").textContent.includes("nothing of the surface is mapped there")')
    run.still()


@pytest.mark.slow
def test_no_picture_is_dragged_at_any_other_stage(run: Moved) -> None:
    begin, goal = run.spot(np.stack([run.middle, ground_at(10.0, 5.0)]))
    run.turn, run.stamp = run.turn + 1, run.stamp + 1
    run.served.put(full_view(run.stamp, run.turn, RunStage.READY, offers=STAGE_OFFERS[RunStage.READY], motion=None))
    run.page.until("document.body.dataset.stage === 'ready' && document.body.dataset.movable === 'no'")
    assert run.page.js('document.getElementById("placing").hidden')
    drag(run.page, begin, goal)
    run.page.key("ArrowLeft", "ArrowLeft")
    run.still()


def test_the_browser_finds_the_ray_of_a_pixel_as_the_estimator_does(run: Moved) -> None:
    import json

    ideal = np.random.default_rng(3).uniform([20, 20], [620, 340], (20, 2))
    camera = {
        "size": CAMERA.size, "matrix": CAMERA.matrix.tolist(), "distortion": CAMERA.distortion.tolist(),
        "base_from_camera": CAMERA.base_from_camera.tolist(),
    }  # fmt: skip
    imaged = distort(CAMERA, ideal)
    found = run.page.js(
        f"""import("./lens.js").then(({{ Lens }}) => {{
            const lens = new Lens({json.dumps(camera)});
            return {imaged.tolist()}.map((p) => lens.straight(...p)); }})"""
    )
    expected = (np.column_stack([ideal, np.ones(20)]) @ np.linalg.inv(CAMERA.matrix).T)[:, :2]
    assert np.allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("size", [(1024, 768), *slowly((768, 1024), (1440, 900))], ids=lambda s: f"{s[0]}x{s[1]}")
def test_nothing_covers_the_question_or_stop_while_the_path_is_moved(run: Moved, size: tuple[int, int]) -> None:
    run.page.resize(*size)
    run.page.js("new Promise((done) => setTimeout(done, 300))")
    for selector in (
        "#question",
        "[data-wish=stop]",
        "#go",
        "[data-wish=again]",
        "#placing .three",
        "[data-move=left]",
    ):
        top = run.page.js(
            f"""(() => {{ const r = document.querySelector("{selector}").getBoundingClientRect();
            const top = document.elementFromPoint(r.x + r.width / 2, r.y + r.height / 2);
            const inside = r.top >= 0 && r.bottom <= {size[1]} && r.right <= {size[0]};
            return Boolean(top.closest("{selector}")) && inside; }})()"""
        )
        assert top, selector
