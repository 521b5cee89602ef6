"""`stillbed calibrate arm --device`: a virtual arm on a pseudo-terminal, network cameras that show where it is."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.arc_rig import arc_rig
from hardware.arm.profile import BITS_PER_BYTE
from hardware.arm_calibration.commanded import NAME, read_commanded
from hardware.cli.main import main
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.rig_file import ImageSource, write_rig
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.port import _serve
from hardware.simulator.pty_link import open_pty
from hardware.simulator.watched_arm import WatchedArm, watched_arm
from perception.frames import Image
from perception.tool_profile import SYRINGE
from planning.kinematics import SimpleArm, nozzle_from_axes
from tests.streams import CLOCK, HttpCamera, served

pytestmark = pytest.mark.slow
NEEDLE = 2  # knots of the tool's outline that are the needle's
CLOTH, STEEL, BODY = 130, 225, 60  # grey: colour would be stored at half the resolution
FINE = 4  # bits of a pixel that outlines are drawn to
FPS = 8.0
SIZE = (800, 600)  # px: the middle of what the simulated cameras see
GRAIN = np.random.default_rng(0).integers(0, 4, (1024, SIZE[0])).astype(np.uint8)


def drawn(camera: Camera, base_from_nozzle: Array, number: int) -> Image:
    """What a camera sees of the tool before a plain cloth; a picture that is none of the others, as of any sensor."""
    width, height = camera.size
    image = np.full((height, width), CLOTH, np.uint8)
    axis = se3.transform_points(base_from_nozzle, np.array([[0, 0, z] for z in SYRINGE[:, 0]]))
    pixels, depth = pixels_from_points(camera, axis)
    half = SYRINGE[:, 1] * camera.matrix[0, 0] / depth
    ahead = pixels[-1] - pixels[0]
    side = np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
    left, right = pixels - half[:, None] * side, pixels + half[:, None] * side
    for part, grey in ((slice(None, NEEDLE), STEEL), (slice(NEEDLE - 1, None), BODY)):
        outline = np.round(np.vstack([left[part], right[part][::-1]]) * 2**FINE).astype(np.int32)
        cv2.fillPoly(image, [outline], grey, cv2.LINE_AA, FINE)
    cut = np.random.default_rng(number).integers(0, 256)
    return np.asarray(cv2.add(image, GRAIN[cut : cut + height, :width]), np.uint8)


@contextmanager
def on_a_terminal(watched: WatchedArm) -> Iterator[tuple[str, VirtualArm]]:
    """The arm's device, and the arm, which says meanwhile where it is."""
    told = watched.told
    arm = VirtualArm(watched.settings, told.dialect, watched.begin, (), told.baud)
    (ours, theirs, device), stop = open_pty(), threading.Event()
    os.set_blocking(ours, False)
    serve = threading.Thread(target=_serve, args=(ours, arm, told.baud / BITS_PER_BYTE, CLOCK, stop))
    serve.start()
    try:
        yield device, arm
    finally:
        stop.set()
        serve.join()
        os.close(theirs)
        os.close(ours)


def shown(arm: VirtualArm, true: SimpleArm, camera: Camera) -> HttpCamera:
    return HttpCamera(FPS, lambda n: drawn(camera, nozzle_from_axes(true, arm.axes_at(np.array([arm.now]))[0]), n))


def test_an_arm_before_live_cameras_is_moved_recorded_and_calibrated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    watched = replace(watched_arm(3), rig=arc_rig(size=SIZE))
    record, out = tmp_path / "moved", tmp_path / "arm.toml"
    told = replace(watched.told, arm=replace(watched.told.arm, home=watched.begin))
    write_arm(tmp_path / "told.toml", told)
    with on_a_terminal(watched) as (device, arm):
        cameras = [shown(arm, watched.true, camera) for camera in watched.rig.cameras]
        with served(*cameras):
            sources = [ImageSource("source", camera.url) for camera in cameras]
            write_rig(tmp_path / "rig.toml", watched.rig, sources)
            files = ["--cameras", str(tmp_path / "rig.toml"), "--arm", str(tmp_path / "told.toml"), "-o", str(out)]
            moves = ["--places", "10", "--dwell-s", "2", "--reach-mm", "30", "--keep-latency", "--stands", "home"]
            wishes = [*files, *moves, "--yes", "--record", str(record), "--limit-mm", "0.5"]
            code = main(["calibrate", "arm", "--device", device, *wishes])
        rested = arm.axes_at(np.array([arm.now]))[0]
    told_of, trouble = capsys.readouterr()
    assert code == 0 and told_of.startswith("PASS"), told_of + trouble
    found = read_arm(out).arm
    change = found.arm_from_base @ se3.inverse(watched.true.arm_from_base)
    assert np.degrees(se3.angle_of(change)) < 0.2
    assert np.linalg.norm(se3.transform_points(change, watched.begin[None, :3])[0] - watched.begin[:3]) < 0.5
    assert found.tool_offset == pytest.approx(watched.true.tool_offset, abs=0.5)
    assert rested == pytest.approx(watched.begin, abs=1e-3)  # it came back
    assert np.abs(read_commanded(record / NAME).axes[:, :3] - watched.begin[:3]).max() > 20
    first = out.read_text()
    assert main(["calibrate", "arm", str(record), "--keep-latency", "-o", str(out), "--limit-mm", "0.5"]) == 0
    assert out.read_text() == first  # the same recording, with nothing moving
