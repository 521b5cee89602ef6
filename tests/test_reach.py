"""Reach: what is too far, beyond a range, singular or too fast is told per checkpoint, before anything moves."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.se3 import Array
from hardware.arm.profile import ARM_FROM_BENCH
from hardware.cli.main import main
from hardware.files.arm_file import read_arm
from hardware.files.path_file import read_path, write_path
from hardware.offline.reach import reach_page
from hardware.report.page import Plot
from planning.kinematics import POSTURES, JointModel, nozzle_from_joints
from planning.path import REACH_REASONS, SurfaceMotion, best_posture, best_spin, reach_at_spin, reach_of
from tests.moving_surfaces import path_through, raster

ARMS = Path(__file__).parents[1] / "data" / "arms"
STILL = SurfaceMotion()


def nominal() -> JointModel:
    model = read_arm(ARMS / "s6h4d.toml").arm.joints
    assert model is not None
    return model


def reasons(model: JointModel, place: Array, motion: SurfaceMotion = STILL, speed: float = 5.0) -> set[str]:
    return {REACH_REASONS[i] for i in reach_of(model, place, raster(speed=speed), motion).reason}


def test_a_path_under_home_is_printable_and_its_joints_bring_the_nozzle_there() -> None:
    model, path = nominal(), raster()
    found = reach_of(model, ARM_FROM_BENCH, path, SurfaceMotion(10.0, 0.05, 0.25))
    assert found.feasible.all()
    assert np.allclose(nozzle_from_joints(model, found.joints), ARM_FROM_BENCH @ path.surface_from_nozzle, atol=1e-9)
    posture = int(np.argmax((model.signs == POSTURES).all(1)))
    assert best_posture(model, ARM_FROM_BENCH, path, STILL) == (posture, len(path))


@pytest.mark.parametrize(
    ("place", "motion", "speed", "reason"),
    [
        (ARM_FROM_BENCH @ se3.exp([0, 0, 0, 500, 0, 0]), STILL, 5.0, "too far"),
        (se3.make(np.eye(3), [5.0, 0, 100]), STILL, 5.0, "too far"),
        (se3.make(se3.exp_rotation([0, 0, np.pi]), [-300.0, 5, 50]), STILL, 5.0, "joint range"),
        (ARM_FROM_BENCH, STILL, 199.0, "joint speed"),
        (ARM_FROM_BENCH, SurfaceMotion(40.0, 0.3, 3.0), 5.0, "joint speed"),
    ],
)
def test_each_reason_is_told(place: Array, motion: SurfaceMotion, speed: float, reason: str) -> None:
    model = nominal()
    if speed > 100:
        model = replace(model, speed=np.full(6, 0.3))
    assert reason in reasons(model, place, motion, speed)


def test_a_wrist_within_five_degrees_of_singular_is_told_though_its_range_allows_it() -> None:
    model = nominal()
    point = path_through(np.array([[0.0, 0, 0], [0.1, 0, 0]]))
    for degrees, reason in ((80.0, "ok"), (86.5, "singular"), (89.0, "joint range")):
        place = nozzle_from_joints(model, np.array([0.1, -0.4, -0.3, 0.2, np.deg2rad(degrees), 0.1]))
        assert {REACH_REASONS[i] for i in reach_of(model, place, point, STILL).reason} == {reason}


def test_a_motion_of_the_surface_takes_reach_away() -> None:
    model, path = nominal(), raster()
    edge = next(
        place
        for x in np.arange(300.0, 600.0, 2.0)
        if not reach_of(model, place := se3.make(np.eye(3), [x + 2.0, 0, 50.0]), path, STILL).feasible.all()
    )
    near = edge @ se3.exp([0, 0, 0, -4.0, 0, 0])
    assert reach_of(model, near, path, STILL).feasible.all()
    assert not reach_of(model, near, path, SurfaceMotion(30.0)).feasible.all()


def test_speed_of_joints_is_that_of_differences() -> None:
    model, path = nominal(), path_through(np.linspace([0, 0, 0], [4, 3, 0], 101), speed=20.0)
    found = reach_of(model, ARM_FROM_BENCH, path, STILL)
    rates = np.abs(np.diff(found.joints, axis=0)) / (0.05 / 20.0) / model.speed
    assert np.allclose(found.speed[1:], rates.max(axis=1), rtol=0.01)


def test_the_tool_spins_to_stay_within_the_last_joint_and_no_more_than_it_must() -> None:
    model, path = nominal(), raster()
    narrow = replace(model, low=np.append(model.low[:5], -0.5), high=np.append(model.high[:5], 0.5))
    assert {REACH_REASONS[i] for i in reach_of(narrow, ARM_FROM_BENCH, path, STILL).reason} == {"joint range"}
    spin = best_spin(narrow, ARM_FROM_BENCH, path, STILL)
    assert reach_at_spin(narrow, ARM_FROM_BENCH, path, STILL, spin).feasible.all()
    assert np.ptp(spin) < 1e-9  # one angle serves the whole path
    assert np.allclose(best_spin(model, ARM_FROM_BENCH, path, STILL), best_spin(model, ARM_FROM_BENCH, path, STILL)[0])


def test_the_command_marks_the_path_and_what_can_be_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_path(tmp_path / "path.csv", raster())
    command = ["reach", str(tmp_path / "path.csv"), "--arm", str(ARMS / "s6h4d.toml")]
    assert main([*command, "-o", str(tmp_path / "good")]) == 0
    text = capsys.readouterr().out
    assert "6 of 6 are feasible" in text and "NOMINAL" in text
    assert main([*command, "--surface", "580,0,50,0,0,0", "-o", str(tmp_path / "bad"), "--spin"]) == 1
    marked = read_path(tmp_path / "bad" / "path.csv").extra["feasible"]
    assert 0 < (marked == 0).sum() <= 6
    with (tmp_path / "bad" / "reach.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["feasible"] for row in rows] == list(map(str, marked.tolist()))
    assert {row["reason"] for row in rows if row["feasible"] == "0"} <= set(REACH_REASONS[1:])
    assert "<svg" in (tmp_path / "bad" / "reach.html").read_text()


def test_the_path_that_is_read_is_not_overwritten_and_no_earlier_answer_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "path.csv"
    write_path(mine, raster())
    before = mine.read_bytes()
    command = ["reach", str(mine), "--arm", str(ARMS / "s6h4d.toml"), "--force", "-o"]
    assert main([*command, str(tmp_path)]) == 2
    assert mine.read_bytes() == before and "would be overwritten" in capsys.readouterr().err
    assert main([*command, str(tmp_path / "out")]) == 0
    monkeypatch.setattr("hardware.offline.reach.run_times", interrupted)
    assert main([*command, str(tmp_path / "out")]) == 130
    assert not list((tmp_path / "out").iterdir())


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_dense_path_is_drawn_as_the_curve_that_it_is() -> None:
    turn = np.linspace(0.0, 2 * np.pi * 20, 50_000)
    x, y = (1 + turn / 100) * np.cos(turn), (1 + turn / 100) * np.sin(turn)
    plot = Plot(900, 600, (-12, 12), (-8, 8))
    plot.way(x, y, "aside")
    drawn = plot.svg().rpartition('class="aside" d="M')[2].partition('"')[0]
    points = np.array([[float(word) for word in point.split()] for point in drawn.replace(",", " ").split("L")])
    assert 1000 < len(points) < 20_000
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 4.0  # px: no chord leaves the curve
    true = np.stack([plot.x(x), plot.y(y)], axis=1)
    assert points[[0, -1]] == pytest.approx(true[[0, -1]], abs=0.06)


def test_the_page_draws_the_arm_and_its_limits_and_lists_what_cannot_be_printed_with_what_to_do(tmp_path: Path) -> None:
    model, path = nominal(), raster(speed=5.0)
    reach = reach_of(model, ARM_FROM_BENCH, path, STILL)
    reason = np.zeros(len(path), np.int64)
    reason[2:5] = REACH_REASONS.index("singular")
    reason[5] = REACH_REASONS.index("too far")
    layered = replace(path, layer=np.where(np.arange(len(path)) < 4, 0, 1))
    text = reach_page("p.csv", "an arm", "words", layered, replace(reach, reason=reason), model)
    rows = re.findall(r"<tr><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)", text)
    assert [row[:3] for row in rows] == [
        ("2 to 3", "0", "singular"), ("4", "1", "singular"), ("5", "1", "too far"),
    ]  # fmt: skip
    assert "--spin" in rows[0][3] and "--surface" in rows[2][3]
    assert "from the side, mm" in text and "checkpoint 2: singular" in text and "limit 100" in text
    assert "Infeasible checkpoints" not in reach_page("p.csv", "an arm", "words", path, reach, model)
