"""A headless Chromium, driven by its own DevTools protocol: clicks and keys as a person gives them."""

from __future__ import annotations

import asyncio
import base64
import importlib.util
import itertools
import json
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, TypeVar

import aiohttp
import pytest

# The shell first: it has no windows of its own to draw, which cost a second of processor time a page.
NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-extensions",
    "--disable-component-update", "--disable-default-apps", "--disable-sync", "--no-first-run", "--mute-audio",
    "--disable-dev-shm-usage", "--hide-scrollbars", "--renderer-process-limit=2", "--remote-debugging-port=0",
)  # fmt: skip
T = TypeVar("T")


def executable() -> str | None:
    """Where a Chromium is, None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One browser; `page` opens a window of it."""

    def __init__(self, program: str) -> None:
        self._folder = tempfile.mkdtemp(prefix="chromium")
        command = [program, *FLAGS, f"--user-data-dir={self._folder}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self.wait(self._connect())

    def wait(self, work: Coroutine[Any, Any, T], timeout: float = 90.0) -> T:
        """The result of some work in the browser's loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(timeout)

    async def _connect(self) -> None:
        port = Path(self._folder, "DevToolsActivePort")
        for _ in range(600):
            if port.exists() and len(lines := port.read_text().split()) == 2:
                break
            await asyncio.sleep(0.05)
        self._session = aiohttp.ClientSession()
        self._socket = await self._session.ws_connect(f"http://127.0.0.1:{lines[0]}{lines[1]}", max_msg_size=0)
        self._hearing = asyncio.create_task(self._hear())

    async def _hear(self) -> None:
        async for message in self._socket:
            said = json.loads(message.data)
            if (future := self._waiting.pop(said.get("id", 0), None)) and not future.done():
                future.set_result(said)

    async def _tell(self, method: str, session: str | None, arguments: dict[str, Any]) -> dict[str, Any]:
        number = next(self._numbers)
        self._waiting[number] = asyncio.get_running_loop().create_future()
        whom = {} if session is None else {"sessionId": session}
        await self._socket.send_json({"id": number, "method": method, "params": arguments, **whom})
        said = await self._waiting[number]
        if "error" in said:
            raise RuntimeError(f"{method}: {said['error']}")
        return dict(said["result"])

    def tell(self, method: str, session: str | None = None, **arguments: Any) -> dict[str, Any]:
        """One command of the protocol."""
        return self.wait(self._tell(method, session, arguments))

    def page(self, address: str, size: tuple[int, int] = (1024, 768)) -> Page:
        """A new window of a size in px, at an address."""
        target = self.tell("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        session = self.tell("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, session, target)
        page.resize(*size)
        page.go(address)
        return page

    def close(self) -> None:
        """End it, and leave nothing behind."""
        self._process.terminate()
        self._process.wait(10)
        self.wait(self._session.close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        shutil.rmtree(self._folder, ignore_errors=True)


class Page:
    """One window."""

    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self._browser, self._session, self._target = browser, session, target

    def _tell(self, method: str, **arguments: Any) -> dict[str, Any]:
        return self._browser.tell(method, self._session, **arguments)

    def resize(self, width: int, height: int) -> None:
        self._tell("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def go(self, address: str) -> None:
        self._tell("Page.navigate", url=address)

    def reload(self) -> None:
        """Load it anew, and wait until nothing of what it was is left to be asked."""
        self.js("window.before = true")
        self._tell("Page.reload")
        self.until("!window.before")

    def js(self, expression: str) -> Any:
        """Value of an expression in the page, awaited where it is a promise."""
        said = self._tell("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in said:
            raise RuntimeError(said["exceptionDetails"].get("exception", {}).get("description", said))
        return said["result"].get("value")

    def until(self, expression: str, timeout: float = 10.0) -> Any:
        """Wait until an expression is true, and give its value."""
        end, value = time.monotonic() + timeout, None
        while time.monotonic() < end:
            try:
                if value := self.js(expression):
                    return value
            except RuntimeError:  # between two documents
                pass
            time.sleep(0.03)
        raise AssertionError(f"never true: {expression}; last {value!r}; page: {self.js('document.body.innerText')!r}")

    def text(self, selector: str) -> str:
        return str(self.js(f"document.querySelector({json.dumps(selector)}).textContent"))

    def click(self, selector: str) -> None:
        """Press in the middle of what a selector finds, whatever lies on top of it there."""
        place = self.js(
            f"(() => {{ const r = document.querySelector({json.dumps(selector)}).getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        self.press(*place)

    def press(self, x: float, y: float) -> None:
        """Press at a place in the window, px."""
        for kind in ("mousePressed", "mouseReleased"):
            self._tell("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag_finger(self, begin: tuple[float, float], end: tuple[float, float], steps: int = 2) -> None:
        """Put a finger down at a place in the window, px, move it evenly to another one and lift it there."""
        way = [tuple(b + (e - b) * k / steps for b, e in zip(begin, end, strict=True)) for k in range(steps + 1)]
        for k, (x, y) in enumerate(way):
            kind = "touchMove" if k else "touchStart"
            self._tell("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": float(x), "y": float(y)}])
        self._tell("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def key(self, code: str, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self._tell("Input.dispatchKeyEvent", type=kind, code=code, key=key, text=key if len(key) == 1 else "")

    def shot(self) -> bytes:
        """What it looks like, as PNG."""
        return base64.b64decode(self._tell("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        self._browser.tell("Target.closeTarget", targetId=self._target)


def axe_source() -> str:
    """axe-core's script, as a package of the extra [dev] brings it; skips without."""
    found = importlib.util.find_spec("axe_core_python")
    if found is None or found.origin is None:
        pytest.skip("no axe-core to judge pages by; it comes with the extra [dev]: pip install -e .[dev]")
    return (Path(found.origin).parent / "axe.min.js").read_text(encoding="utf-8")


def axe_findings(page: Page) -> list[str]:
    """What axe-core finds to be serious or critical on a page that is open."""
    page.js(axe_source() + ";0")
    found = page.js(
        """axe.run(document, { resultTypes: ["violations"] }).then((r) => r.violations
        .filter((v) => ["serious", "critical"].includes(v.impact))
        .flatMap((v) => v.nodes.map((n) => `${v.id}: ${n.target.join(" ")}: ${n.failureSummary}`)))"""
    )
    return list(found)
