"""python -m tests.campaigns.deceit: runs the campaign or some of its sessions.

Exit code 1 where one that can be decided is silently wrong.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy, as the command line does

import argparse
import multiprocessing
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import cv2

from tests.campaigns.deceit.judge import Verdict, run
from tests.campaigns.deceit.kinds import NAMES, make_session
from tests.campaigns.deceit.report import row, shown_sets, table, write_rows, write_sheets

DEFAULT_COUNT = 200
SIZES = {"large": (640, 480), "small": (480, 360)}


def run_one(seed: int, size: tuple[int, int], sheets: bool, index: int) -> tuple[Verdict, float]:
    """One session, and the seconds that it took."""
    cv2.setNumThreads(1)
    start = time.perf_counter()
    session = make_session(seed, index, size)
    verdict = run(session, shown_sets(session) if sheets else ())
    return verdict, time.perf_counter() - start


def run_all(indices: list[int], jobs: int, one: partial[tuple[Verdict, float]]) -> Iterator[tuple[Verdict, float]]:
    """The sessions as they are ready."""
    if jobs == 1:
        yield from map(one, indices)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for done in as_completed([pool.submit(one, i) for i in indices]):
            yield done.result()


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser("tests.campaigns.deceit", description=__doc__)
    parser.add_argument("--count", type=int, default=DEFAULT_COUNT, help="sessions of the campaign")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--kind", action="append", choices=NAMES, help="only this kind; may be given again")
    parser.add_argument("--index", type=int, action="append", help="only this session; may be given again")
    parser.add_argument("--size", choices=SIZES, default="large", help="of the pictures")
    parser.add_argument("--sheets", action="store_true", help="write a contact sheet a kind")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/deceit"))
    options = parser.parse_args()
    indices = [i for i in range(options.count) if not options.kind or NAMES[i % len(NAMES)] in options.kind]
    indices = options.index or indices
    one = partial(run_one, options.seed, SIZES[options.size], options.sheets)
    verdicts, spent = [], 0.0
    options.out.mkdir(parents=True, exist_ok=True)
    for verdict, seconds in run_all(indices, options.jobs, one):
        verdicts.append(verdict)
        spent += seconds
        found = row(verdict)
        text = f"{found['kind']} ({found['what']}): wrong {found['wrong']}, {found['worst_mm']} mm, {verdict.states}"
        print(f"{len(verdicts)}/{len(indices)} #{verdict.index} {seconds:.1f} s {text}", file=sys.stderr, flush=True)
        write_rows(options.out / "sessions.csv", verdicts)
    text = table(verdicts)
    (options.out / "table.md").write_text(text)
    if options.sheets:
        write_sheets(options.out / "sheets", verdicts)
    print(f"{text}\n{spent / len(verdicts):.1f} s a session; rows: {options.out / 'sessions.csv'}")
    return int(any(v.wrong and v.decidable for v in verdicts))


if __name__ == "__main__":
    sys.exit(main())
