"""What processes ask of the system: priority, cores, signals, shared memory; and when and where things are made."""

from __future__ import annotations

import ctypes
import gc
import hashlib
import os
import pickle
import platform
import signal
import struct
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from multiprocessing import parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from select import select
from threading import Thread
from typing import Any, Generic, TypeVar
from zlib import crc32

from estimation.errors import InputError
from hardware.process.clock import utc_now

PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>: which signal the kernel sends when the thread that started this process ends


def signal_at_parents_end(number: int) -> None:
    """Have the kernel send this signal to this process once its parent has ended, however busy either is; 0: none.

    Where the system knows no such thing, nothing happens, and pipes and sentinels alone tell.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number, 0, 0, 0)


def _bound_child(kind: type[BoundProcess], parent: int) -> BoundProcess:
    """What a started process makes first, of what it is sent: before it loads its body and the body's libraries."""
    signal_at_parents_end(signal.SIGKILL)
    if os.getppid() != parent:  # it ended before that
        os._exit(1)
    return kind.__new__(kind)


class BoundProcess(SpawnProcess):
    """A spawned process that the kernel kills once its parent has ended, also while it still loads its libraries.

    It is to be started by a thread that lives as long as it. A body that has to end in order, as one that moves an arm,
    calls `outlive_parent`, and looks at its pipes.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _bound_child, (type(self), os.getpid()), self.__dict__


class BoundContext(SpawnContext):
    """multiprocessing's spawn context, of bound processes, for pools as well."""

    Process = BoundProcess


SPAWN = BoundContext()  # a forked child would have loaded all that its parent has


def outlive_parent() -> None:
    """From now on this bound process ends by itself: its pipes tell it when its parent has ended."""
    signal_at_parents_end(0)


def exit_with_parent() -> None:
    """From now on this process, which multiprocessing started, ends as soon as the one that started it has ended.

    One that is killed says nothing to a process that waits for work from it.
    """
    parent = parent_process()
    assert parent is not None
    sentinel = parent.sentinel
    signal_at_parents_end(signal.SIGKILL)
    if wait([sentinel], 0):
        os._exit(1)

    def exit_after() -> None:
        try:
            wait([sentinel])
        finally:
            os._exit(1)

    Thread(target=exit_after, daemon=True).start()


@contextmanager
def blocked_sigint() -> Iterator[None]:
    """Ctrl-C waits until the block is left; a process that is started in it never sees one."""
    resource_tracker.ensure_running()  # by itself it would start in the block, and let Ctrl-C through again
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


@contextmanager
def handled_signals(handle: Callable[[int], object]) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a closed terminal call `handle` with the signal's number until the block is left."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    previous = [signal.signal(number, lambda number, frame: handle(number)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


REAL_TIME_PRIORITY = 10  # of 1 to 99: above all ordinary work, below the kernel's own
TRACKING_PRIORITY = 5  # of those: the arm's motion goes before the tracking that it waits for
ANSWER_PRIORITY = 2  # of those: whoever answers an operator goes after both
CATCH_UP_PRIORITY = 1  # of those: whoever is behind with what would be lost goes last
NICE_LEVEL = -10  # before all that asked for nothing
NO_PRIORITY = "nothing: an ordinary process"  # what is granted where no priority is


def settle_memory() -> None:
    """Leave what is there by now out of garbage collection: to look through all that is loaded takes 0.1 to 0.3 s."""
    gc.collect()
    gc.freeze()


def ask_for_real_time(priority: int = REAL_TIME_PRIORITY) -> str:
    """Take the best priority that is granted, and leave what is loaded out of garbage collection; what was granted.

    Threads and processes that this thread starts have it as well, unless they `step_back`.
    """
    settle_memory()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return f"real time, priority {priority}"
    except (AttributeError, OSError):
        pass
    return ask_to_go_first()


def ask_to_go_first() -> str:
    """Be served before ordinary processes, which still get their share; what was granted. Children inherit it."""
    try:
        return f"nice {os.nice(NICE_LEVEL)}"
    except OSError:
        return NO_PRIORITY


def answer_first() -> None:
    """Have all threads of a process that does little go before ordinary ones; what it starts is ordinary again."""
    with suppress(AttributeError, OSError):
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        for thread in os.listdir("/proc/self/task"):  # all of them, as each may hold the interpreter's lock
            os.sched_setscheduler(int(thread), policy, os.sched_param(ANSWER_PRIORITY))


