"""`stillbed bench views`: what makes following hard, rendered: skin that deforms, grazing views with glare, edges.

Everything is measured after the constant transform taken at the first TRACKING pose; nothing is fitted over the run.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.bench.figures import Figure, at_least, at_most
from hardware.bench.registration import wound_points
from hardware.process.checks import Table
from hardware.simulator.instant import Instant
from hardware.simulator.look import plain
from hardware.simulator.motion_table import motion_from_tables, waveform_from_table
from hardware.simulator.render import render
from hardware.simulator.scene.fields import smooth
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import Shape, shape_from_function
from hardware.simulator.scene_table import scene_from_table
from hardware.simulator.sensor import Sensor
from hardware.simulator.truth import Truth
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep

RATE, EXPOSURE = 30.0, 0.005  # frame sets a second; s
WHERE = "stillbed bench views"
EDGE, TEXEL = 60.0, 0.15  # mm, of the square that a cube's corner is seen in, and of its texture
EVERY = 37  # nodes of the wound between points that are judged


@dataclass(frozen=True, slots=True)
class View:
    """One sequence. body: a [scene] table, None for a cube that stands on a corner. strain: over time, of a scene that
    deforms. target: mm RMS over the points. reference: what others reached on sequences of this kind."""

    name: str
    body: Table | None
    motion: tuple[Table, ...]
    seed: int
    target: float
    reference: str
    strain: Table | None = None


BREATH: Table = {"kind": "breathing", "amplitude_mm": 6.0, "rate_hz": 0.25, "turn_deg": [2.0, 1.0, 0.0]}
ROLL: Table = {
    "kind": "turn",
    "angles_deg": [22.0],
    "axis": [1.0, 0.0, 0.0],
    "duration_s": 1.5,
    "hold_s": 1.5,
    "start_s": 1.0,
    "repeat": True,
}
BULGES: Table = {"stretch": [0.01, 0.005], "bulge_mm": 1.0, "radius_mm": 25.0}
SWELLS: Table = {"stretch": [0.015, 0.01], "bulge_mm": 1.5, "radius_mm": 20.0}
RIGID = "thesis 1.8, ViSP 0.57, robust pose of each frame set 0.46"
VIEWS = (
    View(
        "forearm that bulges as it breathes",
        {"body": "forearm", "deformation": BULGES},
        (BREATH,),
        1,
        0.3,
        RIGID,
        {"kind": "breathing", "rate_hz": 0.25},
    ),
    View(
        "forearm that swells and sinks by 1.5 mm",
        {"body": "forearm", "deformation": SWELLS},
        ({**BREATH, "rate_hz": 0.3, "amplitude_mm": 8.0},),
        2,
        0.3,
        RIGID,
        {"kind": "sine", "rate_hz": 0.3, "phase_deg": 90.0},
    ),
    View(
        "wet forearm rolled until views graze",
        {"body": "forearm", "wetness": 1.0},
        ({**BREATH, "turn_deg": [12.0, 5.0, 3.0]}, ROLL),
        4,
        0.05,
        "thesis 1.6, ViSP 0.127, robust pose of each frame set 0.10",
    ),
    View(
        "cube on its corner",
        None,
        ({"kind": "constant", "unit_mm": 40.0},),
        6,
        0.018,
        "thesis 4.0, ViSP 0.019, robust pose of each frame set 0.025",
    ),
)


def run(options: argparse.Namespace) -> list[Figure]:
    """All sequences."""
    return [figure for view in VIEWS for figure in _figures(view, options.seconds)]


def _figures(view: View, seconds: float) -> list[Figure]:
    scene, truth, rig = _world(view)
    points, stamps = _judged(scene.shape), np.arange(round(seconds * RATE)) / RATE
    poses = list(_followed(scene, truth, rig, stamps))
    first = next((i for i, p in enumerate(poses) if p.state is TrackState.TRACKING), None)
    if first is None:
        return [
            Figure(f"{view.name}: error", float("nan"), "mm", at_most(view.target), view.reference, "never TRACKING")
        ]
    true = [_moved(truth, points, stamp) for stamp in stamps]
    start, rows = poses[first], [i for i in range(first + 1, len(poses)) if poses[i].state.measured]
    own = se3.transform_points(se3.inverse(start.base_from_surface), true[first])
    own = own if start.warp is None else start.warp.undo(own)
    bent = np.array([_off(poses[i], own if (w := poses[i].warp) is None else w.apply(own), true[i]) for i in rows])
    rigid = np.array([_off(poses[i], own, true[i]) for i in rows])
    deformed = max((p.warp.deformation for p in poses if p.warp is not None), default=0.0)
    measured, degraded = len(rows) / (len(poses) - first - 1), sum(p.state is TrackState.DEGRADED for p in poses)
    note = f"largest {bent.max():.3f}; deformation {deformed:.2f} mm at most, {degraded} of {len(poses)} DEGRADED"
    figures = [
        Figure(f"{view.name}: error", _rms(bent), "mm", at_most(view.target), view.reference, note),
        Figure(f"{view.name}: measured", 100 * measured, "%", at_least(99)),
    ]
    return figures if view.strain is None else [*figures, Figure(f"{view.name}: without the warp", _rms(rigid), "mm")]


def _world(view: View) -> tuple[Scene, Truth, Rig]:
    strain = None
    if view.strain is not None:
        strain = waveform_from_table(WHERE, "strain", dict(view.strain), np.random.default_rng([view.seed, 11]))
    scene = _cube(view.seed) if view.body is None else scene_from_table(WHERE, dict(view.body), Path(), view.seed)
    motion = motion_from_tables(WHERE, [dict(part) for part in view.motion], Path(), view.seed)
    return scene, Truth(REST, motion, scene.deformation, strain, scene.shape.surface_from_grid), arc_rig()


def _cube(seed: int) -> Scene:
    """The three upper faces of a cube on its corner, textured by noise of several sizes, before a cloth at rest."""
    ways = np.pi / 2 + 2 * np.pi * np.arange(3) / 3

    def height(x: Array, y: Array) -> Array:
        return np.asarray(np.sqrt(2) * (EDGE / 6 - np.max([np.cos(a) * x + np.sin(a) * y for a in ways], axis=0)))

    side, rng = round(EDGE / TEXEL), np.random.default_rng([seed, 83])
    grain = sum(smooth((side, side), size, rng) for size in (1.0, 2.0, 4.0, 8.0, 16.0))
    grey = np.clip(128 + 16 * grain, 0, 255).astype(np.uint8)
    return Scene(shape_from_function(height, (EDGE, EDGE)), plain(np.dstack([grey] * 3), TEXEL), seed=seed)


def _followed(scene: Scene, truth: Truth, rig: Rig, stamps: Array) -> Iterator[SurfacePose]:
    """The poses of the tracking step, frame set by frame set."""
    step = TrackingStep(rig, rois(scene, rig, truth.base_from_surface(stamps[:1])[0], 0.0))
    rng = np.random.default_rng(31)
    for stamp in stamps.tolist():
        now = np.array([stamp])
        at, amount = truth.base_from_surface(now)[0], float(truth.amount(now)[0])
        instant = Instant(stamp, EXPOSURE, at, truth.twist(now)[0], amount)
        images = render(scene, rig.cameras, [instant] * len(rig), Sensor(), rng.spawn(len(rig)))
        yield step(FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images))))
        step.idle()


def _judged(shape: Shape) -> Array:
    """Points (N, 3) mm of the wound, or of the middle of a shape without one."""
    return shape.points(shape.grid(3.0, 0.6)) if shape.inside is None else wound_points(shape)[::EVERY]


def _moved(truth: Truth, points: Array, stamp: float) -> Array:
    """Where points (N, 3) of the surface at rest truly are, base frame."""
    placed = se3.make(np.eye(3), points)
    return truth.checkpoints(np.full(len(points), stamp), placed)[:, :3, 3]


def _off(pose: SurfacePose, points: Array, true: Array) -> float:
    """RMS distance, mm, of points (N, 3), surface frame, from their true places (N, 3), base frame."""
    return _rms(np.linalg.norm(se3.transform_points(pose.base_from_surface, points) - true, axis=1))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
