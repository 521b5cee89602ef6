"""What an operator sees in each stage: nothing covers a question or Stop, and what is shown is what is so."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np
import pytest

from estimation.rig import Camera
from hardware.live.view import ACTION_KEYS, KEYS_HELP
from hardware.operator.broadcast import ErrorHistory, TimelineRow
from hardware.operator.process import CameraShot, Thumbnailer
from hardware.operator.shared_state import (
    PageScene,
    RecordingStage,
    RecordingView,
    WavingCamera,
    WavingStage,
    WavingView,
)
from hardware.operator.view import (
    OVER_STAGES,
    STAGE_QUESTIONS,
    WISH_KEYS,
    WISH_WORDS,
    Activity,
    HoldCause,
    HoldRow,
    LogLine,
    OperatorView,
    ProgressView,
    RequestAnswer,
    RestView,
    RunResult,
    RunStage,
    Wish,
    hold_cause,
)
from hardware.report.page import Plot, document, figures_table, legend, line_key, row_of_tiles, section, tile
from planning.command import Hold, HoldReason, RefusalCode
from tests.browser import Browser, axe_findings
from tests.operator_page import LIVE, OFFERED, Run, Served
from tests.slow_cases import slowly

ROOT = Path(__file__).parents[1]
SIZES = [(1440, 900), (1024, 768), (390, 844)]
LONG = "The predicted error at the nozzle is above its limit, as the surface moves faster than before. "
RESULT = RunResult(
    *(0.62, 2120.4, 3420, 900.0, 312.0, 0.91, (0.31, 0.47), (0.22, 0.35), 41.7),
    (HoldRow("the pose is … s old, limit … s", 12, 9.4), HoldRow("paused by the operator", 1, 4.0)),
    tuple(np.where(np.arange(500) < 310, 0.1 + 0.001 * np.arange(500), nan).tolist()),
    *("monday/run.mcap", "", "stillbed live --resume monday/run.mcap"),
)

# Of each element: whether its box lies in the window, and whether every point of a grid over it is its own.
FREE = """((names) => names.map((name) => {
    const each = document.querySelector(name), r = each.getBoundingClientRect();
    const inside = r.left >= 0 && r.top >= 0 && r.right <= innerWidth + 0.5 && r.bottom <= innerHeight + 0.5;
    let own = r.width > 0 && r.height > 0;
    for (const u of [0.02, 0.25, 0.5, 0.75, 0.98]) for (const v of [0.1, 0.5, 0.9]) {
        const top = document.elementFromPoint(r.left + u * r.width, r.top + v * r.height);
        own = own && Boolean(top) && (top === each || each.contains(top) || top.contains(each));
    }
    return [name, inside, own];
}))"""


@pytest.fixture
def run(browser: Browser) -> Iterator[Run]:
    made = Run(browser)
    made.show()
    yield made
    made.close()


WAVED = WavingCamera("a", (640, 360), 12, ((0.2, 1.0), (0.0, 0.5)), (1.0, 0.5, 0.0, 0.2), 0.3)
CAMERA = Camera("camera0", (640, 360), np.array([[600.0, 0, 320], [0, 600, 180], [0, 0, 1]]), np.zeros(5), np.eye(4))


def shown_stage(run: Run, stage: RunStage, **changed: object) -> OperatorView:
    """Show a stage as full of words as it can be, with its end where it is one."""
    more = {"result": RESULT} if stage in OVER_STAGES else {"result": None}
    return run.show(stage=stage, reason=LONG * 2, question=STAGE_QUESTIONS[stage], **more, **changed)


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_nothing_covers_a_question_or_stop_in_any_stage(run: Run, size: tuple[int, int]) -> None:
    page = run.open(size)
    rest = RestView(4.2, 9.0, 0.1)
    for number, stage in enumerate(RunStage):
        view = shown_stage(run, stage, motion=replace(run.view.motion, rest=rest))
        page.click('footer [data-wish="end"]')  # a question, while a message is shown
        page.until('!document.getElementById("sure").hidden')
        run.show(turn=view.turn, answer=RequestAnswer(100 + number, Wish.HOME, False, LONG))
        page.until(f"document.getElementById('toast').textContent.includes('{LONG[:30]}')")
        for name, inside, own in page.js(
            FREE + '(["#question", "#sure-words", "#sure-yes", "#sure-no", "[data-wish=stop]"])'
        ):
            assert inside and own, (stage, name, inside, own)
        wide = "[...document.querySelectorAll('button')].filter((b) => b.scrollWidth > b.clientWidth)"
        assert page.js(f"{wide}.map((b) => b.textContent)") == [], stage
        width = page.js("[document.documentElement.scrollWidth, innerWidth]")
        assert width[0] <= width[1], stage
        page.click("#sure-no")


def test_a_message_moves_no_button(run: Run) -> None:
    page = run.open((1024, 768))
    boxes = (
        "JSON.stringify([...document.querySelectorAll('footer button, .camera')].map((b) => b.getBoundingClientRect()))"
    )
    before = page.js(boxes)
    run.show(turn=run.view.turn, answer=RequestAnswer(7, Wish.PAUSE, False, "nobody knows why"))
    page.until("document.getElementById('toast').textContent.includes('nobody')")
    assert page.js(boxes) == before


@pytest.mark.parametrize("theme", ["dark", *slowly("light")])
def test_axe_finds_nothing_serious_in_any_stage(run: Run, theme: str) -> None:
    page = run.open((1024, 768))
    page.js(f"localStorage.setItem('stillbed.theme', '{theme}')")
    page.reload()
    page.until(f"{LIVE} && document.documentElement.dataset.theme === '{theme}'")
    holding = replace(
        run.view.motion,
        activity=Activity.HOLDING,
        reason="pose is 0.383 s old",
        cause=HoldCause("age", "age of pose", "ms", 383.0, 300.0),
    )
    for stage in RunStage:
        shown_stage(run, stage, motion=holding)
        assert axe_findings(page) == [], stage
    shown_stage(run, RunStage.STOPPED)
    page.click('footer [data-wish="end"]')
    page.click("#opener")
    assert axe_findings(page) == []
    page.js("localStorage.clear()")


def test_after_a_stop_the_page_says_how_the_tissue_moves_and_that_figures_are_old(run: Run) -> None:
    page = run.open()
    motion = replace(
        run.view.motion, activity=Activity.RESTING, error=0.34, error_age=12.0, rest=RestView(4.1, 10, 0.1)
    )
    run.show(stage=RunStage.STOPPED, motion=motion, reason="by the operator", offers=(Wish.RESUME, Wish.LIFT))
    assert (
        page.text("#reason")
        == "By the operator. The nozzle stands at the surface; the surface moves 4.1 mm against it."
    )
    assert page.text("[data-tile=error] span") == "predicted, 12 s ago"
    assert page.js("document.querySelector('[data-tile=error]').className") == "aged"
    assert "4.1mm" in page.text("[data-tile=rest]")
    page.click('[data-wish="lift"]')
    page.click("#sure-yes")
    (request,) = run.served.taken()
    assert request.wish is Wish.LIFT


@pytest.mark.slow
@pytest.mark.parametrize("stage", [RunStage.APPROACH, RunStage.PRINT, RunStage.HOMING])
def test_the_chip_says_what_the_nozzle_does_and_why(run: Run, stage: RunStage) -> None:
    page = run.open()
    motion = replace(run.view.motion, activity=Activity.HOLDING, reason="pose is 0.383 s old, limit 0.3 s")
    run.show(stage=stage, motion=motion, reason="at home")
    assert page.text("#chip") == "Holding" and page.js("document.body.dataset.tone") == "hold"
    assert page.text("#reason") == "Pose is 0.383 s old, limit 0.3 s."
    assert page.text("#said").startswith("Holding.") and "0.383" in page.text("#said")
    assert page.js("document.title").startswith("35 % Holding")


@pytest.mark.parametrize(
    ("code", "got", "limit", "tile", "words"),
    [
        (RefusalCode.POSE_AGE, 0.383, 0.3, "age", ["383", "ms", "limit 300"]),
        (RefusalCode.POSE_ERROR, 0.62, 0.5, "error", ["0.62", "mm", "limit 0.5"]),
        (RefusalCode.SURFACE_SPEED, 62.0, 50.0, "cause", ["surface speed", "62.00", "mm/s", "limit 50"]),
    ],
)
def test_the_figure_that_holds_the_nozzle_is_the_marked_one(
    run: Run, code: RefusalCode, got: float, limit: float, tile: str, words: list[str]
) -> None:
    page = run.open()
    cause = hold_cause(Hold(1.0, 0.02, HoldReason("words", code, got, limit)))
    assert cause is not None
    run.show(motion=replace(run.view.motion, activity=Activity.HOLDING, cause=cause))
    assert page.js("[...document.querySelectorAll('#tiles .cause')].map((b) => b.dataset.tile)") == [tile]
    shown = page.text(f"[data-tile={tile}]")
    assert all(word in shown for word in words), shown
    run.show(motion=replace(run.view.motion, activity=Activity.PRINTING, cause=None))
    assert page.js("document.querySelectorAll('#tiles .cause').length") == 0


def test_a_hold_without_a_figure_has_no_cause() -> None:
    assert hold_cause(Hold(1.0, 0.02, "path finished")) is None
    assert hold_cause(Hold(1.0, 0.02, HoldReason("surface is LOST", RefusalCode.TRACK_STATE))).tile == "tracking"


def test_the_end_page_says_what_was_printed_and_how_well(run: Run) -> None:
    page = run.open()
    path = np.column_stack([np.linspace(0, 40, 500), 5 * np.sin(np.linspace(0, 30, 500)), np.zeros(500)])
    numbers = np.linspace(0, 3420, 500).astype(np.int64)
    run.served.link.scene.put(PageScene((CAMERA,), path, numbers, np.ones(500, bool)))
    shown_stage(run, RunStage.ENDED)
    words = "".join(page.text("#result").split())
    for each in ("62.0%", "checkpoint 2120 of 3420", "0.22 / 0.35", "0.31 / 0.47", "91%", "5 min 12 s", "42mm³", "26 %",
                 "12 ×", "9.4 s", "monday/run.mcap", "stillbed live --resume monday/run.mcap"):  # fmt: skip
        assert each.replace(" ", "") in words, each
    page.until("document.querySelector('#result canvas').dataset.drawn === 'yes'")
    assert page.js("getComputedStyle(document.querySelector('#scene')).display") == "none"
    red = page.js("getComputedStyle(document.querySelector('[data-wish=stop]')).backgroundColor")
    assert red != "rgb(179, 38, 30)"  # nothing is left to be stopped
    run.served.end()
    page.until('document.body.dataset.news === "gone"')
    assert page.js("document.getElementById('alarm').hidden") and page.text("#news") == "the run is over"
    assert float(page.js("getComputedStyle(document.querySelector('main')).opacity")) == 1.0
    run.served.begin()


def test_the_report_of_a_run_that_is_over_can_be_saved_and_of_no_other(run: Run, tmp_path: Path) -> None:
    page = run.open()
    file = tmp_path / "run.report.html"
    file.write_text("<p>all went well</p>", encoding="utf-8")
    asked = "fetch('report').then((r) => r.status)"
    assert page.js(asked) == 404
    shown_stage(run, RunStage.DONE)
    assert page.js(asked) == 404
    run.show(result=replace(RESULT, report=str(file)))
    page.until("!document.querySelector('#result .report a').hidden")
    link = "document.querySelector('#result .report a')"
    assert page.js(f"{link}.download") == "run.report.html"
    assert page.js(f"fetch({link}.href).then((r) => r.text()).catch(String)") or True  # connect-src forbids blobs
    assert page.js("fetch('report').then((r) => r.headers.get('content-disposition'))") == "attachment"


def test_a_run_that_goes_on_says_so_and_from_where(run: Run) -> None:
    page = run.open()
    far = ProgressView(66.2, 152, 0.43, 80.0, None, nan, 1, 2, begun=66.2)
    run.show(stage=RunStage.CONFIRM, progress=far)
    assert page.text("#place").startswith("goes on at 43.0 %") and "80" in page.text("#left").replace(
        "1 min 20 s", "80"
    )
    run.show(stage=RunStage.PRINT, progress=replace(far, fraction=151.9, share=0.999))
    assert page.text("#place").startswith("99.9 % · checkpoint 152 of 152")
    run.show(progress=replace(far, fraction=152.0, share=1.0))
    assert "checkpoint 152 of 152" in page.text("#place")


def test_the_terminals_keys_do_the_same_on_the_page(run: Run) -> None:
    page = run.open()
    assert page.js('import("./words.js").then((words) => words.KEYS)') == {
        key: wish.value for wish, key in WISH_KEYS.items() if wish is not Wish.STOP
    }
    run.show(stage=RunStage.PRINT, offers=(Wish.PAUSE, Wish.HOME))
    page.key("KeyP", "p")
    assert [request.wish for request in run.served.taken()] == [Wish.PAUSE]
    page.key("KeyH", "h")
    page.until('!document.getElementById("sure").hidden')
    assert page.js("document.activeElement.id") == "sure-no"
    page.key("KeyN", "n")
    assert page.js("document.activeElement.dataset.wish") == "home"
    page.key("KeyH", "h")
    page.key("KeyY", "y")
    assert [request.wish for request in run.served.taken()] == [Wish.HOME]
    page.key("KeyS", "s")
    page.until("document.getElementById('toast').textContent.includes('“Start” cannot be done now')")
    page.click("#opener")
    page.key("KeyP", "p")  # into the filter
    assert page.js("document.querySelector('#log input').value") == "p" and run.served.link.requests.take() == []


def test_the_focus_never_falls_to_nothing(run: Run) -> None:
    page = run.open()
    page.js("document.querySelector('[data-wish=pause]').focus()")
    run.show(stage=RunStage.PAUSED, offers=(Wish.RESUME,))
    page.until("document.activeElement.dataset.wish === 'stop'")


def test_every_action_can_be_reached_by_the_tab_key_and_is_seen_to_be(run: Run) -> None:
    page = run.open()
    run.show(stage=RunStage.CONFIRM)
    page.js("document.activeElement.blur()")
    reached = set()
    for _ in range(60):
        page._tell("Input.dispatchKeyEvent", type="keyDown", code="Tab", key="Tab", windowsVirtualKeyCode=9)
        page._tell("Input.dispatchKeyEvent", type="keyUp", code="Tab", key="Tab", windowsVirtualKeyCode=9)
        name, width = page.js(
            """(() => { const e = document.activeElement, s = getComputedStyle(e);
            const names = [e.dataset.wish, e.id, e.className, e.textContent, e.tagName];
            return [e === document.body ? "BODY" : names.find(Boolean),
                s.outlineStyle === "none" ? 0 : parseFloat(s.outlineWidth)]; })()"""
        )
        if name == "BODY":
            break
        reached.add(name)
        assert width >= 2, name
    assert {wish.value for wish in OFFERED if wish not in (Wish.MOVE, Wish.OUTLINE, Wish.START, Wish.RESUME)} <= reached
    assert {"stop", "opener", "sound", "theme"} <= reached


def test_the_words_of_page_terminal_and_documents_are_one(run: Run) -> None:
    page = run.open()
    words = page.js('import("./words.js").then((words) => words.WISHES)')
    assert words == {wish.value: word for wish, word in WISH_WORDS.items()}
    text = " ".join((ROOT / "docs" / "operator.md").read_text(encoding="utf-8").split())
    assert [word for word in WISH_WORDS.values() if f"*{word}*" not in text] == []
    live = " ".join((ROOT / "docs" / "live.md").read_text(encoding="utf-8").split())
    for wish, key in WISH_KEYS.items():
        assert key == "space" or (f"`{key}`" in live and ACTION_KEYS[key] is wish), wish
        assert WISH_WORDS[wish] in KEYS_HELP
    for number, (wish, word) in enumerate(WISH_WORDS.items(), 50):
        run.show(turn=run.view.turn, answer=RequestAnswer(number, wish, False, f"the reason of {wish}"))
        page.until(f"document.getElementById('toast').textContent.startsWith('“{word}” was not followed')")
    assert WISH_WORDS[Wish.END].lower() in STAGE_QUESTIONS[RunStage.PAUSED]


@pytest.mark.slow
def test_the_chart_knows_the_whole_run_and_is_zoomed_by_hand_and_key(run: Run) -> None:
    page = run.open((1440, 900))
    for k in range(40):
        run._stamp += 8.0
        run.served.put(replace(run.view, stamp=run._stamp, motion=replace(run.view.motion, error=0.1 + 0.006 * k)))
        page.js("new Promise((done) => setTimeout(done, 60))")
    page.reload()
    page.until(f"{LIVE} && Number(document.querySelector('#course').dataset.rows) > 20")
    page.js("document.querySelector('.chart').focus()")
    label = "[...document.querySelectorAll('#course [aria-pressed=true]')].map((b) => b.dataset.span)"
    assert page.js(label) == ["minute"]
    page.click("#course [data-span=run]")
    page.until(f"JSON.stringify({label}) === '[\"run\"]'")
    page.js("document.querySelector('.chart').focus()")
    page.key("Equal", "+")
    page.until(f"{label}.length === 0")
    page.key("Escape", "Escape")
    page.until(f"JSON.stringify({label}) === '[\"run\"]'")
    x, y, width = page.js(
        "(() => { const r = document.querySelector('.u-over').getBoundingClientRect();"
        " return [r.x, r.y + r.height / 2, r.width]; })()"
    )
    for kind, at in (("mousePressed", 0.3), ("mouseMoved", 0.5), ("mouseReleased", 0.5)):
        page._tell("Input.dispatchMouseEvent", type=kind, x=x + at * width, y=y, button="left", clickCount=1, buttons=1)
    page.until(f"{label}.length === 0")
    page._tell("Input.dispatchMouseEvent", type="mouseMoved", x=x + 0.6 * width, y=y)
    page.until("/predicted, 95 %:?\\s*0\\.\\d\\d mm/.test(document.querySelector('.u-legend').textContent)")


@pytest.mark.parametrize("seed", range(3))
def test_the_history_keeps_the_largest_error_and_every_hold_in_a_fixed_number_of_rows(seed: int) -> None:
    rng, history = np.random.default_rng(seed), ErrorHistory()
    errors, held = rng.uniform(0, 1, 20_000), rng.random(20_000) < 0.001
    for k, (error, holds) in enumerate(zip(errors, held, strict=True)):
        history.add(TimelineRow(0.15 * k, nan if k % 7 == 0 else error, nan, 0.5, bool(holds)))
    known = np.delete(errors, np.arange(0, len(errors), 7))
    stamps = np.array([row.stamp for row in history.rows])
    assert 500 < len(history.rows) <= 2400 and (np.diff(stamps) >= history.step - 1e-9).all()
    assert max(row.error for row in history.rows) == known.max()
    for stamp in 0.15 * np.flatnonzero(held):
        assert history.rows[int(np.searchsorted(stamps, stamp, "right")) - 1].held


@pytest.mark.slow
def test_the_log_is_kept_is_sent_to_a_new_window_and_is_filtered(run: Run) -> None:
    page = run.open()
    lines = [LogLine(k + 1, float(k), k % 10 == 0, f"line {k} of the arm") for k in range(40)]
    for k in range(40):
        run.show(log=tuple(lines[max(k - 15, 0) : k + 1]))  # as a run: some of them again
    page.reload()
    page.until(f"{LIVE} && document.getElementById('last').textContent === 'line 39 of the arm'")
    page.click("#opener")
    assert page.js("document.querySelectorAll('#log li').length") == 40
    page.js("{const f = document.querySelector('#log input'); f.value = '3'; f.dispatchEvent(new Event('input'));}")
    assert page.js("document.querySelectorAll('#log li').length") == 13
    page.click("#log input[type=checkbox]")
    assert page.js("[...document.querySelectorAll('#log li')].map((l) => l.lastChild.textContent)") == [
        "line 30 of the arm"
    ]
    page.key("Escape", "Escape")
    assert page.js("document.getElementById('log').hidden && document.activeElement.id") == "opener"


@pytest.mark.slow
def test_sound_is_told_at_hold_stop_and_end_once_each_and_stays_muted(run: Run) -> None:
    page = run.open()
    told = "document.getElementById('sound').dataset.told"
    holding = replace(run.view.motion, activity=Activity.HOLDING, reason="the surface moves too fast")
    printing = run.view.motion
    run.show(motion=holding)
    page.until(f"{told} === '1 hold'")
    run.show(motion=printing)
    run.show(stage=RunStage.STOPPED)
    page.until(f"{told} === '2 stop'")
    shown_stage(run, RunStage.DONE)
    page.until(f"{told} === '3 end'")
    page.click("#sound")
    page.reload()
    page.until(f"{LIVE} && document.getElementById('sound').textContent === 'Sound off'")
    page.js("localStorage.clear()")


def test_landmarks_become_a_skin_and_the_scene_is_turned_and_moved_by_keys(run: Run) -> None:
    page = run.open((1440, 900))
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-30, 30, (200, 2)), np.zeros(200)])
    run.served.link.scene.put(PageScene((CAMERA,), surface=points))
    run.show()
    drawn = """(() => { const c = document.querySelector('#scene canvas'), d = c.getContext('2d');
        const [r, g, b] = d.getImageData(0.4 * c.width, 0.6 * c.height, 1, 1).data;
        return r > 150 && r > b + 15; })()"""
    page.until(drawn)
    picture = "document.querySelector('#scene canvas').toDataURL()"
    page.js("document.querySelector('#scene canvas').focus()")
    before = page.js(picture)
    for code, key in (("ArrowLeft", "ArrowLeft"), ("Equal", "+"), ("KeyT", "t")):
        page.key(code, key)
        page.js("new Promise((done) => setTimeout(done, 80))")
        after = page.js(picture)
        assert after != before, key
        before = after
    assert run.served.link.requests.take() == []


def test_pictures_are_as_fine_as_the_camera_while_the_path_is_confirmed(run: Run) -> None:
    link = run.served.link
    page = run.open()
    shots = [CameraShot("camera0", np.random.default_rng(1).integers(0, 255, (720, 1280, 3)).astype(np.uint8),
                        (np.array([[200.0, 100], [1000, 100], [1000, 600], [200, 600]] * 3),))]  # fmt: skip
    thumbnailer = Thumbnailer(link.pictures, link.status)
    widths = {}
    for stage in (RunStage.PRINT, RunStage.CONFIRM):
        run.show(stage=stage)
        page.js("new Promise((done) => setTimeout(done, 300))")
        while not thumbnailer.offer(1.0, shots):
            page.js("new Promise((done) => setTimeout(done, 50))")
        thumbnailer._job.result()
        (picture,) = link.pictures.get().pictures
        (marker,) = [i for i in range(len(picture.near)) if picture.near[i : i + 2] == b"\xff\xc0"][:1]
        widths[stage] = int.from_bytes(picture.near[marker + 7 : marker + 9], "big"), picture.crop[2]
    thumbnailer.close()
    assert widths[RunStage.PRINT][0] == 480
    assert widths[RunStage.CONFIRM][0] == widths[RunStage.CONFIRM][1] > 800


@pytest.mark.parametrize(
    ("name", "view"),
    [
        ("recording.html", RecordingView(1.0, 1, RecordingStage.RECORD, 12.0, 10**7, 300, 2, (), "", (Wish.END,))),
        ("waving.html", WavingView(1.0, 1, WavingStage.WAVE, ("a: hold the board nearer",), (WAVED,), 0.4, 90)),
        ("waving.html", WavingView(1.0, 1, WavingStage.FAILED, (), (WAVED,), 0.4, 90, ("FAIL", "too few views"))),
    ],
)
@pytest.mark.parametrize("theme", ["light", *slowly("dark")])
def test_axe_finds_nothing_serious_beside_a_recording_or_a_calibration(
    browser: Browser, name: str, view: RecordingView | WavingView, theme: str
) -> None:
    served = Served(page=name)
    served.link.views.put(view)
    page = browser.page(served.address)
    page.until("document.querySelector('#theme') && document.querySelector('#theme').textContent")
    page.js(f"localStorage.setItem('stillbed.theme', '{theme}')")
    page.reload()
    page.until(f"document.documentElement.dataset.theme === '{theme}' && document.body.dataset.stage")
    assert axe_findings(page) == []
    page.js("localStorage.clear()")
    page.close()
    served.end()
    served.listener.close()


@pytest.mark.parametrize("scheme", ["dark", *slowly("light")])
def test_axe_finds_nothing_serious_in_a_report(browser: Browser, tmp_path: Path, scheme: str) -> None:
    plot = Plot(900, 200, (0.0, 1.0), (0.0, 1.0))
    plot.line(np.linspace(0, 1, 9), np.linspace(0, 1, 9), "estimate")
    body = [
        row_of_tiles([tile("1", "mm", "error")]),
        section("A chart", "What it shows.", legend([line_key("estimate", "error")]) + plot.svg()),
        section("A table", "Of figures.", figures_table(("name", "value"), [["a", "1"]])),
        '<p class="badge met">met</p><p class="badge missed">missed</p>',
    ]
    file = tmp_path / "report.html"
    file.write_text(document("kind", "title", "lead", body, "footer"), encoding="utf-8")
    page = browser.page(file.as_uri())
    page._tell("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    page.until("document.readyState === 'complete' && Boolean(document.querySelector('footer'))")
    assert axe_findings(page) == []
    page.close()
