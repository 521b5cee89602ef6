"""What a command shows and where it writes: progress on stderr, its output folder, and the cache."""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO, cast

from estimation.errors import InputError

ProgressReport = Callable[[int, int], None]  # (done, total); a total of 0 is not known


def no_progress(done: int, total: int) -> None:
    """Show nothing."""


GOOD, DOUBTFUL, BAD = 32, 33, 31  # colours of a terminal: green, yellow, red


def painted(text: str, colour: int, stream: TextIO) -> str:
    """A text in a colour where `stream` is a terminal and nobody has set NO_COLOR (no-color.org)."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not stream.isatty()
    return text if plain else f"\x1b[{colour}m{text}\x1b[0m"


FIRST_WORD_DELAY = 0.5  # s: heard within a second of the start, and what ends sooner says its own word alone


class FirstWord:
    """Says that a command loads where it has said nothing itself for FIRST_WORD_DELAY; a context.

    On a terminal the word goes as soon as the command says something, so that an error stays one line.
    """

    def __init__(self, command: str) -> None:
        self._streams, self._said, self._lock = (sys.stdout, sys.stderr), False, threading.Lock()
        self._watched = [_WatchedStream(stream, self._heard) for stream in self._streams]
        self._timer = threading.Timer(FIRST_WORD_DELAY, self._say, (f"{command}: loading",))
        self._timer.daemon = True

    def __enter__(self) -> FirstWord:
        sys.stdout, sys.stderr = cast(list[TextIO], self._watched)
        self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._heard()

    def _say(self, word: str) -> None:
        stream = self._streams[1]
        with self._lock, suppress(OSError, ValueError):
            if sys.stderr is self._watched[1]:
                self._said = stream.isatty()
                stream.write(f"\r\x1b[K{word}" if self._said else f"{word}\n")
                stream.flush()

    def _heard(self) -> None:
        """The command says something itself, or ends."""
        with self._lock:
            self._timer.cancel()
            for name, stream, watched in zip(("stdout", "stderr"), self._streams, self._watched, strict=True):
                if getattr(sys, name) is watched:
                    setattr(sys, name, stream)
            if self._said:
                self._said = False
                with suppress(OSError, ValueError):
                    self._streams[1].write("\r\x1b[K")
                    self._streams[1].flush()


class _WatchedStream:
    """A text stream that tells before it writes."""

    def __init__(self, stream: TextIO, tell: Callable[[], None]) -> None:
        self._stream, self._tell = stream, tell

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As the stream's."""
        self._tell()
        return self._stream.write(text)


class Progress:
    """Shows how far `what` is, at what rate, and how long the rest will take; call it with (done, total)."""

    def __init__(self, what: str, unit: str, now: Callable[[], float], stream: TextIO | None = None) -> None:
        self._what, self._unit, self._now = what, unit, now
        self._stream = sys.stderr if stream is None else stream
        self._tty = self._stream.isatty()
        self._every = 0.1 if self._tty else 5.0  # s between lines
        self._reported = now()
        self._first: tuple[float, int] | None = None  # when the first report came, and how much was done by then
        self.note = ""  # behind the figures
        self._open = False  # whether an unfinished line stands on the terminal

    def __call__(self, done: int, total: int) -> None:
        """Report, unless the last report was a moment ago and the work is not done."""
        now = self._now()
        if self._first is None:  # what went before was warming up: its time tells nothing about the rest
            self._first = now, done
        if now - self._reported < self._every and done != total:
            return
        self._reported = now
        note = f"; {self.note}" if self.note else ""
        begun, before = self._first
        text = progress_line(self._what, self._unit, done, total, now - begun, before) + note
        width = None
        with suppress(OSError, ValueError):  # a line that breaks would not be replaced by the next
            width = os.get_terminal_size(self._stream.fileno()).columns or None
        self._stream.write(f"\r\x1b[K{text[:width]}" if self._tty else f"{text}\n")
        self._stream.flush()
        self._open = self._tty

    def restart(self) -> None:
        """The same work begins anew, as another pass over it."""
        self._first = None

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


def progress_line(what: str, unit: str, done: int, total: int, elapsed: float, before: int = 0) -> str:
    """One line: `done` of `total`, of which all but the first `before` took `elapsed` s."""
    rate = (done - before) / elapsed if elapsed > 0 else 0.0
    text = f"{what}: {done}" + (f" of {total}" if total else "") + f" {unit}"
    if rate > 0:
        text += f", {rate:.1f}/s"
        if total > done:
            text += f", {duration_text((total - done) / rate)} left"
    return text


