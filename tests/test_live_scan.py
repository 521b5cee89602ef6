"""A live run with a scan before rendered pictures: where it lies against the truth and against `stillbed plan`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.se3 import Array
from hardware.files.mesh_file import write_ply
from hardware.files.path_file import read_path, write_path
from hardware.live.prepared import RunFiles, read_placement
from hardware.live.prerender import prerender
from hardware.live.recorded_run import replay_run
from hardware.plan.run import register_in_session
from hardware.recording.session_reader import read_poses, used_inputs
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scenario_tables import scene_from_table
from planning.path import Path as PrintPath
from tests.live_runs import Running, closed
from tests.test_clearance import PART_TEXT

pytestmark = pytest.mark.slow
Start = Callable[..., Running]
SCENARIO = """
title = "A wound and its scan"
seconds = 2.6
seed = 3
path = "path.csv"
clearance_mm = 0.4
bead_mm = 1.0
[scene]
body = "chest"
[[motion]]
kind = "breathing"
amplitude_mm = 2.0
rate_hz = 0.4
[rig]
size = [640, 360]
focal_px = 1100
[cameras]
fps = 15.0
"""
PATH = """x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude
-6,-2,0,0,0,0,5,1,20,0,0
6,-2,0,0,0,0,5,1,20,0,1
6,2,0,0,0,0,5,1,20,0,1
-6,2,0,0,0,0,5,1,20,0,1
"""
SCAN_FROM_TRUE = se3.make(se3.exp_rotation([0.3, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame
AGREEMENT_MM, MAX_ERROR_MM, MAX_ERROR_DEG = 0.05, 0.1, 0.1


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario rendered into a cache of its own; a scan and a path in the scanner's frame; other scans."""
    folder = tmp_path_factory.mktemp("scan")
    (folder / "wound.toml").write_text(SCENARIO)
    (folder / "path.csv").write_text(PATH)
    rendered = prerender(folder / "wound.toml", folder / "stillbed", threads=2).folder
    scenario = read_scenario(folder / "wound.toml")
    shape = scene_from_table(scenario.file, scenario.scene, folder, scenario.seed).shape
    vertices, triangles = shape.mesh(1.0)
    write_ply(folder / "scan.ply", vertices=se3.transform_points(SCAN_FROM_TRUE, vertices), triangles=triangles)
    write_ply(folder / "flat.ply", vertices=vertices * [1.0, 1.0, 0.0], triangles=triangles)
    other = scene_from_table(scenario.file, scenario.scene, folder, scenario.seed + 1).shape
    vertices, triangles = other.mesh(1.0)
    write_ply(folder / "other.ply", vertices=vertices, triangles=triangles)
    path = read_path(rendered / "path.csv")
    moved = SCAN_FROM_TRUE @ path.surface_from_nozzle
    write_path(
        folder / "path_scan.csv",
        PrintPath(moved, path.speed, path.material, path.temperature, path.layer, path.extrude),
    )
    (folder / "session").symlink_to(rendered / "session.mcap")
    return folder


@pytest.fixture
def start(cache: Path) -> Iterator[Start]:
    """Starts runs, and leaves none behind."""
    running: list[Running] = []

    def started(*arguments: object) -> Running:
        given = "--simulated", cache / "wound.toml", *arguments, "--no-page"
        running.append(Running(*map(str, given), cache=cache))
        return running[-1]

    yield started
    for run in running:
        run.close()


def off(base_from_scan: Array, base_from_true: Array) -> Array:
    """Where the scan lies from where it should (4, 4), in the true surface frame at the wound."""
    return np.asarray(se3.inverse(base_from_true) @ base_from_scan @ SCAN_FROM_TRUE)


def errors(change: Array) -> tuple[float, float]:
    """Distance at the wound's middle, mm, and angle, degrees."""
    return float(np.linalg.norm(change[:3, 3])), float(np.rad2deg(np.linalg.norm(se3.log(change)[:3])))