def step_back(nice: int = 0) -> None:
    """Work for which nothing waits: this thread is an ordinary one from now on. nice: to be added to its priority."""
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    if nice:
        os.nice(nice)


def catch_up(behind: bool) -> None:
    """This thread goes before ordinary work while it is behind with its own, where the system grants that."""
    with suppress(AttributeError, OSError):
        policy, priority = (os.SCHED_FIFO, CATCH_UP_PRIORITY) if behind else (os.SCHED_OTHER, 0)
        os.sched_setscheduler(0, policy, os.sched_param(priority))


def set_up_process(name: str, cores: Sequence[int] = (), nice: int = 0, outlives: bool = False) -> None:
    """Be a session of one's own, and leave Ctrl-C and a closed terminal to whoever conducts the run.

    A session is a process group that can be killed as one; and Linux shares the processor among sessions first
    (sched_autogroup): niceness counts within one only.

    name: by which ps and top show the process. cores: to run on, all without any. nice: to be added to the priority.
    outlives: whether it ends by itself, in order, once its parent has ended; else the kernel kills it then.
    """
    if outlives:
        outlive_parent()
    with suppress(OSError):
        Path("/proc/self/comm").write_text(f"sb-{name}", encoding="ascii")
        os.setsid()
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    if cores:
        with suppress(OSError, ValueError):
            os.sched_setaffinity(0, cores)
    if nice:
        os.nice(nice)


def take_messages(connection: Connection) -> tuple[list[Any], bool]:
    """The objects that have come, and whether the other end is closed."""
    messages: list[Any] = []
    try:
        while connection.poll():
            messages.append(connection.recv())
    except (EOFError, OSError):
        return messages, True
    return messages, False


def pipe_closed(lifeline: Connection) -> bool:
    """Whether the other end of a pipe on which nothing is ever said was closed."""
    try:
        return lifeline.poll()
    except OSError:
        return True


class Bell:
    """Ends the wait of one process as soon as another has something for it; handed to both when they are started."""

    def __init__(self) -> None:
        self._receiver, self._sender = SPAWN.Pipe(duplex=False)
        for end in (self._receiver, self._sender):
            os.set_blocking(end.fileno(), False)

    def ring(self) -> None:
        """End the wait, or the next one; never waits itself."""
        with suppress(OSError):  # so often rung that there is no room, or nobody is there any more
            os.write(self._sender.fileno(), b"!")

    def wait(self, patience: float) -> None:
        """Wait `patience` s, or until it is rung."""
        if select([self._receiver.fileno()], [], [], max(patience, 0.0))[0]:
            os.read(self._receiver.fileno(), MOST_RINGS)


MOST_RINGS = 2**16  # that a pipe holds

Value = TypeVar("Value")

DEFAULT_CAPACITY = 1 << 20  # bytes: fifty times a pose with its forecast and its warp
MAX_READ_TRIES = 8  # by then the writer would have come twice within each reading, some of them microseconds
_COUNT = struct.Struct("=Q")
_SLOT_HEAD = struct.Struct("=QII")  # count, size, check sum


class SharedLatest(Generic[Value]):
    """The latest value of a stream, in memory that two processes share: one puts, the other gets.

    It is handed to the other process when that is started. Neither side waits. Two slots take turns: one can be read
    while the other is written. A reader that is overtaken sees it by the count and the checksum, and reads the newer.
    """

    def __init__(self, capacity: int = DEFAULT_CAPACITY) -> None:
        self._capacity = capacity
        self._memory: Any = RawArray("B", _COUNT.size + 2 * (_SLOT_HEAD.size + capacity))
        self._read_count, self._value = 0, None

    def put(self, value: Value) -> None:
        """Make `value` the newest; InputError where it is too large."""
        data = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        if len(data) > self._capacity:
            raise InputError("shared memory", "size", len(data), f"at most {self._capacity} bytes")
        memory = memoryview(self._memory).cast("B")
        count = _COUNT.unpack_from(memory)[0] + 1
        start = self._start(count)
        memory[start + _SLOT_HEAD.size : start + _SLOT_HEAD.size + len(data)] = data
        _SLOT_HEAD.pack_into(memory, start, count, len(data), crc32(data))
        _COUNT.pack_into(memory, 0, count)

    def get(self) -> Value | None:
        """The newest value, the very object of the last call if there is no newer one; None before the first."""
        memory = memoryview(self._memory).cast("B")
        for _ in range(MAX_READ_TRIES):
            count = _COUNT.unpack_from(memory)[0]
            if count == self._read_count:
                break
            start = self._start(count)
            written, size, check = _SLOT_HEAD.unpack_from(memory, start)
            data = bytes(memory[start + _SLOT_HEAD.size : start + _SLOT_HEAD.size + min(size, self._capacity)])
            if written == count and crc32(data) == check:
                self._read_count, self._value = count, pickle.loads(data)
                break
        return self._value

    def _start(self, count: int) -> int:
        return _COUNT.size + (count % 2) * (_SLOT_HEAD.size + self._capacity)


