"""Registering by the skin's texture: tracks are carried onto the true surface, and the tracker's frame comes out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.bodies import Wound, body
from hardware.simulator.deformation import Deformation
from hardware.simulator.motion_table import motion_from_tables
from hardware.simulator.registering import LEAST, surface_points, truth_from_estimate
from hardware.simulator.scene.shape import Shape, cylinder, flat
from hardware.simulator.truth import Truth

RIG = arc_rig()
MOTION = motion_from_tables(
    "test", [{"kind": "ramp", "speed_mm_s": [5.0, -3.0, 8.0], "speed_deg_s": [3.0, 2.0, -4.0]}], Path("."), 0
)
EXPOSED = np.array([1.0, 1.004, 0.989])  # s: cameras that do not fire together
STRAINED = Deformation((0.03, -0.02), bulge=2.0, radius=20.0)


@cache
def shapes() -> dict[str, Shape]:
    tilted = se3.make(se3.exp_rotation([0.15, -0.1, 0.7]), [4.0, -6.0, 9.0])
    return {
        "flat": flat((60, 40)),
        "cylinder": cylinder((60, 40), 45.0),
        "wound": body("forearm", Wound(), 3),
        "scan": replace(cylinder((60, 40), 60.0), surface_from_grid=tilted),
    }


def truth(shape: Shape, strained: bool = False) -> Truth:
    strain = (lambda times: 0.5 + 0.5 * np.asarray(times)) if strained else None
    return Truth(REST, MOTION, STRAINED if strained else Deformation(), strain, shape.surface_from_grid)


def seen(shape: Shape, true: Truth, exposed: Array = EXPOSED, count: int = 90) -> tuple[Observations, Array]:
    """What the cameras see of material points (N, 3) of the shape, and these; each in the camera it faces most."""
    rng = np.random.default_rng(7)
    flat_places = rng.uniform(-0.35, 0.35, (count, 2)) * shape.size
    points, normals = shape.points(flat_places), shape.normals(flat_places)
    poses, amount = true.base_from_surface(exposed), true.amount(exposed)
    camera, pixels = np.zeros(count, np.int64), np.zeros((count, 2))
    for i in range(count):
        directions = [
            (c.base_from_camera[:3, 3] - poses[k][:3, 3]) @ poses[k][:3, :3] @ normals[i]
            for k, c in enumerate(RIG.cameras)
        ]
        k = camera[i] = int(rng.choice(np.argsort(directions)[-2:]))
        there = points[i] + true.displacement(points[i : i + 1], amount[k : k + 1])[0]
        pixels[i] = ideal_pixels(RIG.cameras[k], se3.transform_points(poses[k], there[None]))[0][0]
    return Observations(1.0, camera, np.arange(count), pixels, np.full(count, 0.1)), points


@pytest.mark.parametrize("strained", [False, True], ids=["rigid", "strained"])
@pytest.mark.parametrize("name", ["flat", "cylinder", "wound", "scan"])
def test_known_points_of_the_surface_are_found_again_under_their_pixels(name: str, strained: bool) -> None:
    shape = shapes()[name]
    true = truth(shape, strained)
    observations, points = seen(shape, true)
    found, met = surface_points(observations, RIG, true, shape, EXPOSED)
    assert met.all()
    assert np.linalg.norm(found - points, axis=1).max() < 1e-4


def test_a_ray_that_passes_the_surface_by_meets_nothing() -> None:
    shape = cylinder((60, 40), 45.0)
    true = truth(shape)
    observations, points = seen(shape, true)
    pixels = observations.pixels.copy()
    pixels[::3] += [0.0, 700.0]
    pixels[1::3] += [700.0, 0.0]  # beyond the rectangle, where it is not known
    found, met = surface_points(replace(observations, pixels=pixels), RIG, true, shape, EXPOSED)
    assert met[2::3].all()
    assert np.abs(found - points)[2::3].max() < 1e-4
    assert not met[::3].any()
    assert not met[1::3].any()


def moved(rig: Rig, shift: Array) -> Rig:
    """The rig with all its cameras moved by a transform (4, 4) of the base."""
    return Rig(tuple(replace(c, base_from_camera=shift @ c.base_from_camera) for c in rig.cameras))


def at(pose: Array) -> SurfacePose:
    return SurfacePose(1.0, pose, np.eye(6), np.zeros(6), TrackState.TRACKING)


TOGETHER = np.full(3, 1.0)
CHANGE = se3.make(se3.exp_rotation([0.3, -1.2, 2.0]), [7.0, -5.0, 3.0])  # truth_surface_from_estimated_surface


def test_a_known_change_of_the_surface_frame_is_recovered() -> None:
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER)
    pose = at(true.base_from_surface(TOGETHER)[0] @ CHANGE)
    found = truth_from_estimate(pose, observations, (RIG, RIG), true, shape, TOGETHER)
    assert found == pytest.approx(CHANGE, abs=1e-5)


def test_what_the_rig_has_wrong_stays_in_the_pose_and_not_in_the_change() -> None:
    """A tracker that was told a shifted rig sees everything shifted: its frame on the skin is the same."""
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER)
    shift = se3.make(se3.exp_rotation([0.01, 0.02, -0.01]), [0.3, -0.2, 0.5])
    pose = at(shift @ true.base_from_surface(TOGETHER)[0] @ CHANGE)
    found = truth_from_estimate(pose, observations, (RIG, moved(RIG, shift)), true, shape, TOGETHER)
    assert found == pytest.approx(CHANGE, abs=1e-5)


def test_a_pose_that_is_off_by_itself_shows_in_the_change() -> None:
    """What the tracker's first pose has wrong is laid into the path, as it would be by an operator."""
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER)
    slip = se3.exp([0.001, 0, 0, 0, 0.2, 0])
    pose = at(true.base_from_surface(TOGETHER)[0] @ CHANGE @ slip)
    found = truth_from_estimate(pose, observations, (RIG, RIG), true, shape, TOGETHER)
    assert found == pytest.approx(CHANGE @ slip, abs=1e-5)


def test_noise_of_the_tracks_does_not_matter() -> None:
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER, 200)
    noisy = observations.pixels + np.random.default_rng(1).normal(0, 0.1, observations.pixels.shape)
    pose = at(true.base_from_surface(TOGETHER)[0] @ CHANGE)
    found = truth_from_estimate(pose, replace(observations, pixels=noisy), (RIG, RIG), true, shape, TOGETHER)
    assert found == pytest.approx(CHANGE, abs=1e-5)  # it is in both poses


@pytest.mark.parametrize("count", [0, LEAST - 1, LEAST])
def test_too_few_tracks_on_the_surface_register_nothing(count: int) -> None:
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER, 30)
    away = observations.pixels.copy()
    away[count:] += [0.0, 5000.0]
    there = replace(observations, pixels=away)
    pose = at(true.base_from_surface(TOGETHER)[0] @ CHANGE)
    found = truth_from_estimate(pose, there, (RIG, RIG), true, shape, TOGETHER)
    assert (found is None) is (count < LEAST)