def count_text(count: int, noun: str) -> str:
    """A count with its noun: 1 layer, 2 layers."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def duration_text(seconds: float) -> str:
    """Seconds as a person says them: 8 s, 3 min 20 s, 1 h 5 min."""
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    minutes, seconds_left = divmod(total, 60)
    if minutes < 60:
        return f"{minutes} min {seconds_left} s"
    return f"{minutes // 60} h {minutes % 60} min"


BLOCK_TIME = 5.0  # s of a block: a hold is shorter, so that blocks are nearly independent
MIN_BLOCKS = 4  # from which the spread is told
MIN_RATE = 0.02  # s of the path a second: a print that hardly gets on has no end that can be told
QUANTILE = 1.645  # of the normal distribution: 9 times of 10


class TimeLeft:
    """When the path is done, by how it got on so far: s of the path at its own speeds for each second that passed.

    These are summed in blocks of BLOCK_TIME. What is left takes more such blocks; their spread, and that of the mean of
    those seen, give the spread of the time left.
    """

    def __init__(self) -> None:
        self._count, self._sum, self._squares = 0, 0.0, 0.0
        self._time = self._gained = 0.0  # of the block that is not full
        self._last: tuple[float, float] | None = None  # stamp, and s left of the path

    def add(self, now: float, left: float, moves: bool) -> None:
        """What was left of the path at `now`, s. moves: whether the run prints or is held: a pause does not count."""
        if moves and self._last is not None:
            self._time += max(now - self._last[0], 0.0)
            self._gained += max(self._last[1] - left, 0.0)
        self._last = (now, left) if moves else None
        if self._time >= BLOCK_TIME:
            rate = self._gained / self._time
            self._count, self._sum, self._squares = self._count + 1, self._sum + rate, self._squares + rate * rate
            self._time = self._gained = 0.0

    def __call__(self, left: float) -> tuple[float, tuple[float, float] | None]:
        """Seconds until `left`, s of the path, are done, and between which 9 of 10 lie; None of few blocks."""
        if self._count < MIN_BLOCKS:
            return left, None
        mean = max(self._sum / self._count, MIN_RATE)
        variance = max(self._squares - self._sum**2 / self._count, 0.0) / (self._count - 1)
        ahead = max(left / mean / BLOCK_TIME, 1.0)
        off = QUANTILE * math.sqrt(variance * (1 / self._count + 1 / ahead))
        slow = mean - off
        return left / mean, (left / min(mean + off, 1.0), left / slow if slow > MIN_RATE else math.inf)


def fill_standard_streams() -> None:
    """Put the null device where a stream was closed, so that nothing opened later takes its number, here or below."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            file = os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            os.set_inheritable(file, True)
            setattr(sys, name, os.fdopen(file, mode, encoding="utf-8"))


MAX_NAMED_FILES = 20  # files of an interrupted command that are named; more are counted


def prepare_out(out: Path, force: bool) -> None:
    """Make the folder `out`; raises InputError where it is a file, or holds something and `force` is not set."""
    if out.exists() and not out.is_dir():
        raise InputError(out, "--out", "a file", "a folder, new or empty")
    check_new(out, force)
    out.mkdir(parents=True, exist_ok=True)


def check_new(out: Path, force: bool, option: str = "--out", read: Path | None = None) -> None:
    """InputError where `out` holds something and `force` is not set, is `read`, or cannot be written."""
    if read is not None:
        check_apart(option, out, read)
    if out.is_dir() and any(out.iterdir()) and not force:
        raise InputError(out, option, "a folder that is not empty", "a new or empty one, or --force")
    if out.exists() and not out.is_dir() and not force:
        raise InputError(out, option, "a file that exists", "a new one, or --force")
    _check_writable(out, option)


def _check_writable(out: Path, option: str) -> None:
    """InputError where nothing can be created in the folder of `out`, before the work whose result would be lost."""
    from tempfile import TemporaryFile  # its imports are slow, and help needs none of them

    folder = next(each for each in (out, *out.absolute().parents) if each.is_dir())
    try:
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(folder, option, str(error.strerror).lower(), "a folder that can be written to") from None


def check_apart(option: str, written: Path, read: Path) -> None:
    """InputError where a file or folder of results is the one that is read, which they would overwrite."""
    if written.exists() and read.exists() and written.samefile(read):
        raise InputError(written, option, "what is read, and would be overwritten", "another one")


