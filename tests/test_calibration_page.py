"""The page beside a calibration: what it shows is what the guide says, and its two buttons do what they say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.rig import pixels_from_points
from hardware.calibration.corners import MIN_COMMON_SETS, CoverageGuide
from hardware.calibration.live import WavingPage
from hardware.files.rig_file import read_rig, write_board
from hardware.operator.shared_state import WavingStage
from hardware.operator.view import Wish
from hardware.process.clock import WallClock
from perception.frames import Frame, FrameSet
from tests.board_session import BOARD, LENSES, RATE, rendered, small_rig
from tests.boards import motion
from tests.browser import Browser, Page
from tests.command_processes import spoken, started

CLOCK = WallClock()
SIZE = (640, 480)
PATIENCE = 60.0  # s, on a busy machine
GREY = np.full((480, 640, 3), 150, np.uint8)
NAMES = ("camera 1", "camera 2", "camera 3")


@pytest.fixture
def shown() -> Iterator[WavingPage]:
    with WavingPage(CLOCK) as made:
        yield made


def seen_at(instant: float) -> dict[int, np.ndarray]:
    """Corners (P, 2) px of a moving board in each camera, nan outside of its picture."""
    pose = motion(np.array([instant]), np.random.default_rng(11), BOARD.corners.mean(0), 1.5)[0]
    found = {}
    for c, camera in enumerate(small_rig().cameras):
        pixels = pixels_from_points(camera, se3.transform_points(pose, BOARD.corners))[0]
        pixels[((pixels < 0) | (pixels > np.array(SIZE) - 1)).any(-1)] = np.nan
        if np.isfinite(pixels).any():
            found[c] = pixels
    return found


def wished(shown: WavingPage) -> Wish:
    """The next thing that a window asks for."""
    end = CLOCK.now() + PATIENCE
    while (wish := shown.poll()) is None:
        assert CLOCK.now() < end
        CLOCK.wait_until(CLOCK.now() + 0.05)
    return wish


def tell(shown: WavingPage, page: Page, guide: CoverageGuide, looked: int, until: str) -> None:
    """Show the guide and its pictures until the page has it."""
    seen, end = seen_at(0.2), CLOCK.now() + 20
    pictures = tuple(Frame(c, 0.0, GREY) for c in range(3))
    while not page.js(until):
        assert CLOCK.now() < end, page.js("document.body.innerText")
        shown.picture(NAMES, FrameSet(CLOCK.now(), pictures), seen)
        shown.show(guide, guide.missing(), looked, seen)
        CLOCK.wait_until(CLOCK.now() + 0.1)


def test_the_page_shows_what_is_missing_and_enough_is_enough(shown: WavingPage, browser: Browser) -> None:
    guide = CoverageGuide(NAMES, (SIZE,) * 3, BOARD)
    for instant in np.arange(0, 4, 0.25):
        guide.add(seen_at(float(instant)))
    page = browser.page(shown.address)
    tell(shown, page, guide, 16, 'document.querySelector("canvas")?.dataset.drawn === "corners"')
    hint = guide.missing()[0]
    assert page.text("#question") == hint[0].upper() + hint[1:]
    assert page.js('[...document.querySelectorAll(".board")].map((each) => each.dataset.camera)') == list(NAMES)
    named = page.js('document.querySelector(".board[data-next=yes]").dataset.camera')
    assert hint.startswith(f"{named}:")
    assert page.text("#together b") == f"{int(100 * guide.together / MIN_COMMON_SETS)} %"
    parts = guide.coverage(0).parts
    first = page.text(".board .needs b")
    assert first == f"{int(100 * np.minimum(parts / 20, 1).mean())} %"
    page.click('footer [data-wish="end"]')
    assert wished(shown) is Wish.END
    shown.enter(WavingStage.SOLVE)
    page.until('document.body.dataset.stage === "solve"', timeout=PATIENCE)
    assert page.js('[...document.querySelectorAll("footer button")].every((each) => each.disabled)')
    shown.enter(WavingStage.PASSED, "PASS", "good enough to print")
    page.until('document.querySelector("#result pre").textContent === "PASS\\ngood enough to print"', timeout=PATIENCE)
    assert page.text("#chip") == "Passed"


def videos(folder: Path) -> list[str]:
    """What each of three cameras sees of a board that goes there and back for a while."""
    session, files = rendered(folder / "session"), []
    for name in "abc":
        way = [cv2.imread(str(path)) for path in sorted((session / name).glob("*.png"))]
        files.append(str(folder / f"{name}.avi"))
        out = cv2.VideoWriter(files[-1], cv2.VideoWriter.fourcc(*"MJPG"), RATE, SIZE)
        for number in range(int(PATIENCE * RATE)):
            out.write(way[min(number % (2 * len(way) - 2), -number % (2 * len(way) - 2))])
        out.release()
    return files


@pytest.mark.slow
def test_a_waved_board_becomes_a_rig(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "tests.board_session.OFFSETS", (0.0, 0.0, 0.0)
    )  # what goes back is late by what it was early before
    board, out, cameras = tmp_path / "board.toml", tmp_path / "rig.toml", videos(tmp_path)
    write_board(board, BOARD)
    run = started(["calibrate", "cameras", *cameras, "--board", str(board), "-o", str(out), "--limit-mm", "1"])
    page = browser.page(spoken(run).split()[1])
    page.until('parseInt(document.querySelector("#looked")?.textContent) >= 30', timeout=PATIENCE)
    page.until('[...document.querySelectorAll("canvas")].every((each) => each.dataset.drawn)', timeout=PATIENCE)
    assert not page.js('document.querySelector("[data-wish=end]").disabled')
    page.click('footer [data-wish="end"]')
    page.until('document.body.dataset.stage === "passed"', timeout=PATIENCE)
    shown = page.text("#result pre").splitlines()
    told = run.stdout.read().splitlines()
    assert run.wait(PATIENCE) == 0 and told[0] == "PASS"
    assert shown == told[: len(shown)]
    for camera, lens in zip(read_rig(out).rig.cameras, LENSES, strict=True):
        assert camera.matrix[0, 0] == pytest.approx(lens[0], rel=0.03)
    assert all(f'source = "{path}"' in out.read_text() for path in cameras)


def test_stop_stops_and_what_happened_stays_to_be_read(browser: Browser) -> None:
    guide = CoverageGuide(NAMES, (SIZE,) * 3, BOARD)
    with pytest.raises(KeyboardInterrupt), WavingPage(CLOCK) as shown:
        page = browser.page(shown.address)
        tell(shown, page, guide, 0, 'document.body?.dataset.stage === "wave"')
        assert "top left" in page.text("#question")
        page.click('footer [data-wish="stop"]')
        assert wished(shown) is Wish.STOP
        raise KeyboardInterrupt  # as the calibration does, to keep its corners
    page.until('document.body.dataset.stage === "stopped"', timeout=PATIENCE)
    assert page.text("#question") == "Stopped. What was seen is kept."
    assert "the same command goes on" in page.text("#result")
