"""`python -m tests.campaigns views`: tracking of pictures that make it hard: skin that deforms, grazing views, edges.

Everything is measured after the constant transform at the first TRACKING pose; nothing is fitted over the run.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.figures import Figure, at_least, at_most, rms
from hardware.process.checks import Table
from hardware.simulator.motion_table import motion_from_tables, waveform_from_table
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.fields import smooth_noise
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import shape_from_function
from hardware.simulator.truth import Truth
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep
from tests.campaigns.mapping import wound_points

VIEW_RATE, VIEW_EXPOSURE = 30.0, 0.005  # frame sets a second; s
VIEW_SOURCE = "python -m tests.campaigns views"
CUBE_FACE, CUBE_TEXEL = 60.0, 0.15  # mm, of the square that a cube's corner is seen in, and of its texture
POINT_STRIDE = 37  # nodes of the wound between points that are judged


@dataclass(frozen=True, slots=True)
class ViewSequence:
    """One sequence."""

    name: str
    body: Table | None  # a [scene] table, None for a cube that stands on a corner
    motion: tuple[Table, ...]
    seed: int
    target: float  # mm RMS over the points
    reference: str  # what others reached on sequences of this kind
    strain: Table | None = None  # over time, of a scene that deforms


BREATH: Table = {"kind": "breathing", "amplitude_mm": 6.0, "rate_hz": 0.25, "turn_deg": [2.0, 1.0, 0.0]}
ROLL_TABLE: Table = {
    **{"kind": "turn", "angles_deg": [22.0], "axis": [1.0, 0.0, 0.0]},
    **{"duration_s": 1.5, "hold_s": 1.5, "start_s": 1.0, "repeat": True},
}
BULGES: Table = {"stretch": [0.01, 0.005], "bulge_mm": 1.0, "radius_mm": 25.0}
BULGE_TABLE: Table = {"stretch": [0.015, 0.01], "bulge_mm": 1.5, "radius_mm": 20.0}
RIGID_REFERENCE = "thesis 1.8, ViSP 0.57, robust pose of each frame set 0.46"
VIEWS = (
    ViewSequence(
        "forearm that bulges as it breathes", {"body": "forearm", "deformation": BULGES}, (BREATH,), 1, 0.3,
        RIGID_REFERENCE, {"kind": "breathing", "rate_hz": 0.25},
    ),
    ViewSequence(
        "forearm that swells and sinks by 1.5 mm", {"body": "forearm", "deformation": BULGE_TABLE},
        ({**BREATH, "rate_hz": 0.3, "amplitude_mm": 8.0},), 2, 0.3,
        RIGID_REFERENCE, {"kind": "sine", "rate_hz": 0.3, "phase_deg": 90.0},
    ),
    ViewSequence(
        "wet forearm rolled until views graze", {"body": "forearm", "wetness": 1.0},
        ({**BREATH, "turn_deg": [12.0, 5.0, 3.0]}, ROLL_TABLE), 4, 0.05,
        "thesis 1.6, ViSP 0.127, robust pose of each frame set 0.10",
    ),
    ViewSequence(
        "cube on its corner", None, ({"kind": "constant", "unit_mm": 40.0},), 6, 0.018,
        "thesis 4.0, ViSP 0.019, robust pose of each frame set 0.025",
    ),
)  # fmt: skip


def run_views(options: argparse.Namespace) -> list[Figure]:
    """All sequences."""
    return [figure for view in VIEWS for figure in _figures(view, options.seconds)]


def _figures(view: ViewSequence, seconds: float) -> list[Figure]:
    strain = None
    if view.strain is not None:
        strain = waveform_from_table(VIEW_SOURCE, "strain", dict(view.strain), np.random.default_rng([view.seed, 11]))
    scene = _cube(view.seed) if view.body is None else scene_from_table(VIEW_SOURCE, dict(view.body), Path(), view.seed)
    motion = motion_from_tables(VIEW_SOURCE, [dict(part) for part in view.motion], Path(), view.seed)
    shape, stamps = scene.shape, np.arange(round(seconds * VIEW_RATE)) / VIEW_RATE
    truth = Truth(BASE_FROM_REST, motion, scene.deformation, strain, shape.surface_from_grid)
    poses = list(_tracked(scene, truth, arc_rig(), stamps))
    first, what = next((i for i, p in enumerate(poses) if p.state is TrackState.TRACKING), None), f"{view.name}: error"
    if first is None:
        return [Figure(what, math.nan, "mm", at_most(view.target), view.reference, "never TRACKING")]
    # (N, 3) mm, of the wound, or of the middle of a shape without one
    points = shape.points(shape.grid(3.0, 0.6)) if shape.inside is None else wound_points(shape)[::POINT_STRIDE]
    still = se3.make(np.eye(3), points)
    true = [truth.checkpoints(np.full(len(points), stamp), still)[:, :3, 3] for stamp in stamps]  # base frame
    start, rows = poses[first], [i for i in range(first + 1, len(poses)) if poses[i].state.measured]
    own = se3.transform_points(se3.inverse(start.base_from_surface), true[first])
    own = own if start.warp is None else start.warp.undo(own)
    warped = np.array([_error(poses[i], own if (w := poses[i].warp) is None else w.apply(own), true[i]) for i in rows])
    rigid = np.array([_error(poses[i], own, true[i]) for i in rows])
    deformed = max((p.warp.deformation for p in poses if p.warp is not None), default=0.0)
    measured, degraded = len(rows) / (len(poses) - first - 1), sum(p.state is TrackState.DEGRADED for p in poses)
    note = f"largest {warped.max():.3f}; deformation {deformed:.2f} mm at most, {degraded} of {len(poses)} DEGRADED"
    figures = [Figure(what, rms(warped), "mm", at_most(view.target), view.reference, note)]
    figures.append(Figure(f"{view.name}: measured", 100 * measured, "%", at_least(99)))
    return figures if view.strain is None else [*figures, Figure(f"{view.name}: without the warp", rms(rigid), "mm")]


def _cube(seed: int) -> Scene:
    """The three upper faces of a cube on its corner, textured by noise of several sizes, before a cloth at rest."""
    ways = np.pi / 2 + 2 * np.pi * np.arange(3) / 3

    def height(x: Array, y: Array) -> Array:
        return np.asarray(np.sqrt(2) * (CUBE_FACE / 6 - np.max([np.cos(a) * x + np.sin(a) * y for a in ways], axis=0)))

    side, rng = round(CUBE_FACE / CUBE_TEXEL), np.random.default_rng([seed, 83])
    grain = sum(smooth_noise((side, side), size, rng) for size in (1.0, 2.0, 4.0, 8.0, 16.0))
    texture = np.dstack([np.clip(128 + 16 * grain, 0, 255).astype(np.uint8)] * 3)
    look = Appearance(texel=CUBE_TEXEL, drape=False, texture=texture, lit=False)
    return Scene(shape_from_function(height, (CUBE_FACE, CUBE_FACE)), look, seed=seed)


def _tracked(scene: Scene, truth: Truth, rig: Rig, stamps: Array) -> Iterator[SurfacePose]:
    """The poses of the tracking step, frame set by frame set."""
    step = TrackingStep(rig, rois(scene, rig, truth.base_from_surface(stamps[:1])[0], 0.0))
    rng = np.random.default_rng(31)
    for stamp in stamps.tolist():
        now = np.array([stamp])
        at, amount = truth.base_from_surface(now)[0], float(truth.amount(now)[0])
        instant = WorldState(stamp, VIEW_EXPOSURE, at, truth.twist(now)[0], amount)
        images = render(scene, rig.cameras, [instant] * len(rig), Sensor(), rng.spawn(len(rig)))
        yield step(FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images))))
        step.idle()


def _error(pose: SurfacePose, points: Array, true: Array) -> float:
    """RMS distance, mm, of points (N, 3), surface frame, from their true places (N, 3), base frame."""
    return rms(np.linalg.norm(se3.transform_points(pose.base_from_surface, points) - true, axis=1))
