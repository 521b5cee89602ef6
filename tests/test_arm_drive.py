"""Calibration moves: planned within limits, checked, driven, stopped, kept; the needle's end in drawn pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.calibration.arm_fit import ArmUnknowns
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile
from hardware.arm.s6h4d import S6H4D
from hardware.calibration.arm_record import (
    ARM_FILE,
    COMMANDED_FILE,
    COMMANDED_HEADER,
    MoveOptions,
    check_moves,
    move_arm,
    places,
    plan_moves,
    read_commanded,
)
from hardware.calibration.arm_run import check_out, check_record, run_folder
from hardware.cli.main import main
from hardware.files.arm_file import read_arm
from hardware.process.clock import SimClock
from hardware.process.progress import no_progress
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.watched_arm import watched_arm
from perception.boards.needle_tip import _TO_LIGHT, TipFinder, background
from perception.frames import Image
from planning.command import MotionLimits, NoGo

PROFILE = ArmProfile()
HOME = PROFILE.arm.home
SHORT = MoveOptions(places=4, dwell=0.3, swing=1.0, speed=100.0)


def driven(folder: Path, profile: ArmProfile = PROFILE, tell: object = no_progress) -> tuple[VirtualArm, Arm, SimClock]:
    clock = SimClock()
    virtual = VirtualArm(ArmSettings(servo_lag=0.02), profile.dialect, HOME, (), profile.baud)
    arm = Arm(S6H4D(VirtualDevice(virtual, clock, profile.baud), profile), profile, 0.0)
    try:
        move_arm(arm, clock, folder, HOME, SHORT, tell)
    finally:
        virtual.advance(clock.now())
    return virtual, arm, clock


def test_moves_are_smooth_and_come_back() -> None:
    targets, limits = plan_moves(HOME, MotionLimits(), 0.02, SHORT), MotionLimits()
    speed = np.diff(targets, axis=0, prepend=HOME[None]) / 0.02
    assert (np.abs(speed) < limits.speed).all()
    assert (np.abs(np.diff(speed, axis=0)) / 0.02 < 1.1 * limits.acceleration).all()
    assert np.array_equal(targets[-1], HOME)


def test_places_fill_the_room_and_stay_within_bounds() -> None:
    found = places(HOME, MotionLimits(), MoveOptions(places=40))
    assert (np.linalg.svd(found[:, :3] - found[:, :3].mean(0), compute_uv=False) / np.sqrt(40) > 10).all()
    assert (found[::3, 3:] == 0).all() and (np.abs(found[1::3, 3:]).max(0) > 0.1).all()
    low = HOME[2] - 5
    narrow = places(HOME, MotionLimits(low=np.array([-650, -650, low, *-np.ones(3)])), MoveOptions())
    assert (narrow[:, 2] >= low).all()


def test_what_the_guard_refuses_is_named_before_anything_moves(tmp_path: Path) -> None:
    zone = NoGo("lamp", np.array([[0.0, 0, -1]]), np.array([-HOME[2] - 10]))  # all that is 10 mm higher
    profile = replace(PROFILE, limits=replace(PROFILE.limits, zones=(zone,)))
    with pytest.raises(InputError, match="lamp"):
        check_moves(profile, HOME, plan_moves(HOME, profile.limits, profile.tick, MoveOptions()))
    with pytest.raises(InputError, match="lamp"):
        driven(tmp_path, profile)
    assert len((tmp_path / COMMANDED_FILE).read_text().splitlines()) <= 2  # where it stands


def test_an_arm_goes_where_it_is_sent_and_the_file_says_where(tmp_path: Path) -> None:
    virtual, arm, clock = driven(tmp_path)
    assert arm.state is ArmState.DISARMED and not virtual.ignored and not virtual.refused
    point = read_commanded(tmp_path / COMMANDED_FILE)
    stamps = np.arange(point.instants[0], clock.now(), 0.003)
    assert np.abs(point.lagged(stamps, 0.0, 0.02) - virtual.axes_at(stamps)).max() < 0.05
    assert np.abs(point.axes[:, :3] - HOME[:3]).max() > 30


def test_an_interrupt_stops_the_arm_and_keeps_what_was_done(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done > 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        driven(tmp_path, tell=interrupt)
    point = read_commanded(tmp_path / COMMANDED_FILE)
    assert 2.9 < point.instants[-1] - point.instants[0] < 3.3  # a second of listening, and two of moves
    assert np.abs(point.axes[-1] - HOME).max() > 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n", ["line 1", COMMANDED_HEADER]),
        (COMMANDED_HEADER + "\n0,1,2,3,4,5,6\n", ["rows", "two or more"]),
        (COMMANDED_HEADER + "\n0,1,2,3,4,5,6\n1,2,3\n", ["line 3", "7 finite numbers"]),
        (COMMANDED_HEADER + "\n1,1,2,3,4,5,6\n1,1,2,3,4,5,6\n", ["stamps that rise"]),
    ],
)
def test_a_damaged_file_of_commands_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    file = tmp_path / COMMANDED_FILE
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
    with pytest.raises(InputError, match=COMMANDED_FILE):
        run_folder(tmp_path / "full", tmp_path / "arm.toml", 0.1, ArmUnknowns(), no_progress)


@pytest.mark.parametrize(("name", "value"), [("places", 2), ("reach", -1.0), ("speed", 500.0), ("dwell", 0.0)])
def test_wrong_wishes_are_named(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        MoveOptions(**{name: value})


@pytest.mark.parametrize("pictures", [False, True])
def test_what_an_interrupted_calibration_kept_is_said_and_what_to_do(
    pictures: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record, out = tmp_path / "moved", tmp_path / "arm.toml"

    def interrupted(*_: object) -> None:
        if pictures:
            (record / "frames.csv").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("hardware.calibration.arm_run.take_pictures", interrupted)
    moves = ["--places", "4", "--swing-s", "1"]
    assert main(["calibrate", "arm", "--virtual", "--record", str(record), "-o", str(out), *moves]) == 130
    told = capsys.readouterr().err.splitlines()[-1]
    assert f"interrupted; kept in {record}: {ARM_FILE}, {COMMANDED_FILE}" in told
    assert "name another --record or empty this one" in told
    assert (f"`stillbed calibrate arm {record} -o {out}`" in told) == pictures


@pytest.mark.slow
def test_a_simulated_arm_is_calibrated_from_pictures_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched, folder, out = watched_arm(1), tmp_path / "moved", tmp_path / "arm.toml"
    moves = ["--places", "10", "--speed-mm-s", "100", "--seed", "1", "--limit-mm", "0.2"]
    assert main(["calibrate", "arm", "--virtual", "--record", str(folder), "-o", str(out), *moves]) == 0
    assert "cam_1: tip found in" in (told := capsys.readouterr().out) and "hidden by the tool itself" in told
    found, before = read_arm(out), read_arm(folder / ARM_FILE)
    change = found.arm.arm_from_base @ se3.inverse(watched.true.arm_from_base)
    assert np.degrees(se3.angle_of(change)) < 0.1 and np.linalg.norm(change[:3, 3]) < 1.0
    assert found.arm.tool_offset == pytest.approx(watched.true.tool_offset, abs=0.3)
    late = watched.settings.dead_time + watched.settings.servo_lag
    assert found.lag == pytest.approx(before.frame_time + late, abs=0.005)
    assert out.with_suffix(".report.html").read_text().count("<figure>") > 8


SIZE = (240, 320)  # px
FINE = 8  # samples across a pixel of what is drawn


def cloth(seed: int) -> Image:
    draw = np.random.default_rng(seed)
    rough = draw.normal(size=(SIZE[0] // 8, SIZE[1] // 8, 1)).astype(np.float32)
    shade = cv2.resize(rough, SIZE[::-1], interpolation=cv2.INTER_CUBIC)[..., None] * 6
    return np.clip(np.array([130, 118, 42]) + shade, 0, 255).astype(np.uint8)


def picture(
    behind: Image, tip: Array, angle: float, width: float, noise: float, seed: int, needle: bool = True, dark: float = 1
) -> Image:
    """A grey needle of `width` px from `tip`, 26 px long, on a thick red body, blurred by 0.6 px; half of it darker."""
    towards = np.array([np.cos(angle), np.sin(angle)])
    side = np.array([-towards[1], towards[0]])
    light = _TO_LIGHT[behind].astype(float)
    x, y = (((np.arange(n * FINE) + 0.5) / FINE - 0.5) for n in SIZE[::-1])
    along, across = (np.add.outer((y - tip[1]) * d[1], (x - tip[0]) * d[0]) for d in (towards, side))
    steel = np.array([0.2, 0.2, 0.21])
    parts = [(26, 80, 14, -1, np.array([0.03, 0.05, 0.3])), (0, 27, width, -1, steel), (0, 27, width, 0, dark * steel)]
    for start, end, wide, low, colour in parts[: 1 + 2 * needle]:
        inside = (along >= start) & (along <= end) & (across >= 0.5 * wide * low) & (across <= 0.5 * wide)
        share = cv2.resize(255.0 * inside, SIZE[::-1], interpolation=cv2.INTER_AREA)[..., None] / 255.0
        light = light * (1 - share) + colour * share
    shown = 255 * np.interp(cv2.GaussianBlur(light, (0, 0), 0.6), _TO_LIGHT, np.arange(256) / 255.0)
    shown = shown + noise * np.random.default_rng(seed).normal(size=shown.shape)
    return np.clip(np.round(shown), 0, 255).astype(np.uint8)


@settings(max_examples=12)
@given(st.integers(0, 10_000))
def test_the_end_is_found_to_a_fraction_of_a_pixel(seed: int) -> None:
    draw, behind = np.random.default_rng(seed), cloth(seed)
    tip, angle = np.array([160.0, 120.0]) + draw.uniform(-20, 20, 2), draw.uniform(0, 2 * np.pi)
    found = TipFinder(behind, 4.0)(picture(behind, tip, angle, draw.uniform(1.8, 4.0), 1.0, seed))
    assert np.linalg.norm(np.array(found.pixel) - tip) < 0.35  # 0.13 on average, and five times its scatter
    assert np.dot(found.towards, [np.cos(angle), np.sin(angle)]) > 0.999


def test_a_dark_side_does_not_move_the_tip(monkeypatch: pytest.MonkeyPatch) -> None:
    behind, tip, angle = cloth(5), np.array([158.3, 121.4]), 0.9
    even, shaded = (picture(behind, tip, angle, 3.0, 1.0, 0, dark=dark) for dark in (1.0, 0.2))

    def moved() -> float:
        before, after = TipFinder(behind, 4.0)(even), TipFinder(behind, 4.0)(shaded)
        return float(abs((np.array(after.pixel) - before.pixel) @ [-np.sin(angle), np.cos(angle)]))

    assert moved() < 0.05
    monkeypatch.setattr("perception.boards.needle_tip.MIN_COLOUR_CONTRAST", np.inf)  # by brightness alone
    assert moved() > 0.15


def test_noise_is_told() -> None:
    behind, off = cloth(1), []
    tip = np.array([150.3, 110.7])
    for seed in range(12):
        found = TipFinder(behind, 4.0)(picture(behind, tip, 0.7, 2.5, 2.0, seed))
        off.append(np.array(found.pixel) - tip)
    spread = float(np.std(off, axis=0).max())
    assert 0.3 < found.sigma / spread < 5.0


@pytest.mark.parametrize("grey", [True, False])
def test_the_background_is_what_stays(grey: bool) -> None:
    behind = cloth(2)
    places = [np.array([60.0 + 40 * k, 60.0 + 20 * k]) for k in range(6)]
    pictures = [picture(behind, place, 0.8, 3.0, 1.0, k) for k, place in enumerate(places)]
    if grey:
        pictures = [np.asarray(image[..., 2]) for image in pictures]
    found = TipFinder(background(pictures), 4.0)(pictures[2])
    assert found is not None and np.linalg.norm(np.array(found.pixel) - places[2]) < 0.3


def test_where_no_needle_is_none_is_found() -> None:
    behind = cloth(3)
    finder = TipFinder(behind, 4.0)
    assert finder(behind) is None
    assert finder(picture(behind, np.array([160.0, 120.0]), 0.4, 3.0, 1.0, 0, needle=False)) is None
    assert finder(picture(behind, np.array([4.0, 120.0]), 0.0, 3.0, 1.0, 0)) is None  # its end is not in the picture
