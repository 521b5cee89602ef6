"""Subject `scan`: what the cameras scan of a body that breathes, off its true surface, beside the stated sigma."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from estimation import se3
from estimation.rig import Rig
from estimation.synthetic.world import arc_rig
from hardware.bench.figures import Figure, Target, at_least, at_most
from hardware.bench.mapping import NORMAL_MEDIAN, breathing_pose, shape_of
from hardware.live.surface_scan import ScanSource, scan_surface
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from perception.frames import Frame, FrameSet

SCAN_WETNESS = {"dry": 0.0, "wet": 1.0}
SCAN_SPAN, FUSED_SCAN_RATE = (
    4.0,
    7.5,
)  # s, a breath; Hz: tracking makes its map of the first sets, and the rest are far apart
SKIN_LIMITS, WOUND_LIMITS = (0.05, 0.15), (0.10, 0.30)  # mm, median and 95 %
STATED_RATIO = Target(0.6, 1.5)  # of errors by their standard deviations, median by a normal distribution's


def run_scan(options: argparse.Namespace) -> list[Figure]:
    """Scans of bodies, wet and dry, fused from pictures over a breath; poses by the tracker."""
    return [f for body in options.bodies for look in SCAN_WETNESS for f in scan_figures(body, look, options.sets)]


def scan_figures(kind: str, look: str, sets: int, rig: Rig | None = None) -> list[Figure]:
    """A body's scan: errors across the true surface on skin and in the wound, share of the area, honesty, time."""
    shape, rig = shape_of(kind, 1), rig or arc_rig()
    scene = Scene(shape, Appearance(wetness=SCAN_WETNESS[look]), seed=1)
    pictures, name = _sets(scene, rig), f"{kind}, {look}"
    source = ScanSource(rig, rois(scene, rig, breathing_pose(0.0), 0.0), pictures)
    scanned = scan_surface(source, sets, SCAN_SPAN)
    true_from_scanned = se3.inverse(breathing_pose(scanned.first.stamp)) @ scanned.first.base_from_surface
    points = se3.transform_points(true_from_scanned, scanned.scan.vertices)
    place = shape.material(points)
    error = np.abs(np.einsum("ni,ni->n", points - shape.points(place), shape.normals(place)))
    assert shape.inside is not None
    x, y = np.rint(shape.nodes(place)).astype(int).T
    wound, figures = shape.inside[y, x] > 0, list[Figure]()
    for part, mine, limits in (("skin", ~wound, SKIN_LIMITS), ("wound", wound, WOUND_LIMITS)):
        middle, high = np.percentile(error[mine], [50, 95])
        ratio = float(np.median(error[mine] / scanned.sigma[mine]) / NORMAL_MEDIAN)
        figures += [
            Figure(f"{name}: off the {part}, median", float(middle), "mm", at_most(limits[0])),
            Figure(f"{name}: off the {part}, 95 %", float(high), "mm", at_most(limits[1])),
            Figure(f"{name}: errors on the {part}, of what is stated", ratio, "", STATED_RATIO),
        ]
    share = f"{scanned.area / 100:.1f} cm^2 of {scanned.sets} frame sets"
    return [
        *figures,
        Figure(f"{name}: scanned of the region", 100 * scanned.coverage, "%", at_least(95), "", share),
        Figure(f"{name}: time to fuse", scanned.seconds, "s", at_most(10)),
    ]


def _sets(scene: Scene, rig: Rig) -> Iterator[FrameSet]:
    rng = np.random.default_rng([1, 41])
    for stamp in np.arange(round((SCAN_SPAN + 1) * FUSED_SCAN_RATE)) / FUSED_SCAN_RATE:
        state = WorldState(stamp, 0.0, breathing_pose(stamp), np.zeros(6))
        images = render(scene, rig.cameras, [state] * len(rig), Sensor(), rng.spawn(len(rig)))
        yield FrameSet(float(stamp), tuple(Frame(c, float(stamp), image) for c, image in enumerate(images)))
