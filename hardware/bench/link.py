"""`stillbed bench link`: the arm's line with everything going wrong, in virtual and in real time, and the guard."""

from __future__ import annotations

import argparse
import os

import numpy as np

from hardware.arm.profile import ArmProfile
from hardware.bench.campaigns.link import LOSSY, NOTICED, OBEYING, SECONDS, STALLING, Counts, Run
from hardware.bench.figures import Figure, Target, at_most
from hardware.process.clock import WallClock
from hardware.process.progress import Progress

NONE = at_most(0)
FIFO = "a full queue: 4000 ms"  # 200 commands of a tick; the thesis fills it
KINDS = {
    OBEYING: "faults of port and host only",
    STALLING: "the controller stalls up to 600 ms, each 40 s",
    LOSSY: "1 frame in 200 gets a stray byte, the wire is cut each 150 s",
}


def run(options: argparse.Namespace) -> list[Figure]:
    """The figures of all parts that were asked for."""
    figures: list[Figure] = []
    if options.only == "guard":
        options.hours = options.minutes = 0.0
    if options.hours > 0:
        figures += soak_figures(soaked(options.hours, options.seed, options.baud))
    if options.minutes > 0:
        from hardware.bench.campaigns.link_live import live_figures

        figures += live_figures(60 * options.minutes, options.seed, options.busy, not options.ordinary)
    if options.commands > 0:
        from hardware.bench.link_guard import guard_figures

        figures += guard_figures(options.commands, options.seed)
    return figures


def soaked(hours: float, seed: int, baud: int = ArmProfile().baud) -> Counts:
    """What happened in `hours` h of virtual time, in runs of ten minutes that take turns in what goes wrong."""
    counts, runs = Counts(), max(1, round(3600 * hours / SECONDS))
    with Progress("link", "runs of 10 min", WallClock().now) as progress:
        for k in range(runs):
            Run(seed + k, counts, baud).run()
            counts.seconds += SECONDS
            progress(k + 1, runs)
    return counts


def soak_figures(counts: Counts) -> list[Figure]:
    """Figures of the virtual runs."""
    hours = f"{counts.seconds / 3600:.3g} h"
    name = f"virtual {hours}"
    figures = [
        Figure(f"{name}: frames taken", counts.frames, "", note=f"of {counts.ticks} ticks; {counts.held} held"),
        Figure(f"{name}: commands that found the queue full", counts.overflows, "", NONE),
        Figure(f"{name}: frames taken that nobody sent", counts.foreign, "", NONE),
        Figure(f"{name}: noise that reads as an answer", counts.forged, "", None, "", _noise(counts)),
        Figure(f"{name}: frames that the arm refused", counts.refused, "", NONE),
        Figure(f"{name}: most under way, by the model", 1000 * counts.modelled, "ms", at_most(50), FIFO),
        Figure(f"{name}: still moving 55 ms after the last frame", counts.restless, "", NONE, note="an arm that obeys"),
        *_queued(name, counts),
        *_stops(name, counts),
        Figure(f"{name}: underruns", counts.underruns, "", note="each ended at rest"),
        Figure(
            f"{name}: stops by the link itself", counts.faults, "", note=f"the device went {counts.unplugged} times"
        ),
    ]
    return figures


def _noise(counts: Counts) -> str:
    return f"of {counts.strays} stray bytes; there is no check sum, and one answer alone is not believed"


def _queued(name: str, counts: Counts) -> list[Figure]:
    figures = []
    for kind, most in sorted(counts.queued.items()):
        manner = kind.split(",")[0]
        target = at_most(50) if manner == OBEYING else None
        note = f"{KINDS[manner]}; {counts.commands.get(kind, 0)} commands at most"
        figures.append(Figure(f"{name}: most queued, {kind}", 1000 * most, "ms", target, FIFO, note))
    for kind, most in sorted(counts.after.items()):
        target = at_most(50) if kind.endswith("answering") else None
        note = f"of {1000 * NOTICED:.0f} ms or more"
        figures.append(
            Figure(f"{name}: most queued at the end of a stall, {kind}", 1000 * most, "ms", target, "", note)
        )
    return figures


def _stops(name: str, counts: Counts) -> list[Figure]:
    what = f"{name}: stop on the wire after its decision"
    if not counts.stops:
        return [Figure(what, float("nan"), "ms", at_most(10))]
    targets: tuple[tuple[str, float, Target | None], ...] = (("median", 50, None), ("99 %", 99, at_most(10)))
    figures = [
        Figure(f"{what}, {word}", 1000 * float(np.percentile(counts.stops, share)), "ms", target)
        for word, share, target in targets
    ]
    note = f"{len(counts.stops)} stops, and {len(counts.blocked_stops)} before a port that took no bytes"
    return [*figures, Figure(f"{what}, largest", 1000 * max(counts.stops), "ms", note=note)]


def load() -> str:
    """How busy the machine is, in words."""
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
