"""One long run of breathing: whether time, memory and error stay what they were."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.synthetic.follow import Mapping, steps
from estimation.synthetic.world import synthetic_world
from hardware.bench.figures import Figure, at_most
from hardware.process.clock import CpuClock, WallClock
from hardware.process.progress import Progress

RATE = 30.0  # Hz
SETTLED = 60.0  # s, after which memory counts: the key frames are full and the libraries warm


def soak_figures(hours: float, mapping: Mapping, of_map: str) -> list[Figure]:
    """Follow breathing for `hours` h of the surface's time."""
    world = synthetic_world(seconds=3600 * hours, rate=RATE)
    count = len(world) - 1
    seconds, errors = np.ones(count), np.ones(count)  # written to, so that they count as memory from the start
    settled, before = min(count // 2, round(SETTLED * RATE)), np.nan
    run = steps(world, mapping, CpuClock().now)
    begun = next(run).pose
    constant = se3.inverse(world.base_from_surface(np.array(begun.stamp))) @ begun.base_from_surface
    with Progress(f"soak, {of_map}", "frame sets", WallClock().now) as progress:
        for k, step in enumerate(run):
            true = world.base_from_surface(np.array(step.pose.stamp)) @ constant
            seconds[k], errors[k] = step.seconds, np.linalg.norm(step.pose.base_from_surface[:3, 3] - true[:3, 3])
            if k == settled:
                before = resident()
            progress(k + 1, count)
    tenth, minute = max(count // 10, 1), min(count, round(60 * RATE))
    slower = float(np.median(seconds[-tenth:]) / np.median(seconds[:tenth]))
    first, last = (float(np.sqrt((part**2).mean())) for part in (errors[:minute], errors[-minute:]))
    name = f"soak {hours:g} h, {of_map}"
    return [
        Figure(f"{name}: time per frame, last tenth by first", slower, "", at_most(1.02), "gtsam #1452", "CPU"),
        Figure(
            f"{name}: memory more", resident() - before, "MB", at_most(5.0), "gtsam #1935", "since its first minute"
        ),
        Figure(f"{name}: error of the first minute", first, "mm", at_most(0.03)),
        Figure(f"{name}: error of the last minute", last, "mm", at_most(1.1 * first), "thesis chains frames"),
    ]


def resident() -> float:
    """Memory that this process holds, MB; nan where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