SHOWN_DIGITS = 12  # of a hash, in a text for people


@dataclass(frozen=True, slots=True)
class Provenance:
    """What made something.

    inputs: SHA-256 of each file that went in, by its name; "" where the file cannot be read.
    """

    started: str  # UTC, ISO 8601
    version: str  # of stillbed
    commit: str  # of the code, with a + where files differ from it; "" of an installed package
    host: str
    operator: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> dict[str, object]:
        """As part of a summary."""
        return {
            "started_utc": self.started,
            "stillbed": self.version,
            "commit": self.commit,
            "host": self.host,
            "operator": self.operator,
            "inputs_sha256": dict(self.inputs),
        }

    def texts(self) -> dict[str, str]:
        """As the metadata of a recording."""
        own = {key: value for key, value in self.table().items() if isinstance(value, str)}
        return own | {f"sha256 {name}": value for name, value in self.inputs.items()}

    def sentence(self) -> str:
        """As the last line of a report."""
        code = f"stillbed {self.version}" + (f", commit {self.commit}" if self.commit else "")
        operator_text = f" by {self.operator}" if self.operator else ""
        files = ", ".join(f"{name} {value[:SHOWN_DIGITS] or '?'}" for name, value in self.inputs.items())
        return f"{self.started} on {self.host}{operator_text} · {code}" + (f" · SHA-256 of {files}" if files else "")


class _Process:
    """What this process makes things of: stated once, at its start; the files are read when it is first asked for."""

    def __init__(self) -> None:
        self.state_inputs(())

    def state_inputs(self, files: Iterable[Path | None], operator: str = "") -> None:
        """Say of what this process makes things from now on: files, and folders by the files in them; and for whom."""
        self._files = [file for file in files if file is not None]
        self._operator, self._start_time = operator, utc_now()
        self._known: Provenance | None = None

    def provenance(self) -> Provenance:
        """What makes the things that this process makes."""
        if self._known is None:
            inputs: dict[str, str] = {}
            for file in self._files:
                inputs[file.name if file.name not in inputs else str(file)] = file_hash(file)
            started = datetime.fromtimestamp(self._start_time, UTC).isoformat(timespec="seconds")
            host = platform.node()
            self._known = Provenance(started, stillbed_version(), code_commit(), host, self._operator, inputs)
        return self._known


_PROCESS = _Process()
state_inputs, provenance = _PROCESS.state_inputs, _PROCESS.provenance


def file_hash(file: Path) -> str:
    """SHA-256 of a file, or of names and contents of all files in a folder, in order; "" where one is unreadable."""
    digest = hashlib.sha256()
    try:
        for part in sorted(file.rglob("*")) if file.is_dir() else [file]:
            if file.is_dir():
                digest.update(f"{part.relative_to(file).as_posix()}\0".encode())
            if part.is_file():
                with part.open("rb") as stream:
                    hashlib.file_digest(stream, lambda: digest)
    except OSError:
        return ""
    return digest.hexdigest()


def stillbed_version() -> str:
    """The version of the installed package; "" where it is not installed."""
    from importlib.metadata import PackageNotFoundError, version  # a tenth of what a command line loads for its help

    try:
        return version("stillbed")
    except PackageNotFoundError:
        return ""


@cache
def code_commit() -> str:
    """The commit of the code that runs, with a + where files differ from it; "" where it is no clone."""
    here, output = Path(__file__), ""
    tracked, describe = ["ls-files", "--error-unmatch", here.name], ["describe", "--always", "--dirty=+", "--abbrev=12"]
    try:
        for question in (tracked, describe):
            command = ["git", "-C", str(here.parent), *question]
            output = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):  # no git, an installed package, or one inside somebody else's clone
        return ""
    return output
