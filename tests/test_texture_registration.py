"""Registering by the skin's texture carries tracks onto the true surface; laying a path onto a surface."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig, ideal_pixels
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.simulator.motion_table import motion_from_tables
from hardware.simulator.scene.shape import Deformation, Shape, Wound, body, cylinder, flat
from hardware.simulator.truth import (
    MIN_REGISTRATION_TRACKS,
    Truth,
    divide_path,
    drape_path,
    surface_points,
    truth_from_estimate,
)
from planning.path import check_path, way_lengths
from tests.moving_surfaces import path_through, raster

RIG = arc_rig()
RAMP = {"kind": "ramp", "speed_mm_s": [5.0, -3.0, 8.0], "speed_deg_s": [3.0, 2.0, -4.0]}
MOTION = motion_from_tables("test", [RAMP], Path("."), 0)
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
    return Truth(BASE_FROM_REST, MOTION, STRAINED if strained else Deformation(), strain, shape.surface_from_grid)


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
    assert not met[::3].any() and not met[1::3].any()


def moved(rig: Rig, shift: Array) -> Rig:
    """The rig with all its cameras moved by a transform (4, 4) of the base."""
    return Rig(tuple(replace(c, base_from_camera=shift @ c.base_from_camera) for c in rig.cameras))


def at(pose: Array) -> SurfacePose:
    return SurfacePose(1.0, pose, np.eye(6), np.zeros(6), TrackState.TRACKING)


TOGETHER = np.full(3, 1.0)
CHANGE = se3.make(se3.exp_rotation([0.3, -1.2, 2.0]), [7.0, -5.0, 3.0])  # truth_surface_from_estimated_surface


@pytest.mark.parametrize(
    ("shift", "slip"),
    [
        (np.eye(4), np.eye(4)),
        (se3.make(se3.exp_rotation([0.01, 0.02, -0.01]), [0.3, -0.2, 0.5]), np.eye(4)),
        (np.eye(4), se3.exp([0.001, 0, 0, 0, 0.2, 0])),
    ],
    ids=["exact", "shifted rig", "pose that is off"],
)
def test_a_change_of_the_surface_frame_is_recovered(shift: Array, slip: Array) -> None:
    """What the rig has wrong shifts all alike: the frame on the skin is the same. What the tracker's first pose has
    wrong is laid into the path, as it would be by an operator."""
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER)
    pose = at(shift @ true.base_from_surface(TOGETHER)[0] @ CHANGE @ slip)
    found = truth_from_estimate(pose, observations, (RIG, moved(RIG, shift)), true, shape, TOGETHER)
    assert found == pytest.approx(CHANGE @ slip, abs=1e-5)


def test_noise_of_the_tracks_does_not_matter() -> None:
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER, 200)
    noisy = observations.pixels + np.random.default_rng(1).normal(0, 0.1, observations.pixels.shape)
    pose = at(true.base_from_surface(TOGETHER)[0] @ CHANGE)
    found = truth_from_estimate(pose, replace(observations, pixels=noisy), (RIG, RIG), true, shape, TOGETHER)
    assert found == pytest.approx(CHANGE, abs=1e-5)  # it is in both poses


@pytest.mark.parametrize("count", [0, MIN_REGISTRATION_TRACKS - 1, MIN_REGISTRATION_TRACKS])
def test_too_few_tracks_on_the_surface_register_nothing(count: int) -> None:
    shape = shapes()["wound"]
    true = truth(shape)
    observations, _ = seen(shape, true, TOGETHER, 30)
    away = observations.pixels.copy()
    away[count:] += [0.0, 5000.0]
    there = replace(observations, pixels=away)
    pose = at(true.base_from_surface(TOGETHER)[0] @ CHANGE)
    found = truth_from_estimate(pose, there, (RIG, RIG), true, shape, TOGETHER)
    assert (found is None) is (count < MIN_REGISTRATION_TRACKS)


@given(st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20)), min_size=2, max_size=6, unique=True))
def test_a_divided_path_is_the_same_line_in_pieces_of_a_millimetre(xy: list[tuple[float, float]]) -> None:
    points = np.column_stack([xy, np.linspace(0, 1, len(xy))])
    path = path_through(points)
    fine = divide_path(path, 1.0)
    step = way_lengths(fine.surface_from_nozzle)
    assert step.max() <= 1.0 + 1e-9
    assert step.sum() == pytest.approx(way_lengths(path.surface_from_nozzle).sum())
    distance = np.linalg.norm(fine.surface_from_nozzle[:, None, :3, 3] - points, axis=-1)
    assert distance.min(axis=0).max() < 1e-9  # every checkpoint is still there


def test_a_new_checkpoint_takes_after_the_next_of_the_old_ones() -> None:
    path = replace(
        path_through(np.array([[0.0, 0, 0], [3, 0, 0], [3, 2.5, 0]])),
        speed=np.array([1.0, 2, 3]),
        extrude=np.array([False, True, False]),
        layer=np.array([0, 1, 2]),
        extra={"note": np.array(["a", "b", "c"])},
    )
    fine = divide_path(path, 1.0)
    assert fine.speed.tolist() == [1, 2, 2, 2, 3, 3, 3]
    assert fine.extrude.tolist() == [False, True, True, True, False, False, False]
    assert fine.layer.tolist() == [0, 1, 1, 1, 2, 2, 2] and fine.extra["note"].tolist() == list("abbbccc")
    assert fine.surface_from_nozzle[:, 0, 3] == pytest.approx([0, 1, 2, 3, 3, 3, 3])
    check_path(fine)


def test_a_stretch_on_which_the_tool_turns_is_left_whole() -> None:
    path = path_through(np.array([[0.0, 0, 0], [5, 0, 0], [9, 0, 0]]))
    path.surface_from_nozzle[1:, :3, :3] = se3.exp_rotation([0.0, 0.2, 0.0])
    assert len(divide_path(path, 1.0)) == 1 + 1 + 4


@pytest.mark.parametrize("shape", [flat((40, 40)), cylinder((40, 40), 45.0)], ids=["flat", "cylinder"])
def test_a_laid_path_stands_at_its_clearance_above_the_surface(shape: Shape) -> None:
    path = drape_path(raster(20.0), shape, 0.4)
    places = path.surface_from_nozzle[:, :3, 3]
    assert places[:, 2] - shape.heights_at(places[:, :2]) == pytest.approx(0.4)
    assert np.array_equal(path.surface_from_nozzle[:, :3, :3], np.broadcast_to(np.eye(3), (len(path), 3, 3)))


def test_on_a_scan_whose_frame_is_tilted_the_clearance_is_along_the_frames_own_z() -> None:
    bent = cylinder((60, 60), 45.0)
    tilted = replace(bent, surface_from_grid=se3.make(se3.exp_rotation([0.3, -0.4, 0.2]), [3.0, -2.0, 40.0]))
    path = raster(10.0)
    places = drape_path(path, tilted, 0.4).surface_from_nozzle[:, :3, 3]
    below = places - [0, 0, 0.4]
    assert tilted.points(tilted.material(below)) == pytest.approx(below, abs=1e-4)
    assert np.array_equal(places[:, :2], divide_path(path, 1.0).surface_from_nozzle[:, :2, 3])


@pytest.mark.parametrize("side", [10.1, -10.1])
def test_a_path_that_leaves_the_surface_is_refused(side: float) -> None:
    shape = flat((40, 20))
    path = path_through(np.array([[0.0, 0, 0], [0, np.sign(side) * 10, 0]]))
    drape_path(path, shape, 0.4)
    with pytest.raises(InputError, match=r"x\.csv: a place on the path.*40 x 20 mm"):
        drape_path(path_through(np.array([[0.0, 0, 0], [0, side, 0]])), shape, 0.4, "x.csv")


def test_a_path_over_a_hole_of_a_scan_is_refused() -> None:
    shape = flat((40, 20))
    valid = np.ones(shape.heights.shape, bool)
    valid[10, 20] = False  # the node in the middle
    holed = replace(shape, valid=valid)
    drape_path(path_through(np.array([[-5.0, 1, 0], [5, 1, 0]])), holed, 0.4)
    with pytest.raises(InputError, match=r"x = 0\.00, y = 0\.00 mm"):
        drape_path(path_through(np.array([[-5.0, 0, 0], [5, 0, 0]])), holed, 0.4)


def test_the_layers_of_a_path_stay_above_each_other() -> None:
    low = raster(20.0).surface_from_nozzle[:, :3, 3]
    both = path_through(np.concatenate([low, low[::-1] + [0, 0, 0.7]]))
    shape = cylinder((40, 40), 45.0)
    places = drape_path(both, shape, 0.4).surface_from_nozzle[:, :3, 3]
    above = places[:, 2] - shape.heights_at(places[:, :2])
    half = len(above) // 2
    assert above[: half - 1] == pytest.approx(0.4) and above[half + 1 :] == pytest.approx(1.1)
