"""`stillbed simulate` as a whole: the same bytes each time, files that others read, and limits that decide."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.online.surface_state import StateSettings
from estimation.rig import pixels_from_points
from estimation.synthetic.world import BASE_FROM_REST
from hardware.arm.driver import G1, Pause
from hardware.arm.protocol import decode
from hardware.cli.main import main
from hardware.files.arm_file import read_arm
from hardware.files.folder_tables import read_tum
from hardware.files.path_file import read_path
from hardware.files.pose_file import PoseTable, read_poses
from hardware.offline.track import run_track
from hardware.process.faults import faults_from_texts
from hardware.recording.session_reader import open_session
from hardware.simulator import camera_pipeline
from hardware.simulator.camera_pipeline import PictureStore
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scene.render import begin_render
from hardware.simulator.simulate import SimulationOptions, run_simulation
from tests.nozzle_logs import read_nozzle
from tests.simulated_worlds import IDEAL, SMALL, write_path, write_scenario
from tests.test_viewers import placed, read

BREATHING = {"kind": "breathing", "amplitude_mm": 2.0, "rate_hz": 0.4}
FAULTY = {  # whatever chance may bring
    "cameras": {"drop": 0.03, "duplicate": 0.03, "garble": 0.05, "jitter_s": 0.0005, "exposure_s": 0.004},
    "arm": {"replies": "stray", "tool_mm": [[0, 0.5], [12.7, 0.6], [21, 3.6], [58, 8], [96, 8]]},
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run with pictures and faults, rendered by one thread, at a time of day that stands still."""
    folder = tmp_path_factory.mktemp("recorded")
    file = write_scenario(folder, SMALL, FAULTY, motion=[BREATHING], seconds=1.0, seed=8, clearance_mm=0.4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1764150000")
        run_simulation(file, folder / "one", SimulationOptions(threads=1, cache=folder / "cache"))
        yield folder


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A finished run without pictures."""
    folder = tmp_path_factory.mktemp("quick")
    file = write_scenario(folder, IDEAL, seconds=4.0, limits={"p95_mm": 0.06, "duty": 0.9})
    assert run_simulation(file, folder / "out").met
    yield folder


def same_columns(one: Path, other: Path) -> bool:
    """Whether two poses.csv agree in all but the milliseconds."""
    rows = [list(csv.DictReader(file.read_text().splitlines())) for file in (one, other)]
    kept = [[{k: v for k, v in row.items() if not k.startswith("ms_")} for row in table] for table in rows]
    return kept[0] == kept[1]


@pytest.mark.slow  # test_scene_render draws by several threads, and the process replay compares whole runs
def test_two_runs_and_any_number_of_threads_give_the_same_bytes(recorded: Path) -> None:
    run_simulation(recorded / "scenario.toml", recorded / "two", SimulationOptions(threads=2))
    one, two = recorded / "one", recorded / "two"
    names = sorted(str(file.relative_to(one)) for file in one.rglob("*") if file.is_file())
    assert names == sorted(str(file.relative_to(two)) for file in two.rglob("*") if file.is_file())
    timed = {"report.html", *(f"tracking/{name}" for name in ("poses.csv", "report.html", "summary.json"))}
    differing = {name for name in names if (one / name).read_bytes() != (two / name).read_bytes()}
    assert differing <= timed  # these tell how long it took
    assert same_columns(one / "tracking" / "poses.csv", two / "tracking" / "poses.csv")
    assert sum(name.endswith(".jpg") for name in names) > 40


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many pictures were rendered, each time some were."""
    counts: list[int] = []

    def counting(*arguments: Any) -> Any:
        counts.append(len(arguments[2]))
        return begin_render(*arguments)

    monkeypatch.setattr(camera_pipeline, "begin_render", counting)
    return counts


@pytest.mark.slow
def test_pictures_of_an_earlier_run_are_found_again(recorded: Path, rendered: list[int], tmp_path: Path) -> None:
    options = SimulationOptions(cache=recorded / "cache")
    run_simulation(recorded / "scenario.toml", tmp_path / "again", options)
    again, one = tmp_path / "again" / "session.mcap", recorded / "one" / "session.mcap"
    assert not rendered and again.read_bytes() == one.read_bytes()


@pytest.mark.slow  # the store's key is tried below
def test_what_a_fault_changes_is_rendered_and_no_more(recorded: Path, rendered: list[int], tmp_path: Path) -> None:
    later = faults_from_texts("test", "fault", ["camera1 black at 0.5s"])
    options = SimulationOptions(cache=recorded / "cache", faults=later)
    run_simulation(recorded / "scenario.toml", tmp_path / "covered", options)
    whole = sum(file.suffix == ".jpg" for file in (recorded / "one" / "session").rglob("*"))
    assert 5 < sum(rendered) < 0.9 * whole  # what is black, and what the nozzle does because of it


def test_a_store_of_pictures_that_another_run_writes_or_that_is_damaged_is_done_without(tmp_path: Path) -> None:
    file = write_scenario(tmp_path, IDEAL)
    one, other = PictureStore(file, tmp_path / "cache"), PictureStore(file, tmp_path / "cache")
    with ThreadPoolExecutor(1) as renderer:
        renderer.submit(one.put, b"1", ("jpeg", b"picture")).result()
    other.put(b"2", ("jpeg", b"lost"))
    assert other.get(b"2") is None
    other.close()
    one.close()
    for run in range(3):
        later = PictureStore(file, tmp_path / "cache")
        assert (later.get(b"1") if run == 0 else b"") is not None
        later.put(b"%d" % (run + 5), ("jpeg", b""))
        later.finish()
        later.close()
    last = PictureStore(file, tmp_path / "cache")
    assert [last.get(key) is not None for key in (b"1", b"5", b"6", b"7")] == [False, False, True, True]
    last.close()
    (last.folder / "pictures.db").write_bytes(b"no database" * 1000)
    damaged = PictureStore(file, tmp_path / "cache")
    damaged.put(b"1", ("jpeg", b""))
    assert damaged.get(b"1") is None
    damaged.close()


@pytest.mark.slow
def test_with_pictures_too_an_offset_planted_in_the_rig_comes_out_as_that_offset(tmp_path: Path) -> None:
    offset = [0.2, -0.1, 0.3]
    change = {"scene": {"nozzle": False}, "planted": {"rig_offset_mm": offset}}
    run_simulation(write_scenario(tmp_path, SMALL, change, seconds=1.8, clearance_mm=0.4), tmp_path / "out")
    table = read_nozzle(tmp_path / "out" / "nozzle.csv")
    off = (table.nozzle - table.target)[table.extrude]
    assert len(off) > 300 and off[-300:].mean(axis=0) == pytest.approx(offset, abs=0.05)


@pytest.mark.slow  # the process replay holds the like
def test_the_session_tracks_to_the_very_poses_of_the_run(recorded: Path, tmp_path: Path) -> None:
    tool = read_arm(recorded / "one" / "arm.toml").tool
    for kind in ("session", "session.mcap"):
        heads = open_session(recorded / "one" / kind).heads
        assert len(heads) > 5 and np.ptp(heads.rows[:, 1:4], axis=0).max() > 1.0 and heads.extruding.any()
    run_track(recorded / "one" / "session.mcap", tmp_path / "out", tool=tool)  # the folder holds the same, see below
    assert same_columns(tmp_path / "out" / "poses.csv", recorded / "one" / "tracking" / "poses.csv")


@pytest.mark.slow
def test_what_the_tool_of_an_arm_file_covers_is_not_tracked(recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text("tool_mm = [[0, 90], [30, 90]]\n")
    session, arm = str(recorded / "one" / "session"), str(tmp_path / "arm.toml")
    assert main(["track", session, "-o", str(tmp_path / "out"), "--arm", arm]) == 0
    hidden, seen = (read_poses(f / "poses.csv") for f in (tmp_path / "out", recorded / "one" / "tracking"))
    told = hidden.stamps > open_session(session).heads.rows[0, 0] - 1e-6
    assert seen.measured[told].all() and not hidden.measured[told].any()
    assert np.array_equal(hidden.used[~told], seen.used[~told])


def test_the_truth_holds_every_exposure_and_each_pose_is_near_it(recorded: Path) -> None:
    out = recorded / "one"
    scenario = read_scenario(recorded / "scenario.toml")
    truth = read_tum(out / "session" / "truth.tum", exact=True)
    assert (np.diff(truth.stamps) > 0).all()
    exact = scenario.rest @ scenario.motion(truth.stamps)
    assert truth.base_from_surface == pytest.approx(exact, abs=1e-6)
    exposed = 0.1 + np.arange(int(0.9 * 15)) / 15  # no clock offsets: a set's mid-exposure
    assert np.abs(truth.stamps[:, None] - exposed).min(axis=0).max() < 1e-8
    session = open_session(out / "session")
    assert session.truth is not None and len(session.truth.stamps) == len(truth.stamps)


def test_viewers_see_the_landmarks_in_the_wounds_region(recorded: Path) -> None:
    """In the pictures, where the simulator says that the region is."""
    file = recorded / "one" / "session.mcap"
    session = open_session(file)
    cloud = read(file, "/landmarks")[-1]
    lies = placed(read(file, "/tf")[-1].transforms[0].transform)
    points = 1000 * np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 3)
    assert len(points) > 30 and cloud.header.frame_id == "surface"
    for roi in session.roi:
        pixels, depth = pixels_from_points(session.rig.cameras[roi.camera], se3.transform_points(lies, points))
        low, high = roi.polygon.min(axis=0) - 5, roi.polygon.max(axis=0) + 5
        assert ((pixels > low) & (pixels < high)).all(axis=1).mean() > 0.95 and (depth > 0).all()


def test_folder_and_mcap_hold_the_same_session(recorded: Path) -> None:
    folder, mcap = (open_session(recorded / "one" / name) for name in ("session", "session.mcap"))
    assert len(folder) == len(mcap) and folder.heads.rows.tobytes() == mcap.heads.rows.tobytes()
    assert np.array_equal(folder.heads.extruding, mcap.heads.extruding)
    for one, other in zip(folder.frame_sets(), mcap.frame_sets(), strict=True):
        assert [f.camera for f in one.frames] == [f.camera for f in other.frames]
        assert one.stamp == pytest.approx(other.stamp, abs=1e-8)
        assert all(np.array_equal(a.image, b.image) for a, b in zip(one.frames, other.frames, strict=True))
    assert len(folder.roi) == len(mcap.roi) == 3


def test_poses_are_those_of_the_told_surface_and_tracked(recorded: Path) -> None:
    poses: PoseTable = read_poses(recorded / "one" / "tracking" / "poses.csv")
    assert poses.measured[StateSettings().averaged_poses :].mean() > 0.9
    summary = json.loads((recorded / "one" / "summary.json").read_text())
    assert summary["tracking_mm"]["max"] < 0.3
    assert summary["complete"]


def test_the_frames_that_were_sent_are_those_of_the_commands(recorded: Path) -> None:
    out = recorded / "one"
    commands = out.joinpath("commands.csv").read_text().splitlines()[1:]
    data, moves = out.joinpath("frames.bin").read_bytes(), [row for row in commands if ",move," in row]
    frames = [decode(data[i : i + 48]) for i in range(0, len(data), 48)]
    sent = iter([frame.axes[0] for frame in frames if isinstance(frame, G1)])
    assert all(any(abs(x - float(row.split(",")[2])) < 1e-4 for x in sent) for row in moves)  # in their order
    assert isinstance(frames[-1], Pause)  # the arm is stopped at the end
    table = read_nozzle(out / "nozzle.csv")
    assert np.allclose(table.stamps, np.arange(1, 1001) / 1000, atol=1e-9) and table.extrude.any()


@pytest.mark.slow  # test_sim_cameras garbles pictures, and some of `recorded` are garbled
def test_what_arrives_damaged_beyond_decoding_is_told_and_left_out(tmp_path: Path) -> None:
    change = {"cameras": {"fps": 15.0, "garble": 1.0}, "scene": {"wound": False, "texel_mm": 1.0}}
    file = write_scenario(tmp_path, SMALL, change, seconds=0.8, rig={"size": [160, 90], "focal_px": 150})
    run_simulation(file, tmp_path / "out", SimulationOptions(threads=1))
    session = open_session(tmp_path / "out" / "session")
    assert 0 < sum(len(refs) for refs in session.sets) < 3 * 11
    assert all(frame.image.shape == (90, 160, 3) for frames in session.frame_sets() for frame in frames.frames)
    assert len(read_nozzle(tmp_path / "out" / "nozzle.csv")) == 800


def test_a_perfect_loop_meets_its_limits_and_says_so(quick: Path) -> None:
    out = quick / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["met"] and summary["finished"] and summary["complete"]
    assert summary["errors"]["position_mm"]["p95"] < 0.06
    assert "All 2 limits were met" in " ".join(summary["verdict"])
    for name in ("report.html", "arm.toml", "scenario.toml", "tracking/report.html", "commands.csv", "watch.html"):
        assert (out / name).stat().st_size > 100
    assert not (out / "session").exists()  # there are no pictures
    assert (out / "scenario.toml").read_text() == (quick / "scenario.toml").read_text()


def test_a_limit_that_is_missed_is_told(quick: Path) -> None:
    file = write_scenario(quick, IDEAL, seconds=2.0, limits={"p95_mm": 1e-6, "duty": 0.1}, name="strict.toml")
    outcome = run_simulation(file, quick / "strict")
    assert not outcome.met
    assert "1 of 2 limits missed: position error, 95 %" in outcome.text
    assert "MISSED  p95_mm" in outcome.text
    assert "met     duty" in outcome.text


def test_a_trace_is_simulated_instead_of_the_scenarios_own_motion(quick: Path) -> None:
    trace = quick / "moved.tum"
    trace.write_text("".join(f"{t / 10} 0 {2 * np.sin(t / 10)} 0 0 0 0 1\n" for t in range(60)))
    run_simulation(quick / "scenario.toml", quick / "traced", SimulationOptions(trace=trace))
    moved, still = (read_nozzle(quick / name / "nozzle.csv") for name in ("traced", "out"))
    along = BASE_FROM_REST[:3, 1]
    assert np.nanmax(moved.target @ along) > np.nanmax(still.target @ along) + 1.0


def refused(file: Path, out: Path, words: str, options: SimulationOptions | None = None) -> None:
    with pytest.raises(InputError, match=words):
        run_simulation(file, out, options)
    assert not out.exists()  # nothing is made for what makes no sense


def test_what_makes_no_sense_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    file, out = write_scenario(tmp_path, IDEAL), tmp_path / "out"
    refused(tmp_path / "none.toml", out, r"none\.toml")
    refused(file, out, "--threads = 0", SimulationOptions(threads=0))
    refused(file, out, r"gone\.tum", SimulationOptions(trace=tmp_path / "gone.tum"))
    refused(write_scenario(tmp_path, IDEAL, path="gone.csv"), out, r"gone\.csv")
    refused(write_scenario(tmp_path, IDEAL, scene={"body": "whale"}), out, r"scenario\.toml: scene\.body = 'whale'")
    refused(write_scenario(tmp_path, IDEAL, scene={"tone": 2}), out, r"scenario\.toml: scene\.tone")
    refused(write_scenario(tmp_path, IDEAL, scene={"scan": "gone.ply"}), out, r"gone\.ply")
    for no_effect, words in (
        ({"strain": {"kind": "sine", "rate_hz": 0.5}}, "strain, scene.deformation"),
        ({"scene": {"deformation": {"bulge_mm": 1.0}}}, "strain, scene.deformation"),
        ({"tracking": {"by": "truth", "register": "scan"}}, "tracking.register"),
    ):
        refused(write_scenario(tmp_path, IDEAL, no_effect), out, words)
    write_path(tmp_path / "path.csv", [[0, 0, 0], [0, 90, 0]])
    refused(write_scenario(tmp_path, IDEAL, clearance_mm=0.4), out, r"path\.csv: a place on the path")


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path: Path) -> None:
    file = write_scenario(tmp_path, IDEAL, seconds=0.2)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="--force"):
        run_simulation(file, tmp_path / "out")
    assert [f.name for f in (tmp_path / "out").iterdir()] == ["mine.txt"]
    run_simulation(file, tmp_path / "out", SimulationOptions(force=True))
    assert (tmp_path / "out" / "mine.txt").exists()


