"""`stillbed arm DEVICE` moves only what an operator confirmed; `calibrate arm --device` with a virtual arm."""

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
from estimation.errors import InputError
from estimation.rig import Camera, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import arc_rig
from hardware.arm.console import ArmRequest, axes_from_text, findings, jog_from_text, origin_from_text, run_arm
from hardware.arm.device import ArmState, ArmStatus
from hardware.arm.profile import BITS_PER_BYTE, ArmProfile
from hardware.arm.s6h4d import S6H4D
from hardware.calibration.arm_record import COMMANDED_FILE, read_commanded
from hardware.cli.main import main
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.rig_file import ImageSource, write_rig
from hardware.process.clock import SimClock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import _serve, open_pty
from hardware.simulator.arm.settings import ArmSettings, ReplyMode
from hardware.simulator.watched_arm import WatchedArm, watched_arm
from perception.frames import SYRINGE, Image
from planning.kinematics import SimpleArm, nozzle_from_axes
from tests.camera_streams import CLOCK, HttpCamera, served
from tests.faulty_port import FaultyDevice, PortFaults
from tests.test_arm_port import serving
from tests.virtual_arm import HOME, arm_fault

AWAY = HOME + np.array([-20.0, 10, -30, 0, 0.1, 0])


def asked(
    request: ArmRequest, replies: ReplyMode = ReplyMode.STREAM, fault: str = "", port: PortFaults | None = None
) -> tuple[ArmStatus, VirtualArm, list[str]]:
    faults = [arm_fault(fault)] if fault else []
    clock, profile = SimClock(), ArmProfile()
    arm = VirtualArm(ArmSettings(replies=replies), profile.dialect, AWAY, faults)
    lines: list[str] = []
    status = run_arm(S6H4D(FaultyDevice(arm, clock, faults=port), profile), profile, request, clock, lines.append)
    arm.advance(clock.now())
    return status, arm, lines


def test_listening_sends_nothing_and_says_what_answers() -> None:
    status, arm, lines = asked(ArmRequest(seconds=2.0))
    assert (arm.frames, arm.garbage) == (0, []) and status.answered == pytest.approx(AWAY, abs=0.05)
    assert "20.0 places a second" in lines[-1] and "X182.50 Y235.00" in lines[-1]
    _, _, strays = asked(ArmRequest(seconds=5.0), ReplyMode.STRAY)
    assert "nothing that is an answer" in strays[-1] and "0 stray" not in strays[-1]


def test_home_is_reached_and_the_arm_is_disarmed() -> None:
    status, arm, lines = asked(ArmRequest(home=True, confirmed=True))
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(HOME, abs=1e-3)
    assert status.state is ArmState.DISARMED and any("by its own answer" in line for line in lines)
    assert "lag_s = 0.0" in lines[-1]


def test_nothing_moves_without_a_word() -> None:
    for request in (ArmRequest(home=True), ArmRequest(jog=np.ones(6))):
        with pytest.raises(InputError, match="--yes"):
            asked(request)


def test_an_arm_that_does_not_answer_must_be_told_where_it_stands() -> None:
    with pytest.raises(InputError, match="nobody knows"):
        asked(ArmRequest(home=True, confirmed=True), ReplyMode.OFF)
    _, arm, _ = asked(ArmRequest(home=True, confirmed=True, stands=AWAY), ReplyMode.OFF)
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(HOME, abs=1e-3)


def test_a_jog_goes_by_so_much_and_not_out_of_bounds() -> None:
    _, arm, _ = asked(ArmRequest(jog=jog_from_text(["X=+5", "b=-2"]), confirmed=True))
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(AWAY + jog_from_text(["X=5", "B=-2"]), abs=0.06)
    with pytest.raises(InputError, match="out of bounds"):
        asked(ArmRequest(jog=jog_from_text(["X=1000"]), confirmed=True))


