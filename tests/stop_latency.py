"""How long a stop takes: `python -m tests.stop_latency [COUNT]`, in a live run without pictures, before Chromium.

Half of the stops are clicked, half come by the space bar. Told are the times from the event in the browser to the frame
on the arm's wire, and to "Stopped" in the next picture of the page; and how busy the machine was.
"""

from __future__ import annotations

import base64
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hardware.arm.protocol import Pause, encode
from tests.browser import Browser, Page, executable
from tests.live_runs import CLOCK, Running, light_runs, messages, summary
from tests.test_live_run import press, prints

COUNT = 50
TARGET_PAGE, TARGET_WIRE = 250.0, 10.0  # ms
CLOCKS_APART = 0.02  # s by which the browser's clock and this one may differ after a minute; stops are a second apart
WATCH = """(() => {
  window.stops = [];
  const asked = (e) => { if (!window.begun) window.begun = performance.now(); };
  document.querySelector('footer [data-wish="stop"]').addEventListener("pointerdown", asked, true);
  window.addEventListener("keydown", (e) => e.key === " " && asked(e), true);
  new MutationObserver(() => {
    if (!window.begun || document.body.dataset.stage !== "stopped") return;
    if (document.getElementById("chip").textContent !== "Stopped") return;
    const begun = window.begun;
    window.begun = 0;
    requestAnimationFrame(() => stops.push([performance.timeOrigin + begun, performance.now() - begun]));
  }).observe(document.body, { attributes: true, childList: true, subtree: true, characterData: true });
  return true;
})()"""


def measure(folder: Path, browser: Browser, count: int) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Times (N,) ms to the page and to the wire, and the run's own figures of a decided stop."""
    record = folder / "run.mcap"
    with light_runs(folder) as start:
        run: Running = start(record, "--page")
        end = run.wait_for(r"open http://\S+")
        page: Page = browser.page(run.said[:end].rsplit(" ", 1)[1])
        press(page, "confirm", '["ready"]')
        press(page, "start", '["homing", "approach", "print"]', sure=True)
        prints(page)
        page.js(WATCH)
        for number in range(count):
            if number % 2:
                page.key("Space", " ")
            else:
                page.click('footer [data-wish="stop"]')
            page.until(f"stops.length === {number + 1}", timeout=30)
            press(page, "resume", '["approach", "print"]', sure=True)
            prints(page)
        stops = np.array(page.js("stops"), float)
        press(page, "end", '["ended"]', sure=True)
        run.end()
    since = time.time() - CLOCK.now()
    sent = [(float(str(m["stamp"])), base64.b64decode(str(m["data"]))) for m in messages(record, "/arm/sent")]
    wire = np.array([stamp for stamp, data in sent if data == encode(Pause())])
    begun = stops[:, 0] / 1000 - since
    return (
        stops[:, 1],
        1000 * (wire[np.searchsorted(wire, begun - CLOCKS_APART)] - begun),
        summary(record)["latency_ms"]["stop decided to on the wire"],
    )


def main(count: int = COUNT) -> int:
    """Measure and tell; 0 where both targets are met."""
    program = executable()
    if program is None:
        print("no Chromium: make browser")
        return 2
    load = os.getloadavg()[0]
    browser = Browser(program)
    try:
        with tempfile.TemporaryDirectory() as folder:
            page, wire, decided = measure(Path(folder), browser, count)
    finally:
        browser.close()
    print(f"{count} stops, load {load:.1f} before and {os.getloadavg()[0]:.1f} after, {os.cpu_count()} cores")
    for name, values, target in (("to Stopped on the page", page, TARGET_PAGE), ("to the wire", wire, TARGET_WIRE)):
        median, high = np.percentile(values, [50, 99])
        print(f"event {name}: median {median:.1f}, 99 % {high:.1f}, largest {values.max():.1f} ms; wanted {target:g}")
    print(f"decided to the wire: 99 % {decided['p99']:.1f}, largest {decided['max']:.1f} ms")
    return int(np.percentile(page, 99) > TARGET_PAGE or decided["p99"] > TARGET_WIRE)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
