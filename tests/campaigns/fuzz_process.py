"""One reader before inputs that are valid except in a few places, in a process of its own, which may crash.

Valid input is damaged in one to four places, as broken disks, other programs and hostile people do. The results are
written to a CSV file from which a later run goes on.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
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
from hardware.bench.figures import Figure, append_rows, at_most
from hardware.process.clock import ProcessorClock
from tests.campaigns.verdicts import log_rows

NUMBER_TEXT = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
BAD_VALUES = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e308", b"-1e-320", b"99999999999999999999", b"1.5", b"0x10"),
    *(b"", b"true", b"[]", b"{}", b"[[]]", b'""', b'"x"', b"[1, 2]", b"null", b"\xff\xfe", b"\x00", b"\xef\xbb\xbf"),
    *(b"[" * 400, b"{" * 400, b'{"a":' * 300, b"9" * 5000, b"\n", b",,,,", b"=", b"2026-01-01", b"../../etc/passwd"),
)
EDGE_BYTES = (0x00, 0x01, 0x7F, 0x80, 0xFF, 0x0A)
MAX_PLACES = 4  # that are damaged in one input
MUTATIONS = ("flip", "overwrite", "cut", "delete", "double", "insert", "renumber", "renumber", "shuffle lines")


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The data with one to MAX_PLACES places damaged; rarely it comes out the same."""
    for _ in range(int(rng.integers(1, MAX_PLACES + 1))):
        data = _mutated_once(MUTATIONS[int(rng.integers(len(MUTATIONS)))], data, rng)
    return data


def _mutated_once(mutation: str, data: bytes, rng: np.random.Generator) -> bytes:
    numbers = list(NUMBER_TEXT.finditer(data)) if mutation == "renumber" else []
    if mutation == "flip" and not data:
        return data
    if mutation == "shuffle lines":
        return _shuffled_lines(data, rng)
    if numbers:  # one number, or what looks like one, becomes something else
        number = numbers[int(rng.integers(len(numbers)))]
        return data[: number.start()] + BAD_VALUES[int(rng.integers(len(BAD_VALUES)))] + data[number.end() :]
    start = int(rng.integers(len(data) + (mutation != "flip")))
    match mutation:
        case "flip":
            return data[:start] + bytes([data[start] ^ (1 << int(rng.integers(8)))]) + data[start + 1 :]
        case "overwrite":
            return data[:start] + bytes([EDGE_BYTES[int(rng.integers(len(EDGE_BYTES)))]]) + data[start + 1 :]
        case "cut":
            return data[:start]
        case "delete" | "double":
            end = min(start + int(np.exp(rng.uniform(0, np.log(len(data) + 2)))), len(data))
            return data[:end] + data[start:] if mutation == "double" else data[:start] + data[end:]
        case _:
            return data[:start] + BAD_VALUES[int(rng.integers(len(BAD_VALUES)))] + data[start:]


def _shuffled_lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Two lines change places, or one is doubled, or deleted."""
    lines = data.split(b"\n")
    one, other = rng.integers(len(lines), size=2)
    match int(rng.integers(3)):
        case 0:
            lines[one], lines[other] = lines[other], lines[one]
        case 1:
            lines.insert(int(one), lines[other])
        case _:
            del lines[one]
    return b"\n".join(lines)


MAX_SECONDS = 3.0  # s of processor time for one input
MAX_MEMORY = 1 << 30  # bytes for one input, beyond what the reader's libraries take
HANG_SECONDS = 20  # s of processor time for one input inside a library that handles no signal: the process is ended
BLOCK_INPUTS = 1000  # inputs that are reported together
TRACEBACK_LINES = 3
NUMBER_FILE = ".number"  # the file that holds the number of the input that is being read, 8 bytes


@dataclass(frozen=True, slots=True, eq=False)
class Reader:
    """One reader."""

    struck: str  # the file in the folder that is damaged
    make: Callable[[Path], object]  # writes valid input into a folder
    read: Callable[[Path], object]  # given the damaged file


@dataclass(slots=True)
class Block:
    """What a reader did with some inputs."""

    name: str
    count: int = 0
    refused: int = 0  # with one of our errors
    seconds: float = 0.0  # of processor
    wrong: str = ""  # how the reader failed on the last of them
    number: int = 0  # of that one
    case: bytes = b""  # that one


@dataclass(slots=True)
class ReaderSum:
    """What one reader did so far."""

    count: int = 0  # inputs
    refused: int = 0  # with one of our own errors
    seconds: float = 0.0  # of processor time
    wrong: int = 0  # inputs that failed

    def add(self, block: Block) -> None:
        """Count a block."""
        self.count += block.count
        self.refused += block.refused
        self.seconds += block.seconds
        self.wrong += bool(block.wrong)


def print_failure(block: Block, out: Path | None = None) -> None:
    """Print what failed, if anything. out: the folder in which the input is saved, too."""
    text = ""
    if out is not None:
        file = out / f"{block.name.replace(' ', '_')}_{block.number}.bin"
        file.write_bytes(block.case)
        text = f"; kept as {file}"
    if block.wrong:
        print(f"{block.name}, input {block.number}: {block.wrong}{text}", flush=True)


def fuzz_figures(sums: Sequence[ReaderSum]) -> list[Figure]:
    """The figures of all readers."""
    count, refused = sum(each.count for each in sums), sum(each.refused for each in sums)
    seconds, least = sum(each.seconds for each in sums), min(each.count for each in sums)
    note = f"of {len(sums)} readers, {least} or more each; {refused} refused with one error"
    return [
        Figure("inputs", count, "", None, "", note),
        Figure("inputs that went wrong", sum(each.wrong for each in sums), "", at_most(0)),
        Figure("processor time of an input", 1e6 * seconds / max(count, 1), "us"),
    ]


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
    with _bounded(), (folder / NUMBER_FILE).open("wb", buffering=0) as number_file:
        for number in numbers:
            case = mutated(valid, np.random.default_rng([seed, number]))
            file.write_bytes(case)
            os.pwrite(number_file.fileno(), number.to_bytes(8, "little"), 0)
            block.wrong = _failure(reader, file, block)
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


def _failure(reader: Reader, file: Path, block: Block) -> str:
    """How a reader failed, "" where it accepted or refused the input."""
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


Readers = Callable[[], dict[str, Reader]]  # a function of a module: each process calls it again
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
    """The blocks of the tasks as they are done, `jobs` tasks at a time. A process that an input ends is replaced.

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
    number_file = folder / NUMBER_FILE
    if not number_file.exists() or not number_file.stat().st_size:
        raise StillbedError(f"the process that reads {over.task.name} ended with {code} before its first input")
    number = max(int.from_bytes(number_file.read_bytes(), "little"), rest[0])
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
