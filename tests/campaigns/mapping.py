"""Subjects `map` and `registration`: landmarks and a scan, and the truth.

`map`: distances of landmarks from the true surface, beside the reported covariance; and the map's growth.
`registration`: a scan registered to the first pictures, its error over the wound, and its verdict.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.scans.scan import scan_from_triangles
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.follow import MIN_FRAME_SETS
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench.figures import Figure, Target, at_least, at_most, relative_nees, rms
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import Shape, Wound, body, cylinder, flat, with_wound
from perception.frames import Frame, FrameSet
from perception.mapping.patches import RELIEF_PX
from perception.tracking.step import TrackingStep
from tests.campaigns.estimator import nees

SCAN_SPACING = 1.0  # mm between the vertices of a scan, as handheld scanners give them
SCAN_FROM_SURFACE = se3.make(se3.exp_rotation([0.3, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame
SCAN_RATE, SCAN_SETS = 30.0, MIN_FRAME_SETS  # Hz; the last poses are judged
BREATH_RISE, BREATH_TURN, BREATH_RATE = 4.0, 0.03, 0.25  # mm, rad and Hz of the breathing meanwhile
OPEN_DIRECTIONS = {"flat": 3, "cylinder": 2}  # that registration cannot determine on these shapes
NO_REFERENCE = "none"


@dataclass(frozen=True, slots=True)
class ScanCase:
    """One body before the cameras."""

    name: str
    kind: str
    seed: int
    delays: tuple[float, float, float] = (0.0, 0.0, 0.0)  # s, each camera's instant after the stamp


def run_registration(options: argparse.Namespace) -> list[Figure]:
    """Errors over the wound on bodies that fix a scan, verdicts on those that do not."""
    seeds = range(1, options.seeds + 1)
    cases = [ScanCase(f"{kind} {seed}", kind, seed) for kind in ("chest", "forearm", "foot") for seed in seeds]
    cases.append(ScanCase("forearm 1, cameras 10 ms apart", "forearm", 1, (0.0, 0.01, -0.01)))
    figures = [figure for case in cases for figure in _registration_figures(case)]
    for kind, count in OPEN_DIRECTIONS.items():
        last = list(_tracked_with_scan(ScanCase(kind, kind, 1)))[-1]
        named = last.reason.count("slide along") + last.reason.count("turn about")
        value, target = 0 if last.state is TrackState.TRACKING else named, Target(count, count)
        figures.append(Figure(f"{kind}: open directions named", value, "", target, NO_REFERENCE, last.reason))
    return figures


def shape_of(kind: str, seed: int) -> Shape:
    """A body with a wound carved, or, on `flat` and `cylinder`, only painted."""
    if kind == "flat":
        return with_wound(flat((120.0, 90.0)), Wound(), seed)
    return with_wound(cylinder((120.0, 62.0), 50.0), Wound(), seed) if kind == "cylinder" else body(kind, Wound(), seed)


def wound_points(shape: Shape) -> Array:
    """Points (N, 3) mm of the wound, surface frame, one per node."""
    assert shape.inside is not None
    return shape.points(shape.grid(shape.step)[(shape.inside > 0).ravel()])


def breathing_pose(stamp: float) -> Array:
    """base_from_surface (4, 4) at `stamp`, s, in the midst of a breath."""
    phase = 2 * np.pi * BREATH_RATE * (stamp + 0.5)
    up = 0.5 * (1 - np.cos(phase))
    turns, shifts = [BREATH_TURN * up, 0.5 * BREATH_TURN * up, 0.0], [0.1 * BREATH_RISE * up, 0.2 * BREATH_RISE * up]
    return BASE_FROM_REST @ se3.exp([*turns, *shifts, BREATH_RISE * up])


def _tracked_with_scan(case: ScanCase) -> Iterator[SurfacePose]:
    """Poses of the tracking step, which is given the scan in the scanner's own frame."""
    shape, rig = shape_of(case.kind, case.seed), arc_rig()
    vertices, triangles = shape.mesh(SCAN_SPACING)
    scan = scan_from_triangles(se3.transform_points(SCAN_FROM_SURFACE, vertices), triangles)
    scene, rng = Scene(shape, Appearance(), seed=case.seed), np.random.default_rng([case.seed, 41])
    step = TrackingStep(rig, rois(scene, rig, breathing_pose(0.0), 0.0), scan=scan)
    for stamp in np.arange(SCAN_SETS) / SCAN_RATE:
        instants = {delay: WorldState(stamp, 0.0, breathing_pose(stamp + delay), np.zeros(6)) for delay in case.delays}
        images = render(scene, rig.cameras, [instants[delay] for delay in case.delays], Sensor(), rng.spawn(len(rig)))
        yield step(FrameSet(float(stamp), tuple(Frame(c, float(stamp), i) for c, i in enumerate(images))))
        step.idle()


