"""One reader, given inputs that are valid but for a few places: what it does with each."""

from __future__ import annotations

import os
import resource
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np

from estimation.errors import StillbedError
from hardware.bench.mutate import mutated
from hardware.process.clock import ProcessorClock

SECONDS, MEMORY = 3.0, 1 << 30  # of one input: s of processor time, bytes beyond what the reader's libraries take
HANG = 20  # s of processor time of one input that is within a library and hears of no signal: the process is ended
BLOCK = 1000  # inputs that are told of together
SHOWN = 3  # lines of a traceback
NUMBER = ".number"  # the file that holds the number of the input that is being read, 8 bytes


@dataclass(frozen=True, slots=True, eq=False)
class Reader:
    """One reader. make: writes valid input into a folder. struck: the file in it that is made wrong. read: the reader,
    given that file.
    """

    struck: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]


@dataclass(slots=True)
class Block:
    """What came of some inputs of a reader. count: how many. refused: with one of our errors. seconds: of processor.

    wrong: what the reader did that it must not with the last of them, whose number is `number` and which is `case`.
    """

    name: str
    count: int = 0
    refused: int = 0
    seconds: float = 0.0
    wrong: str = ""
    number: int = 0
    case: bytes = b""


def fuzzed(name: str, reader: Reader, numbers: range, seed: int, folder: Path) -> Iterator[Block]:
    """What a reader does with inputs of some numbers, block by block; one that goes wrong ends its block.

    The input that is being read stands in the empty `folder`, as does its number.
    """
    reader.make(folder)
    file, clock = folder / reader.struck, ProcessorClock()
    valid = file.read_bytes()
    with suppress(StillbedError):
        reader.read(file)  # loads its libraries
    block, begun = Block(name), clock.now()
    with _bounded(), (folder / NUMBER).open("wb", buffering=0) as told:
        for number in numbers:
            case = mutated(valid, np.random.default_rng([seed, number]))
            file.write_bytes(case)
            os.pwrite(told.fileno(), number.to_bytes(8, "little"), 0)
            block.wrong = _tried(reader, file, block)
            block.count, block.number = block.count + 1, number
            if block.wrong or block.count == BLOCK or number == numbers[-1]:
                block.seconds, block.case = clock.now() - begun, case if block.wrong else b""
                yield block
                block, begun = Block(name), clock.now()


class _TooLongError(BaseException):
    """An input took more than its time."""


def _too_long(number: int, frame: FrameType | None) -> None:
    raise _TooLongError


@contextmanager
def _bounded() -> Iterator[None]:
    """Let this process take so much memory beyond what it has, and a handler end what takes too long."""
    had = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    memory, time = resource.getrlimit(resource.RLIMIT_AS), resource.getrlimit(resource.RLIMIT_CPU)
    handler = signal.signal(signal.SIGPROF, _too_long)
    resource.setrlimit(resource.RLIMIT_AS, (had + MEMORY, memory[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, memory)
        resource.setrlimit(resource.RLIMIT_CPU, time)
        signal.signal(signal.SIGPROF, handler)


def _tried(reader: Reader, file: Path, block: Block) -> str:
    """What a reader did that it must not, "" where it took or refused the input."""
    limit = int(ProcessorClock().now()) + HANG
    resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        reader.read(file)
    except StillbedError:
        block.refused += 1
    except _TooLongError:
        return f"more than {SECONDS:g} s"
    except Exception as error:
        lines = traceback.extract_tb(error.__traceback__)[-SHOWN:]
        where = " < ".join(f"{Path(line.filename).name}:{line.lineno}" for line in reversed(lines))
        return f"{type(error).__name__}: {str(error)[:120]!r} at {where}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return ""
