"""The wound's outline as an operator corrects it: shown, recorded with its picture, read back as a labelled one."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.files.images import decode, encode
from hardware.files.region_table import crossing_edges
from hardware.operator.overlays import MAX_OUTLINE_CORNERS, OutlineSheet, wound_corners
from hardware.operator.shared_state import Polygons
from hardware.recording.messages import message_from_outlined, message_from_rig
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import corrected_pictures, open_session
from perception.frames import Frame, FrameSet, OutlinedPicture, Roi
from perception.mapping.features import polygon_mask
from perception.tracking.wound_step import SEGMENTATION_DELAY_SETS, RegionSearch
from perception.wound.segmentation import Segmentation, dice, largest_part
from tests import printed_sheet as sheet
from tests.recording_samples import write_frames
from tests.session_files import NAMES, image, rig
from tests.test_recording_format import foreign

SIZE = rig().cameras[0].size
ROUND = np.array([[5.0, 4.0], [40.2, 6.0], [33.0, 30.7], [9.0, 27.0]])


def outlined(camera: int = 0, stamp: float = 9.0, taken: float = 0.0, **changed: Any) -> OutlinedPicture:
    return replace(OutlinedPicture(camera, stamp, taken, image(camera, 7), ROUND, "operator"), **changed)


def recorded(path: Path, *pictures: OutlinedPicture) -> Path:
    with Recorder(path, rig(), jpeg_quality=20, overwrite=True, compress=False) as recorder:
        write_frames(recorder, 2, 3)
        for each in pictures:
            recorder.write(each)
    return path


@st.composite
def star(draw: st.DrawFn) -> np.ndarray:
    """A polygon (N, 2) px round a place in the picture; it may leave the picture."""
    turns = np.sort(draw(st.lists(st.floats(0, 6.28), min_size=3, max_size=20, unique_by=lambda turn: round(turn, 1))))
    reach = draw(st.lists(st.floats(4, 60), min_size=len(turns), max_size=len(turns)))
    middle = np.array([draw(st.floats(10, SIZE[0] - 10)), draw(st.floats(10, SIZE[1] - 10))])
    return middle + np.array(reach)[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])


@given(
    camera=st.integers(0, 2),
    taken=st.floats(-1e8, 1e8) | st.floats(1e9, 4e9),
    polygon=star(),
    seed=st.integers(0, 2**32 - 1),
    colour=st.booleans(),
)
def test_picture_and_mask_come_back_to_the_last_bit_whatever_the_quality_of_the_recording(
    tmp_path_factory: pytest.TempPathFactory, camera: int, taken: float, polygon: np.ndarray, seed: int, colour: bool
) -> None:
    x, y = polygon.T
    beside = (polygon.min(axis=0) > SIZE).any() or (polygon.max(axis=0) < 0).any()
    if beside or abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 4:
        return  # no polygon, or beside the picture
    noise = np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8)
    picture = noise if colour else noise[..., 0].copy()
    said = outlined(camera, taken + 20.0, taken, image=picture, polygon=polygon)
    path = recorded(tmp_path_factory.mktemp("o") / "x.mcap", said)
    (only,) = corrected_pictures(path)
    assert np.array_equal(only.picture, picture[..., ::-1] if colour else np.dstack([picture] * 3))
    assert only.picture.dtype == np.uint8 and only.picture.flags.c_contiguous
    assert only.wound.dtype == bool and np.array_equal(only.wound, polygon_mask(SIZE, polygon) > 0)
    assert only.name == f"x.mcap/{NAMES[camera]}_{taken:.6f}"


def test_a_mask_holds_what_lies_inside_and_nothing_beyond_a_pixel_of_its_line(tmp_path: Path) -> None:
    (only,) = corrected_pictures(recorded(tmp_path / "x.mcap", outlined()))
    line = ROUND.astype(np.float32)
    for (row, column), wound in np.ndenumerate(only.wound):
        away = cv2.pointPolygonTest(line, (float(column), float(row)), True)
        assert wound or away < 1.0
        assert not wound or away > -1.0


def test_each_picture_counts_once_with_the_last_outline_in_order_of_camera_and_stamp(tmp_path: Path) -> None:
    later = ROUND + 3.0
    said = [
        outlined(1, 9.0, 0.1),
        outlined(0, 9.0, 0.3),
        outlined(0, 12.0, 0.2, polygon=later),
        outlined(0, 11.0, 0.2),
    ]
    found = corrected_pictures(recorded(tmp_path / "x.mcap", *said))
    assert [each.name.split("/")[1] for each in found] == ["left_0.200000", "left_0.300000", "top_0.100000"]
    assert np.array_equal(found[0].wound, polygon_mask(SIZE, later) > 0)
    assert np.array_equal(found[1].wound, polygon_mask(SIZE, ROUND) > 0)


def test_an_outline_changes_nothing_that_a_session_is_read_as(tmp_path: Path) -> None:
    plain, more = (open_session(recorded(tmp_path / f"{k}.mcap", *given)) for k, given in enumerate(([], [outlined()])))
    assert plain.sets == more.sets and plain.roi == more.roi == () and more.damage == ""


def test_of_a_region_that_was_recorded_again_the_last_one_counts(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        write_frames(recorder, 2, 3)
        for camera in range(3):
            recorder.write(Roi(camera, 0.3, ROUND, found=True))
        for camera in (0, 2):
            recorder.write(Roi(camera, 7.3, ROUND + 1))
    rois = open_session(tmp_path / "x.mcap").roi
    assert [(roi.camera, roi.stamp, roi.found) for roi in rois] == [(0, 7.3, False), (2, 7.3, False)]


def test_regions_that_were_seen_at_different_stamps_all_count(tmp_path: Path) -> None:
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        write_frames(recorder, 2, 3)
        for camera in range(3):
            recorder.write(Roi(camera, 0.1 * camera, ROUND))
    assert [roi.camera for roi in open_session(tmp_path / "x.mcap").roi] == [0, 1, 2]


def broken(**changed: object) -> list[tuple[str, object]]:
    return [("/rig", message_from_rig(rig())), ("/wound_outline", {**message_from_outlined(outlined()), **changed})]


def small() -> str:
    return base64.b64encode(encode(image(0, 0)[:20])[1]).decode()


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([], ["/wound_outline", "no message", "corrected the wound's outline"]),
        (broken()[:1], ["/wound_outline", "no message", "corrected the wound's outline"]),
        (broken(camera=3), ["/wound_outline: camera", "3", "0..2"]),
        (broken(polygon=[1, 2, 3, 4]), ["2 points", "3 points or more"]),
        (broken(polygon=[1, 2, 3]), ["/wound_outline", "a message of its schema"]),
        (broken(polygon=[1, 2, 3, 4, 5, float("nan")]), ["finite"]),
        (broken(taken=float("nan")), ["stamp", "finite"]),
        (broken(polygon=[900, 900, 990, 900, 990, 990]), ["reaches into the image"]),
        (broken(data=small()), ["20 px", "the camera's `size`"]),
        (broken(data="bm90aGluZw=="), ["undecodable"]),
        (broken(data="?"), ["a message of its schema"]),
        (broken(data=None), ["a message of its schema"]),
    ],
)
def test_what_holds_no_corrected_picture_is_one_error(
    tmp_path: Path, messages: list[tuple[str, object]], words: list[str]
) -> None:
    foreign(tmp_path / "x.mcap", messages)
    with pytest.raises(InputError) as caught:
        corrected_pictures(tmp_path / "x.mcap")
    assert all(word in str(caught.value) for word in ["x.mcap", "allowed", *words])


def test_what_is_no_recording_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"nothing at all")
    for path in (tmp_path / "x.mcap", tmp_path / "gone.mcap", tmp_path):
        with pytest.raises(InputError, match=str(path)):
            corrected_pictures(path)


def test_of_a_recording_that_was_cut_short_what_is_whole_is_read(tmp_path: Path) -> None:
    path = recorded(tmp_path / "x.mcap", outlined(0), outlined(1, stamp=30.0))
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b'"by":"operator"')])
    assert [each.name.split("_")[0] for each in corrected_pictures(path)] == ["x.mcap/left"]


# -- what is shown for correction, and what becomes of it


@st.composite
def blob(draw: st.DrawFn) -> np.ndarray:
    """A wound's mask (H, W): some discs that touch, with holes, and specks beside it."""
    mask = np.zeros((120, 160), np.uint8)
    x, y = draw(st.integers(50, 110)), draw(st.integers(40, 80))
    for _ in range(draw(st.integers(1, 5))):
        cv2.circle(mask, (x, y), draw(st.integers(8, 26)), 1, -1)
        x, y = x + draw(st.integers(-8, 8)), y + draw(st.integers(-8, 8))
    cv2.circle(mask, (x, y), draw(st.integers(0, 4)), 0, -1)
    cv2.circle(mask, (5, 110), draw(st.integers(0, 3)), 1, -1)
    return mask > 0


