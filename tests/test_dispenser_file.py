"""Dispenser files: what is read, each key's error, delays written back; and the command on such a file."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.arm.profile import ArmProfile, Extruder
from hardware.cli.main import main
from hardware.dispenser.dispenser import ArmAxisDispenser, ArmPwmDispenser, DispenserProfile, check_path_materials
from hardware.dispenser.line_dispenser import LineDispenser
from hardware.dispenser.messages import PRESETS
from hardware.files.dispenser_file import (
    PRESET_NAMES,
    arm_with_dispensers,
    check_arm_moves,
    dispensers_from_text,
    drivers_of,
    read_dispensers,
    write_delays,
)
from hardware.files.path_file import read_path
from hardware.recording.loop_record import recorded_arm
from hardware.simulator.dispenser import DIALECTS
from tests.test_dispenser import served

SHIPPED = sorted(Path("data/dispensers").glob("*.toml"))
GOOD = {
    "name": '"a"',
    "materials": '["gel", 1]',
    "preset": '"arduino"',
    "port": '"/dev/ttyACM0"',
    "on_dead_time_s": "0.03",
    "nozzle_offset_mm": "[1, 2, 3]",
    "temperature_range_c": "[4, 60]",
}


def text(messages: str = "", **changes: str | None) -> str:
    keys = {key: value for key, value in (GOOD | changes).items() if value is not None}
    table = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f"[[dispenser]]\n{table}" + (f"[dispenser.messages]\n{messages}\n" if messages else "")


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_each_example_is_read_and_carries_a_shipped_path(file: Path) -> None:
    (each,) = settings = read_dispensers(file)
    assert each.preset == file.stem
    dispensers = drivers_of(settings, file)
    (driver,) = dispensers
    by_arm = {"arm_pwm": ArmPwmDispenser, "arm_axis": ArmAxisDispenser}
    assert isinstance(driver, by_arm.get(file.stem, LineDispenser))
    path = read_path("data/paths/square_10mm.csv")
    if each.profile.metered:
        with pytest.raises(InputError, match="meters its flow"):
            check_path_materials(dispensers, path, "p.csv")
    else:
        check_path_materials(dispensers, path, "p.csv")


def test_there_is_an_example_a_preset_and_the_virtual_ones_are_presets() -> None:
    assert {file.stem for file in SHIPPED} == set(PRESET_NAMES)
    assert set(DIALECTS) <= set(PRESETS)


def test_what_a_file_leaves_out_is_its_presets() -> None:
    (each,) = dispensers_from_text(text(), "d.toml")
    line, preset = each.line, PRESETS["arduino"]
    assert line is not None and (line.baud, line.start, line.messages) == (115_200, 2.0, preset.line.messages)
    assert each.profile.watchdog == 0.1 and each.profile.on_dead_time == 0.03 and not each.profile.metered
    assert each.profile.materials == ("gel", "1") and each.profile.nozzle_offset.tolist() == [1, 2, 3]
    (each,) = dispensers_from_text(text('on = "ON {flow_ul_s}"', metered="true", watchdog_s="0", baud="9600"), "d.toml")
    assert each.line is not None and each.line.messages.on == "ON {flow_ul_s}" and each.line.baud == 9600
    assert each.profile.metered and each.profile.watchdog is None


WRONG = [
    ("name", {"name": None}, "missing"),
    ("name", {"name": '""'}, "not empty"),
    ("materials", {"materials": "[]"}, "one or more"),
    ("materials", {"materials": "[1.5]"}, "names or whole numbers"),
    ("preset", {"preset": None}, "missing"),
    ("preset", {"preset": '"arduno"'}, "did you mean 'arduino'"),
    ("port", {"port": None}, "missing"),
    ("port", {"port": '"http://"'}, "http://HOST"),
    ("port", {"port": '"http://host/on"'}, "http://HOST"),
    ("port", {"port": '"http://host:none"'}, "http://HOST"),
    ("baud", {"baud": "100"}, ">= 300"),
    ("on_dead_time_s", {"on_dead_time_s": "5.1"}, "0 to 5 s"),
    ("on_lag_s", {"on_lag_s": "-0.1"}, "0 to 5 s"),
    ("off_dead_time_s", {"off_dead_time_s": "nan"}, "finite number"),
    ("off_lag_s", {"off_lag_s": '"x"'}, "finite number"),
    ("nozzle_offset_mm", {"nozzle_offset_mm": "[0, 0]"}, "3 finite numbers"),
    ("nozzle_offset_mm", {"nozzle_offset_mm": "[0, 0, 500]"}, "within 200 mm"),
    ("watchdog_s", {"watchdog_s": "0.01"}, "0.02 to 60 s"),
    ("watchdog_s", {"preset": '"usb_relay"', "temperature_range_c": None, "watchdog_s": "1"}, "messages.keepalive"),
    ("keepalive_s", {"keepalive_s": "0.05"}, "at most 0.04 s"),
    ("keepalive_s", {"keepalive_s": "0.001"}, "0.01 to 10"),
    ("start_s", {"start_s": "31"}, "0 to 30"),
    ("gap_s", {"gap_s": "2"}, "0 to 1"),
    ("timeout_s", {"timeout_s": "0"}, "0.05 to 5"),
    ("metered", {"metered": "1"}, "true or false"),
    ("messages.on", {"metered": "true"}, "a flow in it"),
    ("flow_range_mm3_s", {"flow_range_mm3_s": "[2, 1]"}, "low < high"),
    (
        "flow_range_mm3_s",
        {"preset": '"new_era"', "temperature_range_c": None, "flow_range_mm3_s": "[1, 200]"},
        "160 mm",
    ),
    ("flow_mm3_s", {"flow_mm3_s": "0"}, "to 1000 mm"),
    ("temperature_range_c", {"temperature_range_c": "[60, 4]"}, "low < high"),
    ("temperature_range_c", {"temperature_range_c": "[4, 600]"}, "-50 to 500"),
    ("temperature_range_c", {"preset": '"chemyx"'}, "messages.temperature"),
    ("kept_at_c", {"kept_at_c": "20"}, "left out where temperature_range"),
    ("kept_at_c", {"temperature_range_c": None, "kept_at_c": "900"}, "-50 to 500"),
    ("retract_mm3", {"retract_mm3": "1"}, "messages.retract"),
    ("prime_mm3", {"prime_mm3": "1"}, "messages.prime"),
    ("retract_mm3", {"retract_mm3": "-1"}, "0 to 100 mm"),
    ("plunger_mm2", {"preset": '"gcode_extruder"'}, "missing"),
    ("plunger_mm2", {"plunger_mm2": "0"}, "0.01 to 10000"),
    ("speed", {"speed": "1"}, "unknown key"),
    ("on_lag", {"on_lag": "1"}, "did you mean 'on_lag_s'"),
    ("pwm_on", {"pwm_on": "1"}, "unknown key"),
    ("messages", {"metered": "false\nmessages = 1"}, "a table"),
]


@pytest.mark.parametrize(("key", "changes", "words"), WRONG)
def test_each_key_that_makes_no_sense_is_named(key: str, changes: dict[str, str | None], words: str) -> None:
    with pytest.raises(InputError) as caught:
        dispensers_from_text(text(**changes), "d.toml")
    assert str(caught.value).startswith(f"d.toml: dispenser.{key} = ") and words in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("message", "key", "words"),
    [
        ('on = ""', "on", "a line or more"),
        ('on = "{speed}"', "on", "flow_ul_s"),
        ('keepalive = "{step_mm}"', "keepalive", "plunger_mm2"),
        ('off = "hex:A"', "off", "hex: and bytes"),
        ('answer = "T"', "answer", "one group"),
        ('alarm = "("', "alarm", "regular expression"),
        ("end = 10", "end", "a text"),
        ('onn = "X"', "onn", "did you mean 'on'"),
    ],
)
def test_each_message_that_makes_no_sense_is_named(message: str, key: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        dispensers_from_text(text(message), "d.toml")
    assert str(caught.value).startswith(f"d.toml: dispenser.messages.{key} = ") and words in str(caught.value)


PWM = '[[dispenser]]\nname = "t"\nmaterials = [1]\npreset = "arm_pwm"\npwm_on = {on}\npwm_off = 0\n{more}\n'
AXIS = '[[dispenser]]\nname = "t"\nmaterials = [1]\npreset = "arm_axis"\n{more}\n'
AXIS_NEEDS = "plunger_mm2 = 2.0\nflow_range_mm3_s = [0.1, 5]\n"


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", "d.toml: file = 'empty'"),
        ("x = 1", "x = 'unknown key'"),
        ("dispenser = 1", "dispenser = 1, allowed one [[dispenser]] table"),
        (text() + text(), "dispenser.name = 'a', allowed a name, and each once"),
        (text() + text(name='"b"'), "materials = 'gel', allowed in one dispenser"),
        (PWM.format(on=0, more=""), "dispenser.pwm_on = 0, allowed another number"),
        (PWM.format(on=1e9, more=""), "dispenser.pwm_on = 1000000000.0"),
        (PWM.format(on=1, more='port = "x"'), "dispenser.port = 'unknown key'"),
        (PWM.format(on=1, more="metered = true"), "dispenser.metered = True, allowed left out of arm_pwm"),
        (PWM.format(on=1, more="") + text(), "dispenser.preset = 'arm_pwm', allowed the only one"),
        (text() + AXIS.format(more=AXIS_NEEDS), "dispenser.preset = 'arm_axis', allowed the only one"),
        (AXIS.format(more="plunger_mm2 = 2.0"), "dispenser.flow_range_mm3_s = 'missing'"),
        (AXIS.format(more="flow_range_mm3_s = [0.1, 5]"), "dispenser.plunger_mm2 = 'missing'"),
        (AXIS.format(more=AXIS_NEEDS + "prime_mm3 = 1"), "dispenser.prime_mm3 = 1, allowed left out of arm_axis"),
        (AXIS.format(more=AXIS_NEEDS + 'port = "x"'), "dispenser.port = 'unknown key'"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused(table: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        dispensers_from_text(table, "d.toml")
    assert words in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("dispenser", "arm", "needed"),
    [
        (PWM.format(on=1, more=""), "/dev/ttyUSB0", ""),
        (PWM.format(on=1, more=""), "virtual", ""),
        (PWM.format(on=1, more=""), "gcode:///dev/ttyACM0", "SEED S6H4D"),
        (AXIS.format(more=AXIS_NEEDS), "gcode:///dev/ttyACM0", ""),
        (AXIS.format(more=AXIS_NEEDS), "/dev/ttyUSB0", "G-code machine"),
        (text(), "gcode:///dev/ttyACM0", ""),
    ],
)
def test_what_an_arm_is_to_switch_or_push_itself_needs_an_arm_that_does(dispenser: str, arm: str, needed: str) -> None:
    given = dispensers_from_text(dispenser, "d.toml")
    if needed:
        with pytest.raises(InputError, match=f"d.toml: dispenser.preset = .*{needed}"):
            check_arm_moves(given, arm, "d.toml")
    else:
        check_arm_moves(given, arm, "d.toml")


def test_an_arm_is_told_how_it_switches_or_pushes() -> None:
    plain = ArmProfile()
    assert arm_with_dispensers(plain, "") is plain
    pwm = arm_with_dispensers(plain, PWM.format(on=1500, more=""))
    assert (pwm.dialect.pwm_on, pwm.dialect.pwm, pwm.extruder) == (1500, 0, None)
    pushed = arm_with_dispensers(plain, AXIS.format(more=f"{AXIS_NEEDS}retract_mm3 = 0.5"))
    assert pushed.extruder == Extruder(2.0, 5.0, 0.5) and pushed.dialect == plain.dialect
    assert recorded_arm(pushed)[1].extruder == pushed.extruder  # as a live run takes it


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.0, 5.0), min_size=4, max_size=4), st.integers(0, 1))
def test_delays_that_are_written_are_read_and_all_else_stays(
    tmp_path_factory: pytest.TempPathFactory, delays: list[float], which: int
) -> None:
    file = tmp_path_factory.mktemp("d") / "d.toml"
    second = text('on = "X" # [[dispenser]]', name='"b"', materials='["ink"]', on_lag_s="0.5 # measured last year")
    before = f"# mine\n{text()}\n{second}"
    file.write_text(before)
    name = "ab"[which]
    write_delays(file, name, DispenserProfile("x", ("x",), *delays))
    found = read_dispensers(file)
    profile, other = found[which].profile, found[1 - which].profile
    got = [profile.on_dead_time, profile.on_lag, profile.off_dead_time, profile.off_lag]
    assert np.allclose(got, delays, atol=1e-6)
    assert (other.on_dead_time, other.on_lag) == (0.03, 0.5 * (which == 0))
    kept = [line for line in before.splitlines() if not re.match(r"(on|off)_(dead_time|lag)_s", line)]
    assert [line for line in file.read_text().splitlines() if not re.match(r"(on|off)_(dead_time|lag)_s", line)] == kept
    assert "# measured last year" in file.read_text()
    with pytest.raises(InputError, match="one of a, b"):
        write_delays(file, "c", profile)


# -- the command


def toml(folder: Path, port: object, **changes: str) -> str:
    file = folder / "dispenser.toml"
    file.write_text(text(port=f'"{port}"', start_s="0.0", **changes))
    return str(file)


def test_the_command_listens_and_sends_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served(tmp_path) as (port, models):
        assert main(["dispenser", toml(tmp_path, port), "--seconds", "0.1"]) == 0
    out = capsys.readouterr().out
    assert "switches itself off 100 ms" in out and "half its flow 30 ms after on" in out and "said 0 lines" in out
    assert models[0].unknown_lines == [] and models[0].switches == []
    assert main(["dispenser", toml(tmp_path, tmp_path / "none"), "--seconds", "0.1"]) == 1
    assert "failed" in capsys.readouterr().out
    assert main(["dispenser", "data/dispensers/arm_pwm.toml"]) == 0
    assert "HAS NO WATCHDOG" in capsys.readouterr().out


def test_the_command_opens_for_so_long_and_closes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served(tmp_path, heat_lag=0.1) as (port, models):
        assert main(["dispenser", toml(tmp_path, port), "--on", "0.2", "--yes", "--celsius", "22.5"]) == 0
    (on, flow), (off, none) = models[0].switches
    assert (flow, none) == (1.0, 0.0) and 0.19 < off - on < 0.5
    assert models[0].temperature_at(models[0].now) == pytest.approx(22.5, abs=0.5)
    assert capsys.readouterr().out.splitlines()[-1].endswith("closed: closed, off")


def test_the_command_closes_when_it_is_interrupted(tmp_path: Path) -> None:
    with served(tmp_path) as (port, models):
        command = [
            sys.executable,
            "-u",
            "-m",
            "hardware.cli.main",
            "dispenser",
            toml(tmp_path, port),
            "--on",
            "50",
            "--yes",
        ]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        while "on, 1" not in process.stdout.readline():
            pass
        process.terminate()
        assert process.wait(10) == 130
    assert not models[0].on and models[0].watchdog_stops == [] and len(models[0].switches) == 2


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["FILE", "--on", "1"], "--yes"),
        (["FILE", "--on", "61", "--yes"], "at most 60"),
        (["FILE", "--yes"], "only with --on"),
        (["FILE", "--name", "b"], "one of a"),
        (["FILE", "--log", "x.csv"], "only for a virtual one"),
        (["FILE", "--on", "1", "--yes", "--celsius", "90"], "4 to 60"),
        (["data/dispensers/new_era.toml", "--on", "1", "--yes", "--flow", "30"], "cannot give 30"),
        (["data/dispensers/arm_pwm.toml", "--on", "1", "--yes"], "a line of its own"),
        (["virtual", "--on", "1"], "only for dispensers of a file"),
        (["virtual", "--preset", "arduno"], "did you mean 'arduino'"),
        (["virtual", "--log", "FILE"], "a new file"),
    ],
)
def test_a_wrong_command_line_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], wrong: str
) -> None:
    file = toml(tmp_path, tmp_path / "none")
    assert main(["dispenser", *(file if word == "FILE" else word for word in words)]) == 2
    error = capsys.readouterr().err
    assert wrong in error and error.count("\n") == 1
