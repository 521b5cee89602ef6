"""A command is heard of within a second of its start; where it ends sooner, its own words stand alone."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path

import pytest

from hardware.process.progress import FIRST_WORD_DELAY, FirstWord
from tests.slow_cases import slowly

ROOT = Path(__file__).parents[1]
BOUND = 4.0  # s: 0.8 were seen beside five busy processes, where it were 3 to 12 before
LOADED = 60.0  # s
SIMULATED = "data/live/small.toml"
COMMANDS = (
    f"live --simulated {SIMULATED} --record OUT.mcap --no-page",
    *(f"simulate {SIMULATED} -o OUT", "plan --example forearm -o OUT.csv", "doctor", "smooth nothing -o OUT"),
    *("view nothing", "segment nothing -o OUT", "scan nothing -o OUT.ply", "cameras", "bench --quick -o OUT"),
    *(
        "reach data/paths/wound_raster.csv --arm data/arms/s6h4d.toml",
        "calibrate board -o OUT.pdf",
        "track nothing -o OUT",
    ),
)


class Terminal(StringIO):
    def isatty(self) -> bool:
        return True


@contextmanager
def heard(monkeypatch: pytest.MonkeyPatch, error: StringIO) -> Iterator[tuple[StringIO, StringIO]]:
    """Standard output and error of a command that says its first word."""
    output = StringIO()
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setattr(sys, "stderr", error)
    with FirstWord("stillbed x"):
        yield output, error
    assert sys.stdout is output and sys.stderr is error


def until_said(error: StringIO) -> None:
    end = time.monotonic() + 20
    while not error.getvalue() and time.monotonic() < end:
        time.sleep(0.02)


def test_who_is_silent_is_spoken_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with heard(monkeypatch, StringIO()) as (output, error):
        until_said(error)
        print("done")
    assert (output.getvalue(), error.getvalue()) == ("done\n", "stillbed x: loading\n")


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_who_speaks_soon_speaks_alone(monkeypatch: pytest.MonkeyPatch, stream: str) -> None:
    with heard(monkeypatch, StringIO()) as (output, error):
        print("at once", file=getattr(sys, stream))
        time.sleep(1.2 * FIRST_WORD_DELAY)
    assert output.getvalue() + error.getvalue() == "at once\n"


def test_on_a_terminal_the_word_goes_before_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    with heard(monkeypatch, Terminal()) as (_, error):
        until_said(error)
        print("one line", file=sys.stderr)
    assert error.getvalue().endswith("loading\r\x1b[Kone line\n") and error.getvalue().count("\n") == 1


def test_on_a_terminal_nothing_is_left_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with heard(monkeypatch, Terminal()) as (_, error):
        until_said(error)
    assert error.getvalue().endswith("loading\r\x1b[K")


@contextmanager
def started(words: str, folder: Path, error: int) -> Iterator[subprocess.Popen[bytes]]:
    """A command by a process of its own, which is ended; what it says goes to `error`."""
    line = [sys.executable, "-m", "hardware.cli.main", *words.replace("OUT", str(folder / "out")).split()]
    environment = os.environ | {"XDG_CACHE_HOME": str(folder), "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(line, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, stdout=error, stderr=error)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            process.terminate()
        process.wait(LOADED)


@pytest.mark.parametrize("words", [COMMANDS[0], *slowly(*COMMANDS[1:])])
def test_each_command_is_heard_of_within_a_second(words: str, tmp_path: Path) -> None:
    ours, theirs = os.pipe()
    begun = time.monotonic()
    with started(words, tmp_path, theirs):
        os.close(theirs)
        assert os.read(ours, 1) and time.monotonic() - begun < BOUND
    os.close(ours)


def test_an_error_is_one_line_of_a_terminal_however_long_it_loads(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    with started("smooth nothing -o OUT", tmp_path, theirs) as process:
        process.wait(LOADED)
    os.close(theirs)
    said = b""
    with suppress(OSError):  # the end of a terminal
        while part := os.read(ours, 4096):
            said += part
    os.close(ours)
    assert said.count(b"\n") == 1 and b"stillbed: " in said.rpartition(b"\x1b[K")[2] and process.returncode == 2
