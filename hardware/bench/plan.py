"""`stillbed bench plan`: a whole plan of a large wound, from a damaged mesh in memory to the path: time, memory, fit.

Each plan is made in a process of its own, whose peak memory is its own too. The time is of the processor, from the
mesh's arrays to the path: the scan's making and the writing of files are not in it, and imports are told beside it.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from dataclasses import dataclass

import numpy as np

from estimation.errors import StillbedError
from estimation.scan import Index
from estimation.se3 import Array
from hardware.bench.figures import Figure, at_least, at_most
from hardware.process.clock import ProcessorClock

SIZE, DEPTH = (60.0, 40.0), 4.0  # mm; with the bed's unevenness 6 mm deep at the deepest
SCAN_STEP = 1.0  # mm between the vertices of a scan, as handheld scanners give them
BEAD = 0.4  # mm
DAMAGE = 0.01  # share of the triangles that are turned over, and of those that are missing
PATTERNS = ("zigzag", "hybrid", "contour")
MODES = ("skin", "conformal", "horizontal")
REFERENCE = "none"


@dataclass(frozen=True, slots=True)
class Measured:
    """What one process told. seconds: of the processor. memory: MB at the peak. depth: mm. filled: volume of the beads
    over that of the wound."""

    imports: float
    seconds: float
    memory: float
    checkpoints: int
    layers: int
    depth: float
    filled: float
    covered: float
    double: float


def run(options: argparse.Namespace) -> list[Figure]:
    """Plans of one wound by pattern and by way of layering."""
    cases = [(pattern, "skin") for pattern in PATTERNS] + [("hybrid", mode) for mode in MODES[1:]]
    return [figure for pattern, mode in cases for figure in _figures(options.body, pattern, mode)]


def _figures(kind: str, pattern: str, mode: str) -> list[Figure]:
    name = f"{pattern}, layers {mode}"
    m = measured_apart(kind, pattern, mode)
    note = f"{m.layers} layers, {m.checkpoints} checkpoints, {m.depth:.1f} mm deep; imports {m.imports:.2f} s apart"
    return [
        Figure(f"{name}: time", m.seconds, "s", at_most(2.0), REFERENCE, note),
        Figure(f"{name}: memory", m.memory, "MB", at_most(500.0), REFERENCE, "the whole process"),
        Figure(f"{name}: covered", 100 * m.covered, "%", at_least(99.0), "97.8 (thesis, one flat contour)"),
        Figure(f"{name}: laid twice", 100 * m.double, "%", at_most(5.0)),
        Figure(f"{name}: ink over the wound's volume", m.filled, "", None, "", "1 fills it exactly"),
    ]


def measured_apart(kind: str, pattern: str, mode: str) -> Measured:
    """What a process of its own measures."""
    command = [sys.executable, "-m", "hardware.bench.plan", kind, pattern, mode]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise StillbedError(f"planning ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    return Measured(**json.loads(done.stdout))


def measure(kind: str, pattern: str, mode: str) -> Measured:
    """Plan once, in this process."""
    clock = ProcessorClock()
    start = clock.now()
    from planning.fill.pattern import Pattern
    from planning.layers.figures import figures_of, total_of
    from planning.layers.plan import Order, make_plan
    from planning.layers.repair import repaired
    from planning.layers.tissue import Tissue
    from planning.layers.wound import wound_in

    imports = clock.now() - start
    vertices, triangles = _scan(kind)
    tissues = tuple(
        Tissue(name, thickness, name) for name, thickness in (("hypodermis", None), ("dermis", 1.6), ("epidermis", 0.4))
    )
    order = Order(tissues, Pattern(pattern, BEAD), mode)  # type: ignore[arg-type]
    start = clock.now()
    scan, _ = repaired(vertices, triangles, "scan")
    plan = make_plan(wound_in(scan, 0.6 * BEAD, "scan"), order)
    seconds = clock.now() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    total, found = total_of(figures_of(plan)), plan.wound.findings
    return Measured(
        imports, seconds, memory, len(plan.path), len(plan.layers), found.depth,
        float(plan.points.volume.sum()) / found.volume, total.covered, total.double,
    )  # fmt: skip


def _scan(kind: str) -> tuple[Array, Index]:
    """A damaged scan: vertices (V, 3) mm, triangles (T, 3)."""
    from hardware.simulator.bodies import Wound, body

    vertices, triangles = body(kind, Wound(SIZE, DEPTH), 1).mesh(SCAN_STEP)
    chance = np.random.default_rng(1).random(len(triangles))
    triangles = np.where((chance < DAMAGE)[:, None], triangles[:, ::-1], triangles)
    return vertices, triangles[chance < 1 - DAMAGE]


if __name__ == "__main__":
    from dataclasses import asdict

    print(json.dumps(asdict(measure(*sys.argv[1:4]))))
