"""What a wrong settings file is refused with: one sentence a case, held against those that were looked at.

`python -m tests.test_file_messages` writes tests/reference/file_messages.txt anew; read what changed in it.
"""

from __future__ import annotations

import copy
import json
import math
import os
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.cameras.sources import read_live_rig
from hardware.files.arm_file import read_arm
from hardware.files.dispenser_file import read_dispensers
from hardware.files.path_file import PATH_HEADER, read_contour, read_path
from hardware.files.rig_file import read_board, read_rig
from hardware.live.settings import check_settings, read_settings
from hardware.process.checks import read_toml, record_from_table, toml_from_text, toml_lines, within
from hardware.simulator.arm.settings import read_virtual_arm
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scenario_tables import bare_scene
from hardware.simulator.trace_file import read_trace

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests/reference/file_messages.txt"
LEFT_OUT = object()  # a key that is taken away

CAMERA = {
    **{"name": "left", "size": [640, 480], "matrix": [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]},
    **{"distortion": [0.0] * 5, "base_from_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
}
RIGHT = CAMERA | {"name": "right", "base_from_camera": [[1, 0, 0, 80], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
LIVE = {"source": "usb:A1", "exposure_s": 0.008, "fps": 30.0, "format": "MJPG"}
SYRINGE = {"name": "syringe", "materials": [1], "preset": "arduino", "port": "/dev/ttyACM0", "kept_at_c": 20}
VALVE = {"name": "valve", "materials": [1], "preset": "arm_pwm", "pwm_on": 2000, "pwm_off": 1500}
RUN = {"cameras": {"simulated": "still.toml"}, "record": {"file": "run.mcap"}}


def shipped(name: str) -> dict[str, Any]:
    """The table of a file in data/."""
    return tomllib.loads((ROOT / "data" / name).read_text(encoding="utf-8"))


def read_run(file: Path) -> object:
    """A session.toml as `live` reads it."""
    return check_settings(read_settings(file), file)


def read_scene(file: Path) -> object:
    """The table [scene] of a scenario as a simulation reads it."""
    return bare_scene(file, read_toml(file)["scene"], file.parent, 0)


KINDS: dict[str, tuple[Callable[[Path], object], dict[str, Any]]] = {
    "arm": (read_arm, shipped("arms/six_axis.toml")),
    "board": (read_board, {"kind": "charuco", "squares": [9, 6], "square_mm": 10.0}),
    "dispenser": (read_dispensers, {"dispenser": [SYRINGE]}),
    "pwm": (read_dispensers, {"dispenser": [VALVE]}),
    "live_rig": (read_live_rig, {"camera": [CAMERA | LIVE, RIGHT | LIVE | {"source": "usb:B2"}]}),
    "rig": (read_rig, {"camera": [CAMERA, RIGHT]}),
    "scenario": (read_scenario, shipped("scenarios/breathing_calm.toml")),
    "scene": (read_scene, {"scene": {}}),
    "session": (read_run, RUN),
    "virtual_arm": (read_virtual_arm, {"faults": [], "arm": {"servo_lag_s": 0.02}}),
}
PART = {"name": "head", "box": [[0, 0, 60], [10, 10, 90]]}
ZONE = {"name": "patient", "box": [[-300, 50, -100], [300, 150, 40]]}
CASES: list[tuple[str, str, object]] = [  # kind of file, key, and its value
    ("arm", "home_mm", [0, 0, 0, 0, 0, 0]),
    ("arm", "home_mm_deg", [0, 0, 0]),
    ("arm", "motion_byte", 1.5),
    ("arm", "motion_byte", 7),
    ("arm", "slots", ["J4", "J5"]),
    ("arm", "slots", ["J4", "J5", "J9"]),
    ("arm", "baud", 1200),
    ("arm", "tick_s", 20),
    ("arm", "lag_s", "24 ms"),
    ("arm", "dead_time_s", -1.0),
    ("arm", "max_lean_deg", 200.0),
    ("arm", "tool_mm", [[0, 0.5], [-1, 2]]),
    ("arm", "tool_mm", 4),
    ("arm", "limits", 3),
    ("arm", "limits.sped", 3),
    ("arm", "limits.speed", [1, 2, 3]),
    ("arm", "limits.speed", [9000, 150, 150, 120, 120, 120]),
    ("arm", "limits.turn", "2.4"),
    ("arm", "limits.jump", float("inf")),
    ("arm", "no_go", {"name": "patient"}),
    ("arm", "no_go", [{"name": "patient", "cube": [[0, 0, 0], [1, 1, 1]]}]),
    ("arm", "no_go", [{"name": "patient"}]),
    ("arm", "no_go", [ZONE | {"radius": 3}]),
    ("arm", "no_go", [ZONE | {"box": [[0, 0, 0], [0.3, 0.1, 0.2]]}]),
    ("arm", "no_go", [{"name": "post", "cylinder": [[0, 0, 0], [0, 0, 100]], "radius": "80"}]),
    ("arm", "tool_part", [PART | {"radius": 3}]),
    ("arm", "tool_part", [{"name": "head", "cone": [[0, 0, 60], [0, 0, 120]], "radii": [5]}]),
    ("arm", "tool_part", [PART | {"name": ""}]),
    ("arm", "kinematics.nominal", "yes"),
    ("arm", "kinematics.angles", "joint"),
    ("arm", "kinematics.posture", ["front", "up"]),
    ("arm", "kinematics.posture", ["front", "up", "left"]),
    ("arm", "kinematics.low_deg", [170, -110, -75, -170, -88, -175]),
    ("arm", "kinematics.dh_mm_deg", LEFT_OUT),
    ("arm", "kinematics", {"name": "x", "urdf": "fr3.urdf", "flange": "link8"}),
    ("board", "kind", "charucco"),
    ("board", "squares", [9.5, 6]),
    ("board", "squares", [2, 6]),
    ("board", "square_mm", LEFT_OUT),
    ("board", "square_mm", 0.01),
    ("board", "dictionary", "4X4_51"),
    ("board", "inverted", 1),
    ("board", "sqare", 1),
    ("dispenser", "dispenser", []),
    ("dispenser", "dispenser.0.preset", "ardiuno"),
    ("dispenser", "dispenser.0.port", LEFT_OUT),
    ("dispenser", "dispenser.0.baud", 9600.5),
    ("dispenser", "dispenser.0.materials", []),
    ("dispenser", "dispenser.0.metered", "no"),
    ("dispenser", "dispenser.0.on_dead_time", 0.03),
    ("dispenser", "dispenser.0.on_dead_time_s", -0.03),
    ("dispenser", "dispenser.0.on_dead_time_s", True),
    ("dispenser", "dispenser.0.start_s", 60),
    ("dispenser", "dispenser.0.keepalive_s", 0.09),
    ("dispenser", "dispenser.0.nozzle_offset_mm", [0, 0]),
    ("dispenser", "dispenser.0.temperature_range_c", [60, 4]),
    ("dispenser", "dispenser.0.flow_mm3_s", 1e9),
    ("dispenser", "dispenser.0.messages", "ON"),
    ("dispenser", "dispenser.0.messages", {"onn": "ON"}),
    ("dispenser", "dispenser.0.messages", {"on": 5}),
    ("dispenser", "dispenser.0.messages", {"on": "ON {flw}"}),
    ("pwm", "dispenser.0.pwm_on", 1500),
    ("pwm", "dispenser.0.pwm_on", 1e9),
    ("pwm", "dispenser.0.metered", True),
    ("pwm", "dispenser.0.port", "/dev/ttyACM0"),
    ("live_rig", "camera.0.source", LEFT_OUT),
    ("live_rig", "camera.0.source", "usb:B2"),
    ("live_rig", "camera.0.fps", 0),
    ("live_rig", "camera.0.format", "MJPEG"),
    ("live_rig", "camera.0.exposure_s", "8 ms"),
    ("live_rig", "camera.0.exposure_ms", 8),
    ("live_rig", "camera.0.trigger", "software"),
    ("live_rig", "camera.0.source", "genicam://A"),
    ("live_rig", "camera.0.ptp", True),
    ("rig", "camera", {}),
    ("rig", "camera.0.name", "a/b"),
    ("rig", "camera.0.name", "right"),
    ("rig", "camera.0.size", [640.5, 480]),
    ("rig", "camera.0.matrix", [[0.006, 0, 0], [0, 0.006, 0], [0, 0, 1]]),
    ("rig", "camera.0.distortion", [0, 0, 0, 0]),
    ("rig", "camera.0.base_from_camera", LEFT_OUT),
    ("rig", "camera.1.base_from_camera", [[1, 0, 0, 0.08], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    ("rig", "camera.1.base_from_camera", [[1, 0, 0, 80], [0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]),
    ("rig", "camera.0.distorsion", [0, 0, 0, 0, 0]),
    ("rig", "camera.0.lens_sigma", [-1] * 9),
    ("rig", "camera.0.video", 3),
    ("scenario", "titel", "x"),
    ("scenario", "path", LEFT_OUT),
    ("scenario", "seconds", "26 s"),
    ("scenario", "seconds", 0),
    ("scenario", "seed", -1),
    ("scenario", "clearance_mm", 60),
    ("scenario", "look", "layers"),
    ("scenario", "faults", "arm stall 600ms"),
    ("scenario", "faults", ["arm stahl 600ms"]),
    ("scenario", "scene", 3),
    ("scene", "scene.body", "ches"),
    ("scenario", "scene.nozzle", 1),
    ("scene", "scene.tone", 2),
    ("scene", "scene.wound_size_mm", [1, 31]),
    ("scene", "scene.deformation", 3),
    ("scene", "scene.deformation", {"bulge": 1}),
    ("scenario", "motion", {"kind": "pulse"}),
    ("scenario", "motion.0.kind", "breathin"),
    ("scenario", "motion.0.kind", LEFT_OUT),
    ("scenario", "motion.0.rate_hz", 10),
    ("scenario", "motion.0.turn_deg", [1, 2]),
    ("scenario", "motion.0.amplitude", 4),
    ("scenario", "motion.0.direction", [0, 0, 0]),
    ("scenario", "motion.1", {"kind": "tremor", "rms_mm": [0.1, 0.1, 0.1], "band_hz": [12, 8]}),
    ("scenario", "motion.1", {"kind": "ramp", "speed_mm_s": [1, 0, 0], "back": True}),
    ("scenario", "motion.1", {"kind": "turn", "angles_deg": []}),
    ("scenario", "strain", {"kind": "sinus"}),
    ("scenario", "rig", {"focal_px": 10}),
    ("scenario", "rig", {"size": [32, 270]}),
    ("scenario", "rig", {"angles_deg": []}),
    ("scenario", "rig", {"focal_mm": 8}),
    ("scenario", "cameras", {"fps": 0}),
    ("scenario", "cameras", {"exposure_s": 0.05}),
    ("scenario", "cameras", {"every": 0}),
    ("scenario", "cameras", {"phase_s": [0, 0]}),
    ("scenario", "cameras", {"offset_s": {"lefft": 0.1}}),
    ("scenario", "cameras", {"off": [["top", 1]]}),
    ("scenario", "cameras", {"off": [["nowhere", 1, 2]]}),
    ("scenario", "cameras", {"drop": 0.6, "garble": 0.6}),
    ("scenario", "cameras", {"gain_period_s": 0}),
    ("scenario", "cameras", {"rate": 30}),
    ("scenario", "sensor", {"jpeg_quality": 101}),
    ("scenario", "sensor", {"noise": -1}),
    ("scenario", "tracking", {"by": "picture"}),
    ("scenario", "tracking", {"processing_s": "mesured"}),
    ("scenario", "arm", {"servo_lag_s": -0.1}),
    ("scenario", "arm", {"replies": "steam"}),
    ("scenario", "arm", {"low_mm_deg": [0, 0, 0]}),
    ("scenario", "arm", {"low_mm_deg": [2000, 0, 0, 0, 0, 0]}),
    ("scenario", "arm", {"fifo": 0}),
    ("scenario", "arm", {"servo_lag": 0.02}),
    ("scenario", "arm", {"wire_baud": 9600}),
    ("scenario", "arm", {"assumed_lag_s": 9}),
    ("scenario", "dispenser", {"led": 1}),
    ("scenario", "dispenser", {"given": 0}),
    ("scenario", "dispenser", {"on_lag_s": -0.1}),
    ("scenario", "dispenser", {"on_lag": 0.1}),
    ("scenario", "gel", {"aspect": 3}),
    ("scenario", "gel", {"sag": 3}),
    ("scenario", "planted", {"rig_offset_mm": 3}),
    ("scenario", "limits", {"duty": 80}),
    ("scenario", "limits", {"p95": 0.5}),
    ("session", "camera", {}),
    ("session", "cameras", 3),
    ("session", "cameras.patience_s", 0),
    ("session", "cameras.patience_s", "10 s"),
    ("session", "cameras.rigg", "rig.toml"),
    ("session", "cameras.simulated", 3),
    ("session", "cameras.simulated", "none.toml"),
    ("session", "cameras.rig", "still.toml"),
    ("session", "print", {"lift_mm": 200}),
    ("session", "print", {"dry_run": "yes"}),
    ("session", "record.file", "run.bag"),
    ("session", "record.jpeg_quality", 101),
    ("session", "record.jpeg_quality", 90.5),
    ("session", "page", {"names": "printer"}),
    ("session", "page", {"port": 70000}),
    ("session", "cores", {"motion": [-1]}),
    ("session", "cores", {"tracking": ["0"]}),
    ("session", "region", {"by": "network", "left": [[0, 0], [100, 0], [100, 100]]}),
    ("session", "region", {"colour": "green"}),
    ("session", "region", {"by": "colours"}),
    ("virtual_arm", "arm", 3),
    ("virtual_arm", "arm.seed", -1),
    ("virtual_arm", "arm.top_turn_deg_s", 0),
    ("virtual_arm", "arm.top_speed_mm_s", "fast"),
    ("virtual_arm", "faults", LEFT_OUT),
    ("virtual_arm", "faults", ["camera0 off"]),
]
TEXTS = {  # files that are no such TOML at all, and paths
    "empty.toml": "",
    "syntax.toml": "kind = charuco\n",
    "twice.toml": 'kind = "charuco"\nkind = "chessboard"\n',
    "semicolons.csv": "x_mm;y_mm;z_mm\n1;2;3\n",
    "word.csv": "x_mm,y_mm,z_mm,a_deg,b_deg,c_deg,speed_mm_s,material,temperature_c,layer,extrude\n1,2,three\n",
    "short.csv": f"{','.join(PATH_HEADER)}\n1,2,3\n",
    "nothing.csv": "\n\n",
    "numbers.csv": f"{','.join(PATH_HEADER)}\n0,0,0,0,0,0,nan,1,20,0,1\n1,0,0,0,0,0,1,1,20,0,1\n",
    "contour_empty.csv": "",
    "contour_word.csv": "x_mm,y_mm\n1,two\n3,4\n5,6\n",
    "contour_short.csv": "x_mm,y_mm\n1,2,3\n",
    "contour_head.csv": "x,y\n1,2\n",
    "trace_empty.csv": "",
    "trace_word.csv": "t_s,tx_mm,ty_mm,tz_mm\n0,0,0,zero\n",
    "trace_short.csv": "t_s,tx_mm,ty_mm,tz_mm\n0,0,0\n",
    "unit.csv": "x_m,y_mm,z_mm,a_deg,b_deg,c_deg,speed_mm_s,material,temperature_c,layer,extrude\n1,2,3\n",
}


TEXT_KINDS: dict[str, Callable[[Path], object]] = {"contour": read_contour, "trace": read_trace}


def toml(value: object) -> str:
    """A value as TOML, tables in line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def changed(table: dict[str, Any], key: str, value: object) -> dict[str, Any]:
    """A copy of the table with one value at "a.0.b" changed, added or left out."""
    copied = copy.deepcopy(table)
    *way, last = [int(word) if word.isdigit() else word for word in key.split(".")]
    at: Any = copied
    for step in way:
        at = at[step] if isinstance(step, int) or step in at else at.setdefault(step, {})
    if value is LEFT_OUT:
        del at[last]
    else:
        at[last] = value
    return copied


def refusals(folder: Path) -> dict[str, str]:
    """What each case is refused with; the words of a case to the message."""
    os.chdir(folder)
    (folder / "still.toml").write_text('title = ""\n', encoding="utf-8")
    found: dict[str, str] = {}
    for kind, key, value in CASES:
        read, table = KINDS[kind]
        file = Path(f"{kind}.toml")
        lines = [f"{json.dumps(name)} = {toml(each)}" for name, each in changed(table, key, value).items()]
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        found[f"{kind}: {key} {'left out' if value is LEFT_OUT else '= ' + toml(value)}"] = refusal(read, file)
    for name, text in TEXTS.items():
        file = Path(name)
        file.write_text(text, encoding="utf-8")
        found[name] = refusal(
            TEXT_KINDS.get(name.split("_")[0], read_path if file.suffix == ".csv" else read_board), file
        )
    return found


def refusal(read: Callable[[Path], object], file: Path) -> str:
    """The message of an InputError; "accepted" without one."""
    try:
        read(file)
    except InputError as error:
        return str(error)
    return "accepted"


def golden() -> dict[str, str]:
    """The messages that were looked at."""
    lines = GOLDEN.read_text(encoding="utf-8").splitlines()
    return dict(zip(lines[::3], lines[1::3], strict=True))


def test_a_wrong_settings_file_is_refused_with_the_sentence_that_was_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = refusals(tmp_path)
    assert "accepted" not in found.values()
    assert {case: text for case, text in found.items() if golden().get(case) != text} == {}
    assert found.keys() == golden().keys()


PLAIN = (
    st.text(st.characters(exclude_categories=["Cs"])) | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats()
)


@example({"a": "\x7f", "b": [float("inf"), "\\"]})
@given(st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), PLAIN | st.lists(PLAIN, max_size=3)))
def test_what_is_written_is_read_back(table: dict[str, object]) -> None:
    read = toml_from_text("here", "\n".join(["a0 = 0", *toml_lines(table)]))
    assert repr({"a0": 0, **table}) == repr(read)


@example(1.0, 2.0, 1.0, False)
@example(1.0, 2.0, 1.0, True)
@example(1.0, 2.0, 2.0, True)
@given(st.floats(), st.floats(), st.floats(), st.booleans())
def test_a_number_passes_within_its_range_alone_and_is_told_the_range(
    low: float, high: float, number: float, open_end: bool
) -> None:
    table, inside = {"a_mm": number}, low <= number <= high and (number > low or not open_end)
    try:
        found = record_from_table("x.toml", "t.", table, dict, {"a_mm": ("a", within(low, high, "mm", open_end))})
    except InputError as error:
        assert error.what == "t.a_mm" and not (inside and math.isfinite(number))
    else:
        assert found == {"a": number} and inside


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        blocks = [f"{case}\n{text}\n" for case, text in refusals(Path(scratch)).items()]
        GOLDEN.write_text("\n".join(blocks), encoding="utf-8")
