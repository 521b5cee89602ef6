"""A live run operated from its page alone: what the buttons say is so, and the bytes that the arm was sent prove it."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, Page, executable

from hardware.process.clock import WallClock
from tests.light_live import HOME, prepare_files
from tests.live_runs import Running, closed, executed, messages

CLOCK = WallClock()
CHROMIUM = executable()
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
SETTLED = 0.3  # s after which what was sent before has been carried out
RETREATED = 2.0  # s after which the nozzle stands above the surface in a pause


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Running]:
    prepare_files(tmp_path)
    made = Running("--page", cache=tmp_path, program=("tests.light_live", str(tmp_path), str(tmp_path / "run.mcap")))
    yield made
    made.close()


@pytest.fixture
def browser() -> Iterator[Browser]:
    assert CHROMIUM is not None
    made = Browser(CHROMIUM)
    yield made
    made.close()


def press(page: Page, wish: str, leads_to: str, sure: bool = False) -> float:
    """Press a button, and again if a busy machine let the page look old at that moment; when it was followed, s."""
    button = f'footer [data-wish="{wish}"]'
    for attempt in range(6):
        if attempt and page.js(f'{leads_to}.includes(document.body.dataset.stage + "")'):
            return CLOCK.now()
        page.until(f"document.querySelector('{button}') && !document.querySelector('{button}').disabled", timeout=60)
        page.js("new Promise((done) => setTimeout(done, 750))")
        page.click(button)
        if sure and page.js('!document.getElementById("sure").hidden'):
            page.click("#sure-yes")
        try:
            page.until(f'{leads_to}.includes(document.body.dataset.stage + "")', timeout=4)
            return CLOCK.now()
        except AssertionError:
            continue
    raise AssertionError(f"{wish} led to nothing: {page.js('document.body.innerText')}")


def moves_sent(record: Path) -> np.ndarray:
    """Stamps (N,), s, of the moves that went to the arm."""
    sent = messages(record, "/arm/sent")
    return np.array([float(str(m["stamp"])) for m in sent if base64.b64decode(str(m["data"]))[1:2] == b"1"])


def test_every_button_does_what_it_says_and_the_end_is_told(run: Running, browser: Browser, tmp_path: Path) -> None:
    end = run.wait_for(r"open http://\S+")
    page = browser.page(run.said[:end].rsplit(" ", 1)[1])
    confirmed = press(page, "confirm", '["ready"]')
    started = press(page, "start", '["homing", "approach", "print"]', sure=True)
    prints(page)
    paused = press(page, "pause", '["paused"]')
    pause_ends = later(RETREATED + 1.0)
    press(page, "resume", '["approach", "print"]')
    prints(page)
    homing = press(page, "home", '["homing", "stopped"]', sure=True)
    page.until('document.body.dataset.stage === "stopped"', timeout=60)
    home = CLOCK.now()
    home_ends = later(0.5)
    press(page, "resume", '["approach", "print"]', sure=True)
    prints(page)
    stopped = press(page, "stop", '["stopped"]')
    stop_ends = later(1.0)
    press(page, "resume", '["approach", "print"]', sure=True)
    prints(page)
    ended = press(page, "end", '["ended"]', sure=True)
    page.until('document.body.dataset.news === "gone"', timeout=60)
    assert page.text("#chip") == "Finished" and "by the operator" in page.text("#reason")
    assert run.end() == 1 and "\nended by the operator\n" in run.said
    record = tmp_path / "run.mcap"
    closed(record)
    moves = moves_sent(record)

    def between(begin: float, end: float) -> int:
        return int(((moves > begin) & (moves < end)).sum())

    assert between(0.0, confirmed) == 0
    assert between(started, paused) > 20
    assert between(paused + RETREATED, pause_ends) == 0
    assert between(pause_ends, homing) > 20
    assert between(homing, home) > 5 and between(home + SETTLED, home_ends) == 0
    assert between(home_ends, stopped) > 20
    assert between(stopped + SETTLED, stop_ends) == 0
    assert between(stop_ends, ended) > 20 and between(ended + SETTLED, np.inf) == 0
    stamps, axes = executed(record)
    for begin, end in ((stopped, stop_ends), (home, home_ends), (ended, np.inf)):
        still = axes[(stamps > begin + SETTLED) & (stamps < end)]
        assert not len(still) or np.ptp(still, axis=0).max() < 0.05
    waits = axes[(stamps > paused + RETREATED) & (stamps < pause_ends)]
    printing = axes[(stamps > paused - 0.3) & (stamps < paused)]
    assert waits[:, 2].min() > printing[:, 2].max() + 5.0
    at_home = axes[(stamps > home + SETTLED) & (stamps < home_ends)]
    assert np.abs(at_home[:, 2] - HOME).max() < 0.1


def prints(page: Page) -> None:
    page.until('document.body.dataset.stage === "print"', timeout=60)
    later(0.8)


def later(seconds: float) -> float:
    """Wait; the instant, s."""
    CLOCK.wait_until(CLOCK.now() + seconds)
    return CLOCK.now()
