"""`stillbed bench map`: how far landmarks lie off the true surface, beside what is claimed; and growth."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.bench.figures import Figure, Target, at_least, at_most
from hardware.bench.pooled import nees
from hardware.bench.registration import shape_of
from hardware.simulator.bodies import Wound, with_wound
from hardware.simulator.instant import Instant
from hardware.simulator.look import Look
from hardware.simulator.render import render
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import Shape, cylinder, flat
from hardware.simulator.sensor import Sensor
from perception.alignment import RELIEF
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep

RATE = 10.0  # frame sets a second: key frames are further apart
LEAST = 1.0  # s: the first pose is given out after half of it
COVERED = 1.0, 5.0  # s: from when to when all cameras but one are covered,
GREY = 90, 110  # by what shows these grey levels at random
DISTANCE, FOCAL = 400.0, 1100.0  # mm, px: of the cameras before the still standing surfaces
PIXEL = DISTANCE / FOCAL  # mm
HONEST = Target(0.3, 2.0)  # of an error's size against its claim
FORGOTTEN = 5.0  # sigmas: a landmark beyond, which the pose solver leaves out, is none


@dataclass(frozen=True, slots=True, eq=False)
class Ran:
    """What a run came to. true: (N, 4, 4), of each pose. maps: after each frame set from the second on."""

    poses: list[SurfacePose]
    true: Array
    maps: list[SurfaceMap]


def run(options: argparse.Namespace) -> list[Figure]:
    """Maps of a cylinder, a forearm and a chest while they breathe; a surface that passes by; one that turns."""
    if not options.seconds >= LEAST:
        raise InputError("command line", "--seconds", options.seconds, f">= {LEAST:g}")
    stamps = np.arange(round(options.seconds * RATE)) / RATE
    plain = with_wound(cylinder((80.0, 60.0), 70.0), Wound((70.0, 54.0)), 1)
    shapes = {"cylinder": plain, "forearm": shape_of("forearm", 1), "chest": shape_of("chest", 1)}
    figures = [f for name, shape in shapes.items() for f in _map_errors(name, shape, stamps)]
    return figures + _passing() + _turning() + _alone("steep", 2, 1.0) + _alone("upper", 0, -1.0)


def ran(
    shape: Shape,
    look: Look,
    size: tuple[int, int],
    focal: float,
    poses: Array,
    stamps: Array,
    alone: int | None = None,
) -> Ran:
    """The tracking step on pictures of a shape at base_from_surface poses (N, 4, 4).

    alone: the one camera that is not covered in COVERED, s.
    """
    rig, scene, rng = arc_rig(size=size, focal=focal), Scene(shape, look, seed=1), np.random.default_rng(41)
    step = TrackingStep(rig, rois(scene, rig, poses[0], 0.0))
    found, maps = [], []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        images = render(scene, rig.cameras, [Instant(stamp, 0.0, pose, np.zeros(6))] * 3, Sensor(), rng.spawn(3))
        if alone is not None and COVERED[0] <= stamp < COVERED[1]:
            images = [i if c == alone else rng.integers(*GREY, i.shape).astype(np.uint8) for c, i in enumerate(images)]
        found.append(step(FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images)))))
        step.idle()
        if step.map is not None:
            maps.append(step.map)
    return Ran(found, poses, maps)


def heights(shape: Shape, surface_map: SurfaceMap, true_from_estimated: Array) -> tuple[Array, Array]:
    """Heights (N,) mm of landmarks over the true surface, and one standard deviation (N,) as the map claims it."""
    points = se3.transform_points(true_from_estimated, surface_map.points)
    place = shape.material(points)
    normals = shape.normals(place)
    inner = normals @ true_from_estimated[:3, :3]
    count = len(surface_map)
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(count, 3, count, 3))
    claimed = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", inner, blocks, inner), 1e-12))
    return np.einsum("ni,ni->n", points - shape.points(place), normals), claimed


def _map_errors(name: str, shape: Shape, stamps: Array) -> list[Figure]:
    up = 2 * (1 - np.cos(2 * np.pi * 0.25 * stamps))
    poses = REST @ se3.exp(up[:, None] * np.array([0.015, 0.01, 0.0, 0.2, 0.3, 1.0]))
    result = ran(shape, Look(), (1280, 720), FOCAL, poses, stamps)
    figures = []
    for when, number in (("confirmed", 1), ("refined", -1)):
        change = se3.inverse(poses[number]) @ result.poses[number].base_from_surface
        off, claimed = heights(shape, result.maps[number], change)
        claimed = np.hypot(claimed, RELIEF * PIXEL)  # what all tracks of a patch share is in no covariance of poses
        kept = np.abs(off) < FORGOTTEN * max(0.1, float(np.median(claimed)))
        size = float(np.median(np.abs(off[kept]) / claimed[kept]) / 0.6745)
        note = f"{len(off)} landmarks, {np.mean(off[kept]):+.3f} mm in the mean"
        figures.append(Figure(f"{name}, {when}: off the surface", float(np.median(np.abs(off))), "mm", None, "", note))
        figures.append(Figure(f"{name}, {when}: of what is claimed", size, "", HONEST))
    return [
        *figures,
        Figure(f"{name}: squared error of poses, of what is claimed", _of_claim(result), "", at_most(1.25)),
    ]


def _of_claim(result: Ran) -> float:
    """NEES/6 of the poses after the first one given out: what map and tracks are off by alike is no error of theirs."""
    first = next(i for i, pose in enumerate(result.poses) if pose.state.measured)
    later = result.poses[first + 1 :]
    change = se3.inverse(result.true[first]) @ result.poses[first].base_from_surface
    estimated = np.stack([pose.base_from_surface for pose in later])
    errors = se3.log(se3.inverse(estimated) @ result.true[first + 1 :] @ change)
    return float(nees(errors, np.stack([pose.covariance for pose in later])).mean() / 6)


def _passing() -> list[Figure]:
    """A long patch passes by until nothing is left of what was in view at first."""
    shape, stamps = with_wound(flat((320.0, 60.0)), Wound((310.0, 56.0)), 1), np.arange(46) / RATE
    moves = np.outer(stamps, [0.0, 0.0, 0.0, -45.0, 0.0, 0.0]) + [0.0, 0.0, 0.0, 85.0, 0.0, 0.0]
    moves[:, 5] = 1.5 * np.sin(2 * stamps)
    look = Look(texel=0.2, wetness=0.3, drape=False)
    return _growth("passing by", ran(shape, look, (320, 240), 560.0, REST @ se3.exp(moves), stamps))


def _turning() -> list[Figure]:
    """A limb turns about its own axis from one flank to the other."""
    radius, stamps = 46.0, np.arange(46) / RATE
    shape = with_wound(cylinder((80.0, 74.0), radius), Wound((78.0, 72.0)), 1)
    axis = se3.make(np.eye(3), [0.0, 0.0, -radius])
    turns = np.outer(0.65 * (1 - np.cos(0.8 * stamps)) - 0.65, [1.0, 0, 0, 0, 0, 0])
    look = Look(texel=0.2, wetness=0.3, drape=False)
    poses = REST @ axis @ se3.exp(turns) @ se3.inverse(axis)
    return _growth("turning", ran(shape, look, (480, 360), 560.0, poses, stamps))


def _alone(name: str, camera: int, way: float) -> list[Figure]:
    """A limb turns by 43 degrees under one camera alone, and back; the others are covered meanwhile."""
    radius, stamps = 46.0, np.arange(61) / RATE
    shape = with_wound(cylinder((80.0, 74.0), radius), Wound((78.0, 72.0)), 1)
    axis, part = se3.make(np.eye(3), [0.0, 0.0, -radius]), np.clip((stamps - COVERED[0]) / 4.5, 0.0, 1.0)
    turns = np.outer(way * 0.375 * (1 - np.cos(2 * np.pi * part)), [1.0, 0, 0, 0, 0, 0])
    rates, sizes = np.array([1.0, 1.3, 1.0, 1.0, 2.0, 1.7]), np.array([0.02, 0.01, 0.0, 1.5, 1.0, 1.5])
    poses = REST @ axis @ se3.exp(turns) @ se3.inverse(axis) @ se3.exp(sizes * np.sin(stamps[:, None] * rates))
    look = Look(texel=0.2, wetness=0.3, drape=False)
    result = ran(shape, look, (640, 480), 600.0, poses, stamps, camera)
    error, measured = _error(result)
    note = f"{len(result.maps[-1]) - len(result.maps[0])} landmarks added to {len(result.maps[0])}; 0.67 mm a pixel"
    return [
        Figure(f"{name} camera alone: error while measured", float(np.sqrt(np.mean(error[measured] ** 2))), "mm"),
        Figure(f"{name} camera alone: largest", float(error[measured].max()), "mm"),
        Figure(
            f"{name} camera alone: error once the others are back",
            float(error[-5:].max()),
            "mm",
            at_most(0.1),
            "",
            note,
        ),
    ]


def _error(result: Ran) -> tuple[Array, NDArray[np.bool_]]:
    """Error (N,) mm from the first measured pose on, and which are measured (N,)."""
    first = next(i for i, pose in enumerate(result.poses) if pose.state.measured)
    change = se3.inverse(result.poses[first].base_from_surface) @ result.true[first]
    estimated = np.stack([pose.base_from_surface for pose in result.poses[first:]]) @ change
    error = np.linalg.norm((se3.inverse(result.true[first:]) @ estimated)[:, :3, 3], axis=1)
    return error, np.array([pose.state.measured for pose in result.poses[first:]])


def _growth(name: str, result: Ran) -> list[Figure]:
    error, measured = _error(result)
    added = len(result.maps[-1]) - len(result.maps[0])
    note = f"{len(result.maps[0])} at first"
    return [
        Figure(f"{name}: landmarks added", added, "", at_least(20), "", note),
        Figure(f"{name}: followed", 100 * float(measured.mean()), "%", at_least(100)),
        Figure(f"{name}: error, largest", float(error.max()), "mm", at_most(0.15), "", "0.7 mm a pixel"),
    ]
