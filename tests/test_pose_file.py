"""Poses.csv and TUM files: read back, by us and by evo, to the last whole line; every wrong line named."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.observations import no_observations
from estimation.pose import MotionState, SurfacePose, TrackState, Trajectory
from hardware.files.folder_tables import read_rows, read_tum, write_rows, write_tum
from hardware.files.pose_file import PoseTable, PoseWriter, read_poses
from hardware.offline.trajectory_files import read_pose_series
from perception.tracking.step import StepReport
from tests.tracking_runs import run

STATES = {3: TrackState.DEGRADED, 4: TrackState.COASTING, 5: TrackState.LOST}


def pose(table: PoseTable, i: int) -> SurfacePose:
    return SurfacePose(
        table.stamps[i],
        table.base_from_surface[i],
        table.covariance[i],
        table.twist[i],
        table.states[i],
        reason=table.reasons[i],
        motion=MotionState(bool(table.moving[i]), table.onset[i], table.moved[i], table.turned[i]),
    )


def report(table: PoseTable, i: int) -> StepReport:
    nothing = no_observations(float(table.stamps[i]))
    return StepReport(nothing, table.used[i], table.seconds[i, :-1], table.offsets[i], table.offset_sigmas[i])


def write(folder: Path, table: PoseTable) -> Path:
    with PoseWriter(folder, table.cameras, table.stages[:-1]) as writer:
        for i in range(len(table)):
            writer.write(pose(table, i), int(table.frames[i]), report(table, i), float(table.seconds[i, -1]))
    return folder / "poses.csv"


def test_csv_round_trip(tmp_path: Path) -> None:
    table, _ = run(20, sigma=np.full(6, 0.01), states=STATES)
    back = read_poses(write(tmp_path, table))
    for name in ("states", "reasons", "cameras", "stages"):
        assert getattr(back, name) == getattr(table, name)
    assert np.array_equal(back.frames, table.frames) and np.array_equal(back.used, table.used)
    assert np.abs(back.stamps - table.stamps).max() < 1e-6
    assert np.abs(back.base_from_surface - table.base_from_surface).max() < 1e-6
    assert np.allclose(back.covariance, table.covariance, rtol=1e-8)
    assert np.allclose(back.twist, table.twist, rtol=1e-8) and np.array_equal(back.moving, table.moving)
    for name in ("onset", "moved", "turned"):
        assert np.allclose(getattr(back, name), getattr(table, name), atol=1e-6, equal_nan=True)
    for name in ("offsets", "offset_sigmas", "seconds"):
        assert np.abs(getattr(back, name) - getattr(table, name)).max() < 1e-7


def test_a_second_round_trip_changes_no_byte(tmp_path: Path) -> None:
    table, _ = run(20, sigma=np.full(6, 0.01), states=STATES)
    first = write(tmp_path, table)
    (tmp_path / "again").mkdir()
    assert write(tmp_path / "again", read_poses(first)).read_bytes() == first.read_bytes()


def test_a_file_from_before_the_clocks_were_learned_is_read(tmp_path: Path) -> None:
    table, _ = run(5)
    path = write(tmp_path, table)
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    kept = [i for i, name in enumerate(rows[0]) if not name.startswith("offset_")]
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([row[i] for i in kept] for row in rows)
    back = read_poses(path)
    assert not back.offsets.any() and np.isnan(back.offset_sigmas).all()
    assert back.offsets.shape == back.offset_sigmas.shape == (5, 3) and back.stages == table.stages
    assert np.abs(back.seconds - table.seconds).max() < 1e-7 and np.array_equal(back.used, table.used)


def test_a_pose_that_is_not_known_yet_round_trips(tmp_path: Path) -> None:
    table, _ = run(3)
    table.base_from_surface[0, :3] = np.nan
    table.covariance[0] = np.inf
    back = read_poses(write(tmp_path, table))
    assert np.isnan(back.base_from_surface[0, :3]).all() and np.isinf(back.covariance[0]).all()


def test_tum_holds_the_measured_poses_and_loads_in_evo(tmp_path: Path) -> None:
    from evo.tools import file_interface

    table, _ = run(20, states=STATES)
    write(tmp_path, table)
    loaded = file_interface.read_tum_trajectory_file(str(tmp_path / "poses.tum"))
    assert loaded.check()[0]
    assert loaded.num_poses == table.measured.sum() == 17
    expected = table.base_from_surface[table.measured]
    assert np.abs(np.array(loaded.poses_se3) - expected).max() < 1e-6


def test_every_line_stands_before_the_next_pose_is_known(tmp_path: Path) -> None:
    table, _ = run(5)
    with PoseWriter(tmp_path, table.cameras, table.stages[:-1]) as writer:
        for i in range(5):
            writer.write(pose(table, i), 3, report(table, i), 0.01)
            assert len(read_poses(tmp_path / "poses.csv")) == i + 1


def test_a_file_cut_anywhere_is_read_to_its_last_whole_line(tmp_path: Path) -> None:
    table, _ = run(4)
    whole = write(tmp_path, table).read_bytes()
    head = whole.index(b"\n") + 1
    cut = tmp_path / "cut.csv"
    for end in range(head, len(whole), 37):
        cut.write_bytes(whole[:end])
        lines = whole[head:end].count(b"\n")
        assert len(read_poses(cut)) in (lines, lines + 1)  # cut inside the reason, a line is whole already


def test_an_empty_run_is_an_empty_table(tmp_path: Path) -> None:
    table, _ = run(2)
    with PoseWriter(tmp_path, table.cameras, table.stages[:-1]):
        pass
    assert len(read_poses(tmp_path / "poses.csv")) == 0


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("stamp_s,", "time,", "header"),
        ("TRACKING", "FLYING", "state = 'FLYING'"),
        ("0.033333", "soon", "stamp_s = 'soon'"),
        ("0.033333,", "0.033333,7,", "columns"),
        ("offset_ms_top,", "offset_top,", "offset_ms_top"),
    ],
)
def test_a_wrong_file_is_told_by_line_and_column(tmp_path: Path, old: str, new: str, says: str) -> None:
    path = write(tmp_path, run(4)[0])
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=says):
        read_poses(path)


def test_a_measured_pose_that_is_no_number_is_told_by_its_line_where_it_is_to_be_judged(tmp_path: Path) -> None:
    table, _ = run(20)
    assert len(read_pose_series(str(write(tmp_path, table)))) == 19  # the first is INITIALISING
    table.base_from_surface[7, 0, 3] = np.nan
    with pytest.raises(InputError, match=r"poses\.csv: line 9 = .*nan.*finite numbers"):
        read_pose_series(str(write(tmp_path, table)))


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"poses\.csv"):
        read_poses(tmp_path / "poses.csv")


finite = st.floats(-1e7, 1e7)


@given(
    steps=st.lists(st.floats(1e-6, 1e5), min_size=1, max_size=8),
    start=st.floats(-1e6, 1e6),
    xi=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
)
def test_a_trajectory_comes_back(
    tmp_path_factory: pytest.TempPathFactory, steps: list[float], start: float, xi: list[float]
) -> None:
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    stamps = start + np.cumsum(steps)
    poses = se3.exp(np.outer(np.linspace(-1, 1, len(stamps)), xi)) @ se3.make(np.eye(3), [1e3, -2e3, 0.1])
    write_tum(path, Trajectory(stamps, poses, True))
    back = read_tum(path, True)
    assert back.stamps.tobytes() == stamps.tobytes()
    assert back.base_from_surface[:, :3, 3].tobytes() == poses[:, :3, 3].tobytes()
    assert np.abs(back.base_from_surface - poses).max() < 1e-14 and back.exact


def test_rows_written_again_are_the_same_bytes(tmp_path: Path) -> None:
    rows = np.array([[0.1 + 0.2, 1 / 3, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8], [0.4, 1e-17, 2e9, 3.0, 0.5, 0.5, -0.5, 0.5]])
    write_rows(tmp_path / "a.tum", rows)
    write_rows(tmp_path / "b.tum", read_rows(tmp_path / "a.tum"))
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()
    assert read_rows(tmp_path / "a.tum").tobytes() == rows.tobytes()


GOOD = "0.0 1 2 3 0 0 0 1"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "poses"), ("# only words\n\n", "poses"), (f"{GOOD}\n1.0 1 2 3 0 0 nan 1\n", "line 2"),
        (f"{GOOD}\n1.0 inf 2 3 0 0 0 1\n", "line 2"), (f"{GOOD}\n0.0 1 2 3 0 0 0 1\n", "line 2: stamp"),
        (f"# words\n{GOOD}\n-0.5 1 2 3 0 0 0 1\n", "line 3: stamp"),
        ("0.0 1 2 3 0 0 0 0\n", "line 1: length of qx qy qz qw"),
        ("0.0 1 2 3 0 0 0 1.02\n", "line 1: length of qx qy qz qw"),
        ("0.0 1 2 3 0 0 1\n", "line 1"), ("0.0 1 2 3 0 0 0 one\n", "line 1"),
    ],
)  # fmt: skip
def test_a_wrong_line_is_named(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_tum(path, False)
    assert (caught.value.where, caught.value.what) == (str(path), what)


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("b.tum", "none.tum"):
        with pytest.raises(InputError, match=name):
            read_tum(tmp_path / name, False)
