"""The moves of a calibration: planned within limits, checked before the first, driven, stopped, and kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile
from hardware.arm_calibration.commanded import HEADER, NAME, read_commanded
from hardware.arm_calibration.moves import MoveWishes, check_moves, places, planned
from hardware.arm_calibration.record import move_arm
from hardware.arm_status import ArmState
from hardware.calibration.arm_run import Wishes, check_out, check_record, run_folder
from hardware.calibration.arm_solve import ARM
from hardware.cli.main import main
from hardware.files.arm_file import read_arm
from hardware.process.clock import SimClock
from hardware.process.progress import silent
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.watched_arm import watched_arm
from planning.limits import Limits
from planning.no_go import NoGo

PROFILE = ArmProfile()
HOME = PROFILE.arm.home
SHORT = MoveWishes(places=4, dwell=0.3, swing=1.0, speed=100.0)


def driven(folder: Path, profile: ArmProfile = PROFILE, tell: object = silent) -> tuple[VirtualArm, Arm, SimClock]:
    clock = SimClock()
    virtual = VirtualArm(ArmSettings(servo_lag=0.02), profile.dialect, HOME, (), profile.baud)
    arm = Arm(VirtualDevice(virtual, clock, profile.baud), profile, 0.0)
    try:
        move_arm(arm, clock, folder, HOME, SHORT, tell)  # type: ignore[arg-type]
    finally:
        virtual.advance(clock.now())
    return virtual, arm, clock


def test_moves_are_smooth_and_come_back() -> None:
    targets, limits = planned(HOME, Limits(), 0.02, SHORT), Limits()
    speed = np.diff(targets, axis=0, prepend=HOME[None]) / 0.02
    assert (np.abs(speed) < limits.speed).all()
    assert (np.abs(np.diff(speed, axis=0)) / 0.02 < 1.1 * limits.acceleration).all()
    assert np.array_equal(targets[-1], HOME)


def test_places_fill_the_room_and_stay_within_bounds() -> None:
    found = places(HOME, Limits(), MoveWishes(places=40))
    assert (np.linalg.svd(found[:, :3] - found[:, :3].mean(0), compute_uv=False) / np.sqrt(40) > 10).all()
    assert (found[::3, 3:] == 0).all() and (np.abs(found[1::3, 3:]).max(0) > 0.1).all()
    low = HOME[2] - 5
    narrow = places(HOME, Limits(low=np.array([-650, -650, low, *-np.ones(3)])), MoveWishes())
    assert (narrow[:, 2] >= low).all()


def test_what_the_guard_refuses_is_named_before_anything_moves(tmp_path: Path) -> None:
    zone = NoGo("lamp", np.array([[0.0, 0, -1]]), np.array([-HOME[2] - 10]))  # all that is 10 mm higher
    profile = replace(PROFILE, limits=replace(PROFILE.limits, zones=(zone,)))
    with pytest.raises(InputError, match="lamp"):
        check_moves(profile, HOME, planned(HOME, profile.limits, profile.tick, MoveWishes()))
    with pytest.raises(InputError, match="lamp"):
        driven(tmp_path, profile)
    assert len((tmp_path / NAME).read_text().splitlines()) <= 2  # where it stands


def test_an_arm_goes_where_it_is_sent_and_the_file_says_where(tmp_path: Path) -> None:
    virtual, arm, clock = driven(tmp_path)
    assert arm.state is ArmState.DISARMED and not virtual.ignored and not virtual.refused
    point = read_commanded(tmp_path / NAME)
    stamps = np.arange(point.instants[0], clock.now(), 0.003)
    assert np.abs(point.lagged(stamps, 0.0, 0.02) - virtual.axes_at(stamps)).max() < 0.05
    assert np.abs(point.axes[:, :3] - HOME[:3]).max() > 30


def test_an_interrupt_stops_the_arm_and_keeps_what_was_done(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done > 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        driven(tmp_path, tell=interrupt)
    point = read_commanded(tmp_path / NAME)
    assert 2.9 < point.instants[-1] - point.instants[0] < 3.3  # a second of listening, and two of moves
    assert np.abs(point.axes[-1] - HOME).max() > 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n", ["line 1", HEADER]),
        (HEADER + "\n0,1,2,3,4,5,6\n", ["rows", "two or more"]),
        (HEADER + "\n0,1,2,3,4,5,6\n1,2,3\n", ["line 3", "7 finite numbers"]),
        (HEADER + "\n1,1,2,3,4,5,6\n1,1,2,3,4,5,6\n", ["stamps that rise"]),
    ],
)
def test_a_damaged_file_of_commands_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    file = tmp_path / NAME
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_commanded(file)
    assert all(word in str(caught.value) for word in [str(file), *words]), caught.value


def test_where_files_go_is_checked_first(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a file that ends in"):
        check_out(tmp_path / "arm.txt")
    with pytest.raises(InputError, match="no such folder"):
        check_out(tmp_path / "nowhere" / "arm.toml")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(InputError, match="new or empty folder"):
        check_record(tmp_path / "full")
    with pytest.raises(InputError, match=NAME):
        run_folder(tmp_path / "full", tmp_path / "arm.toml", Wishes(), silent)


@pytest.mark.parametrize(("name", "value"), [("places", 2), ("reach", -1.0), ("speed", 500.0), ("dwell", 0.0)])
def test_wrong_wishes_are_named(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        MoveWishes(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "one of a recorded FOLDER, --device, --virtual or --touched"),
        (["moved", "--virtual"], "folder and virtual"),
        (["--virtual"], "--record = 'missing'"),
        (["--device", "/dev/x", "--record", "r"], "--cameras = 'missing'"),
        (["--device", "/dev/x", "--terminal"], "--terminal"),
        (["--device", "/dev/x", "--cameras", "rig.toml", "--record", "r"], "nobody is within the arm's reach"),
    ],
)
def test_wrong_words_are_named(words: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "arm", *words, "-o", "arm.toml"]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("pictures", [False, True])
def test_what_an_interrupted_calibration_kept_is_said_and_what_to_do(
    pictures: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record, out = tmp_path / "moved", tmp_path / "arm.toml"

    def interrupted(*_: object) -> None:
        if pictures:
            (record / "frames.csv").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("hardware.arm_calibration.virtual.take_pictures", interrupted)
    moves = ["--places", "4", "--swing-s", "1"]
    assert main(["calibrate", "arm", "--virtual", "--record", str(record), "-o", str(out), *moves]) == 130
    told = capsys.readouterr().err.splitlines()[-1]
    assert f"interrupted; kept in {record}: {ARM}, {NAME}" in told and "name another --record or empty this one" in told
    assert (f"`stillbed calibrate arm {record} -o {out}`" in told) == pictures


@pytest.mark.slow
def test_a_simulated_arm_is_calibrated_from_pictures_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched, folder, out = watched_arm(1), tmp_path / "moved", tmp_path / "arm.toml"
    moves = ["--places", "10", "--speed-mm-s", "100", "--seed", "1", "--limit-mm", "0.2"]
    assert main(["calibrate", "arm", "--virtual", "--record", str(folder), "-o", str(out), *moves]) == 0
    assert "cam_1: tip found in" in (told := capsys.readouterr().out) and "hidden by the tool itself" in told
    found, before = read_arm(out), read_arm(folder / ARM)
    change = found.arm.arm_from_base @ se3.inverse(watched.true.arm_from_base)
    assert np.degrees(se3.angle_of(change)) < 0.1 and np.linalg.norm(change[:3, 3]) < 1.0
    assert found.arm.tool_offset == pytest.approx(watched.true.tool_offset, abs=0.3)
    late = watched.settings.dead_time + watched.settings.servo_lag
    assert found.lag == pytest.approx(before.frame_time + late, abs=0.005)
    assert out.with_suffix(".report.html").read_text().count("<figure>") > 8
