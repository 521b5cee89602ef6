"""The driver of G-code machines: numbered lines, what is lost on the way, stops, a machine that does not turn.

`tests/test_arm_laws.py` tries it before OctoPrint's virtual printer; here stands a board of a few lines.
"""

from __future__ import annotations

import os
import pty
import re
import tty
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.driver import G1, G4, Pause, ReplyKind
from hardware.arm.gcode import GcodeMachine, emergency_stop, find_arms, numbered, open_arm
from hardware.arm.profile import Extruder
from hardware.files.arm_file import arm_from_text, arm_text
from hardware.files.path_file import write_path
from hardware.live.recorded_run import replay_run
from planning.kinematics import axes_from_nozzle, nozzle_from_axes, tool_lean
from tests import octoprint_bench
from tests.arm_benches import closing_bench
from tests.moving_surfaces import raster
from tests.octoprint_bench import GcodeBench, OctoPrintServer, gantry
from tests.test_arm_laws import straight
from tests.test_franka_live import Live, nozzle_errors

PARKED = np.array([110.0, 110.0, 60.0])
STEPS_PER_MM = np.array([80.0, 80.0, 800.0])


class Board:
    """A machine that takes numbered lines as Marlin does. fates: of each line that comes, "" or what goes wrong."""

    def __init__(self, fates: list[str] | None = None, firmware: str = "Marlin 2.1.2 (a board)") -> None:
        self.fates, self.firmware = list(fates or ()), firmware
        self.moves: list[Array] = []
        self.place, self.made, self.expected, self.stops = PARKED.copy(), PARKED.copy(), 1, 0
        self.lines: list[str] = []
        self.pushed: list[tuple[float, float]] = []  # of each G1, mm and mm/s of E
        self.relative, self.e = False, 0.0  # of E, which G90 makes absolute as all axes
        self._in, self._out = b"", b""

    def write(self, data: bytes) -> int:
        *lines, self._in = (self._in + data).split(b"\n")
        for line in filter(None, lines):
            self._take(line.decode())
        return len(data)

    def read(self) -> bytes:
        data, self._out = self._out, b""
        return data

    def waiting(self) -> int:
        return 0

    def close(self) -> None:
        self._in = self._out = b""

    def say(self, *lines: str) -> None:
        self._out += "".join(f"{line}\n" for line in lines).encode()

    def _take(self, line: str) -> None:
        self.lines.append(line)
        fate = self.fates.pop(0) if self.fates and line.startswith("N") and "M110" not in line else ""
        if fate == "lost":
            return
        if line == "M410":
            self.stops += 1
            self.place = self.made.copy()
            self.say("ok")
            return
        found = re.fullmatch(r"N(\d+) (.*)\*(\d+)", line)
        assert found is not None, line
        number, text = int(found[1]), found[2]
        if text.startswith("M110"):
            self.expected = number + 1
        elif fate == "garbled" or number != self.expected:
            self.say("Error:checksum mismatch, Last Line: x", f"Resend: {self.expected}", "ok")
            return
        else:
            self.expected += 1
            self._do(text)
        if fate != "unanswered":
            self.say("ok")

    def _push(self, text: str) -> None:
        """Make a move, and note how fast E went in it."""
        words = {word[0]: float(word[1:]) for word in text.split()[1:]}
        place = np.array([words.get(axis, here) for axis, here in zip("XYZ", self.place, strict=True)])
        end = words.get("E", 0.0) + self.e if self.relative else words.get("E", self.e)
        pushed, self.e = end - self.e, end
        way = float(np.linalg.norm(place - self.place)) or abs(pushed)
        self.pushed.append((pushed, pushed / (way / words["F"] * 60) if way else 0.0))
        if "X" in words:
            self.moves.append(place)
        self.place = place

    def _do(self, text: str) -> None:
        if text.startswith("G1"):
            self._push(text)
        elif text in ("G90", "M83"):
            self.relative = text == "M83"
        elif text == "M115":
            self.say(f"FIRMWARE_NAME:{self.firmware} SOURCE_CODE_URL:x MACHINE_TYPE:y")
        elif text == "M92":
            self.say("echo:  M92 X80.00 Y80.00 Z800.00 E90.00")
        elif text == "M400":
            self.made = self.place.copy()
        elif text == "M114":
            x, y, z = self.place
            count = " ".join(f"{axis}:{round(v)}" for axis, v in zip("XYZ", self.made * STEPS_PER_MM, strict=True))
            self.say(f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:0.00 Count {count}")


class Driven:
    """A driver before a board, in a time of its own."""

    def __init__(self, board: Board, extruder: Extruder | None = None) -> None:
        self.board, self.now, self.fault = board, 0.0, ""
        self.places: list[Array] = []
        profile = replace(gantry(), extruder=extruder)
        self.machine = GcodeMachine("gcode://here", lambda: board, profile)
        self.machine.connect(0.0)
        self.run(1.5)

    def run(self, seconds: float, each: Callable[[], None] = lambda: None) -> None:
        for _ in range(round(seconds / 0.002)):
            self.now += 0.002
            reported = self.machine.state(self.now)
            self.fault = reported.fault
            self.places += [reply.values for reply in reported.replies if reply.kind is ReplyKind.PLACE]
            self.machine.flush(self.now)
            each()

    def go(self, x: float, volume: float = 0.0) -> None:
        self.machine.send(G1(np.array([x, 110, 60, 0, 0, 0]), 10.0, volume > 0, volume), self.now)


def test_a_line_has_the_checksum_that_reprap_s_own_examples_have() -> None:
    assert numbered(3, "T0") == b"N3 T0*57\n" and numbered(4, "G92 E0") == b"N4 G92 E0*67\n"


@given(st.lists(st.sampled_from(["", "", "", "lost", "garbled", "unanswered"]), max_size=60))
def test_whatever_is_lost_each_move_is_made_once_and_in_order(fates: list[str]) -> None:
    driven = Driven(board := Board())
    board.fates = fates
    for k in range(20):
        driven.go(111.0 + k)
        driven.run(0.02)
    driven.run(60.0 if "lost" in fates or "unanswered" in fates else 1.0)
    assert [move[0] for move in board.moves] == [111.0 + k for k in range(20)]
    assert driven.machine.blocked_for(driven.now) is None and driven.fault == ""


@settings(max_examples=40)
@given(st.lists(st.sampled_from(["", "lost", "garbled", "unanswered"]), max_size=12), st.integers(0, 10))
def test_after_a_stop_nothing_goes_out_that_was_given_before(fates: list[str], steps: int) -> None:
    driven = Driven(board := Board())
    board.fates = fates
    for k in range(4):
        driven.go(111.0 + k)
    driven.run(0.002 * steps)
    sent = driven.machine.stop(driven.now)
    assert [type(each.instruction) for each in sent] == [Pause] and board.stops == 1
    moves, board.fates = len(board.moves), []
    driven.run(5.0)
    assert len(board.moves) == moves
    driven.go(150.0)
    driven.run(1.0)
    assert board.moves[-1][0] == 150.0 and len(board.moves) == moves + 1


def test_where_it_is_comes_from_the_steps_that_were_made_not_from_the_plan() -> None:
    driven = Driven(board := Board())
    assert driven.places[-1] == pytest.approx(PARKED)
    driven.go(113.0)
    driven.run(0.2)
    assert driven.places[-1] == pytest.approx(PARKED)  # planned, not made
    board.made = board.made + [1.5, 0, 0]
    driven.run(0.2)
    assert driven.places[-1] == pytest.approx(PARKED + [1.5, 0, 0], abs=0.01)


def test_a_machine_that_starts_anew_is_a_fault_until_the_operator_has_seen_to_it() -> None:
    driven = Driven(board := Board())
    assert driven.machine.enable(driven.now) == ""
    board.expected, board.place = 1, np.zeros(3)
    board.say("start", "echo:Marlin 2.1.2")
    driven.run(0.5)
    assert "home it" in driven.fault
    assert "see that it is homed" in driven.machine.enable(driven.now)
    driven.run(0.5)
    assert driven.fault == "" and driven.machine.enable(driven.now) == ""


@pytest.mark.parametrize("line", ["Error:Printer halted. kill() called!", "Error:MAXTEMP triggered", "!! Lost"])
def test_a_machine_that_has_halted_says_so(line: str) -> None:
    driven = Driven(board := Board())
    board.say(line)
    driven.run(0.01)
    assert line in driven.fault and "reset" in driven.fault


def test_what_is_no_marlin_or_says_nothing_is_not_driven() -> None:
    assert "Klipper" in Driven(Board(firmware="Klipper")).machine.enable(1.0)
    driven = Driven(Board(["lost"] * 1000))
    assert "`baud` of the arm file" in driven.machine.enable(driven.now)


def test_a_stop_before_it_has_said_who_it_is_greets_it_again() -> None:
    driven = Driven(Board(["lost"] * 5))
    driven.machine.stop(driven.now)
    driven.run(2.0)
    assert driven.machine.enable(driven.now) == "" and driven.places[-1] == pytest.approx(PARKED)


PUSHED = Extruder(area=2.0, max_flow=40.0, retract_volume=1.0)  # mm^2, mm^3/s, mm^3: 20 mm/s of E at most


def rest(driven: Driven, ticks: int = 10) -> None:
    for _ in range(ticks):
        driven.machine.send(G4(0.001), driven.now)
        driven.run(0.02)


@settings(max_examples=60)
@given(
    st.lists(st.sampled_from(["", "", "lost", "garbled", "unanswered"]), max_size=40),
    st.lists(st.tuples(st.floats(-0.3, 0.3) | st.just(0.0), st.floats(0.001, 0.2)), min_size=1, max_size=20),
)
@example([], [(0.000135, 0.1875)])  # hardly any way
def test_whatever_is_lost_a_bead_gets_its_volume_and_what_is_drawn_back_is_given_again(
    fates: list[str], bead: list[tuple[float, float]]
) -> None:
    driven = Driven(board := Board(), PUSHED)
    driven.go(110.0)
    driven.run(0.05)
    board.fates, x = fates, 110.0
    for _ in range(2):
        for step, volume in bead:
            x += step
            driven.go(x, volume)
            driven.run(0.02)
        rest(driven)
    driven.run(60.0 if "lost" in fates or "unanswered" in fates else 1.0)
    laid = sum(volume for _, volume in bead)
    out, speeds = (np.array(column) for column in zip(*board.pushed, strict=True))
    assert np.abs(speeds).max() <= PUSHED.max_flow / PUSHED.area * 1.01
    back = np.flatnonzero(out < 0)
    again = int(np.flatnonzero(out[back[0] :] > 0)[0]) + back[0]  # where the second bead begins
    assert PUSHED.area * out[: back[0]].sum() == pytest.approx(laid, abs=1e-4)
    assert PUSHED.area * out[back[0] : again].sum() == pytest.approx(-1.0, abs=1e-4)
    assert PUSHED.area * out.sum() == pytest.approx(2 * laid - 1.0, abs=1e-4)
    assert board.place[0] == pytest.approx(x, abs=1e-4)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 12), st.integers(0, 12), st.booleans())