@given(blob())
def test_the_outline_that_is_shown_is_a_polygon_of_few_corners_round_the_wound(mask: np.ndarray) -> None:
    corners = np.array(wound_corners(mask))
    assert 3 <= len(corners) <= MAX_OUTLINE_CORNERS and crossing_edges(corners) is None
    contours, _ = cv2.findContours(largest_part(mask).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(mask.shape, np.uint8), contours, 0, 1, -1) > 0
    assert dice(polygon_mask((160, 120), corners) > 0, filled) > 0.95


def test_no_wound_has_no_outline_and_a_line_has_none_that_could_be_drawn() -> None:
    mask = np.zeros((40, 60), bool)
    assert wound_corners(mask) == ()
    mask[20, 10:50] = True
    assert wound_corners(mask) == ()


def ragged(teeth: int) -> np.ndarray:
    """A mask like a comb, which no outline of few corners follows."""
    mask = np.zeros((120, 160), bool)
    mask[90:110, 10:150] = True
    mask[20:90, 10 : 10 + 4 * teeth : 4] = True
    return mask


def test_a_ragged_wound_has_an_outline_too() -> None:
    corners = np.array(wound_corners(ragged(30)))
    assert 3 <= len(corners) <= 64 and crossing_edges(corners) is None
    assert (polygon_mask((160, 120), corners) > 0)[ragged(30)].mean() > 0.9


