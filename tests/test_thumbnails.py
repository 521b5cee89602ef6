"""Live pictures cost nothing while nobody looks; what a live run shows beside its figures."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.pose import SurfacePose
from estimation.rig import Camera, Rig, pixels_from_points
from hardware.arm.device import ArmState, ArmStatus, Reason
from hardware.arm.profile import ArmProfile
from hardware.files.images import decode
from hardware.live.records import LiveMotionReport, RunReports, TrackingReport
from hardware.live.view import NozzleErrorEstimate
from hardware.motion.loop import Tick
from hardware.operator.overlays import SurfaceOutline
from hardware.operator.process import THUMBNAIL_PERIOD, THUMBNAIL_WIDTH, CameraShot, Thumbnailer, crop_around
from hardware.operator.shared_state import PICTURES_CAPACITY, PagePictures, PageStatus
from hardware.process.system import SharedLatest
from perception.frames import Roi
from planning.command import Move
from planning.kinematics import axes_from_nozzle
from planning.path import PrintPhase, PrintProgress
from tests.moving_surfaces import breathing, pose_at, raster


def shot(width: int = 1280, height: int = 720) -> CameraShot:
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2] = (40, 60, 200)
    return CameraShot("camera0", image, (np.array([[1.0, 2.0], [3.0, 4.0]]),), np.array([[5.0, 6.0]]))


def looked_at(capacity: int = PICTURES_CAPACITY) -> tuple[SharedLatest[PagePictures], Thumbnailer]:
    """Where pictures go, and who makes them, with one window open."""
    pictures, line = SharedLatest[PagePictures](capacity), PageStatus()
    line.windows = 1
    return pictures, Thumbnailer(pictures, line)


def taken(pictures: SharedLatest[PagePictures]) -> PagePictures:
    end = time.monotonic() + 10
    while (found := pictures.get()) is None and time.monotonic() < end:
        time.sleep(0.005)
    assert found is not None
    return found


def test_a_picture_is_small_and_says_what_the_shot_said() -> None:
    pictures, taker = looked_at()
    assert taker.offer(3.5, [shot()], np.eye(4))
    found = taken(pictures)
    taker.close()
    (picture,) = found.pictures
    image = decode(picture.jpeg, "picture", "jpeg")
    assert image.shape == (360, THUMBNAIL_WIDTH, 3) and found.stamp == 3.5
    assert np.abs(image[100, 100].astype(int) - [40, 60, 200]).max() < 12 and image[100, 600].max() < 12
    assert picture.camera == "camera0" and picture.outline[0][1, 1] == 4.0 and picture.tracks[0, 0] == 5.0


PLACES = st.tuples(st.floats(0, 1279), st.floats(0, 719), st.floats(1, 900))


@given(PLACES)
def test_the_near_picture_holds_the_wound_in_the_images_proportions(place: tuple[float, float, float]) -> None:
    x, y, spread = place
    tracks = np.array([x, y]) + spread * np.random.default_rng(1).uniform(-0.5, 0.5, (200, 2))
    tracks = np.clip(tracks, 0, [1279, 719])
    image = np.zeros((720, 1280), np.uint8)
    crop = crop_around(CameraShot("camera0", image, tracks=tracks), None)
    left, top, width, height = crop or (0, 0, 1280, 720)
    assert min(left, top) >= 0 and left + width <= 1280 and top + height <= 720
    assert abs(width / height - 16 / 9) < 0.05 and width >= 1280 / 8
    inside = ((tracks >= [left, top]) & (tracks <= [left + width, top + height])).all(axis=1)
    assert inside.mean() > 0.9


def test_the_near_picture_rests_while_the_wound_breathes_and_follows_it_when_it_leaves() -> None:
    image = np.zeros((720, 1280), np.uint8)
    tracks = np.random.default_rng(1).uniform([500, 300], [700, 420], (100, 2))

    def around(shift: float, present: tuple[int, int, int, int] | None) -> tuple[int, int, int, int] | None:
        return crop_around(CameraShot("camera0", image, tracks=tracks + [shift, 0]), present)

    first = around(0, None)
    assert first is not None and around(20, first) == first and around(-20, first) == first
    moved = around(200, first)
    assert moved is not None and moved != first and moved[0] > first[0] + 150
    assert crop_around(CameraShot("camera0", image), first) == first


def test_nothing_is_taken_while_nobody_looks_nor_sooner_than_is_due() -> None:
    pictures: SharedLatest[PagePictures] = SharedLatest(PICTURES_CAPACITY)
    line = PageStatus()
    taker = Thumbnailer(pictures, line)
    assert not taker.offer(0.0, [shot()])
    line.windows = 1
    begun, accepted = time.monotonic(), 0
    while time.monotonic() < begun + 1.0:
        accepted += taker.offer(1.0, [shot()])
    taker.close()
    assert 1 <= accepted <= 1.0 / THUMBNAIL_PERIOD + 2


def test_offering_never_waits_for_the_pictures_to_be_made() -> None:
    _, taker = looked_at()
    large = [shot(3000, 2000)] * 3  # 60 ms of work
    spent = []
    for _ in range(200):
        begun = time.thread_time()
        taker.offer(1.0, large)
        spent.append(time.thread_time() - begun)
        time.sleep(0.003)
    taker.close()
    assert sorted(spent)[-3] < 0.002


def test_pictures_that_do_not_fit_are_dropped_and_the_next_ones_come() -> None:
    pictures, taker = looked_at(20_000)
    noise = np.random.default_rng(1).integers(0, 255, (360, 640, 3)).astype(np.uint8)
    assert taker.offer(1.0, [CameraShot("camera0", noise)])
    time.sleep(THUMBNAIL_PERIOD + 0.1)
    assert pictures.get() is None and taker.offer(2.0, [shot()])
    assert taken(pictures).stamp == 2.0
    taker.close()


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
    outline = SurfaceOutline(RIG)
    outline.place([Roi(camera, 0.0, told)], landmarks, rest)
    assert outline.on_surface and outline.in_pixels(1 - camera, rest) == ()
    for moved in (rest, rest @ se3.exp(np.array([0.05, 0.02, 0.1, 2.0, -3.0, 6.0]))):
        (shown,) = outline.in_pixels(camera, moved)
        expected = pixels_from_points(RIG.cameras[camera], se3.transform_points(moved, SQUARE))[0]
        assert shown == pytest.approx(expected, abs=3.0)


def test_a_whole_picture_is_no_outline() -> None:
    outline = SurfaceOutline(RIG)
    whole = np.array([[0.0, 0], [639, 0], [639, 479], [0, 479]])
    outline.place([Roi(0, 0.0, whole)], np.zeros((50, 3)), np.eye(4))
    assert not outline.on_surface and outline.in_pixels(0, np.eye(4)) == ()


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
    tick = Tick(now, Move(now, axes, 5.0, 1, extrude), b"", 0.0, status, Reason())
    progress = PrintProgress(PrintPhase.PRINTING, 1, len(path), 1.0, 9.0, fraction)
    motion = LiveMotionReport(tick, progress, None, (), (), 0, 0, None, 0, "ordinary")
    pose: SurfacePose = replace(pose_at(breathing, now - 0.03))
    return TrackingReport(now, ("a", "b"), pose=pose, truth=breathing(now - 0.03)), motion


@pytest.mark.parametrize("off", [0.0, 0.3, 2.0])
def test_the_true_error_is_the_way_from_the_nozzle_to_its_place(off: float) -> None:
    error = NozzleErrorEstimate(raster())
    for k in range(60):
        error.update(RunReports(*reports(0.02 * k, off, extrude=True)), PROFILE)
    assert error.last == pytest.approx(off, abs=0.02)


def test_there_is_no_true_error_without_truth_or_while_nothing_is_printed() -> None:
    error = NozzleErrorEstimate(raster())
    for k in range(20):
        error.update(RunReports(*reports(0.02 * k, 1.0, extrude=False)), PROFILE)
        assert np.isnan(error.last)
        tracking, motion = reports(0.02 * k, 1.0, extrude=True)
        error.update(RunReports(replace(tracking, truth=None), motion), PROFILE)
        assert np.isnan(error.last)
