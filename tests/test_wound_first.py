"""Tracking that looks for the wound first, where nobody has said where the surface is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from estimation.pose import TrackState
from perception.contact_sheet import CELL, COLUMNS, Shown, contact_sheet
from perception.features import polygon_mask
from perception.frames import FrameSet, Image, Roi
from perception.tracking.step import TrackingStep
from perception.tracking.wound_step import LOOKS, WoundFirst
from perception.wound.segmentation import Segmentation
from tests.test_segmentation import disc, picture
from tests.test_tracking import RIG, ROIS, run, same, shot


class Sees:
    """A segmenter that knows where the surface is; `cameras` are those in which it finds it."""

    def __init__(self, sets: Sequence[FrameSet], cameras: Sequence[int]) -> None:
        self._camera = {id(f.image): f.camera for frames in sets for f in frames.frames}
        self._cameras = cameras

    def __call__(self, image: Image) -> Segmentation:
        camera = self._camera[id(image)]
        mask = polygon_mask(RIG.cameras[camera].size, ROIS[camera].polygon) > 0
        found = camera in self._cameras
        return Segmentation(mask & found, float(found), 0.7 if found else np.nan)


def first_step(sets: Sequence[FrameSet], cameras: Sequence[int]) -> tuple[WoundFirst, list[tuple[Roi, ...]]]:
    asked: list[tuple[Roi, ...]] = []

    def made(rois: Sequence[Roi]) -> TrackingStep:
        asked.append(tuple(rois))
        return TrackingStep(RIG, rois)

    return WoundFirst(RIG, made, Sees(sets, cameras)), asked


def test_the_surface_is_tracked_where_the_wound_was_seen() -> None:
    sets = shot(stamps=np.arange(9) / 10)
    step, asked = first_step(sets, (0, 1, 2))
    poses = []
    for frames in sets:
        poses.append(step(frames))
        step.idle()
    assert [p.state for p in poses[:3]] == [TrackState.INITIALISING] * 3
    assert "looked for" in poses[0].reason
    assert poses[-1].state is TrackState.TRACKING
    (rois,) = asked
    for roi, told in zip(rois, ROIS, strict=True):
        size = np.array(RIG.cameras[roi.camera].size)
        inside = np.clip(told.polygon, 0, size - 1)
        assert (roi.polygon.min(0) <= inside.min(0)).all() and (roi.polygon.max(0) >= inside.max(0)).all()
    assert all(same(a, b) for a, b in zip(poses[3:], run(sets[3:], rois), strict=True))


@pytest.mark.slow
def test_without_a_wound_in_two_cameras_the_whole_pictures_are_taken() -> None:
    sets = shot(stamps=np.arange(3 * LOOKS + 1) / 10)
    step, asked = first_step(sets, (1,))
    for frames in sets:
        step(frames)
    assert asked == [()]


@pytest.mark.slow
def test_a_camera_that_does_not_see_the_wound_is_searched_whole() -> None:
    sets = shot(stamps=np.arange(4) / 10)
    step, asked = first_step(sets, (0, 2))
    for frames in sets:
        step(frames)
    ((first, second, third),) = asked
    assert np.array_equal(second.polygon.max(0), RIG.cameras[1].size)
    assert (third.polygon.max(0) < RIG.cameras[2].size).any() and first.stamp == sets[0].stamp


def test_a_contact_sheet_has_three_rows_however_few_pictures_there_are() -> None:
    image, truth = picture((60, 50), 20, (100, 120))
    shown = [Shown(image, Segmentation(disc((100, 120), (60, 50), r), 0.9, 0.7), truth) for r in (20, 10, 4)]
    assert contact_sheet(shown).shape == (3 * CELL, COLUMNS * CELL, 3)
    assert contact_sheet([Shown(image, Segmentation(truth & False, 0.0, np.nan), truth & False)]).dtype == np.uint8