def test_what_is_called_back_before_it_went_out_is_neither_pushed_nor_counted(
    answered: int, waiting: int, bead: bool
) -> None:
    driven = Driven(board := Board(), PUSHED)
    driven.go(110.0)
    driven.go(110.3, 0.1)
    driven.run(0.1)
    board.fates = [""] * answered + ["unanswered"] * 8
    for k in range(waiting):
        driven.go(110.6 + 0.3 * k, 0.1 if bead else 0.0)
    driven.machine.recall()
    driven.run(30.0)
    rest(driven)
    lines = [float(line.partition(" E")[2].partition(" ")[0]) for line in dict.fromkeys(board.lines) if " E" in line]
    assert PUSHED.area * sum(lines) == pytest.approx(PUSHED.area * board.e, abs=1e-4)
    went = sum(" E" in line and " E-" not in line for line in dict.fromkeys(board.lines))
    assert PUSHED.area * board.e == pytest.approx(0.1 * went - 1.0, abs=1e-4)


def test_a_machine_without_moves_or_stopped_or_without_an_axis_pushes_nothing() -> None:
    driven = Driven(board := Board(), replace(PUSHED, retract_volume=0.0))
    driven.go(110.0)
    driven.go(110.3, 0.1)
    driven.run(0.1)
    assert board.e == pytest.approx(0.05)
    rest(driven, 20)
    driven.machine.stop(driven.now)
    driven.run(1.0)
    driven.go(110.6)
    driven.run(0.1)
    assert board.e == pytest.approx(0.05)
    plain = Driven(board := Board())
    plain.go(110.0)
    plain.go(110.3, 0.1)
    plain.run(0.1)
    assert not any(" E" in line or "M83" in line for line in board.lines)


