"""`stillbed bench fuzz`: every reader of what comes from outside, given inputs that are valid but for a few places.

A reader may take an input or refuse it with one of our own errors. Anything else counts: another exception, more than
`SECONDS` of processor time, more than `MEMORY` of memory, the end of the process. What made it so is kept.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType

import numpy as np

from estimation.errors import InputError, StillbedError
from hardware.bench.figure import Figure, at_most
from hardware.bench.fuzz_readers import Reader, readers
from hardware.bench.mutate import mutated
from hardware.clock import ProcessorClock, WallClock
from hardware.progress import Progress

SECONDS, MEMORY = 3.0, 1 << 30  # of one input: s of processor time, bytes beyond what the reader's libraries take
KEPT = 5  # inputs of each reader that are kept
SHOWN = 3  # lines of a traceback


@dataclass(slots=True)
class Fuzzed:
    """What came of one reader. wrong: what it did with some inputs, in words; cases: those inputs."""

    name: str
    count: int = 0
    refused: int = 0
    seconds: float = 0.0
    wrong: list[str] = field(default_factory=list)
    cases: list[bytes] = field(default_factory=list)


def run(options: argparse.Namespace) -> list[Figure]:
    """Fuzz the readers, one process each, and say what they did."""
    known = readers()
    if options.only is not None and options.only not in known:
        raise InputError("command line", "--only", options.only, f"one of {', '.join(known)}")
    chosen = {name: each for name, each in known.items() if options.only in (None, name)}
    total = sum(each.weight for each in chosen.values())
    results = []
    with Progress("fuzz", "readers", WallClock().now) as progress:
        for name, each in chosen.items():
            count = max(1, round(options.count * each.weight / total))
            results.append(in_a_process(name, count, options.seed))
            progress(len(results), len(chosen))
    for result in results:
        print(f"{result.name:<24}{result.count:>9}  refused {result.refused:>9}  wrong {len(result.wrong)}")
        for text, case in zip(result.wrong, result.cases, strict=False):
            print(f"  {text}{_kept(options.out, result.name, case)}")
    return figures(results)


def _kept(out: Path | None, name: str, case: bytes) -> str:
    """Where an input that went wrong is kept, in words."""
    if out is None:
        return ""
    file = out / f"{name.replace(' ', '_')}_{abs(hash(case)) % 10**8}.bin"
    file.write_bytes(case)
    return f"; kept as {file}"


def figures(results: list[Fuzzed]) -> list[Figure]:
    """The figures of all readers."""
    count, refused = sum(r.count for r in results), sum(r.refused for r in results)
    seconds = sum(r.seconds for r in results)
    return [
        Figure("inputs", count, "", None, "", f"of {len(results)} readers; {refused} refused with one error"),
        Figure("inputs that went wrong", sum(len(r.wrong) for r in results), "", at_most(0)),
        Figure("processor time of an input", 1e6 * seconds / max(count, 1), "us"),
    ]


def in_a_process(name: str, count: int, seed: int) -> Fuzzed:
    """Fuzz one reader in a process of its own, again from behind an input that ended it."""
    spawn, whole, done = get_context("spawn"), Fuzzed(name), 0
    while done < count:
        with tempfile.TemporaryDirectory() as folder:
            ours, theirs = spawn.Pipe(duplex=False)
            process = spawn.Process(target=_worker, args=(name, done, count, seed, Path(folder), theirs))
            process.start()
            theirs.close()
            part = _received(ours, process.sentinel, name)
            process.join()
            if part is not None:
                _join(whole, part)
                break
            file = Path(folder) / readers()[name].struck
            number = int((Path(folder) / ".number").read_text() or done)
            whole.wrong.append(f"input {number}: the process ended with {process.exitcode}")
            whole.cases.append(file.read_bytes())
            whole.count += number - done + 1
            done = number + 1
    return whole


def _received(ours: Connection, sentinel: int, name: str) -> Fuzzed | None:
    try:
        received: Fuzzed = ours.recv()
    except EOFError:
        return None
    return received


def _join(whole: Fuzzed, part: Fuzzed) -> None:
    whole.count += part.count
    whole.refused += part.refused
    whole.seconds += part.seconds
    whole.wrong += part.wrong
    whole.cases += part.cases


def _worker(name: str, first: int, count: int, seed: int, folder: Path, answer: Connection) -> None:
    with open(os.devnull, "w") as quiet:
        os.dup2(quiet.fileno(), 1)  # what libraries print of broken files is not ours to show
        os.dup2(quiet.fileno(), 2)
    answer.send(fuzzed(name, readers()[name], range(first, count), seed, folder))


def fuzzed(name: str, reader: Reader, numbers: range, seed: int, folder: Path) -> Fuzzed:
    """What a reader does with inputs of some numbers; the last one stands in the empty `folder`, as does its number."""
    reader.make(folder)
    file, clock, result = folder / reader.struck, ProcessorClock(), Fuzzed(name)
    valid = file.read_bytes()
    with suppress(StillbedError):
        reader.read(file)  # loads its libraries
    begun = clock.now()
    with _bounded():
        for number in numbers:
            case = mutated(valid, np.random.default_rng([seed, number]))
            file.write_bytes(case)
            (folder / ".number").write_text(str(number))
            result.count += 1
            if wrong := _tried(reader, file, result):
                result.wrong.append(f"input {number}: {wrong}")
                if len(result.cases) < KEPT:
                    result.cases.append(case)
    result.seconds = clock.now() - begun
    return result


class _TooLongError(BaseException):
    """An input took more than its time."""


def _too_long(number: int, frame: FrameType | None) -> None:
    raise _TooLongError


@contextmanager
def _bounded() -> Iterator[None]:
    """Let this process take so much memory beyond what it has, and a handler end what takes too long."""
    had = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGPROF, _too_long)
    resource.setrlimit(resource.RLIMIT_AS, (had + MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGPROF, handler)


def _tried(reader: Reader, file: Path, result: Fuzzed) -> str:
    """What a reader did that it must not, "" where it took or refused the input."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        reader.read(file)
    except StillbedError:
        result.refused += 1
    except _TooLongError:
        return f"more than {SECONDS:g} s"
    except Exception as error:
        lines = traceback.extract_tb(error.__traceback__)[-SHOWN:]
        where = " < ".join(f"{Path(line.filename).name}:{line.lineno}" for line in reversed(lines))
        return f"{type(error).__name__}: {str(error)[:120]!r} at {where}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return ""
