"""A live run operated from its page alone: what the buttons say is so, and the bytes that the arm was sent prove it."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, Page, executable

from hardware.clock import WallClock
from hardware.live.prerender import prerender
from tests.live_runs import PATH, SCENARIO, Running, closed, executed, messages

CLOCK = WallClock()
CHROMIUM = executable()
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
SETTLED = 0.3  # s after which what was sent before has been carried out


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Running]:
    (tmp_path / "small.toml").write_text(SCENARIO)
    (tmp_path / "path.csv").write_text(PATH)
    prerender(tmp_path / "small.toml", tmp_path / "stillbed", threads=1)
    simulated, record = str(tmp_path / "small.toml"), str(tmp_path / "run.mcap")
    made = Running("--simulated", simulated, "--record", record, cache=tmp_path)
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
    for _ in range(6):
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


def test_confirmed_started_paused_resumed_and_stopped_from_the_page(
    run: Running, browser: Browser, tmp_path: Path
) -> None:
    end = run.wait_for(r"open http://\S+")
    page = browser.page(run.said[:end].rsplit(" ", 1)[1])
    confirmed = press(page, "confirm", '["ready"]')
    started = press(page, "start", '["homing", "approach", "print"]', sure=True)
    page.until('document.body.dataset.stage === "print"', timeout=60)
    CLOCK.wait_until(CLOCK.now() + 1.0)
    paused = press(page, "pause", '["paused"]')
    CLOCK.wait_until(CLOCK.now() + 1.0)
    pause_ends = CLOCK.now()
    press(page, "resume", '["approach", "print"]')
    page.until('document.body.dataset.stage === "print"', timeout=60)
    CLOCK.wait_until(CLOCK.now() + 1.0)
    stopped = press(page, "stop", '["stopped"]')
    CLOCK.wait_until(CLOCK.now() + 1.0)
    stop_ends = CLOCK.now()
    run.process.terminate()
    run.end()
    record = tmp_path / "run.mcap"
    closed(record)
    moves = moves_sent(record)

    def between(begin: float, end: float) -> int:
        return int(((moves > begin) & (moves < end)).sum())

    assert between(0.0, confirmed) == 0
    assert between(started, paused) > 20
    assert between(paused + SETTLED, pause_ends) == 0
    assert between(pause_ends, stopped) > 20
    assert between(stopped + SETTLED, stop_ends) == 0
    stamps, axes = executed(record)
    still = axes[(stamps > stopped + SETTLED) & (stamps < stop_ends)]
    assert len(still) and np.ptp(still, axis=0).max() < 0.05