SIDE = np.linspace(-60, 60, 31)
GROUND = np.column_stack([part.ravel() for part in np.meshgrid(SIDE, SIDE, [0.0])])  # (961, 3) mm, the sheet's plane
INSET = 20.0  # mm


def sheet_frames(cameras: int = 3) -> FrameSet:
    grain = np.random.default_rng(3).integers(0, 256, (cameras, sheet.SIZE[1], sheet.SIZE[0], 3), np.uint8)
    return FrameSet(5.0, tuple(Frame(c, 5.0 + c / 1000, grain[c]) for c in range(cameras)))


def drawn_at(stamp: float) -> Polygons:
    """A part of the printed sheet, as each camera sees it at `stamp`, s."""
    cameras = sheet.rig().cameras
    return tuple((c.name, tuple(map(tuple, sheet.corners_at(stamp, c, INSET)))) for c in cameras)


@given(st.floats(0.0, 8.0), st.floats(0.0, 8.0))
def test_an_outline_goes_to_where_the_surface_is_when_it_is_taken(then: float, now: float) -> None:
    shown = OutlineSheet(sheet.rig(), sheet_frames(), {})
    shown.place(GROUND, sheet.pose_at(then))
    shown.place(GROUND[:4], np.eye(4))  # later than the pictures: it says nothing of them
    rois = shown.rois(drawn_at(then), sheet.pose_at(now))
    for roi, (_, wanted) in zip(rois, drawn_at(now), strict=True):
        assert np.abs(roi.polygon - np.array(wanted)).max() < 0.7  # px: a corner has its neighbours' mean depth
        assert not roi.found and roi.stamp == -np.inf


