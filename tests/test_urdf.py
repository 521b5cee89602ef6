"""An arm by its URDF file: `make counterparts`, as it needs pinocchio."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.files.arm_file import arm_from_text, arm_text, read_arm, write_arm
from hardware.files.path_file import write_path
from hardware.offline.reach import ReachQuestion, run_reach
from hardware.recording.loop_record import recorded_arm
from planning.urdf import UrdfKinematics
from tests.franka_bench import fr3
from tests.moving_surfaces import raster

ROOT = Path(__file__).parents[1]
FR3 = ROOT / "data/arms/fr3.toml"


@pytest.fixture(scope="module")
def arm() -> UrdfKinematics:
    pytest.importorskip("pinocchio", reason="pinocchio is not installed: make counterparts")
    profile = fr3()
    assert profile.urdf is not None and profile.flange_from_nozzle is not None
    return UrdfKinematics(profile.urdf, profile.flange_from_nozzle)


def some_joints(arm: UrdfKinematics, count: int) -> Array:
    rng = np.random.default_rng(3)
    return np.asarray(arm.ready + rng.uniform(-0.4, 0.4, (count, 7)))


def test_an_arm_file_names_its_urdf_and_comes_back(tmp_path: Path) -> None:
    profile = fr3()
    write_arm(tmp_path / "arm.toml", profile)
    again = read_arm(tmp_path / "arm.toml")
    assert profile.urdf is not None and again.urdf is not None
    assert again.urdf.file == profile.urdf.file.resolve() and again.urdf.name == "Franka Research 3"
    assert again.urdf.ready == pytest.approx(profile.urdf.ready)
    assert again.flange_from_nozzle == pytest.approx(profile.flange_from_nozzle)


def test_what_a_recording_keeps_of_an_arm_has_its_urdf_where_the_file_is_not(tmp_path: Path) -> None:
    file = tmp_path / "fr3.urdf"
    file.write_bytes((FR3.parent / "fr3.urdf").read_bytes())
    here = read_arm(FR3)
    assert here.urdf is not None and here.flange_from_nozzle is not None
    text, kept = recorded_arm(replace(here, urdf=replace(here.urdf, file=file)))
    file.unlink()
    assert str(tmp_path) not in text and kept.urdf is not None
    pytest.importorskip("pinocchio", reason="pinocchio is not installed: make counterparts")
    there = arm_from_text(arm_text(kept, whole=True), "elsewhere/run.mcap/arm.toml").urdf  # of a run that resumes
    assert there is not None
    model, known = (UrdfKinematics(each, here.flange_from_nozzle) for each in (there, here.urdf))
    assert model.nozzle(known.ready) == pytest.approx(known.nozzle(known.ready), abs=1e-12)


@pytest.mark.parametrize(("key", "wrong"), [("urdf", "none.urdf"), ("flange", "link9"), ("ready_deg", [0, 1])])
def test_what_does_not_fit_is_named(arm: UrdfKinematics, tmp_path: Path, key: str, wrong: object) -> None:
    text = FR3.read_text().replace('urdf = "fr3.urdf"', f'urdf = "{ROOT / "data/arms/fr3.urdf"}"')
    lines = [f"{key} = {wrong!r}" if line.startswith(f"{key} =") else line for line in text.splitlines()]
    (tmp_path / "arm.toml").write_text("\n".join(lines))
    profile = read_arm(tmp_path / "arm.toml")
    assert profile.urdf is not None and profile.flange_from_nozzle is not None
    with pytest.raises(InputError, match=f"kinematics.{key}"):
        UrdfKinematics(profile.urdf, profile.flange_from_nozzle)


def test_the_joints_have_the_ranges_and_speeds_of_the_file(arm: UrdfKinematics) -> None:
    assert np.rad2deg(arm.high[3]) < 0 < np.rad2deg(arm.low[5])  # joint 4 never opens, joint 6 never closes
    assert arm.speed == pytest.approx([2.62] * 4 + [5.26, 4.18, 5.26])


def test_the_inverse_leads_back(arm: UrdfKinematics) -> None:
    for joints in some_joints(arm, 20):
        pose = arm.nozzle(joints)
        found = arm.joints(pose, arm.ready)
        again = arm.nozzle(found)
        assert np.linalg.norm((again - pose)[:3, 3]) < 0.011
        assert np.linalg.norm(se3.log_rotation(again[:3, :3] @ pose[:3, :3].T)) < 1.1e-4


def test_the_jacobian_is_what_small_turns_of_the_joints_do(arm: UrdfKinematics) -> None:
    h = 1e-6
    for joints in some_joints(arm, 5):
        columns = []
        for step in h * np.eye(7):
            before, after = arm.nozzle(joints - step), arm.nozzle(joints + step)
            turn = se3.log_rotation(after[:3, :3] @ before[:3, :3].T)
            columns.append(np.concatenate([turn, (after - before)[:3, 3]]) / (2 * h))
        assert arm.jacobian(joints) == pytest.approx(np.array(columns).T, abs=1e-3)


def test_out_of_reach_is_said_and_not_invented(arm: UrdfKinematics) -> None:
    far = se3.make(np.eye(3), [2000.0, 0, 300])
    assert np.isnan(arm.joints(far, arm.ready)).all()


def test_a_path_below_home_can_be_printed_and_one_far_away_cannot(arm: UrdfKinematics, tmp_path: Path) -> None:
    write_path(tmp_path / "path.csv", raster(size=40.0, lines=4))
    question = ReachQuestion(amplitude_mm=5.0, turn_deg=2.0)
    answer = run_reach(tmp_path / "path.csv", FR3, question, tmp_path / "out")
    assert answer.feasible and "Franka Research 3" in answer.text
    assert "j7_deg" in (tmp_path / "out/reach.csv").read_text().splitlines()[0]
    away = run_reach(tmp_path / "path.csv", FR3, replace(question, surface=(690.0, 380, 60, 0, 0, 0)))
    assert not away.feasible
    with pytest.raises(InputError, match="--spin"):
        run_reach(tmp_path / "path.csv", FR3, replace(question, spin=True))
