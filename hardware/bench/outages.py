"""`stillbed bench outages`: cameras fail in every way before a moving wound; is the tracker ever lost in silence?

Each outage is laid over the pictures of a surface with exact truth, and what the tracking step says is held against it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hardware.bench.campaigns.outages import GOOD, Verdict, judge
from hardware.bench.figures import Figure, at_most
from hardware.bench.outage_page import outage_page
from hardware.bench.outage_run import Watched, make_pictures, run_stretch
from hardware.bench.workers import workers
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.simulator.outage import Kind

SCENE = 64  # outages before one scene, whose pictures take as long to render as ten of them to track
REFERENCE = "FoundationPose #136, #103: the target is lost and nothing says so"

Judged = tuple[Watched, Verdict]


def run(options: argparse.Namespace) -> list[Figure]:
    """Run the campaign, print what came of each kind, and give the figures of all."""
    jobs = shares(options.count, options.processes, options.seed)
    judged = list[Judged]()
    with Progress("outages", "scenes", WallClock().now) as progress, workers(options.processes) as pool:
        for done, part in enumerate(pool.map(_scene, jobs), 1):
            judged += part
            progress(done, len(jobs))
    print(kinds_text([(w.outage.kind, v) for w, v in judged]) + "\n")
    if options.out is not None:
        page: Path = options.out / "outages.html"
        page.write_text(outage_page(judged), encoding="utf-8")
        print(f"pictures: {page}\n")
    return figures([v for _, v in judged])


def shares(count: int, processes: int, seed: int) -> list[tuple[int, list[Kind]]]:
    """Seeds and outages of each scene: kinds in turn, as many scenes as are needed and a multiple of the processes."""
    kinds = [list(Kind)[i % len(Kind)] for i in range(count)]
    scenes = processes * max(1, -(-count // (SCENE * processes)))
    order = np.random.default_rng([seed, 71]).permutation(count)
    parts = [p for p in np.array_split(order, min(scenes, count)) if len(p)]
    return [(100 * seed + i, [kinds[k] for k in part]) for i, part in enumerate(parts)]


def _scene(job: tuple[int, list[Kind]]) -> list[Judged]:
    seed, kinds = job
    return [(w, judge(w)) for w in run_stretch(make_pictures(seed), kinds, seed, GOOD)]


HEADER = (
    "kind",
    "count",
    "silent",
    "beyond",
    "unflagged",
    "flag ms",
    "max",
    "back ms",
    "max",
    "back mm",
    "max",
    "worst",
)


def kinds_text(judged: Sequence[tuple[Kind, Verdict]]) -> str:
    """A line for each kind and one for all; times are median and largest, `worst` the largest error while measured."""
    rows: list[tuple[str, ...]] = [HEADER]
    for kind in Kind:
        mine = [v for k, v in judged if k is kind]
        if mine:
            rows.append(_row(kind.value, mine))
    rows.append(_row("all", [v for _, v in judged]))
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADER))]
    return "\n".join(
        "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    )


def _row(name: str, verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    flagged, back, after, worst = (
        np.array([getattr(v, n) for v in verdicts]) for n in ("flagged", "back", "after", "worst")
    )
    said = flagged[np.isfinite(flagged)]
    came = back[np.isfinite(back)]
    return (
        name,
        str(len(verdicts)),
        str(sum(v.silent for v in verdicts)),
        str(sum(v.beyond for v in verdicts)),
        str(int(np.isinf(flagged).sum())),
        *(_text(1000 * f(said), 0) if len(said) else "-" for f in (np.median, np.max)),
        *(_text(1000 * f(came), 0) if len(came) else "-" for f in (np.median, np.max)),
        _text(np.median(after), 3),
        _text(after.max(), 3),
        _text(worst.max(), 2),
    )


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}"


def figures(verdicts: Sequence[Verdict]) -> list[Figure]:
    """The campaign's figures beside their targets."""
    flagged, back, after = (np.array([getattr(v, name) for v in verdicts]) for name in ("flagged", "back", "after"))
    needed = flagged[~np.isnan(flagged)]
    note = f"of {len(verdicts)} outages"
    late = int((needed > 0.1 + 1e-9).sum())
    slow = int((back > 0.2 + 1e-9).sum())
    return [
        Figure("silent losses", sum(v.silent for v in verdicts), "", at_most(0), REFERENCE, note),
        Figure("errors beyond the claim", sum(v.beyond for v in verdicts), "", at_most(0), "", "in any state but LOST"),
        Figure("flagged after more than 100 ms", late, "", at_most(0), "", f"of {len(needed)} that had to be"),
        Figure("time to the flag, median", 1000 * float(np.median(needed)) if len(needed) else np.nan, "ms"),
        Figure("time to the flag, largest", 1000 * float(needed.max(initial=0.0)), "ms", at_most(100)),
        Figure("back after more than 200 ms", slow, "", at_most(0), "", note),
        Figure("time back, median", 1000 * float(np.median(back)), "ms", None, "", "from the view's return"),
        Figure("time back, largest", 1000 * float(back.max()), "ms", at_most(200), "", "from the view's return"),
        Figure("error once back, median", float(np.median(after)), "mm"),
        Figure("error once back, largest", float(after.max()), "mm", at_most(GOOD), "", "of five points of the wound"),
    ]