def _registration_figures(case: ScanCase) -> list[Figure]:
    points = wound_points(shape_of(case.kind, case.seed))
    distance, squares, count = np.full(len(points), np.nan), np.nan, 0
    for pose in _tracked_with_scan(case):
        if pose.state is TrackState.TRACKING:
            now, true = pose.base_from_surface @ SCAN_FROM_SURFACE, breathing_pose(pose.stamp)
            distance = np.linalg.norm(se3.transform_points(now, points) - se3.transform_points(true, points), axis=1)
            error = se3.adjoint(SCAN_FROM_SURFACE) @ se3.log(se3.inverse(now) @ true)
            squares, count = relative_nees(error, pose.covariance), count + 1
    mean, note = f"{case.name}: error over the wound, mean", f"{count} of {SCAN_SETS} poses TRACKING"
    return [
        Figure(mean, float(distance.mean()), "mm", at_most(0.1), NO_REFERENCE, note),
        Figure(f"{case.name}: largest", float(distance.max()), "mm", at_most(0.15)),
        Figure(f"{case.name}: squared error, in parts of what is claimed", squares, "", at_most(3.0)),
    ]


MAP_RATE = 10.0  # frame sets a second: key frames are further apart
MIN_SECONDS = 1.0  # s: there is a first pose after half of it
COVERED_SPAN = 1.0, 5.0  # s: from when to when all cameras but one are covered,
COVER_GREYS = 90, 110  # by these grey levels at random
CAMERA_DISTANCE, FOCAL_PX = 400.0, 1100.0  # mm, px: of the cameras
PIXEL_MM = CAMERA_DISTANCE / FOCAL_PX
PLAIN_LOOK = Appearance(texel=0.2, wetness=0.3, drape=False)
LIMB_RADIUS = 46.0  # mm
SIGMA_RATIO = Target(0.3, 2.0)  # of an error's size by its standard deviation
NORMAL_MEDIAN = 0.6745  # of the size of what is normally distributed, in standard deviations
OUTLIER_SIGMAS = 5.0  # landmarks beyond are not counted: the pose solver leaves them out


@dataclass(frozen=True, slots=True, eq=False)
class TrackedShape:
    """One run of the tracking step."""

    poses: list[SurfacePose]
    true: Array  # (N, 4, 4), of each pose
    maps: list[SurfaceMap]  # after each frame set from the second on

    @property
    def first(self) -> int:
        """Number of the first measured pose."""
        return next(i for i, pose in enumerate(self.poses) if pose.state.measured)


def run_map(options: argparse.Namespace) -> list[Figure]:
    """Maps of a cylinder, a forearm and a chest while they breathe; a surface that passes by; one that turns."""
    if not options.seconds >= MIN_SECONDS:
        raise InputError("command line", "--seconds", options.seconds, f">= {MIN_SECONDS:g}")
    stamps = np.arange(round(options.seconds * MAP_RATE)) / MAP_RATE
    plain = with_wound(cylinder((80.0, 60.0), 70.0), Wound((70.0, 54.0)), 1)
    shapes = {"cylinder": plain, "forearm": shape_of("forearm", 1), "chest": shape_of("chest", 1)}
    figures = [f for name, shape in shapes.items() for f in _map_errors(name, shape, stamps)]
    return [*figures, *_growth(), *_alone("steep", 2, 1.0), *_alone("upper", 0, -1.0)]


