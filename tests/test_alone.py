"""Where one camera alone sees the surface, the map grows by landmarks on its smooth continuation."""

from __future__ import annotations

from functools import cache

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.se3 import Array
from estimation.state_machine import StateSettings
from estimation.surface_map import SurfaceMap
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.bodies import Wound
from hardware.simulator.scene.scene import rois
from perception.frames import Frame, FrameSet
from perception.tracking.step import TrackingStep
from tests.synthetic import frame_sets, patch

RADIUS, COVERED = 46.0, 0.8  # mm; s, from when two cameras see nothing
RIG = arc_rig(size=(480, 360), focal=450.0)  # 0.9 mm a pixel
LIMB = patch(1, (80.0, 74.0), RADIUS, Wound((78.0, 72.0)))
FIRST = StateSettings().first  # the pose that is given out first
STAMPS = np.arange(34) / 10
AXIS = se3.make(np.eye(3), [0.0, 0.0, -RADIUS])


def turning(stamp: float) -> Array:
    """A limb that turns about its own axis until most of what was in view of the steep camera is not."""
    turn = 0.6 * 0.5 * (1 - np.cos(np.pi * np.clip((stamp - COVERED) / 2.5, 0, 1)))
    sway = [0.02 * np.sin(stamp), 0, 0, 1.5 * np.sin(stamp), np.sin(2 * stamp), 1.5 * np.sin(1.7 * stamp)]
    return np.asarray(REST @ AXIS @ se3.exp([turn, 0, 0, 0, 0, 0]) @ se3.inverse(AXIS) @ se3.exp(sway))


@cache
def followed() -> tuple[list[SurfacePose], SurfaceMap, slice]:
    """Poses while camera 2 alone sees the limb, the map at the end, and which of it camera 2 alone has seen."""
    step = TrackingStep(RIG, rois(LIMB, RIG, turning(0.0), 0.0))
    poses, rng, before = [], np.random.default_rng(7), 0
    for frames in frame_sets(LIMB, RIG, turning, STAMPS, np.random.default_rng(0)):
        shown = [
            f
            if f.camera == 2 or frames.stamp < COVERED
            else Frame(f.camera, f.stamp, rng.integers(90, 110, f.image.shape).astype(np.uint8))
            for f in frames.frames
        ]
        poses.append(step(FrameSet(frames.stamp, tuple(shown))))
        step.idle()
        if frames.stamp < COVERED and step.map is not None:
            before = len(step.map)
    assert step.map is not None
    return poses, step.map, slice(before, None)


def true_from_estimated() -> Array:
    first = next(p for p in followed()[0] if p.state.measured)
    return np.asarray(se3.inverse(turning(first.stamp)) @ first.base_from_surface)


def test_a_limb_that_one_camera_sees_is_followed_around() -> None:
    poses, _, _ = followed()
    change = se3.inverse(true_from_estimated())
    off = [np.linalg.norm((se3.inverse(turning(p.stamp)) @ p.base_from_surface @ change)[:3, 3]) for p in poses]
    assert all(p.state.measured for p in poses[FIRST:])
    assert np.mean(off[-6:]) < 0.75  # mm, and 0.95 without those that it alone sees


def test_what_one_camera_alone_has_seen_lies_on_the_surface_as_claimed() -> None:
    _, surface_map, alone = followed()
    points = se3.transform_points(true_from_estimated(), surface_map.points[alone])
    assert len(points) >= 8
    place = LIMB.shape.material(points)
    normals = LIMB.shape.normals(place)
    off = np.einsum("ni,ni->n", points - LIMB.shape.points(place), normals)
    inner, count = normals @ true_from_estimated()[:3, :3], len(surface_map)
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(count, 3, count, 3))[alone]
    claimed = np.sqrt(np.einsum("ni,nij,nj->n", inner, blocks, inner))
    assert np.median(np.abs(off)) < 0.5
    assert np.mean((off / claimed) ** 2) < 2.5


def test_the_covariance_of_the_map_stays_one() -> None:
    assert np.linalg.eigvalsh(followed()[1].covariance).min() > -1e-9
