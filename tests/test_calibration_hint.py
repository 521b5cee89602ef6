"""Pictures that are mirrored, upside down or exchanged are told from the start, and none is where nothing is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.simulator.scene.scene import rois
from perception.frames import Frame, FrameSet, Image, Roi
from perception.mapping.features import calibration_hint, grey
from perception.tracking.step import TrackingStep
from tests.rendered_sets import WIDE, patch, pictures
from tests.slow_cases import slowly

RIG = arc_rig(size=(640, 480), focal=560.0)
SCENE = patch(2, wound=WIDE)
NAMES = [camera.name for camera in RIG.cameras]
EVERY = frozenset(range(len(RIG)))
LAST = np.array(RIG.cameras[0].size) - 1.0

Trick = tuple[tuple[int, ...], str]  # cameras, and what is done to their pictures


def tricked(images: list[Image], polygons: list[Array], trick: Trick) -> tuple[list[Image], list[Array]]:
    """Pictures and regions (N, 2) px of all cameras, some of them as no camera that is set up rightly shows them."""
    cameras, kind = trick
    images, polygons = list(images), list(polygons)
    if kind == "exchanged":
        a, b = cameras
        images[a], images[b], polygons[a], polygons[b] = images[b], images[a], polygons[b], polygons[a]
        return images, polygons
    for c in cameras:
        turned = images[c][:, ::-1] if kind == "mirrored" else images[c][::-1, ::-1]
        images[c] = np.ascontiguousarray(turned)
        flipped = LAST - polygons[c]
        polygons[c] = flipped if kind == "upside down" else np.column_stack([flipped[:, 0], polygons[c][:, 1]])
    return images, polygons


def seen(seed: int, trick: Trick = ((), "")) -> tuple[list[Image], list[Array]]:
    images = [grey(image) for image in pictures(SCENE, RIG.cameras, BASE_FROM_REST, np.random.default_rng(seed))]
    polygons = [roi.polygon for roi in sorted(rois(SCENE, RIG, BASE_FROM_REST, 0.0), key=lambda roi: roi.camera)]
    return tricked(images, polygons, trick)


def hint(trick: Trick, suspects: frozenset[int] = EVERY) -> tuple[frozenset[int], str]:
    images, polygons = seen(0, trick)
    return calibration_hint(RIG, dict(enumerate(images)), dict(enumerate(polygons)), suspects)


def test_where_nothing_is_wrong_there_is_no_hint() -> None:
    assert hint(((), "")) == (frozenset(), "")


@pytest.mark.parametrize(
    "trick",
    [
        *(((1,), "upside down"), ((0, 1, 2), "mirrored"), ((0, 2), "exchanged")),
        *slowly(((0,), "mirrored"), ((2,), "mirrored"), ((0, 1, 2), "upside down"), ((1, 2), "exchanged")),
    ],
)
def test_what_is_wrong_is_told_of_the_right_cameras(trick: Trick) -> None:
    cameras, kind = trick
    told = {1: f"{NAMES[cameras[0]]} looks {kind}", 3: f"all cameras look {kind}"}
    told[2] = f"{NAMES[cameras[0]]} and {NAMES[cameras[-1]]} look {kind}"
    assert hint(trick) == (frozenset(cameras), told[len(cameras)])


def test_a_calibration_that_is_wrong_otherwise_is_contradicted_by_matches() -> None:
    """A picture shifted across the baseline: nothing that is looked for."""
    images, polygons = seen(0)
    images[2], polygons[2] = np.roll(images[2], 150, axis=1), polygons[2] + [150, 0]
    found = calibration_hint(RIG, dict(enumerate(images)), dict(enumerate(polygons)), frozenset([2]))
    assert found == (frozenset([2]), f"the matches of {NAMES[2]} contradict the calibration: calibrate again")


def followed(trick: Trick, sets: int = 8) -> list[SurfacePose]:
    _, polygons = seen(0, trick)
    step, poses = TrackingStep(RIG, [Roi(c, 0.0, polygon) for c, polygon in enumerate(polygons)]), []
    for number in range(sets):
        stamp = number / 30
        images, _ = seen(number, trick)
        poses.append(step(FrameSet(stamp, tuple(Frame(c, stamp, image) for c, image in enumerate(images)))))
        step.idle()
    return poses


def test_a_mirrored_camera_is_never_missed_in_silence() -> None:
    poses = followed(((1,), "mirrored"))
    assert TrackState.TRACKING not in {p.state for p in poses}
    assert poses[-1].state is TrackState.DEGRADED
    assert poses[-1].reason == f"{NAMES[1]} shows nothing of the map, {NAMES[1]} looks mirrored"


def test_no_pose_is_given_by_mirrored_pictures_alone() -> None:
    poses = followed(((0, 1, 2), "mirrored"))
    assert TrackState.TRACKING not in {p.state for p in poses} and poses[-1].state is TrackState.INITIALISING
    assert "all cameras look mirrored" in poses[-1].reason


def test_cameras_that_see_the_map_are_not_named() -> None:
    assert followed(((), ""))[-1].state is TrackState.TRACKING