def track_shape(
    shape: Shape, look: Appearance, rig: Rig, poses: Array, stamps: Array, alone: int | None = None
) -> TrackedShape:
    """The tracking step on pictures of a shape at base_from_surface poses (N, 4, 4).

    alone: the one camera that is not covered in COVERED_SPAN, s.
    """
    scene, rng = Scene(shape, look, seed=1), np.random.default_rng(41)
    step = TrackingStep(rig, rois(scene, rig, poses[0], 0.0))
    tracked, maps = [], []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        images = render(scene, rig.cameras, [WorldState(stamp, 0.0, pose, np.zeros(6))] * 3, Sensor(), rng.spawn(3))
        if alone is not None and COVERED_SPAN[0] <= stamp < COVERED_SPAN[1]:
            covers = [rng.integers(*COVER_GREYS, i.shape).astype(np.uint8) for c, i in enumerate(images) if c != alone]
            images = [*covers[:alone], images[alone], *covers[alone:]]
        tracked.append(step(FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images)))))
        step.idle()
        if step.map is not None:
            maps.append(step.map)
    return TrackedShape(tracked, poses, maps)


def heights(shape: Shape, surface_map: SurfaceMap, true_from_estimated: Array) -> tuple[Array, Array]:
    """Heights (N,) mm of landmarks over the true surface, and their standard deviation (N,) by the map."""
    points = se3.transform_points(true_from_estimated, surface_map.points)
    place = shape.material(points)
    normals, count = shape.normals(place), len(surface_map)
    inner = normals @ true_from_estimated[:3, :3]
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(count, 3, count, 3))
    sigma = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", inner, blocks, inner), 1e-12))
    return np.einsum("ni,ni->n", points - shape.points(place), normals), sigma


def _map_errors(name: str, shape: Shape, stamps: Array) -> list[Figure]:
    up = 2 * (1 - np.cos(2 * np.pi * 0.25 * stamps))
    poses = BASE_FROM_REST @ se3.exp(up[:, None] * np.array([0.015, 0.01, 0.0, 0.2, 0.3, 1.0]))
    result = track_shape(shape, Appearance(), arc_rig(focal=FOCAL_PX), poses, stamps)
    figures = []
    for when, number in (("confirmed", 1), ("refined", -1)):
        change = se3.inverse(poses[number]) @ result.poses[number].base_from_surface
        height, sigma = heights(shape, result.maps[number], change)
        # an error that all tracks of a patch share is not in the covariance of poses
        sigma = np.hypot(sigma, RELIEF_PX * PIXEL_MM)
        inlier = np.abs(height) < OUTLIER_SIGMAS * max(0.1, float(np.median(sigma)))
        size = float(np.median(np.abs(height[inlier]) / sigma[inlier]) / NORMAL_MEDIAN)
        note = f"{len(height)} landmarks, {np.mean(height[inlier]):+.3f} mm in the mean"
        median = float(np.median(np.abs(height)))
        figures.append(Figure(f"{name}, {when}: off the surface", median, "mm", None, "", note))
        figures.append(Figure(f"{name}, {when}: of what is claimed", size, "", SIGMA_RATIO))
    # NEES/6 of the poses after the first: an error that map and tracks have in common is not theirs
    first, later = result.first, result.poses[result.first + 1 :]
    change = se3.inverse(poses[first]) @ result.poses[first].base_from_surface
    estimated = np.stack([pose.base_from_surface for pose in later])
    covariance = np.stack([pose.covariance for pose in later])
    errors = se3.log(se3.inverse(estimated) @ poses[first + 1 :] @ change)
    what, squares = f"{name}: squared error of poses, of what is claimed", float(nees(errors, covariance).mean() / 6)
    return [*figures, Figure(what, squares, "", at_most(1.25))]


