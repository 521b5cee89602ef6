"""`stillbed bench fuzz`: every reader of what comes from outside, given inputs that are valid but for a few places.

A reader may take an input or refuse it with one of our own errors. Anything else counts: another exception, more than
`SECONDS` of processor time, more than `MEMORY` of memory, the end of the process. What made it so is kept. `--log`
keeps how far each reader is, and what went wrong; a run goes on from there.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from estimation.errors import InputError
from hardware.bench.campaigns.fuzz import readers
from hardware.bench.campaigns.fuzz_process import Task, run_tasks
from hardware.bench.figures import Figure, at_most
from hardware.bench.fuzz_log import append_log, read_log
from hardware.bench.fuzz_try import Block
from hardware.process.clock import WallClock
from hardware.process.progress import Progress

KEPT = 5  # inputs of each reader that are kept; the others can be made again from their seed and number


@dataclass(slots=True)
class Sum:
    """What came of one reader so far."""

    count: int = 0
    refused: int = 0
    seconds: float = 0.0
    wrong: int = 0

    def add(self, block: Block) -> None:
        """Count a block."""
        self.count += block.count
        self.refused += block.refused
        self.seconds += block.seconds
        self.wrong += bool(block.wrong)


def run(options: argparse.Namespace) -> list[Figure]:
    """Fuzz the readers, in processes of their own, and say what they did."""
    names = list(readers())
    if options.only is not None and options.only not in names:
        raise InputError("command line", "--only", options.only, f"one of {', '.join(names)}")
    for name in ("count", "jobs"):
        if getattr(options, name) < 1:
            raise InputError("command line", f"--{name}", getattr(options, name), ">= 1")
    sums = {name: Sum() for name in names if options.only in (None, name)}
    if options.log is not None and options.log.exists():
        for block in read_log(options.log, options.seed):
            if block.name in sums:
                sums[block.name].add(block)
                _tell(block, "")
    share = -(-options.count // len(sums))
    _go_on(options, sums, [Task(name, range(done.count, share)) for name, done in sums.items() if done.count < share])
    for name, done in sums.items():
        each = 1e6 * done.seconds / max(done.count, 1)
        print(f"{name:<24}{done.count:>9}  refused {done.refused:>9}  wrong {done.wrong:>3}  {each:>7.0f} us each")
    return figures(list(sums.values()))


def _go_on(options: argparse.Namespace, sums: dict[str, Sum], tasks: list[Task]) -> None:
    """Do the tasks; whatever goes wrong is said, kept and logged when it does."""
    done, total = 0, sum(len(task.numbers) for task in tasks)
    with Progress("fuzz", "inputs", WallClock().now) as progress:
        for block in run_tasks(tasks, options.seed, options.jobs, readers):
            sums[block.name].add(block)
            if options.log is not None:
                append_log(options.log, options.seed, block)
            if block.wrong:
                progress.close()
                keep = options.out is not None and sums[block.name].wrong <= KEPT
                _tell(block, _kept(options.out, block) if keep else "")
            done += block.count
            progress(done, total)


def _tell(block: Block, kept: str) -> None:
    if block.wrong:
        print(f"{block.name}, input {block.number}: {block.wrong}{kept}", flush=True)


def _kept(out: Path, block: Block) -> str:
    """Where an input that went wrong is kept, in words."""
    file = out / f"{block.name.replace(' ', '_')}_{block.number}.bin"
    file.write_bytes(block.case)
    return f"; kept as {file}"


def figures(sums: Sequence[Sum]) -> list[Figure]:
    """The figures of all readers."""
    count, refused = sum(each.count for each in sums), sum(each.refused for each in sums)
    seconds, least = sum(each.seconds for each in sums), min(each.count for each in sums)
    note = f"of {len(sums)} readers, {least} or more each; {refused} refused with one error"
    return [
        Figure("inputs", count, "", None, "", note),
        Figure("inputs that went wrong", sum(each.wrong for each in sums), "", at_most(0)),
        Figure("processor time of an input", 1e6 * seconds / max(count, 1), "us"),
    ]
