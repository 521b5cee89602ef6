"""HTTP as a line: a message is a request, `GET /on?ul_s=2.5` or `POST /switch on=1`, and its answer is the body.

A thread of its own makes the requests one after the other, so that nobody else waits. While one is under way the port
takes nothing, so what waits stays with the driver, where an off overtakes it.
"""

from __future__ import annotations

import http.client
import threading
from urllib.parse import urlsplit

from estimation.errors import InputError
from hardware.arm.driver import UnpluggedError

METHODS = ("GET", "POST", "PUT")
MAX_BODY = 4096  # bytes of an answer that are read


def is_http(url: str) -> bool:
    """Whether a port is reached by HTTP."""
    return url.startswith("http://")


class HttpOpener:
    """Opens the way to one device; there is nothing to lock, and nothing is sent. InputError for no such URL."""

    def __init__(self, url: str, timeout: float) -> None:
        try:
            parts = urlsplit(url)
            self._host, self._number = parts.hostname or "", parts.port or http.client.HTTP_PORT
        except ValueError:
            self._host, parts = "", urlsplit("")
        if not self._host or parts.path not in ("", "/") or parts.query:
            raise InputError("dispenser", "port", url, "http://HOST or http://HOST:PORT; the path is in the messages")
        self._timeout = timeout

    def __call__(self) -> HttpPort:
        """A port; whether the device is there shows with the first request."""
        return HttpPort(self._host, self._number, self._timeout)

    def release(self) -> None:
        """Nothing is held."""


class HttpPort:
    """One request at a time, by a thread that ends with `close`."""

    def __init__(self, host: str, number: int, timeout: float) -> None:
        self._host, self._number, self._timeout = host, number, timeout
        self._change = threading.Condition()
        self._request, self._answers, self._error, self._open = b"", b"", "", True
        threading.Thread(target=self._work, name=f"http {host}", daemon=True).start()

    def write(self, data: bytes) -> int:
        """Take a whole message, or nothing while one is under way. UnpluggedError after one that failed."""
        with self._change:
            self._check()
            if self._request:
                return 0
            self._request = bytes(data)
            self._change.notify()
        return len(data)

    def read(self) -> bytes:
        """The answers that have come, a line end after each. UnpluggedError after a request that failed."""
        with self._change:
            self._check()
            answers, self._answers = self._answers, b""
        return answers

    def waiting(self) -> int:
        """Bytes of the request that is under way."""
        with self._change:
            return len(self._request)

    def close(self) -> None:
        """Make no further request; one under way ends by itself."""
        with self._change:
            self._open = False
            self._change.notify()

    def _check(self) -> None:
        if self._error:
            raise UnpluggedError(self._error)

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._request or not self._open)
                if not self._open:
                    return
                request = self._request
            answer, error = self._ask(request.decode("ascii").strip())
            with self._change:
                self._answers += answer + b"\n"
                self._request, self._error = b"", error

    def _ask(self, text: str) -> tuple[bytes, str]:
        """The body of the answer, and why there is none."""
        method, _, rest = text.partition(" ")
        path, _, body = rest.partition(" ")
        line = http.client.HTTPConnection(self._host, self._number, timeout=self._timeout)
        try:
            line.request(method, path, body or None)
            response = line.getresponse()
            answer = response.read(MAX_BODY)
        except (OSError, http.client.HTTPException, ValueError) as error:
            return b"", f"{text}: {error or type(error).__name__}"
        finally:
            line.close()
        return (answer, "") if response.status // 100 == 2 else (b"", f"{text}: HTTP {response.status}")
