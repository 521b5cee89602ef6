"""Readers are fuzzed in processes of their own, which may end of it."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory

from estimation.errors import StillbedError
from hardware.bench.fuzz_try import NUMBER, Block, Reader, fuzzed

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
    told = folder / NUMBER
    if not told.exists() or not told.stat().st_size:
        raise StillbedError(f"the process that reads {over.task.name} ended with {code} before its first input")
    number = max(int.from_bytes(told.read_bytes(), "little"), rest[0])
    case = (folder / reader.struck).read_bytes()
    return Block(over.task.name, number - rest[0] + 1, wrong=f"the process ended with {code}", number=number, case=case)