def test_a_run_in_which_nothing_could_be_printed_has_a_report(tmp_path: Path) -> None:
    outcome = run_simulation(write_scenario(tmp_path, IDEAL, seconds=0.15, limits={}), tmp_path / "out")
    assert "Nothing was printed" in outcome.text and not outcome.met
    assert (tmp_path / "out" / "report.html").exists()
    assert len(read_path(tmp_path / "path.csv")) == 2


def test_a_path_that_was_never_placed_has_the_reason(tmp_path: Path) -> None:
    off = {"off": [[camera, 0.0, 9.0] for camera in ("cam_0", "cam_1")]}  # two of three
    file = write_scenario(tmp_path, IDEAL, seconds=1.0, limits={}, tracking={"by": "tracks"}, cameras=off)
    text = run_simulation(file, tmp_path / "out").text
    assert re.search(r"the path was not placed, as no pose was TRACKING; \d+ of \d+ were \w+ \(", text)


def test_a_scenario_is_not_run_over_itself(tmp_path: Path) -> None:
    file = write_scenario(tmp_path, IDEAL)
    with pytest.raises(InputError, match="the folder that holds the scenario"):
        run_simulation(file, tmp_path, SimulationOptions(force=True))
    assert file.exists()


@pytest.mark.slow
def test_nothing_of_an_earlier_run_is_left_to_be_mistaken_for_this_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for seconds, quality in ((0.9, 90), (0.5, 0)):
        tables = {"sensor": {"jpeg_quality": quality}}
        run_simulation(write_scenario(tmp_path, SMALL, tables, seconds=seconds), out, SimulationOptions(force=True))
    (out / "mine.txt").write_text("kept")
    session = open_session(out / "session")
    pictures = sum(len(list(folder.iterdir())) for folder in (out / "session").iterdir() if folder.is_dir())
    assert pictures == sum(map(len, session.sets)) and len(list(session.frame_sets())) == len(session)
