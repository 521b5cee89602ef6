"""`stillbed plan`: one line for a new user, one for what is wrong; a plan that lies beside the wound shows it."""

from __future__ import annotations

import base64
import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.cli.main import main
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import read_contour, read_path
from hardware.plan import run as planning_command
from hardware.plan.order import (
    SCAN_UNITS,
    SETTINGS,
    PlanRequest,
    PlanSettings,
    in_mm,
    plan_order,
    subject_of,
)
from hardware.plan.run import MAX_CENTROID_DISTANCE, WoundSighting, _sighting, placement_lines
from hardware.report.page import document, figures_table, section
from perception.lens import Lenses
from planning.command import MotionLimits, Move
from planning.kinematics import SimpleArm
from planning.motion.planner import Planner
from tests.browser import Browser, axe_findings
from tests.moving_surfaces import pose_at, still
from tests.wound_scans import scan_of

SQUARE = "x_mm,y_mm\n0,0\n12,0\n12,8\n0,8\n"


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def contour(folder: Path, text: str = SQUARE) -> Path:
    file = folder / "contour.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_an_arm_says_which_checkpoints_are_feasible(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["plan", str(contour(tmp_path)), "--bead", "0.8", "--no-pictures", "-o"]
    assert main([*line, str(tmp_path / "without.csv")]) == 0
    assert "--arm" in capsys.readouterr().out and "feasible" not in read_path(tmp_path / "without.csv").extra
    assert main([*line, str(tmp_path / "with.csv"), "--arm", "data/arms/s6h4d.toml"]) == 0
    feasible = read_path(tmp_path / "with.csv").extra["feasible"]
    assert f"{feasible.sum()} of {len(feasible)} checkpoints" in capsys.readouterr().out


