"""What a live run shows beside its figures: the outline of what is followed, and the true error where it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.pose import SurfacePose
from estimation.rig import Camera, Rig, pixels_from_points
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmState, ArmStatus
from hardware.live.outline import Outline
from hardware.live.records import LiveMotionReport, TrackingReport
from hardware.live.true_error import TrueError
from hardware.motion.loop import Tick
from perception.frames import Roi
from planning.command import Move
from planning.kinematics import axes_from_nozzle
from planning.progress import Phase, Progress
from tests.moving import breathing, pose_at, raster

PROFILE = ArmProfile()
DOWN = se3.make(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 300.0]))
LENS = np.array([-0.1, 0.02, 1e-3, -1e-3, 0.0])
MATRIX = np.array([[800.0, 0, 320], [0, 800.0, 240], [0, 0, 1]])
RIG = Rig(
    tuple(
        Camera(name, (640, 480), MATRIX, LENS, se3.make(np.eye(3), [x, 0, 0]) @ DOWN)
        for name, x in (("a", 0.0), ("b", 60.0))
    )
)
SQUARE = np.array([[-20.0, -15, 0], [20, -15, 0], [20, 15, 0], [-20, 15, 0]])  # mm, surface frame


@pytest.mark.parametrize("camera", [0, 1])
def test_an_outline_is_carried_by_the_surface_that_it_was_told_on(camera: int) -> None:
    rng = np.random.default_rng(camera)
    landmarks = np.column_stack([rng.uniform(-30, 30, (400, 2)), np.zeros(400)])
    rest = se3.make(se3.exp_rotation([0.1, -0.05, 0.2]), [3.0, -2.0, 10.0])
    told = pixels_from_points(RIG.cameras[camera], se3.transform_points(rest, SQUARE))[0]
    outline = Outline(RIG)
    outline.lay([Roi(camera, 0.0, told)], landmarks, rest)
    assert outline.laid and outline.in_pixels(1 - camera, rest) == ()
    for moved in (rest, rest @ se3.exp(np.array([0.05, 0.02, 0.1, 2.0, -3.0, 6.0]))):
        (shown,) = outline.in_pixels(camera, moved)
        expected = pixels_from_points(RIG.cameras[camera], se3.transform_points(moved, SQUARE))[0]
        assert shown == pytest.approx(expected, abs=3.0)


def test_a_whole_picture_is_no_outline() -> None:
    outline = Outline(RIG)
    whole = np.array([[0.0, 0], [639, 0], [639, 479], [0, 479]])
    outline.lay([Roi(0, 0.0, whole)], np.zeros((50, 3)), np.eye(4))
    assert not outline.laid and outline.in_pixels(0, np.eye(4)) == ()


def reports(now: float, off: float, extrude: bool) -> tuple[TrackingReport, LiveMotionReport]:
    """The truth of 30 ms ago, and a command for where the path will be, `off` mm beside it."""
    path, due = raster(), now + PROFILE.tick + PROFILE.lag
    fraction = 0.5 * due
    points = path.surface_from_nozzle[:, :3, 3]
    place = np.array([np.interp(fraction, np.arange(len(points)), points[:, k]) for k in range(3)])
    beside = se3.make(np.eye(3), place + np.array([0.0, 0.0, off]))
    axes = axes_from_nozzle(PROFILE.arm, (breathing(due) @ beside)[None])[0]
    nan = float("nan")
    status = ArmStatus(now, ArmState.ARMED, "", axes, None, 0.0, nan, nan, 0.0, 0, 0, 0, 0)
    tick = Tick(now, Move(now, axes, 5.0, 1, extrude), b"", 0.0, status, "")
    progress = Progress(Phase.PRINTING, 1, len(path), 1.0, 9.0, fraction)
    motion = LiveMotionReport(tick, progress, False, (), (), 0, 0, None, 0, "ordinary")
    pose: SurfacePose = replace(pose_at(breathing, now - 0.03))
    return TrackingReport(now, ("a", "b"), pose=pose, truth=breathing(now - 0.03)), motion


@pytest.mark.parametrize("off", [0.0, 0.3, 2.0])
def test_the_true_error_is_the_way_from_the_nozzle_to_its_place(off: float) -> None:
    error = TrueError(raster())
    for k in range(60):
        error.look(*reports(0.02 * k, off, extrude=True), PROFILE)
    assert error.last == pytest.approx(off, abs=0.02)


def test_there_is_no_true_error_without_truth_or_while_nothing_is_printed() -> None:
    error = TrueError(raster())
    for k in range(20):
        error.look(*reports(0.02 * k, 1.0, extrude=False), PROFILE)
        assert np.isnan(error.last)
        tracking, motion = reports(0.02 * k, 1.0, extrude=True)
        error.look(replace(tracking, truth=None), motion, PROFILE)
        assert np.isnan(error.last)
