"""The operator's page in a real browser: every button does what it says, and what is shown is so."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.pose import TrackState
from estimation.rig import Camera, distort, pixels_from_points
from hardware.files.images import encode
from hardware.operator.settings import WindowLimits
from hardware.operator.shared_state import CameraPicture, LaidDrawing, OperatorRequest, PagePictures, PageScene
from hardware.operator.view import (
    Activity,
    CheckVerdict,
    LogLine,
    RequestAnswer,
    RunStage,
    Wish,
)
from tests.browser import Browser, Page, axe_findings
from tests.operator_page import LIVE, OFFERED, Run
from tests.slow_cases import slowly

SIZES = [(1024, 768), (768, 1024), *slowly((1440, 900))]  # which is the first, with more room
SURE = (Wish.START, Wish.RESUME, Wish.LOOK, Wish.LIFT, Wish.HOME, Wish.END)


@pytest.fixture
def run(browser: Browser) -> Iterator[Run]:
    made = Run(browser)
    made.show()
    yield made
    made.close()


def settle(page: Page) -> None:
    """Wait until the button in the middle may be pressed, which has just come to mean something."""
    page.js("new Promise((done) => setTimeout(done, 750))")


def test_every_button_asks_for_what_it_says_once_and_those_that_move_the_arm_ask_twice(run: Run) -> None:
    page = run.open()
    elsewhere = (Wish.MOVE, Wish.OUTLINE)  # they have no button there: test_path_page.py, test_outline_page.py
    for wish in (wish for wish in Wish if wish not in elsewhere):
        view = run.show(offers=(wish,) if wish is not Wish.STOP else (), stage=RunStage.PAUSED)
        if wish in (Wish.CONFIRM, Wish.START, Wish.RESUME):
            settle(page)
        page.click(f'footer [data-wish="{wish}"]')
        if wish in SURE:
            assert run.served.link.requests.take() == []
            page.until('!document.getElementById("sure").hidden')
            page.click("#sure-yes")
        (request,) = run.served.taken()
        assert request.wish is wish and request.turn == (0 if wish is Wish.STOP else view.turn)
    assert run.served.link.requests.take() == []


def test_what_is_not_offered_cannot_be_pressed_and_stop_always_can(run: Run) -> None:
    page = run.open()
    for stage in RunStage:
        run.show(stage=stage, offers=())
        enabled = page.js('[...document.querySelectorAll("footer button:not(:disabled)")].map((b) => b.dataset.wish)')
        assert enabled == ["stop"]
        for wish in OFFERED:
            page.js(f"document.querySelector('footer [data-wish=\"{wish}\"]')?.click()")
    assert run.served.link.requests.take() == []
    page.click('[data-wish="stop"]')
    assert [request.wish for request in run.served.taken()] == [Wish.STOP]


def test_the_space_bar_stops_whatever_is_focused_and_presses_nothing_else(run: Run) -> None:
    page = run.open()
    page.js("document.querySelector('[data-wish=\"pause\"]').focus()")
    page.key("Space", " ")
    assert [request.wish for request in run.served.taken()] == [Wish.STOP]
    page.click('[data-wish="home"]')
    page.js('document.getElementById("sure-yes").focus()')
    page.key("Space", " ")
    assert [request.wish for request in run.served.taken()] == [Wish.STOP]
    assert run.served.link.requests.take() == []


def test_a_question_whether_one_is_sure_is_dropped_in_words_when_the_run_has_changed(run: Run) -> None:
    page = run.open()
    page.click('[data-wish="home"]')
    page.until('!document.getElementById("sure").hidden')
    run.show(stage=RunStage.STOPPED)
    page.until('document.getElementById("sure").hidden')
    assert page.text("#toast") == "“Home” was not asked: the run has changed meanwhile."
    page.click('[data-wish="end"]')
    page.click("#sure-no")
    page.until('document.getElementById("sure").hidden')
    assert run.served.link.requests.take() == []


def test_the_end_of_a_run_that_changes_meanwhile_is_still_asked_for(run: Run) -> None:
    page = run.open()
    page.click('[data-wish="end"]')
    page.until('!document.getElementById("sure").hidden')
    view = run.show(stage=RunStage.APPROACH)
    page.click("#sure-yes")
    (request,) = run.served.taken()
    assert request.wish is Wish.END and request.turn < view.turn
    page.click('[data-wish="end"]')
    page.until('!document.getElementById("sure").hidden')
    run.show(stage=RunStage.DONE, offers=())
    page.until('document.getElementById("sure").hidden')


def test_a_button_that_has_just_come_to_mean_something_else_is_not_pressed_by_a_second_tap(run: Run) -> None:
    page = run.open()
    run.show(stage=RunStage.CONFIRM, offers=(Wish.CONFIRM,))
    settle(page)
    page.click("#go")
    assert [request.wish for request in run.served.taken()] == [Wish.CONFIRM]
    run.show(stage=RunStage.PAUSED, offers=(Wish.RESUME,))
    page.click("#go")
    settle(page)
    assert run.served.link.requests.take() == []
    page.click("#go")
    page.click("#sure-yes")
    assert [request.wish for request in run.served.taken()] == [Wish.RESUME]


def test_a_finger_that_was_down_when_another_window_stopped_the_run_does_not_resume_it(run: Run) -> None:
    page, other = run.open(), run.open()
    run.show(stage=RunStage.PAUSED, offers=(Wish.RESUME,))
    settle(page)
    press = "document.getElementById('go').dispatchEvent(new PointerEvent('pointerdown'))"
    page.js(press)
    other.click('[data-wish="stop"]')
    run.show(stage=RunStage.PAUSED, offers=(Wish.RESUME,))
    page.js("document.getElementById('go').click()")
    page.click("#sure-yes")
    page.until('document.getElementById("toast").textContent.includes("changed")')
    assert [request.wish for request in run.served.taken()] == [Wish.STOP]
    assert run.served.link.requests.take() == []


def test_both_windows_show_what_became_of_a_request(run: Run) -> None:
    first, second = run.open(), run.open()
    run.show(offers=(Wish.PAUSE,))
    first.click('[data-wish="pause"]')
    (request,) = run.served.taken()
    first.until('document.querySelector("[data-wish=pause]").classList.contains("asked")')
    run.show(stage=RunStage.PAUSED, answer=RequestAnswer(request.number, Wish.PAUSE, True), offers=(Wish.RESUME,))
    for page in (first, second):
        page.until('document.getElementById("toast").textContent === "“Pause” was followed."')
        assert page.text("#chip") == "Paused"
    assert not first.js('document.querySelector("[data-wish=pause]").classList.contains("asked")')


def test_a_stop_that_nobody_answers_is_not_taken_for_done(run: Run) -> None:
    page = run.open()
    page.click('[data-wish="stop"]')
    page.until('document.getElementById("toast").textContent.includes("emergency stop")')


def test_a_reloaded_window_shows_the_same_and_knows_the_last_minute(run: Run) -> None:
    page = run.open()
    for _ in range(5):
        run.show(question="Is it well?", reason="so that it may go on")
    texts = {name: page.text(name) for name in ("#chip", "#question", "#reason", "#states", "#tiles", "#progress")}
    page.reload()
    page.until(f"{LIVE} && document.body.dataset.turn === '{run.view.turn}'")
    assert texts == {name: page.text(name) for name in texts}
    page.until("document.querySelector('#course').dataset.rows === '6'")  # drawn in the next frame
    page.click('[data-wish="pause"]')
    assert run.served.taken() == [OperatorRequest(1, Wish.PAUSE, run.view.turn)]


def test_state_and_why_and_all_figures_are_there_in_words(run: Run) -> None:
    page = run.open((1440, 900))
    motion = replace(run.view.motion, activity=Activity.HOLDING, error=0.62, reason="the surface moves too fast")
    log = tuple(LogLine(k, float(k), False, words) for k, words in enumerate(("camera1 was late", "it is back"), 1))
    run.show(motion=motion, notes=("dry run",), log=log)
    body = "".join(page.js("document.body.innerText").split())
    for words in (
        "Holding", "The surface moves too fast", "Good", "three cameras agree", "0.62 mm", "predicted, σ 0.12/0.5",
            "0.19 mm",
        "18 ms", "14 / 27 ms", "31 ms", "0.052 mm", "35.2 %", "checkpoint 1204 of 3420", "layer 3 of 12",
        "about 13 min left", "12 min to 14 min", "30 Hz", "60 tracks", "dry run", "live", "6.0 mm/s", "it is back",
    ):  # fmt: skip
        assert words.replace(" ", "") in body, words


def test_the_page_has_words_for_all_that_a_view_can_say(run: Run) -> None:
    page = run.open()
    kinds = (RunStage, TrackState, Activity, Wish, CheckVerdict)
    for name, kind in zip(("STAGES", "TRACKING", "ACTIVITIES", "WISHES", "VERDICTS"), kinds, strict=True):
        known = page.js(f'import("./words.js").then((words) => Object.keys(words.{name}))')
        assert set(known) == {each.value for each in kind}


def test_a_failed_check_says_what_to_do(run: Run) -> None:
    page = run.open()
    run.show(stage=RunStage.CHECK, offers=(Wish.AGAIN,))
    assert "✗ fail" in page.text("#checks tr.fail") and "Switch it on." in page.text("#checks tr.fail")
    assert len(page.js('[...document.querySelectorAll("#checks tr")].map((r) => r.className)')) == 2


def test_markup_in_what_is_shown_stays_text(run: Run) -> None:
    page = run.open()
    evil = "<img src=x onerror=\"document.body.dataset.owned='yes'\"><b>bold</b>"
    checks = tuple(replace(check, name=evil, found=evil, remedy=evil) for check in run.view.checks)
    cameras = tuple(replace(camera, words=evil) for camera in run.view.cameras)
    tracking = replace(run.view.tracking, reason=evil)
    run.show(question=evil, reason=evil, notes=(evil,), checks=checks, cameras=cameras, tracking=tracking)
    run.show(stage=RunStage.CHECK)
    assert page.text("#question") == evil
    assert page.js("document.querySelectorAll('img').length") == 0
    assert page.js("document.body.dataset.owned") is None


def test_old_news_are_greyed_and_said_to_be_old_and_stop_still_stops(browser: Browser) -> None:
    run = Run(browser, WindowLimits(stale=0.6, patience=30.0))
    run.show()
    page = browser.page(run.served.address)
    run.pages.append(page)
    page.until('document.body.dataset.news === "old"')
    assert "No news from the run" in page.text("#alarm") and "old" in page.text("#alarm")
    assert "grayscale" in page.js("getComputedStyle(document.querySelector('main')).filter")
    assert float(page.js("getComputedStyle(document.querySelector('main canvas')).opacity")) < 0.5
    assert axe_findings(page) == []  # what is grey can be read
    enabled = page.js('[...document.querySelectorAll("footer button:not(:disabled)")].map((b) => b.dataset.wish)')
    assert enabled == ["stop"]
    page.click('[data-wish="stop"]')
    assert [request.wish for request in run.served.taken()] == [Wish.STOP]
    run.served.put(replace(run.view, stamp=99.0))
    page.until(LIVE)
    run.close()


@pytest.mark.slow
def test_a_window_says_when_the_run_is_gone_and_comes_back_by_itself(run: Run) -> None:
    page = run.open()
    run.served.put(replace(run.view, stamp=99.0, stage=RunStage.DONE))
    run.served.end()
    page.until('document.body.dataset.news === "gone" && document.body.dataset.stage === "done"')
    assert "has ended" in page.text("#alarm")
    page.until("performance.now() > 0")
    run.served.begin()
    page.until(LIVE, timeout=20)
    assert page.js('document.getElementById("alarm").hidden')


def test_a_wrong_address_shows_nothing(run: Run, browser: Browser) -> None:
    page = browser.page(f"http://{run.served.host}/wrong/")
    page.until('document.body && document.body.innerText.includes("refused")')
    assert page.js("document.querySelectorAll('button').length") == 0
    page.close()


CAMERA = Camera(
    "camera0",
    (640, 360),
    np.array([[610.0, 0.4, 331.0], [0, 602.0, 171.0], [0, 0, 1]]),
    np.array([-0.21, 0.06, 0.0012, -0.0008, 0.01]),
    se3.exp(np.array([0.4, 2.6, 0.3, 12.0, -40.0, 300.0])),
)


def test_the_browser_images_points_as_the_estimator_does(run: Run) -> None:
    page = run.open()
    rng = np.random.default_rng(3)
    points = se3.transform_points(CAMERA.base_from_camera, rng.uniform([-60, -30, 200], [60, 30, 400], (40, 3)))
    ideal = rng.uniform([0, 0], CAMERA.size, (20, 2))
    camera = {
        "size": CAMERA.size,
        "matrix": CAMERA.matrix.tolist(),
        "distortion": CAMERA.distortion.tolist(),
        "base_from_camera": CAMERA.base_from_camera.tolist(),
    }
    found = page.js(
        f"""import("./lens.js").then(({{ Lens }}) => {{
            const lens = new Lens({json.dumps(camera)}), one = [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]];
            return [{points.tolist()}.map((p) => lens.from(one)(...p)),
                {ideal.tolist()}.map((p) => lens.distorted(...p))];
        }})"""
    )
    assert np.allclose(found[0], pixels_from_points(CAMERA, points)[0], atol=1e-9)
    assert np.allclose(found[1], distort(CAMERA, ideal), atol=1e-9)


def test_a_picture_that_stands_still_says_how_old_it_is_while_the_others_go_on(run: Run) -> None:
    page = run.open()
    jpeg = encode(np.full((36, 64, 3), 128, np.uint8), 90)[1]
    run.served.link.pictures.put(PagePictures(1.0, tuple(CameraPicture(f"camera{k}", jpeg) for k in range(2))))
    page.until('document.querySelector("[data-camera=camera0] canvas").dataset.drawn')
    for stamp in range(2, 30):
        run.served.link.pictures.put(PagePictures(float(stamp), (CameraPicture("camera1", jpeg),)))
        if page.js('document.querySelector("[data-camera=camera0]").classList.contains("still")'):
            break
        page.js("new Promise((done) => setTimeout(done, 100))")
    assert "s old" in page.text("[data-camera=camera0]")
    assert page.text("[data-camera=camera1] figcaption span") == "camera1"


@pytest.mark.parametrize("crop", [None, (150, 110, 320, 180)], ids=["whole", "near"])
def test_the_path_is_drawn_where_it_lies_in_the_picture(run: Run, crop: tuple[int, int, int, int] | None) -> None:
    page = run.open((1440, 900))
    above = np.diag([1.0, -1.0, -1.0, 1.0])
    above[2, 3] = 300.0
    straight = replace(CAMERA, base_from_camera=above)
    path = np.column_stack([np.linspace(-50, 50, 11), np.zeros(11), np.zeros(11)])
    run.served.link.scene.put(PageScene((straight,), path, np.arange(11), np.ones(11, bool)))
    jpeg = encode(np.full((360, 640, 3), 128, np.uint8), 90)[1]
    picture = CameraPicture("camera0", jpeg, near=b"" if crop is None else jpeg, crop=crop)
    run.served.link.pictures.put(PagePictures(1.0, (picture,), np.eye(4)))
    run.show(motion=replace(run.view.motion, base_from_nozzle=None), progress=replace(run.view.progress, fraction=5.0))
    page.until('document.querySelector("[data-camera=camera0] canvas").dataset.drawn === "path"')
    left, top, width, height = crop or (0, 0, 640, 360)
    for place, green in ((path[3] + [5, 0, 0], True), (path[6] + [5, 0, 0], False)):
        pixel = pixels_from_points(straight, place[None])[0][0] - [left, top] + 0.5
        r, g, b = page.js(
            f"""(() => {{ const c = document.querySelector("[data-camera=camera0] canvas");
                const s = Math.min(c.width / {width}, c.height / {height});
                const x = (c.width - {width} * s) / 2 + s * {pixel[0]};
                const y = (c.height - {height} * s) / 2 + s * {pixel[1]};
                const near = [-1, 0, 1].map((d) => c.getContext("2d").getImageData(x, y + d, 1, 1).data);
                return [0, 1, 2].map((k) => Math.max(...near.map((data) => data[k])));
            }})()"""
        )
        assert (g > r + 40 and g > b + 25) if green else (b > r + 25 and b > 160), (r, g, b)


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_everything_fits_and_stop_is_on_top_in_every_stage(run: Run, size: tuple[int, int]) -> None:
    page = run.open(size)
    long = "The predicted error at the nozzle is above its limit, as the surface moves faster than before. "
    for stage in RunStage:
        run.show(stage=stage, reason=long * 3, question=long)
        facts = page.js(
            """(() => { const b = document.querySelector("[data-wish=stop]").getBoundingClientRect();
            const top = document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2);
            const small = [...document.querySelectorAll("button")].filter((e) => e.offsetParent && e.offsetHeight < 42);
            return [b.top, b.bottom, b.width, Boolean(top.closest("[data-wish=stop]")), small.length,
                document.documentElement.scrollWidth, document.documentElement.scrollHeight]; })()"""
        )
        assert facts[0] > 0 and facts[1] <= size[1] and facts[2] > 200, stage
        assert facts[3] and facts[4] == 0, stage
        assert facts[5] <= size[0] and facts[6] <= size[1], stage


def test_what_a_look_found_is_drawn_in_the_scene_piece_by_piece(run: Run) -> None:
    page = run.open((1440, 900))
    path = np.column_stack([np.linspace(-50, 50, 11), np.zeros(11), np.zeros(11)])
    pieces = np.array([[[x, y, 0.0], [x + 9.0, y, 0.0]] for y in (-20.0, 20.0) for x in (-40.0, -20, 0, 20)])
    for share, wanted in ((1.0, "g"), (0.1, "r")):
        laid = LaidDrawing(pieces, np.array([share] * 7 + [np.nan]))
        run.served.link.scene.put(PageScene((CAMERA,), path, np.arange(11), np.ones(11, bool), laid=laid))
        run.show(stage=RunStage.PAUSED)
        page.until(
            f"""(() => {{ const c = document.querySelector("#scene canvas");
                const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data, n = {{ g: 0, r: 0 }};
                for (let i = 0; i < d.length; i += 4) {{
                    n.g += d[i] === 39 && d[i + 1] === 174 && d[i + 2] === 96;
                    n.r += d[i] === 192 && d[i + 1] === 57 && d[i + 2] === 43;
                }}
                return n.{wanted} > 100 && n.{"r" if wanted == "g" else "g"} === 0;
            }})()"""
        )
        words = page.js("[...document.querySelectorAll('#scene .look')].map((line) => line.textContent)")
        assert words == [{"g": "laid as planned", "r": "a gap"}[wanted], "not seen"]