def test_a_contour_becomes_a_path_with_everything_beside_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "path.csv"
    gcode = tmp_path / "print.gcode"
    assert main(["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "0.8", "--gcode", str(gcode)]) == 0
    told = capsys.readouterr().out
    assert "coverage: 99" in told and "path: 1 layer, " in told
    path = read_path(out)
    planner = Planner(path, MotionLimits(), SimpleArm(), 0.02)
    commands = [planner(pose_at(still, 0.02 * k), 0.02 * k) for k in range(600)]
    assert sum(isinstance(command, Move) for command in commands) > 500 and planner.progress.place > 0
    assert sorted(file.name for file in out.parent.iterdir()) == [
        "path.csv", "path.html", "path.json", "path_layers", "path_layers.csv",
    ]  # fmt: skip
    assert gcode.read_text().count("\nG1 ") == path.extrude.sum()
    facts = json.loads(out.with_suffix(".json").read_text())
    assert facts["checkpoints"] == len(path) and facts["wound"]["area"] == pytest.approx(96)
    with (out.parent / "path_layers.csv").open(encoding="utf-8") as stream:
        (row,) = csv.DictReader(stream)
    assert float(row["covered"]) > 0.99 and float(row["gap_mm2"]) < 1
    (picture,) = (out.parent / "path_layers").iterdir()
    drawn = ElementTree.parse(picture).getroot()
    assert sum(e.get("class") == "start" for e in drawn.iter()) == 1


def test_what_was_repaired_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vertices, triangles = scan_of()
    write_ply(tmp_path / "scan.ply", vertices, np.vstack([triangles, triangles[:1]]))
    out = tmp_path / "path.csv"
    assert main(["plan", str(tmp_path / "scan.ply"), "-o", str(out), "--bead", "2", "--no-pictures"]) == 0
    assert "scan: duplicate triangles left out (1)\n" in capsys.readouterr().out


def test_the_report_needs_no_network_and_holds_every_checkpoint(tmp_path: Path) -> None:
    out = tmp_path / "path.csv"
    assert main(["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "0.8"]) == 0
    page = out.with_suffix(".html").read_text(encoding="utf-8")
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", page) and "@import" not in page
    data = re.search(r'<script type="application/json" id="plan-data">(.*?)</script>', page)
    held = json.loads(data[1])
    assert len(held["extrude"]) == -(-len(read_path(out)) // 3) * 4  # a byte each, as base64
    moments = np.frombuffer(base64.b64decode(held["seconds"]), "<f4")  # the slider's last time is that of the tile
    seconds = json.loads(out.with_suffix(".json").read_text())["total"]["seconds"]
    assert len(moments) == len(read_path(out)) and moments[-1] == pytest.approx(seconds, rel=1e-5)
    for name, value in (
        ("bead", "0.8 mm"),
        ("turning-deg-mm", "5 °/mm"),
        ("sideways", "200 mm/s²"),
        ("angle", "fastest"),
    ):
        assert re.search(rf"<td>[^<]*, --{name}</td><td>{value}</td>", page)


def test_axe_finds_nothing_serious_in_a_plan_or_in_what_an_arm_can_reach(browser: Browser, tmp_path: Path) -> None:
    out, arm = tmp_path / "path.csv", "data/arms/s6h4d.toml"
    assert main(["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "0.8"]) == 0
    assert main(["reach", str(out), "--arm", arm, "-o", str(tmp_path / "reach")]) in (0, 1)
    for file in (out.with_suffix(".html"), tmp_path / "reach" / "reach.html"):
        page = browser.page(file.as_uri())
        page.until("document.readyState === 'complete' && Boolean(document.querySelector('footer'))")
        assert axe_findings(page) == [], file
        page.close()


def test_no_table_widens_a_page_beyond_a_phone(browser: Browser, tmp_path: Path) -> None:
    file, words = tmp_path / "wide.html", [f"measured {i}" for i in range(11)]
    text = document("report", "wide", "", [section("wide", "", figures_table(words, [words]))], "")
    file.write_text(text, encoding="utf-8")
    page = browser.page("about:blank", (390, 844))
    page.go(file.as_uri())
    page.until("Boolean(document.querySelector('footer'))")
    assert page.js("document.documentElement.scrollWidth") == 390
    assert page.js("(() => { const s = document.querySelector('section'); return s.scrollWidth > s.clientWidth })()")
    assert axe_findings(page) == []
    page.close()


def test_a_finger_scrolls_the_page_up_and_down_and_turns_the_plan_sideways(browser: Browser, tmp_path: Path) -> None:
    out = tmp_path / "path.csv"
    assert main(["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "0.8"]) == 0
    page = browser.page(out.with_suffix(".html").as_uri(), (390, 844))
    page.until("document.readyState === 'complete' && Boolean(document.querySelector('footer'))")
    page.js("document.getElementById('plan-canvas').scrollIntoView({block: 'center'})")
    at, (x, y) = page.js("scrollY"), (195.0, 422.0)
    before = page.shot()
    page.drag_finger((x, y), (x - 120, y), 6)
    assert page.js("scrollY") == at and page.shot() != before
    page.drag_finger((x, y), (x, y - 200), 10)
    page.until(f"scrollY > {at} + 100")
    page.close()


@pytest.mark.slow
def test_a_scan_in_metres_is_recognised_and_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vertices, triangles = scan_of()
    write_ply(tmp_path / "scan.ply", vertices / 1000, triangles)
    command = ["plan", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "path.csv"), "--bead", "1", "--no-pictures"]
    assert main(command) == 2
    assert "--unit m (" in capsys.readouterr().err
    assert main([*command, "--unit", "m", "--pattern", "zigzag"]) == 0
    assert (tmp_path / "path_scan.ply").is_file() and not (tmp_path / "path.html").exists()
    assert np.abs(read_path(tmp_path / "path.csv").surface_from_nozzle[:, :3, 3]).max() < 100


def test_an_example_plans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "path.csv"
    command = ["plan", "--example", "chest", "-o", str(out), "--bead", "1.5", "--pattern", "zigzag", "--no-pictures"]
    with monkeypatch.context() as patched:
        patched.setattr(planning_command, "make_plan", interrupted)
        assert main(command) == 130
    assert "nothing was written" in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert main(command) == 0
    assert "path_example.ply" in capsys.readouterr().out.splitlines()[-2]
    path = read_path(out)
    assert len(np.unique(path.layer)) > 1 and set(path.material.tolist()) <= {1, 2, 3}
    assert (tmp_path / "path_example.ply").is_file()


@pytest.mark.parametrize(
    "text",
    [
        "", "x,y\n0,0\n1,0\n1,1\n", "x_mm,y_mm\n0,0\n9,0\n", "x_mm,y_mm\n0,0\n9,nan\n9,9\n", "x_mm,y_mm\n0,0\n9\n9,9\n",
        "x_mm,y_mm\n0,0\n9,9\n9,0\n0,9\n", "x_mm,y_mm,z_mm\n0,0,0\n9,0,0\n9,9,0\n",
    ],
)  # fmt: skip
def test_a_contour_that_is_none_is_one_line(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", str(contour(tmp_path, text)), "-o", str(tmp_path / "path.csv")]) == 2
    assert "allowed" in capsys.readouterr().err


@pytest.mark.slow
def test_a_good_scan_turned_over_is_answered_without_flip(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_ply(tmp_path / "scan.ply", *scan_of(size=(60.0, 40.0), depth=6.0))
    assert main(["plan", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "path.csv"), "--flip"]) == 2
    told = capsys.readouterr().err
    assert "mm: leave --flip out" in told and "say --flip" not in told


def test_a_path_that_is_there_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "path.csv"
    out.write_text("mine")
    command = ["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "2", "--no-pictures"]
    assert main(command) == 2
    assert out.read_text() == "mine" and "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    assert len(read_path(out)) > 2


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--unit", "cm"),
        ("--flip", None),
        ("--outline", "contour.csv"),
        ("--clicks", "0,0,0/1,0,0/1,1,0"),
        ("--wound", "2"),
    ],
)
@pytest.mark.parametrize("example", [True, False])
def test_an_option_of_a_scan_is_refused_where_there_is_none(
    option: str, value: str | None, example: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = contour(tmp_path)
    subject = ["--example", "forearm"] if example else [str(drawn)]
    words = [option] if value is None else [option, str(drawn) if value.endswith(".csv") else value]
    assert main(["plan", *subject, *words, "-o", str(tmp_path / "path.csv")]) == 2
    assert f"{option} = " in capsys.readouterr().err and not (tmp_path / "path.csv").exists()


@pytest.mark.parametrize("name", ["path.csv", "path_layers.csv", "path.json"])
def test_no_file_of_a_plan_is_written_over_by_its_g_code(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["plan", str(contour(tmp_path)), "--gcode", str(tmp_path / name), "-o", str(tmp_path / "path.csv")]
    assert main(command) == 2
    assert "--gcode = " in capsys.readouterr().err


def test_nothing_of_an_earlier_plan_stays_beside_a_path(tmp_path: Path) -> None:
    """A path with the scan of another plan would be kept off tissue that is not there."""
    scan, out = tmp_path / "scan.ply", tmp_path / "of.monday.csv"
    write_ply(scan, *scan_of())
    assert main(["plan", str(scan), "-o", str(out), "--bead", "2"]) == 0
    ends = {file.name.removeprefix("of.monday") for file in tmp_path.iterdir()} - {"scan.ply"}
    assert ends == {".csv", ".html", ".json", "_layers", "_layers.csv", "_scan.ply"}  # a dot in a name is no suffix
    assert len(list((tmp_path / "of.monday_layers").iterdir())) > 1
    assert main(["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "2", "--no-pictures", "--force"]) == 0
    assert sorted(tmp_path.glob("of*")) == [
        tmp_path / f"of.monday{e}" for e in (".csv", ".json", "_layers", "_layers.csv")
    ]
    assert not list((tmp_path / "of.monday_layers").iterdir())


def test_ctrl_c_is_atomic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "path.csv"
    command = ["plan", str(contour(tmp_path)), "-o", str(out), "--bead", "2"]
    with monkeypatch.context() as patched:
        patched.setattr(planning_command, "layer_svg", interrupted)  # while the first picture is drawn
        assert main(command) == 130
    assert "whole" in capsys.readouterr().err and len(read_path(out)) > 2
    with monkeypatch.context() as patched:
        patched.setattr("planning.layers.plan.path_from", interrupted)
        assert main([*command, "--force"]) == 130
    assert len(read_path(out)) > 2 and not list(tmp_path.glob("*.part"))


@given(st.sampled_from(sorted(SCAN_UNITS)), st.floats(25, 900))
def test_the_right_unit_is_taken_and_a_wrong_one_is_answered_with_it(unit: str, size: float) -> None:
    vertices = np.random.default_rng(0).uniform(0, 1.05 * size / SCAN_UNITS[unit], (2000, 3))
    triangles = np.arange(1998).reshape(-1, 3)
    assert np.allclose(in_mm(vertices, triangles, unit, "scan"), vertices * SCAN_UNITS[unit])
    for other in SCAN_UNITS:
        try:
            in_mm(vertices, triangles, other, "scan")
        except InputError as error:
            assert f"--unit {unit}" in str(error)


@given(st.sampled_from([name for name, info in SETTINGS.items() if info.limits is not None]), st.booleans())
def test_every_setting_is_refused_just_beyond_its_range(name: str, above: bool) -> None:
    low, high = SETTINGS[name].limits
    inside, outside = (high, np.nextafter(high, np.inf)) if above else (low, np.nextafter(low, -np.inf))
    plan_order(PlanSettings(**{name: inside}), flat=False)
    with pytest.raises(InputError, match="--" + name.replace("_", "-")):
        plan_order(PlanSettings(**{name: float(outside)}), flat=False)


def test_a_contour_may_be_closed_and_repeat_points(tmp_path: Path) -> None:
    file = contour(tmp_path, "x_mm,y_mm\n0,0\n0,0\n5,0\n5,5\n0,0\n")
    assert np.array_equal(read_contour(file), [[0, 0], [5, 0], [5, 5]])


AROUND = np.linspace(0, 2 * np.pi, 200, endpoint=False)
OUTLINE = np.column_stack([20 * np.cos(AROUND), 14 * np.sin(AROUND) + 2 * np.cos(2 * AROUND), 0 * AROUND])


def seen(camera: int, outline: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """The mask of an outline (N, 3), surface frame, as a camera images it."""
    rig = arc_rig()
    inner = se3.transform_points(se3.inverse(rig.cameras[camera].base_from_camera) @ BASE_FROM_REST, outline)
    ideal = inner[:, :2] / inner[:, 2:] * rig.cameras[camera].matrix[[0, 1], [0, 1]] + rig.cameras[camera].matrix[:2, 2]
    pixels, _ = Lenses(rig).image(camera, ideal, inner[:, 2])
    mask = np.zeros(rig.cameras[camera].size[::-1], np.uint8)
    return cv2.fillPoly(mask, [np.rint(pixels).astype(np.int32)], 1).astype(bool)


@pytest.mark.parametrize("camera", range(3))
def test_a_plan_on_the_wound_is_near_its_middle(camera: int) -> None:
    found = _sighting(arc_rig().cameras[camera], seen(camera, OUTLINE), BASE_FROM_REST, OUTLINE)
    assert found.distance < 0.5 and found.share > 0.9


@given(st.floats(4, 15), st.floats(0, 2 * np.pi))
@settings(max_examples=10)
def test_a_plan_beside_the_wound_is_off_by_as_much(away: float, angle: float) -> None:
    moved = OUTLINE + away * np.array([np.cos(angle), np.sin(angle), 0.0])
    offs = [_sighting(arc_rig().cameras[c], seen(c, OUTLINE), BASE_FROM_REST, moved).distance for c in range(3)]
    assert 0.85 * away < max(offs) < 1.15 * away + 0.5
    lines = placement_lines("TRACKING", [WoundSighting("top", max(offs), 1.0)])
    assert (f"more than {MAX_CENTROID_DISTANCE:g} mm" in lines[1]) == (max(offs) > MAX_CENTROID_DISTANCE)


def test_a_camera_that_shows_no_wound_says_so() -> None:
    nothing = np.zeros(arc_rig().cameras[0].size[::-1], bool)
    found = _sighting(arc_rig().cameras[0], nothing, BASE_FROM_REST, OUTLINE)
    assert "no wound" in placement_lines("TRACKING", [found])[1]


@pytest.mark.parametrize(
    ("option", "text", "words"),
    [
        ("--arm", "lag_s = -1\n", "lag_s"), ("--arm", "lag_s = 0.1\n", "kinematics"),
        ("--outline", "x\n", "header"), ("--session", "", "session"),
    ],
)  # fmt: skip
def test_every_file_that_a_plan_is_given_is_read_before_the_scan(
    option: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scan is none: whoever read it first would tell of that."""
    (tmp_path / "scan.ply").write_text("no scan")
    wrong = tmp_path / ("nowhere.mcap" if option == "--session" else "wrong.toml")
    if text:
        wrong.write_text(text)
    assert main(["plan", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "path.csv"), option, str(wrong)]) == 2
    told = capsys.readouterr().err
    assert f"stillbed: {wrong}: {words}" in told and "scan.ply" not in told and not (tmp_path / "path.csv").exists()


@pytest.mark.slow
def test_a_cloud_of_points_is_planned_as_the_mesh_is(tmp_path: Path) -> None:
    vertices, triangles = scan_of()
    write_ply(tmp_path / "mesh.ply", vertices, triangles)
    order = np.random.default_rng(0).permutation(len(vertices))
    np.savetxt(tmp_path / "cloud.xyz", vertices[order], "%.6f")
    mesh, cloud = (
        subject_of(PlanRequest(tmp_path / "x.csv", scan=tmp_path / name), False).wound.findings
        for name in ("mesh.ply", "cloud.xyz")
    )
    assert cloud.area == pytest.approx(mesh.area, rel=0.02) and cloud.volume == pytest.approx(mesh.volume, rel=0.02)
