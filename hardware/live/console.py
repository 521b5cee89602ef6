"""The terminal of a run: keys in, lines out; a terminal that is closed or was never there stops nothing."""

from __future__ import annotations

import os
import sys
import termios
import tty
from contextlib import suppress
from typing import Any

from hardware.operator.shared_state import Wish

KEYS = {
    " ": Wish.STOP,
    "\r": Wish.STOP,
    "\n": Wish.STOP,
    "p": Wish.PAUSE,
    "r": Wish.RESUME,
    "h": Wish.HOME,
    "y": Wish.CONFIRM,
    "s": Wish.START,
    "a": Wish.AGAIN,
    "q": Wish.END,
}
HELP = "space or Enter: STOP   p: pause   r: resume   h: home   y: the path is right   s: start   a: again   q: end"
MOST = 100  # of keys read at once


class Console:
    """Reads single keys and writes lines. file: to wait on, None where there is no terminal."""

    def __init__(self) -> None:
        self.file: int | None = None
        self._before: list[Any] | None = None

    def __enter__(self) -> Console:
        with suppress(OSError, ValueError, termios.error):
            if sys.stdin is not None and os.isatty(sys.stdin.fileno()):
                self._before = termios.tcgetattr(sys.stdin.fileno())
                tty.setcbreak(sys.stdin.fileno())
                self.file = sys.stdin.fileno()
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            with suppress(OSError, ValueError, termios.error):
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)

    def wishes(self) -> list[Wish]:
        """What was asked for; a stop stands alone."""
        assert self.file is not None
        try:
            keys = os.read(self.file, MOST).decode(errors="replace")
        except OSError:
            keys = ""
        if not keys:  # the terminal is gone
            self.file = None
        wishes = [KEYS[key] for key in keys if key in KEYS]
        return [Wish.STOP] if Wish.STOP in wishes else wishes

    def say(self, text: str) -> None:
        """Write a line where people look."""
        with suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)