def test_before_the_surface_is_measured_an_outline_stays_where_it_was_drawn() -> None:
    shown = OutlineSheet(sheet.rig(), sheet_frames(), {})
    for pose in (None, np.eye(4)):
        for roi, (_, wanted) in zip(shown.rois(drawn_at(0.0), pose), drawn_at(0.0), strict=True):
            assert np.array_equal(roi.polygon, np.array(wanted))


def test_an_outline_that_a_camera_would_not_see_any_more_stays_where_it_was_drawn() -> None:
    shown, away = OutlineSheet(sheet.rig(), sheet_frames(), {}), sheet.pose_at(0.0)
    away[0, 3] += 2000.0  # mm
    shown.place(GROUND, sheet.pose_at(0.0))
    for roi, (_, wanted) in zip(shown.rois(drawn_at(0.0), away), drawn_at(0.0), strict=True):
        assert np.array_equal(roi.polygon, np.array(wanted))


def test_what_is_recorded_are_the_very_pictures_and_corners_of_cameras_that_have_both() -> None:
    frames, polygons = sheet_frames(2), drawn_at(0.0)
    pictures = OutlineSheet(sheet.rig(), frames, {}).recorded(polygons[1:], 77.0)
    (only,) = pictures  # the first camera has no outline, and the third no picture
    assert only.image is frames.frames[1].image and only.taken == frames.frames[1].stamp
    assert (only.camera, only.stamp, only.by) == (1, 77.0, "operator")
    assert np.array_equal(only.polygon, np.array(polygons[1][1]))


def test_the_page_gets_each_picture_whole_with_its_outline_inside_it() -> None:
    outside = ((-20.0, 10.0), (200.0, -3.0), (9999.0, 9999.0))
    shown = OutlineSheet(sheet.rig(), sheet_frames(), {2: outside}).pictures()
    assert shown.stamp == 5.0 and [each.camera for each in shown.pictures] == [c.name for c in sheet.rig().cameras]
    assert [len(each.outline) for each in shown.pictures] == [0, 0, 1]
    width, height = sheet.SIZE
    assert shown.pictures[2].outline[0].tolist() == [[0, 10], [200, 0], [width - 1, height - 1]]
    for each in shown.pictures:
        assert decode(each.jpeg, "here", "jpeg").shape == (height, width, 3)


class Discs:
    """A segmenter that sees a disc in the pictures that are bright enough."""

    def __call__(self, picture: np.ndarray) -> Segmentation:
        mask = np.zeros(picture.shape[:2], bool)
        if picture.max() > 100:
            mask[40:80, 60:120] = True
            mask[100:104, 10:14] = True  # a speck beside it
        return Segmentation(mask, 0.9, 0.5)


def lit(stamp: float, *bright: bool) -> FrameSet:
    pictures = [np.full((sheet.SIZE[1], sheet.SIZE[0], 3), 200 if each else 50, np.uint8) for each in bright]
    return FrameSet(stamp, tuple(Frame(c, stamp, picture) for c, picture in enumerate(pictures)))


@pytest.mark.parametrize(
    ("bright", "seen"), [((1, 1, 1), [0, 1, 2]), ((1, 0, 1), [0, 2]), ((0, 0, 1), [2]), ((0, 0, 0), [])]
)
def test_what_the_network_saw_is_kept_with_the_pictures_that_it_was_given(
    bright: tuple[bool, ...], seen: list[int]
) -> None:
    search, sets = RegionSearch(sheet.rig(), Discs()), [lit(float(k), *bright) for k in range(20)]
    given = 0
    while isinstance(search(sets[given]), str):
        assert search.sight is None
        given += 1
    assert search.sight is not None and search.sight.frames in sets
    assert search.sight.frames.stamp == given - SEGMENTATION_DELAY_SETS
    assert list(search.sight.masks) == seen
    assert all(mask.sum() == 40 * 60 and mask[40:80, 60:120].all() for mask in search.sight.masks.values())


def test_a_printed_frame_is_no_wound_to_be_corrected() -> None:
    search, number = RegionSearch(sheet.rig(), Discs(), patch=True), 0
    while isinstance(search(lit(float(number), True, True, True)), str):
        number += 1
    assert search.sight is None