def test_a_board_that_starts_anew_is_told_again_that_e_is_relative() -> None:
    driven = Driven(board := Board(), PUSHED)
    driven.go(110.0)
    driven.go(110.3, 0.1)
    driven.run(0.1)
    board.expected, board.relative, board.e = 1, False, 7.0
    board.say("start", "echo:Marlin 2.1.2")
    driven.run(0.5)
    driven.machine.enable(driven.now)
    driven.run(0.5)
    driven.go(110.0)
    driven.go(110.3, 0.1)
    driven.run(0.1)
    assert board.e == pytest.approx(7.05)


def test_a_machine_that_pushes_nothing_cold_says_so() -> None:
    driven = Driven(board := Board(), PUSHED)
    board.say("echo: cold extrusion prevented")
    driven.run(0.01)
    assert "M302 P1" in driven.fault


def test_a_turn_is_refused() -> None:
    driven = Driven(Board())
    with pytest.raises(InputError, match="does not turn"):
        driven.machine.send(G1(np.array([110.0, 110, 60, 0, 0.01, 0]), 10.0), driven.now)
    with pytest.raises(InputError, match="gcode://DEVICE"):
        open_arm("gcode://", gantry())
    assert all(address.startswith("gcode://") for address, _ in find_arms())


@settings(max_examples=50)
@given(st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3), st.lists(st.floats(-20, 20), min_size=3, max_size=3))
def test_its_tip_goes_where_the_path_wants_it_and_its_tool_leans_no_further_than_it_may(
    turn: list[float], offset: list[float]
) -> None:
    arm = arm_from_text(
        arm_text(gantry()).replace("tool_offset_mm = [0.0, 0.0, 0.0]", f"tool_offset_mm = {offset}"), "x"
    ).arm
    pose = se3.make(se3.exp_rotation(np.array(turn)), np.array([100.0, 90.0, 40.0]))
    axes, lean = axes_from_nozzle(arm, pose), float(tool_lean(arm, pose))
    assert arm.max_lean is not None and np.isfinite(axes).all() == (lean <= arm.max_lean)
    if lean <= arm.max_lean:
        there = nozzle_from_axes(arm, axes)
        assert there[:3, 3] == pytest.approx(pose[:3, 3], abs=1e-9)
        assert float(np.arccos(np.clip(there[:3, 2] @ pose[:3, 2], -1, 1))) == pytest.approx(lean, abs=1e-6)


