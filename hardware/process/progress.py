"""Progress of long work on stderr: one updating line on a terminal, a line every few seconds otherwise."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TextIO

Report = Callable[[int, int], None]  # (done, total); a total of 0 is not known


def silent(done: int, total: int) -> None:
    """Report nothing."""


class Progress:
    """Says how far `what` is, at what rate, and how long the rest will take; call it with (done, total)."""

    def __init__(self, what: str, unit: str, now: Callable[[], float], stream: TextIO | None = None) -> None:
        self._what, self._unit, self._now = what, unit, now
        self._stream = sys.stderr if stream is None else stream
        self._tty = self._stream.isatty()
        self._every = 0.1 if self._tty else 5.0  # s between lines
        self._start = now()
        self._said = self._start
        self.note = ""  # said behind the figures
        self._open = False  # whether an unfinished line stands on the terminal

    def __call__(self, done: int, total: int) -> None:
        """Say it, unless something was said a moment ago and the work is not done."""
        now = self._now()
        if now - self._said < self._every and done != total:
            return
        self._said = now
        text = line(self._what, self._unit, done, total, now - self._start) + (f"; {self.note}" if self.note else "")
        if self._tty:
            self._stream.write(f"\r\x1b[K{text}")
        else:
            self._stream.write(text + "\n")
        self._stream.flush()
        self._open = self._tty

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the line that stands on the terminal."""
        if self._open:
            self._stream.write("\n")
            self._stream.flush()
            self._open = False


def line(what: str, unit: str, done: int, total: int, elapsed: float) -> str:
    """One line: `done` of `total` after `elapsed` s."""
    rate = done / elapsed if elapsed > 0 else 0.0
    text = f"{what}: {done}" + (f" of {total}" if total else "") + f" {unit}"
    if rate > 0:
        text += f", {rate:.1f}/s"
        if total > done:
            text += f", {duration((total - done) / rate)} left"
    return text


def counted(count: int, noun: str) -> str:
    """So many of what is counted: 1 layer, 2 layers."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """Seconds as a person says them: 8 s, 3 min 20 s, 1 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