def _limb() -> Shape:
    return with_wound(cylinder((80.0, 74.0), LIMB_RADIUS), Wound((78.0, 72.0)), 1)


def _turned(turns: Array) -> Array:
    """base_from_surface (N, 4, 4) of a limb turned by (N,) rad about its own axis."""
    axis = se3.make(np.eye(3), [0.0, 0.0, -LIMB_RADIUS])
    return np.asarray(BASE_FROM_REST @ axis @ se3.exp(np.outer(turns, [1.0, 0, 0, 0, 0, 0])) @ se3.inverse(axis))


def _growth() -> list[Figure]:
    """A long patch passes by until nothing of the first view is left; a limb turns from one flank to the other."""
    stamps = np.arange(46) / MAP_RATE
    moves = np.outer(stamps, [0.0, 0.0, 0.0, -45.0, 0.0, 0.0]) + [0.0, 0.0, 0.0, 85.0, 0.0, 0.0]
    moves[:, 5] = 1.5 * np.sin(2 * stamps)
    patch, passing = with_wound(flat((320.0, 60.0)), Wound((310.0, 56.0)), 1), BASE_FROM_REST @ se3.exp(moves)
    turning, figures = _turned(0.65 * (1 - np.cos(0.8 * stamps)) - 0.65), list[Figure]()
    runs = ("passing by", patch, (320, 240), passing), ("turning", _limb(), (480, 360), turning)
    for name, shape, size, poses in runs:
        result = track_shape(shape, PLAIN_LOOK, arc_rig(size=size, focal=560.0), poses, stamps)
        error, measured = _error(result)
        added, note = len(result.maps[-1]) - len(result.maps[0]), f"{len(result.maps[0])} at first"
        figures += [
            Figure(f"{name}: landmarks added", added, "", at_least(20), "", note),
            Figure(f"{name}: followed", 100 * float(measured.mean()), "%", at_least(100)),
            Figure(f"{name}: error, largest", float(error.max()), "mm", at_most(0.15), "", "0.7 mm a pixel"),
        ]
    return figures


def _alone(name: str, camera: int, way: float) -> list[Figure]:
    """A limb turns by 43 degrees under one camera alone, and back; the others are covered meanwhile."""
    stamps = np.arange(61) / MAP_RATE
    part = np.clip((stamps - COVERED_SPAN[0]) / 4.5, 0.0, 1.0)
    rates, sizes = np.array([1.0, 1.3, 1.0, 1.0, 2.0, 1.7]), np.array([0.02, 0.01, 0.0, 1.5, 1.0, 1.5])
    turned = _turned(way * 0.375 * (1 - np.cos(2 * np.pi * part)))
    poses = turned @ se3.exp(sizes * np.sin(stamps[:, None] * rates))
    result = track_shape(_limb(), PLAIN_LOOK, arc_rig(size=(640, 480), focal=600.0), poses, stamps, camera)
    error, measured = _error(result)
    note = f"{len(result.maps[-1]) - len(result.maps[0])} landmarks added to {len(result.maps[0])}; 0.67 mm a pixel"
    after = float(error[-5:].max())
    return [
        Figure(f"{name} camera alone: error while measured", rms(error[measured]), "mm"),
        Figure(f"{name} camera alone: largest", float(error[measured].max()), "mm"),
        Figure(f"{name} camera alone: error once the others are back", after, "mm", at_most(0.1), "", note),
    ]


def _error(result: TrackedShape) -> tuple[Array, NDArray[np.bool_]]:
    """Error (N,) mm from the first measured pose on, and which are measured (N,)."""
    poses, true = result.poses[result.first :], result.true[result.first :]
    estimated = np.stack([pose.base_from_surface for pose in poses])
    change = se3.inverse(estimated[0]) @ true[0]
    error = np.linalg.norm((se3.inverse(true) @ (estimated @ change))[:, :3, 3], axis=1)
    return error, np.array([pose.state.measured for pose in poses])
