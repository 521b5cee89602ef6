"""One reader before inputs that are valid but for a few places, in a process of its own, which may end of it.

Valid input is made wrong in one to four places, as broken disks, other programs and hostile people do. What came of it
is kept as a CSV file that a later run goes on from.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

import numpy as np

from estimation.errors import InputError, StillbedError
from hardware.bench.figures import append_rows, log_rows
from hardware.process.clock import ProcessorClock

NUMBER_TEXT = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
BAD_VALUES = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e308", b"-1e-320", b"99999999999999999999", b"1.5", b"0x10"),
    *(b"", b"true", b"[]", b"{}", b"[[]]", b'""', b'"x"', b"[1, 2]", b"null", b"\xff\xfe", b"\x00", b"\xef\xbb\xbf"),
    *(b"[" * 400, b"{" * 400, b'{"a":' * 300, b"9" * 5000, b"\n", b",,,,", b"=", b"2026-01-01", b"../../etc/passwd"),
)
EDGE_BYTES = (0x00, 0x01, 0x7F, 0x80, 0xFF, 0x0A)
MAX_PLACES = 4  # places


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with something wrong; it may come out the same, seldom."""
    mutator = _Mutator(rng)
    for _ in range(int(rng.integers(1, MAX_PLACES + 1))):
        data = MUTATIONS[int(rng.integers(len(MUTATIONS)))](mutator, data)
    return data