def test_the_scan_lies_where_it_is_in_truth_and_where_plan_finds_it(start: Start, cache: Path, tmp_path: Path) -> None:
    record = tmp_path / "run.mcap"
    run = start("--scan", cache / "scan.ply", "--path", cache / "path_scan.csv", "--record", record, "--yes")
    run.wait_for(r"\nhoming: placed by the scan, good to 0\.\d\d mm and 0\.\d\d degrees")
    run.wait_for(r"\nprint\n")
    run.press("q")
    run.end()
    session, placed = closed(record), read_placement(RunFiles(record).surface)
    assert placed.certain and (placed.surface_from_path == np.eye(4)).all()
    poses = [pose for pose in read_poses(record) if pose.state.measured]
    truth = {stamp: pose for stamp, pose in zip(session.truth.stamps, session.truth.base_from_surface, strict=True)}
    live = [off(pose.base_from_surface, truth[pose.stamp]) for pose in poses if pose.stamp in truth]
    found = np.array([errors(change) for change in live])
    assert len(live) > 20 and found[:, 0].max() <= MAX_ERROR_MM and found[:, 1].max() <= MAX_ERROR_DEG, found.max(
        axis=0
    )

    points = np.array([[x, y, 0.0] for x in (-15.0, 0.0, 15.0) for y in (-10.0, 0.0, 10.0)])
    mean = np.mean([se3.transform_points(change, points) for change in live], axis=0)
    for shown, limit in (
        (record, AGREEMENT_MM),
        (cache / "session", 2 * AGREEMENT_MM),
    ):  # the same pictures, and others
        planned, pose, placement, _ = register_in_session(shown, cache / "scan.ply", SCAN_FROM_TRUE[:3, 3])
        assert placement is not None and placement.certain and pose is not None
        nearest = int(np.argmin(np.abs(planned.truth.stamps - pose.stamp)))
        lies = off(pose.base_from_surface, planned.truth.base_from_surface[nearest])
        first = min(poses, key=lambda each: each.stamp)
        same = off(first.base_from_surface, truth[first.stamp])
        reached = se3.transform_points(same, points) if shown is record else mean
        apart = np.linalg.norm(reached - se3.transform_points(lies, points), axis=1).max()
        print(f"live and plan {apart:.4f} mm apart at most over the wound, before {shown.name}")
        assert apart <= limit
    print(f"off the truth {found.max(axis=0)} mm, degrees")

    again = start("--resume", record, "--yes")
    again.wait_for(r"\nhoming: as the run before placed it: placed by the scan")
    again.wait_for(r"\nprint\n")
    again.press("q")
    again.end()
    second = RunFiles(record).next().record.with_name("run-2.mcap")
    resumed, path = closed(second), used_inputs(second).path.surface_from_nozzle
    truth = dict(zip(resumed.truth.stamps, resumed.truth.base_from_surface, strict=True))
    wanted = se3.inverse(SCAN_FROM_TRUE) @ read_path(cache / "path_scan.csv").surface_from_nozzle
    seen = [pose for pose in read_poses(second) if pose.state.measured and pose.stamp in truth]
    lies = np.array([(se3.inverse(truth[p.stamp]) @ p.base_from_surface @ path)[:, :3, 3] for p in seen])
    away = np.linalg.norm(lies - wanted[:, :3, 3], axis=2).max()
    print(f"resumed: the path lies {away:.3f} mm off at most")
    assert len(seen) > 10 and away <= 2 * MAX_ERROR_MM


@pytest.mark.parametrize("name", ["flat.ply", "other.ply"])
def test_a_scan_that_is_not_found_for_certain_is_told_and_nothing_is_printed(
    name: str, start: Start, cache: Path, tmp_path: Path
) -> None:
    record = tmp_path / "run.mcap"
    run = start("--scan", cache / name, "--record", record, "--yes")
    run.wait_for("where the path belongs is not certain")
    assert run.end() == 1 and "\nprint\n" not in run.said and "\nhoming" not in run.said
    assert not RunFiles(record).surface.exists()


def test_a_tool_with_a_body_prints_on_its_scan_and_is_recorded_with_it(
    start: Start, cache: Path, tmp_path: Path
) -> None:
    arm, record = tmp_path / "arm.toml", tmp_path / "run.mcap"
    rendered = (cache / "session").resolve().parent / "arm.toml"
    arm.write_text(rendered.read_text(encoding="utf-8") + PART_TEXT.split('[[tool_part]]\nname = "bracket')[0])
    given = "--scan", cache / "scan.ply", "--path", cache / "path_scan.csv", "--profile", arm
    run = start(*given, "--record", record, "--yes")
    run.wait_for(r"\nprint\n")
    run.wait_for(r"\nthe path is printed")
    assert run.end() == 0
    profile, tissue = used_inputs(record).profile, used_inputs(record).tissue
    assert [part.name for part in profile.parts] == ["head", "hose", "nut"] and tissue is not None
    assert "tool in the tissue" not in run.said
    ticks = list(replay_run(record))
    assert len(ticks) > 100 and all(tick.frame == tick.recorded for tick in ticks)