def left_files_text(out: Path | None) -> str:
    """What an interrupted command left behind, for a person. out: None where it writes nothing."""
    if out is None:
        return "nothing was to be written"
    if out.is_dir():
        names = sorted(file.name for file in out.iterdir())
        if len(names) > MAX_NAMED_FILES:
            return f"kept in {out}: {len(names)} files"
        return f"kept in {out}: {', '.join(names)}" if names else f"nothing was written to {out}"
    if out.suffix == ".csv" and out.exists():
        return f"kept {out}, whole, and what stands beside it"
    if out.suffix == ".mcap" and out.exists():
        return f"kept {out}, readable up to its last whole chunk"
    return f"kept {out}" if out.exists() else "nothing was written"


def write_error_text(error: Exception, out: Path | None) -> str:
    """An error of the system that names no file, as of a full disk: where it struck, and what is left there."""
    reason = str(getattr(error, "strerror", None) or error).lower()
    if out is None:
        return reason
    hint = ", of which what was written last may end early" if out.is_dir() and any(out.iterdir()) else ""
    return f"{out}: {reason}; {left_files_text(out)}{hint}"


def write_atomically(file: Path, contents: str | Callable[[Path], object]) -> None:
    """Write a file under another name first, then rename it: there is never half of one.

    contents: its text, or a function that writes the file whose path it is given.
    """
    part = file.with_name(file.name + ".part")
    try:
        if isinstance(contents, str):
            part.write_text(contents, encoding="utf-8")
        else:
            contents(part)
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Where it is, as the XDG rules have it; it may not be there yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stillbed"


CACHE_VERSION = "5"  # of what the cache holds: another one is rendered anew


def content_of(file: Path) -> bytes:
    """The bytes of a scenario and of all files that it names, each after its length.

    Files that cannot be read are left out: whoever renders the scenario says so.
    """
    import tomllib  # which a command line does not need for its help

    parts = [file.read_bytes()]
    with suppress(ValueError):
        for name in _texts(tomllib.loads(parts[0].decode("utf-8-sig"))):
            with suppress(OSError, ValueError):  # most texts name no file
                parts.append((file.parent / name).read_bytes())
    return b"".join(b"%d " % len(part) + part for part in parts)


def _texts(value: object) -> Iterator[str]:
    """All texts in a table, in its order."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _texts(each)


class PrerenderedSession:
    """A pre-rendered session in its cache folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.session = folder / "session.mcap"  # pictures, with exact truth
        self.path = folder / "path.csv"  # checkpoints in the true surface frame
        self.arm = folder / "arm.toml"  # what the motion knows of the arm

    @property
    def ready(self) -> bool:
        """Whether it is there, whole."""
        return (self.folder / "scenario").exists()


def cached(file: Path, cache: Path, seconds: float | None = None) -> PrerenderedSession:
    """Where the session of a scenario lies or will lie; another text of it, or of what it names, is another folder.

    seconds: of its beginning, None for all of it.
    """
    import hashlib  # which a command line does not need for its help, nor shutil and subprocess below

    text = content_of(file) + CACHE_VERSION.encode() + (b"" if seconds is None else f"{seconds:g} s".encode())
    return PrerenderedSession(cache / f"{file.stem}-{hashlib.sha256(text).hexdigest()[:12]}")


UNFINISHED = ".part-"  # in the name of a folder that is being written, before the number of its process


def folder_size(folder: Path) -> int:
    """Bytes of all files in it."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def size_text(size: int) -> str:
    """Bytes as a person says them."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def clear_unfinished(cache: Path) -> None:
    """Remove from a cache what a process that is gone has left unfinished."""
    import shutil

    for half in cache.glob(f"*{UNFINISHED}*"):
        number = half.name.rpartition(UNFINISHED)[2]
        if not (number.isdigit() and Path(f"/proc/{number}").exists()):
            shutil.rmtree(half, ignore_errors=True)


def clear_cache(cache: Path) -> tuple[int, int]:
    """Remove all rendered scenes from a cache; how many there were, and their bytes."""
    import shutil

    scenes = [folder for folder in cache.glob("*") if (folder / "scenario").is_file()]
    size = sum(map(folder_size, scenes))
    for folder in scenes:
        shutil.rmtree(folder, ignore_errors=True)
    clear_unfinished(cache)
    return len(scenes), size


def cache_error(folder: Path, error: OSError) -> InputError:
    """The error about a cache that could not be written."""
    from hardware.process.checks import error_text  # loads numpy, which a command line does not need for its help

    return InputError(folder, "cache", error_text(error), "one that can be written: set XDG_CACHE_HOME")