class _Mutator:
    """Each method makes one place of some data wrong."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def _place(self, data: bytes) -> int:
        return int(self._rng.integers(len(data) + 1))

    def _span(self, data: bytes) -> tuple[int, int]:
        start = self._place(data)
        return start, min(start + int(np.exp(self._rng.uniform(0, np.log(len(data) + 2)))), len(data))

    def _bad_value(self) -> bytes:
        return BAD_VALUES[int(self._rng.integers(len(BAD_VALUES)))]

    def flip(self, data: bytes) -> bytes:
        if not data:
            return data
        at = int(self._rng.integers(len(data)))
        return data[:at] + bytes([data[at] ^ (1 << int(self._rng.integers(8)))]) + data[at + 1 :]

    def overwrite(self, data: bytes) -> bytes:
        at = self._place(data)
        return data[:at] + bytes([EDGE_BYTES[int(self._rng.integers(len(EDGE_BYTES)))]]) + data[at + 1 :]

    def cut(self, data: bytes) -> bytes:
        return data[: self._place(data)]

    def delete(self, data: bytes) -> bytes:
        start, end = self._span(data)
        return data[:start] + data[end:]

    def double(self, data: bytes) -> bytes:
        start, end = self._span(data)
        return data[:end] + data[start:end] + data[end:]

    def insert(self, data: bytes) -> bytes:
        at = self._place(data)
        return data[:at] + self._bad_value() + data[at:]

    def renumber(self, data: bytes) -> bytes:
        """One number, or what looks like one, becomes something else."""
        numbers = list(NUMBER_TEXT.finditer(data))
        if not numbers:
            return self.insert(data)
        one = numbers[int(self._rng.integers(len(numbers)))]
        return data[: one.start()] + self._bad_value() + data[one.end() :]

    def shuffle_lines(self, data: bytes) -> bytes:
        """Two lines change places, or one is there twice, or no more."""
        lines = data.split(b"\n")
        one, other = self._rng.integers(len(lines), size=2)
        match int(self._rng.integers(3)):
            case 0:
                lines[one], lines[other] = lines[other], lines[one]
            case 1:
                lines.insert(int(one), lines[other])
            case _:
                del lines[one]
        return b"\n".join(lines)


_M = _Mutator
MUTATIONS = (_M.flip, _M.overwrite, _M.cut, _M.delete, _M.double, _M.insert, _M.renumber, _M.renumber, _M.shuffle_lines)


MAX_SECONDS, MAX_MEMORY = (
    3.0,
    1 << 30,
)  # of one input: s of processor time, bytes beyond what the reader's libraries take
HANG_SECONDS = (
    20  # s of processor time of one input that is within a library and hears of no signal: the process is ended
)
BLOCK_INPUTS = 1000  # inputs that are told of together
TRACEBACK_LINES = 3  # lines of a traceback
NUMBER_FILE = ".number"  # the file that holds the number of the input that is being read, 8 bytes


@dataclass(frozen=True, slots=True, eq=False)
class Reader:
    """One reader."""

    struck: str  # the file in the folder that is made wrong
    make: Callable[[Path], None]  # writes valid input into a folder
    read: Callable[[Path], object]  # given the file that was struck


@dataclass(slots=True)
class Block:
    """What came of some inputs of a reader."""

    name: str
    count: int = 0
    refused: int = 0  # with one of our errors
    seconds: float = 0.0  # of processor
    wrong: str = ""  # what the reader did that it must not with the last of them
    number: int = 0  # of that one
    case: bytes = b""  # that one


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
    with _bounded(), (folder / NUMBER_FILE).open("wb", buffering=0) as told:
        for number in numbers:
            case = mutated(valid, np.random.default_rng([seed, number]))
            file.write_bytes(case)
            os.pwrite(told.fileno(), number.to_bytes(8, "little"), 0)
            block.wrong = _tried(reader, file, block)
            block.count, block.number = block.count + 1, number
            if block.wrong or block.count == BLOCK_INPUTS or number == numbers[-1]:
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
    resource.setrlimit(resource.RLIMIT_AS, (had + MAX_MEMORY, memory[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, memory)
        resource.setrlimit(resource.RLIMIT_CPU, time)
        signal.signal(signal.SIGPROF, handler)


def _tried(reader: Reader, file: Path, block: Block) -> str:
    """What a reader did that it must not, "" where it took or refused the input."""
    limit = int(ProcessorClock().now()) + HANG_SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
    try:
        reader.read(file)
    except StillbedError:
        block.refused += 1
    except _TooLongError:
        return f"more than {MAX_SECONDS:g} s"
    except Exception as error:
        lines = traceback.extract_tb(error.__traceback__)[-TRACEBACK_LINES:]
        where = " < ".join(f"{Path(line.filename).name}:{line.lineno}" for line in reversed(lines))
        return f"{type(error).__name__}: {str(error)[:120]!r} at {where}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return ""


Readers = Callable[[], dict[str, Reader]]  # a function of a module: a process asks for them again
MEMORY_DISK = Path("/dev/shm")  # inputs are written by the million


@dataclass(frozen=True, slots=True)
class Task:
    """Inputs of a reader, by their numbers."""

    name: str
    numbers: range


@dataclass(slots=True)
class _Running:
    task: Task
    process: BaseProcess
    folder: TemporaryDirectory[str]
    done: int = 0


def run_tasks(tasks: list[Task], seed: int, jobs: int, known: Readers) -> Iterator[Block]:
    """What comes of the tasks, as it comes, `jobs` of them at a time. Where an input ends its process, another goes on.

    StillbedError: a process ended before it had an input.
    """
    left, running = tasks[::-1], dict[Connection, _Running]()
    try:
        while left or running:
            while left and len(running) < jobs:
                answers, one = _started(left.pop(), seed, known)
                running[answers] = one
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                try:
                    block: Block = ready.recv()
                    running[ready].done += block.count
                    yield block
                except EOFError:
                    over = running.pop(ready)
                    over.process.join()
                    rest = over.task.numbers[over.done :]
                    if rest:
                        block = _last(over, known()[over.task.name], rest)
                        left.append(Task(over.task.name, rest[block.count :]))
                        yield block
                    over.folder.cleanup()
    finally:
        for one in running.values():
            one.process.kill()
            one.process.join()
            one.folder.cleanup()


def _started(task: Task, seed: int, known: Readers) -> tuple[Connection, _Running]:
    context = get_context("forkserver")  # which loads all readers once: a process each costs a fork, not seconds
    context.set_forkserver_preload([known.__module__])
    folder = TemporaryDirectory(dir=MEMORY_DISK if os.access(MEMORY_DISK, os.W_OK) else None)
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(task, seed, Path(folder.name), known, theirs), daemon=True)
    process.start()
    theirs.close()
    return ours, _Running(task, process, folder)


def _work(task: Task, seed: int, folder: Path, known: Readers, answers: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one
    with open(os.devnull, "w") as quiet:
        os.dup2(quiet.fileno(), 1)  # what libraries print of broken files is not ours to show
        os.dup2(quiet.fileno(), 2)
    for block in fuzzed(task.name, known()[task.name], task.numbers, seed, folder):
        answers.send(block)


def _last(over: _Running, reader: Reader, rest: range) -> Block:
    """The block whose last input ended the process."""
    folder, code = Path(over.folder.name), over.process.exitcode
    told = folder / NUMBER_FILE
    if not told.exists() or not told.stat().st_size:
        raise StillbedError(f"the process that reads {over.task.name} ended with {code} before its first input")
    number = max(int.from_bytes(told.read_bytes(), "little"), rest[0])
    case = (folder / reader.struck).read_bytes()
    return Block(over.task.name, number - rest[0] + 1, wrong=f"the process ended with {code}", number=number, case=case)


FUZZ_LOG_COLUMNS = ("seed", "reader", "inputs", "refused", "seconds", "number", "wrong")


def append_log(file: Path, seed: int, block: Block) -> None:
    """Add a block to a log, with its header where it is new."""
    row = seed, block.name, block.count, block.refused, f"{block.seconds:.6f}", block.number, block.wrong
    append_rows(file, FUZZ_LOG_COLUMNS, [row])


def read_log(file: Path, seed: int) -> list[Block]:
    """The blocks of a run with this seed; InputError where the file is none of ours."""
    blocks = []
    for line, row in log_rows(file, FUZZ_LOG_COLUMNS):
        try:
            own, count, refused, number = (int(row[name]) for name in ("seed", "inputs", "refused", "number"))
            block = Block(row["reader"], count, refused, float(row["seconds"]), row["wrong"], number)
        except (TypeError, ValueError):
            raise InputError(file, f"line {line}", row, f"{','.join(FUZZ_LOG_COLUMNS)}, in numbers") from None
        if own == seed:
            blocks.append(block)
    return blocks