RETRACTS = "retract_mm3 = 0.0", "retract_mm3 = 0.5"
ERRORS = "60:resend", "75:checksum_mismatch", "90:resend_with_timeout", "130:missing_lineno"
needs_octoprint = pytest.mark.skipif(not octoprint_bench.installed(), reason=octoprint_bench.MISSING)


@needs_octoprint
@pytest.mark.slow
def test_lines_that_octoprint_s_printer_asks_for_again_are_made_good(tmp_path: Path) -> None:
    with closing_bench(GcodeBench(tmp_path, ERRORS)) as bench:
        start = bench.begin()
        bench.follow(straight(start), 4.0)
        bench.run(0.5)
        target = bench.arm.target
        assert bench.arm.state is ArmState.ARMED, bench.arm.reason
        _, axes = bench.truth()
        assert target is not None and target[0] > start[0] + 20
        assert axes[-1, :3] == pytest.approx(target[:3], abs=1e-3)
        assert (np.diff(axes[:, 0]) >= -1e-9).all() and np.abs(np.diff(axes[:, 0])).max() < 1.0  # none left out


@needs_octoprint
@pytest.mark.slow
def test_a_breathing_surface_is_printed_with_octoprint_s_printer_and_its_axis_pushes_the_beads(tmp_path: Path) -> None:
    link = tmp_path / "printer"
    live = Live(tmp_path, lambda folder, home: OctoPrintServer(folder, home), f"gcode://{link}")
    path = raster(lines=12, speed=5.0)
    path = replace(path, extra={"width_mm": np.full(len(path), 0.8), "height_mm": np.full(len(path), 0.5)})
    write_path(tmp_path / "path.csv", path)
    (tmp_path / "axis.toml").write_text(Path("data/dispensers/arm_axis.toml").read_text().replace(*RETRACTS))
    try:
        record = tmp_path / "run.mcap"
        run = live.start(record, "--yes", "--until-printed", f"--dispensers={tmp_path / 'axis.toml'}")
        run.wait_for(r"\nprint\n")
        run.wait_for("done|finished|ended")
        assert run.end() == 0, run.said
        assert isinstance(live.server, OctoPrintServer)
        rows = live.server.truth()
    finally:
        live.close()
    axes = np.hstack([rows[:, 1:4], np.zeros((len(rows), 3))])
    ways = np.linalg.norm(np.diff(path.surface_from_nozzle[:, :3, 3], axis=0), axis=1)
    pushed, planned = 78.5 * rows[:, 4], 0.8 * 0.5 * ways.sum()  # mm^3
    errors, duty = nozzle_errors(record, tmp_path / "path.csv", live.profile, rows[:, 0], axes)
    words = f"P95 {np.percentile(errors, 95):.2f} mm, max {errors.max():.2f} mm, duty {100 * duty:.0f} %, "
    words += f"pushed {pushed.max():.2f} mm^3 of {planned:.2f}, at the end {pushed[-1]:.2f}"
    print(words)
    ticks = list(replay_run(record))
    assert len(ticks) > 200 and all(tick.frame == tick.recorded for tick in ticks)
    assert np.percentile(errors, 95) <= 0.5 and duty >= 0.8, words
    assert pushed.max() == pytest.approx(planned, rel=0.03), words
    assert pushed.max() - pushed[-1] == pytest.approx(0.5, abs=0.01), words


@needs_octoprint
@pytest.mark.slow
def test_halted_octoprint_s_printer_stands_until_it_is_reset(tmp_path: Path) -> None:
    with closing_bench(GcodeBench(tmp_path)) as bench:
        bench.begin()
        bench.follow(straight(bench.arm.target), 0.5)
        bench.arm.close()
        bench.arm.driver.release()
        assert emergency_stop(f"gcode://{bench.server.link}", bench.profile)[1] == ""
        bench.run(0.3)
        end = bench.clock.now()
        bench.run(0.5)
        stamps, axes = bench.truth()
        assert np.ptp(axes[stamps > end - 0.1, :3], axis=0).max() == 0.0


def test_nobody_left_it_is_halted_by_m112(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    (tmp_path / "board").symlink_to(os.ttyname(theirs))
    _, why = emergency_stop(f"gcode://{tmp_path / 'board'}", gantry())
    assert why == "" and os.read(ours, 100) == b"\nM112\n"
    os.close(ours)
    os.close(theirs)
