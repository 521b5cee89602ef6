"""How late a dispenser switches, from lines: laws of the fit, a virtual one and painted sheets, what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.profile import ArmProfile
from hardware.arm.s6h4d import S6H4D
from hardware.calibration.arm_record import ARM_FILE, COMMANDED_FILE, check_moves
from hardware.calibration.dispenser_lines import (
    LN2,
    LineProfile,
    LinesResult,
    bead_share,
    fit_switch,
    judge_lines,
    mean_pictures,
    measure_lines,
    profile_of,
)
from hardware.calibration.dispenser_record import (
    STEADY,
    SWITCHES_FILE,
    TAIL,
    DrawnLine,
    LineOptions,
    delays_by_hand,
    draw_lines,
    drawn_lines,
    plan_lines,
    read_switches,
    record_virtual,
)
from hardware.cli.main import main
from hardware.dispenser.dispenser import DispenserProfile
from hardware.dispenser.line_dispenser import LineDispenser
from hardware.dispenser.messages import PRESETS
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.dispenser_file import read_dispensers
from hardware.files.session_folder import open_folder
from hardware.process.clock import SimClock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import VirtualDevice
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.dispenser import DispenserModel, VirtualDispenserSettings
from hardware.simulator.watched_arm import watched_arm
from tests.dispenser_bench import HinderedPort

DISPENSER = DispenserProfile("pump", ("gel",), metered=True, watchdog=None)
TRUE = VirtualDispenserSettings("new_era", 0.08, 0.04, 0.06, 0.05, watchdog=float("inf"))
ON, OFF = 0.08 + LN2 * 0.04, 0.06 + LN2 * 0.05
SHORT = LineOptions(speeds=(10.0, 30.0), repeats=2, length=30.0)
FILE = '[[dispenser]]\nname = "pump"\nmaterials = ["gel"]\npreset = "new_era"\nport = "/dev/none"  # kept\n'
Lenses = list[tuple[Array, Array] | None]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lines")
    line = replace(PRESETS["new_era"].line, port="/dev/none")
    record_virtual(watched_arm(1), DISPENSER, line, TRUE, folder, SHORT)
    return folder


@pytest.fixture(scope="module")
def measured(recorded: Path) -> LinesResult:
    return measure_lines(recorded, DISPENSER, SHORT.height)


@pytest.fixture(scope="module")
def first_line(recorded: Path) -> tuple[DrawnLine, Lenses]:
    told = read_switches(recorded / SWITCHES_FILE, "pump")
    pictures = mean_pictures(open_folder(recorded), recorded, (told[0][0], told[-1][1]))
    return drawn_lines(recorded, read_arm(recorded / ARM_FILE), np.zeros(3), told, SHORT.height)[0], pictures


@pytest.fixture
def copied(recorded: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "lines"
    shutil.copytree(recorded, folder)
    return folder


def drawn(dead: float, lag: float, on: bool, rng: np.random.Generator, noise: float = 0.0) -> list[LineProfile]:
    """Profiles of six lines in two cameras, each of which is off by as much as it likes along the lines."""
    profiles, constant, cameras = [], rng.normal() * 0.5, rng.normal(size=2) * 0.3
    for number in range(6):
        speed, forth = (10.0, 20.0, 30.0)[number % 3], (-1.0) ** (number // 3)
        line = DrawnLine(speed, 40.0, np.eye(4), forth, "")
        for camera in range(2):
            along, width = np.arange(-4.0, 40 + 0.64 * speed, 0.4), 8.0 / speed + 0.3
            beyond = along - (0 if on else 40.0) - dead * speed - constant - forth * cameras[camera]
            share = bead_share(beyond, np.full(len(along), lag * speed), 0.25, np.full(len(along), width), on)
            share += noise * rng.normal(size=len(along))
            profiles.append(LineProfile(number, camera, line, along, share, width, 100.0))
    return profiles


@settings(max_examples=3)
@given(st.floats(0.0, 0.25), st.floats(0.005, 0.1), st.booleans(), st.integers(0, 1000))
def test_what_is_constantly_off_takes_no_part(dead: float, lag: float, on: bool, seed: int) -> None:
    found = fit_switch(drawn(dead, lag, on, np.random.default_rng(seed)), on)
    assert found.delay == pytest.approx(dead + LN2 * lag, abs=2e-4)
    assert found.lag == pytest.approx(lag, abs=1e-3) and found.scatter < 0.01 and found.rms < 1e-3


def test_the_stated_doubt_is_that_of_the_noise() -> None:
    fits = [fit_switch(drawn(0.1, 0.03, True, np.random.default_rng(seed), 0.05), True) for seed in range(4)]
    off = [(f.delay - 0.1 - LN2 * 0.03) / f.scatter_sigma for f in fits]
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 2.0


@pytest.mark.slow
def test_a_virtual_dispenser(measured: LinesResult) -> None:
    on, off = measured.on, measured.off
    assert abs(on.delay - ON) < 0.01 and abs(off.delay - OFF) < 0.01
    assert abs(on.lag - 0.04) < 0.01 and abs(off.lag - 0.05) < 0.015
    assert not measured.left_out and judge_lines(measured).passed
    assert {round(line.speed) for line in measured.lines} == {10, 30}


def test_a_later_switch_and_a_later_arm_are_seen(copied: Path, measured: LinesResult) -> None:
    arm = read_arm(copied / ARM_FILE)
    write_arm(copied / ARM_FILE, replace(arm, lag=arm.lag + 0.03))  # it then stood farther back when it was told
    found = measure_lines(copied, DISPENSER, SHORT.height)
    assert found.on.delay - measured.on.delay == pytest.approx(0.03, abs=0.004)
    assert found.off.delay - measured.off.delay == pytest.approx(0.03, abs=0.004)


def test_the_log_of_switches_is_believed_only_whole(copied: Path) -> None:
    file = copied / SWITCHES_FILE
    whole = file.read_text()
    for old, new, words in (
        (",off\n", ",off: nothing was sent for 0.2 s: its watchdog\n", "goes off only where it is told"),
        (",pump,", ",syringe,", "which is calibrated"),
        ("stamp_s", "when", "stamp_s,dispenser"),
    ):
        file.write_text(whole.replace(old, new))
        with pytest.raises(InputError, match=words):
            measure_lines(copied, DISPENSER, SHORT.height)
    file.write_text("\n".join(whole.splitlines()[:5]) + "\n")
    with pytest.raises(InputError, match="4 or more, each told on and off"):
        measure_lines(copied, DISPENSER, SHORT.height)
    file.unlink()
    with pytest.raises(InputError, match="has recorded"):
        measure_lines(copied, DISPENSER, SHORT.height)


def test_an_arm_that_was_held_on_its_way(copied: Path) -> None:
    header, *rows = (copied / COMMANDED_FILE).read_text().splitlines()
    stamps = np.array([float(row.split(",")[0]) for row in rows])
    told, arm = read_switches(copied / SWITCHES_FILE, "pump"), read_arm(copied / ARM_FILE)
    held = stamps + 0.05 * (stamps > told[1][0] + 0.3)  # for 50 ms in the second line
    lines = [",".join([f"{stamp:.6f}", row.split(",", 1)[1]]) for stamp, row in zip(held, rows, strict=True)]
    (copied / COMMANDED_FILE).write_text("\n".join([header, *lines]) + "\n")
    wrong = [line.wrong for line in drawn_lines(copied, arm, np.zeros(3), told, SHORT.height)]
    assert "constant speed" in wrong[1] and wrong[0] == ""
    still = [",".join([row.split(",")[0], rows[0].split(",", 1)[1]]) for row in rows]
    (copied / COMMANDED_FILE).write_text("\n".join([header, *still]) + "\n")
    with pytest.raises(InputError, match=r"moved by 0\.0 mm"):
        measure_lines(copied, DISPENSER, SHORT.height)


def seen(first_line: tuple[DrawnLine, Lenses], change: float = 1.0, gain: float = 1.0, bend: float = 0.0) -> object:
    line, pictures = first_line
    assert pictures[0] is not None
    before, after = pictures[0]
    after = before + change * (after - before)
    if bend:
        rows = np.arange(after.shape[0])[:, None] + np.round(bend * np.sin(np.arange(after.shape[1]) / 12)).astype(int)
        after = after[np.clip(rows, 0, after.shape[0] - 1), np.arange(after.shape[1])]
    both = (np.clip(gain * before, 0, 255), np.clip(gain * after, 0, 255))
    return profile_of(0, line, 0, watched_arm(1).rig.cameras[0], both, 2.8)


def test_what_a_picture_must_show(first_line: tuple[DrawnLine, Lenses]) -> None:
    assert isinstance(seen(first_line), LineProfile)
    assert "no line seen" in str(seen(first_line, change=0.0))
    assert "no line seen" in str(seen(first_line, change=0.05))
    assert "saturated" in str(seen(first_line, gain=1.5))
    assert "not straight" in str(seen(first_line, bend=3.0))
    line, pictures = first_line
    away = replace(line, frame=line.frame @ np.block([[np.eye(3), np.array([[900.0], [0], [0]])], [np.zeros(3), 1]]))
    assert pictures[0] is not None
    found = profile_of(0, away, 0, watched_arm(1).rig.cameras[0], pictures[0], 2.8)
    assert found == "not whole in the picture"


def test_the_verdict(measured: LinesResult) -> None:
    for change, words in (
        ({"scatter_sigma": 0.011}, "more lines"),
        ({"places": measured.on.places + [0.9, -0.9, 0.9, -0.9]}, "does not repeat"),
        ({"rms": 0.1}, "no dead time with a lag"),
        ({"dead_time": 0.41, "places": measured.on.places + 0.33 * measured.on.speeds}, "leads 0.4 s"),
    ):
        verdict = judge_lines(replace(measured, on=replace(measured.on, **change)))
        assert not verdict.passed and any(words in hint for hint in verdict.hints)


def test_the_command_writes_what_passed(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "dispenser.toml"
    file.write_text(FILE)
    assert main(["calibrate", "dispenser", str(file), "--from", str(recorded)]) == 0
    profile = read_dispensers(file)[0].profile
    assert abs(profile.on_delay - ON) < 0.01 and abs(profile.off_delay - OFF) < 0.01
    assert "# kept" in file.read_text() and "PASS" in capsys.readouterr().out
    page = (tmp_path / "dispenser.pump.report.html").read_text()
    assert "the way over the speed" in page and "profile and fit" in page


def test_the_command_refuses_pictures_without_lines(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "dispenser.toml"
    file.write_text(FILE)
    for camera in ("cam_0", "cam_1", "cam_2"):
        first, *others = sorted((copied / camera).iterdir())
        for other in others:
            shutil.copyfile(first, other)
    assert main(["calibrate", "dispenser", str(file), "--from", str(copied)]) == 2
    told = capsys.readouterr().err
    assert "lines that can be measured = '0 of 4; most often: no line seen" in told and file.read_text() == FILE


def test_a_ruler(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "dispenser.toml"
    file.write_text(FILE)
    command = ["calibrate", "dispenser", str(file), "--measured", "1.5,0.3,10", "--measured", "3.5,1.3,30"]
    assert main(command) == 0
    profile = read_dispensers(file)[0].profile
    assert profile.on_dead_time == pytest.approx(0.1) and profile.off_dead_time == pytest.approx(0.05)
    assert profile.on_lag == profile.off_lag == 0
    assert delays_by_hand([(1.0, 0.5, 10.0)], DISPENSER).on_dead_time == pytest.approx(0.1)
    with pytest.raises(InputError, match="delay by the start"):
        delays_by_hand([(-1.0, 0.5, 10.0)], DISPENSER)


@pytest.mark.slow
@settings(max_examples=5)
@given(st.lists(st.integers(5, 30), min_size=2, max_size=3, unique=True), st.integers(1, 2))
def test_the_nozzle_is_at_its_speed_long_before_and_after(speeds: list[int], repeats: int) -> None:
    profile = ArmProfile()
    options = LineOptions(tuple(map(float, speeds)), repeats, 35.0)
    start = profile.arm.home - [0, 0, 60.0, 0, 0, 0]
    plan = plan_lines(start, profile.arm.home, profile.tick, options)
    check_moves(profile, start, plan.targets)
    switches = sorted(plan.switches.items())
    assert [v for _, v in switches[::2]] == [float(v) for v in speeds] * repeats
    for (on, speed), (off, told) in zip(switches[::2], switches[1::2], strict=True):
        rows = plan.targets[on - round(STEADY / profile.tick) : off + round(TAIL / profile.tick) - 1]
        steps = np.linalg.norm(np.diff(rows, axis=0), axis=1)
        assert told == 0 and np.allclose(steps, speed * profile.tick) and np.ptp(rows[:, 2]) == 0
    assert (plan.targets[[span[0] for span in plan.looks]] == profile.arm.home).all()


def draw(
    folder: Path,
    port: HinderedPort,
    dispenser: DispenserProfile,
    options: LineOptions,
    watch: Callable[[], None] = lambda: None,
) -> None:
    clock, profile = port.clock, ArmProfile()
    start = profile.arm.home - [0, 0, 60.0, 0, 0, 0]
    virtual = VirtualArm(ArmSettings(), profile.dialect, start, (), profile.baud)
    arm = Arm(S6H4D(VirtualDevice(virtual, clock, profile.baud), profile), profile, clock.now())
    line = replace(PRESETS["new_era"].line, port="/dev/none")
    driver = LineDispenser(dispenser, line, port)

    def report(done: int, total: int) -> None:
        if port.model.on:
            watch()

    draw_lines(arm, driver, clock, folder, start, profile.arm.home, options, report=report)


def test_a_line_that_is_lost_ends_it_and_one_that_cannot_be_asked_begins_nothing(tmp_path: Path) -> None:
    clock = SimClock()
    port = HinderedPort(DispenserModel(TRUE), clock)

    def unplug() -> None:
        port.plugged = False

    with pytest.raises(InputError, match="one that stays on until it is told"):
        draw(tmp_path, port, DISPENSER, SHORT, unplug)
    assert not [r for r in (tmp_path / SWITCHES_FILE).read_text().splitlines() if r.endswith(",off")]
    weak = replace(DISPENSER, flow_range=(0.1, 5.0))
    port = HinderedPort(DispenserModel(TRUE), SimClock())
    with pytest.raises(InputError, match=r"cannot give 12 mm\^3/s"):
        draw(tmp_path, port, weak, SHORT)
    assert not port.taken
    with pytest.raises(InputError, match="two different ones"):
        LineOptions(speeds=(10.0,))


def test_material_stops_with_the_arm(tmp_path: Path) -> None:
    port = HinderedPort(DispenserModel(TRUE), SimClock())

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        draw(tmp_path, port, DISPENSER, SHORT, interrupt)
    (on, _), (off, flow) = port.model.switches
    assert flow == 0 and off - on < 0.05
