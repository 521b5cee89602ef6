"""`stillbed cameras`: lists, watches, writes its sheet, and says what to do."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hardware.cameras.feed import CameraPlace
from hardware.cameras.inspection import CELL_SIZE, preview_sheet, sharpness
from hardware.cameras.live import LiveCameras
from hardware.cameras.sources import CameraSource, identity_from_text, list_devices
from hardware.cli.main import main
from tests.camera_streams import CLOCK, HttpCamera, picture, served
from tests.test_camera_names import rig_file


def test_two_streams_are_watched_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = HttpCamera(fps=20), HttpCamera(fps=20)
    with served(*cameras):
        urls = [camera.url for camera in cameras]
        assert main(["cameras", *urls, "--seconds", "1.5", "--json", "-o", str(tmp_path / "sheet.png")]) == 0
        told = json.loads(capsys.readouterr().out)
        assert [one["source"] for one in told["cameras"]] == urls and told["trouble"] == ""
        for one in told["cameras"]:
            assert one["size_px"] == [160, 120] and one["frames"] > 5 and one["sharpness"] > 100
            assert 100 < one["grey_level"] < 160 and one["left_out"].get("frozen", 0) == 0
        shown = cv2.imread(str(tmp_path / "sheet.png"))
        assert shown is not None and shown.shape[1] == 2 * CELL_SIZE[0]
        assert shown[: CELL_SIZE[1], : CELL_SIZE[0]].std() > 20
        assert main(["cameras", urls[0], "http://127.0.0.1:9/none", "--seconds", "0.5"]) == 1
        assert "TROUBLE: camera 2 cannot be opened since" in capsys.readouterr().out


def test_a_rig_is_watched_by_name_and_refused_controls_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = HttpCamera(picture_of=lambda n: np.kron(picture(n)[:90], np.ones((8, 8, 1), np.uint8)))
    with served(camera):
        rig = rig_file(tmp_path, f'source = "{camera.url}"\ngain = 3')
        assert main(["cameras", str(rig), "--seconds", "1"]) == 1
    told = capsys.readouterr().out
    assert told.startswith("c0\n") and "1280 x 720 px" in told
    assert "c0 did not take gain not there, asked for 3" in told


def test_a_sheet_that_is_there_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Above all where it is the picture that is looked at."""
    shown = tmp_path / "wound.png"
    cv2.imwrite(str(shown), picture(1))
    before = shown.read_bytes()
    assert main(["cameras", str(shown), "--seconds", "0.1", "-o", str(shown)]) == 2
    assert shown.read_bytes() == before and "--force" in capsys.readouterr().err


def test_no_cameras_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    if not list_devices():
        assert main(["cameras"]) == 0 and "connect one" in capsys.readouterr().out
        assert main(["cameras", "--json"]) == 0 and json.loads(capsys.readouterr().out) == []


def test_a_sharper_picture_has_the_higher_number() -> None:
    blurred = np.asarray(cv2.GaussianBlur(picture(1), (0, 0), 1.5), np.uint8)
    assert sharpness(picture(1)) > 2 * sharpness(blurred)


def test_a_sheet_has_a_cell_for_a_camera_without_a_picture() -> None:
    cells = [(picture(1), ["one"], True), (None, ["two", "gone"], False), (picture(2)[..., 0], ["three"], True)]
    drawn = preview_sheet(cells)
    assert drawn.shape[1] == 2 * CELL_SIZE[0] and drawn.shape[0] > 2 * CELL_SIZE[1]


def test_a_camera_that_is_plugged_in_delivers() -> None:
    found = [device.identity for device in list_devices() if device.identity]
    if not found:
        pytest.skip("no camera is plugged in, nor is a v4l2loopback device fed")
    source = CameraSource(identity_from_text("test", "source", found[0], Path()))
    with LiveCameras([CameraPlace(0, "plugged in", None)], [source], CLOCK) as live:
        end = CLOCK.now() + 10
        sets = [one for _ in range(10) if (one := live.next_set(end)) is not None]
        assert len(sets) == 10, live.health().trouble
