"""The wound's outline as an operator corrects it: recorded with its picture, and read back as a labelled one."""

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
from hardware.files.images import encode
from hardware.recording.messages import message_from_outlined, message_from_rig
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import corrected_pictures, open_session
from perception.frames import OutlinedPicture, Roi
from perception.mapping.features import polygon_mask
from tests.recorded import write_frames
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
    if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 4:
        return  # no polygon
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