def test_an_origin_is_sent_when_confirmed_and_moves_stay_in_machine_axes() -> None:
    origin = origin_from_text("200,210.5,90")
    with pytest.raises(InputError, match="--yes"):
        asked(ArmRequest(origin=origin))
    status, arm, _ = asked(ArmRequest(origin=origin, confirmed=True))
    assert arm.origin == pytest.approx([200, 210.5, 90]) and status.state is ArmState.DISARMED
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(AWAY)
    _, arm, _ = asked(ArmRequest(origin=origin, home=True, confirmed=True))
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(HOME, abs=1e-3)
    with pytest.raises(InputError, match="--origin"):
        origin_from_text("1,2")


def test_a_fault_on_the_way_stops_it() -> None:
    status, arm, lines = asked(ArmRequest(home=True, confirmed=True), fault="stall 9s at 2s")
    assert status.state is ArmState.STOPPED and "later on its way" in status.reason
    assert any("stopped" in line for line in lines) and arm.frames < 150


def test_a_device_that_is_not_there_is_said_at_once() -> None:
    with pytest.raises(InputError, match="--watch to wait"):
        asked(ArmRequest(), port=PortFaults(away=[(0.0, 9.0)]))


@pytest.mark.parametrize("text", ["X", "X=", "Q=1", "X=nan", "XY=1", "=5"])
def test_a_jog_that_says_nothing_is_wrong_input(text: str) -> None:
    with pytest.raises(InputError, match="--jog"):
        jog_from_text([text])


def test_where_an_arm_stands_is_home_or_six_numbers() -> None:
    assert axes_from_text("home", HOME) is HOME
    assert axes_from_text("1,2,3,90,0,-90", HOME) == pytest.approx([1, 2, 3, np.pi / 2, 0, -np.pi / 2])
    for wrong in ("1,2,3", "a,b,c,d,e,f", "1,2,3,4,5,nan"):
        with pytest.raises(InputError, match="--stands"):
            axes_from_text(wrong, HOME)


def test_what_is_not_known_is_not_said() -> None:
    nan = float("nan")
    status = ArmStatus(0.0, ArmState.DISARMED, "x", None, None, 0.0, nan, nan, 0.0, 0, 0, 0, 0)
    lines = findings(status, ArmProfile()).splitlines()
    assert lines == ["disarmed: x", "it sent nothing that is an answer and 0 stray bytes"]


def test_the_command_finds_a_virtual_arm_on_its_pty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = tmp_path / "arm"
    with serving(link, ArmSettings(replies=ReplyMode.STREAM)) as ended:
        assert main(["arm", str(link), "--seconds", "0.6"]) == 0
        assert "it stands at X202.50 Y225.00 Z113.00" in capsys.readouterr().out
        assert main(["arm", str(link), "--home"]) == 2 and main(["arm", str(link), "--jog", "Z=-2", "--yes"]) == 0
    assert ended[0].axes_at(np.array([ended[0].now]))[0][2] == pytest.approx(111.0, abs=1e-3)
    assert main(["arm", str(tmp_path / "nothing")]) == 2 and "a device that is there" in capsys.readouterr().err


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
    told = watched.profile
    arm = VirtualArm(watched.settings, told.dialect, watched.begin, (), told.baud)
    (ours, theirs, device), stop = open_pty(), threading.Event()
    os.set_blocking(ours, False)
    serve = threading.Thread(target=_serve, args=(ours, arm, CLOCK.now(), told.baud / BITS_PER_BYTE, CLOCK, stop))
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


@pytest.mark.slow
def test_an_arm_before_live_cameras_is_moved_and_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched = replace(watched_arm(3), rig=arc_rig(size=SIZE))
    record, out = tmp_path / "moved", tmp_path / "arm.toml"
    told = replace(watched.profile, arm=replace(watched.profile.arm, home=watched.begin))
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
    assert np.abs(read_commanded(record / COMMANDED_FILE).axes[:, :3] - watched.begin[:3]).max() > 20
    first = out.read_text()
    assert main(["calibrate", "arm", str(record), "--keep-latency", "-o", str(out), "--limit-mm", "0.5"]) == 0
    assert out.read_text() == first  # the same recording, with nothing moving
