"""`stillbed arm DEVICE`: it listens, and moves only what an operator has confirmed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimation.errors import InputError
from hardware.arm.console import Request, axes_from_text, findings, jog_from_text, origin_from_text, run_arm
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmState, ArmStatus
from hardware.cli.main import main
from hardware.process.clock import SimClock
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import PortFaults, VirtualDevice
from hardware.simulator.arm.settings import ArmSettings, Replies
from tests.test_arm_port import serving
from tests.virtual_arm import HOME, arm_fault

AWAY = HOME + np.array([-20.0, 10, -30, 0, 0.1, 0])


def asked(
    request: Request, replies: Replies = Replies.STREAM, fault: str = "", port: PortFaults | None = None
) -> tuple[ArmStatus, VirtualArm, list[str]]:
    faults = [arm_fault(fault)] if fault else []
    clock, profile = SimClock(), ArmProfile()
    arm = VirtualArm(ArmSettings(replies=replies), profile.dialect, AWAY, faults)
    lines: list[str] = []
    status = run_arm(VirtualDevice(arm, clock, faults=port), profile, request, clock, lines.append)
    arm.advance(clock.now())
    return status, arm, lines


def test_listening_sends_nothing_and_says_what_answers() -> None:
    status, arm, lines = asked(Request(seconds=2.0))
    assert (arm.frames, arm.garbage) == (0, [])
    assert status.answered == pytest.approx(AWAY, abs=0.05)
    assert "20.0 places a second" in lines[-1] and "X182.50 Y235.00" in lines[-1]
    _, _, strays = asked(Request(seconds=5.0), Replies.STRAY)
    assert "nothing that is an answer" in strays[-1] and "0 stray" not in strays[-1]


def test_home_is_reached_and_the_arm_is_disarmed() -> None:
    status, arm, lines = asked(Request(home=True, confirmed=True))
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(HOME, abs=1e-3)
    assert status.state is ArmState.DISARMED
    assert any("by its own answer" in line for line in lines)
    assert "lag_s = 0.0" in lines[-1]


def test_nothing_moves_without_a_word() -> None:
    for request in (Request(home=True), Request(jog=np.ones(6))):
        with pytest.raises(InputError, match="--yes"):
            asked(request)


def test_an_arm_that_does_not_answer_must_be_told_where_it_stands() -> None:
    with pytest.raises(InputError, match="nobody knows"):
        asked(Request(home=True, confirmed=True), Replies.OFF)
    _, arm, _ = asked(Request(home=True, confirmed=True, stands=AWAY), Replies.OFF)
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(HOME, abs=1e-3)


def test_a_jog_goes_by_so_much_and_not_out_of_bounds() -> None:
    _, arm, _ = asked(Request(jog=jog_from_text(["X=+5", "b=-2"]), confirmed=True))
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(AWAY + jog_from_text(["X=5", "B=-2"]), abs=0.06)
    with pytest.raises(InputError, match="out of bounds"):
        asked(Request(jog=jog_from_text(["X=1000"]), confirmed=True))


def test_an_origin_is_sent_when_confirmed_and_moves_stay_in_machine_axes() -> None:
    origin = origin_from_text("200,210.5,90")
    with pytest.raises(InputError, match="--yes"):
        asked(Request(origin=origin))
    status, arm, _ = asked(Request(origin=origin, confirmed=True))
    assert arm.origin == pytest.approx([200, 210.5, 90]) and status.state is ArmState.DISARMED
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(AWAY)
    _, arm, _ = asked(Request(origin=origin, home=True, confirmed=True))
    assert arm.axes_at(np.array([arm.now]))[0] == pytest.approx(HOME, abs=1e-3)
    with pytest.raises(InputError, match="--origin"):
        origin_from_text("1,2")


def test_a_fault_on_the_way_stops_it() -> None:
    status, arm, lines = asked(Request(home=True, confirmed=True), fault="stall 9s at 2s")
    assert status.state is ArmState.STOPPED and "later on its way" in status.reason
    assert any("stopped" in line for line in lines) and arm.frames < 150


def test_a_device_that_is_not_there_is_said_at_once() -> None:
    with pytest.raises(InputError, match="--watch to wait"):
        asked(Request(), port=PortFaults(away=[(0.0, 9.0)]))


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
    assert findings(status, ArmProfile()).splitlines() == [
        "disarmed: x",
        "it sent nothing that is an answer and 0 stray bytes",
    ]


def test_the_command_finds_a_virtual_arm_on_its_pty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = tmp_path / "arm"
    with serving(link, ArmSettings(replies=Replies.STREAM)) as ended:
        assert main(["arm", str(link), "--seconds", "0.6"]) == 0
        assert "it stands at X202.50 Y225.00 Z113.00" in capsys.readouterr().out
        assert main(["arm", str(link), "--home"]) == 2
        assert main(["arm", str(link), "--jog", "Z=-2", "--yes"]) == 0
    assert ended[0].axes_at(np.array([ended[0].now]))[0][2] == pytest.approx(111.0, abs=1e-3)
    assert main(["arm", str(tmp_path / "nothing")]) == 2
    assert "a device that is there" in capsys.readouterr().err
