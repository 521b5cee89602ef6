"""`stillbed record`: cameras of another program recorded, and what is done with the file by the other commands."""

from __future__ import annotations

import csv
import json
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from hardware.cli.main import main
from hardware.files.folder_tables import read_tum
from hardware.files.images import decode
from hardware.files.region_table import RegionBy, RegionSettings
from hardware.files.rig_file import ImageSource, read_rig, write_board, write_rig
from hardware.files.session import Session
from hardware.live.camera_recording import CameraRecording, RecordOrder, check_order
from hardware.offline.track import run_track
from hardware.recording.session_reader import open_session
from tests.board_session import BOARD, LENSES, small_rig
from tests.camera_streams import HttpCamera, served
from tests.live_runs import CLOCK, Running
from tests.outside_cameras import SETS, outside
from tests.printed_sheet import FPS, SHEET, SIZE, corners_at, pose_at, rig

SECONDS = 5.5
NAMES = ("camera0", "camera1", "camera2")
Start = Callable[..., Running]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("record")


@pytest.fixture(scope="module")
def recorded(place: Path) -> Path:
    """A recording of a sheet on a table, by cameras of another program, with the region that was given."""
    corners = {c.name: corners_at(0.0, c, 2.0).round(1).tolist() for c in rig().cameras}
    lines = ["[region]", *(f"{name} = {value}" for name, value in corners.items())]
    (place / "region.toml").write_text("\n".join(lines))
    with outside(place) as rig_file:
        run = Running(
            str(rig_file), "-o", str(place / "try.mcap"), "--seconds", str(SECONDS), "--region",
            str(place / "region.toml"), "--no-page", cache=place, program=("hardware.cli.main", "record"),
        )  # fmt: skip
        assert run.end() == 0, run.said
    return place / "try.mcap"


def sheet_error(poses: np.ndarray) -> np.ndarray:
    """(N,) mm: how far poses (N, 4, 4) are from the nearest of those that the cameras showed, from the first one on."""
    shown = np.stack([pose_at(k / FPS) for k in range(SETS)])
    moved = poses @ se3.inverse(poses[0])
    best = np.full(len(poses), np.inf)
    middle = np.array([[0.0, 0.0, 0.0], [SHEET[0] / 3, 0.0, 0.0], [0.0, SHEET[1] / 3, 0.0]])
    for first in shown:
        here = se3.transform_points(moved, se3.transform_points(first, middle))  # (N, 3, 3)
        there = se3.transform_points(shown, middle)  # (K, 3, 3)
        off = np.linalg.norm(here[:, None] - there[None], axis=-1).mean(axis=-1).min(axis=1)  # (N,)
        best = off if np.median(off) < np.median(best) else best
    return best


def test_what_another_program_shows_is_recorded_whole(recorded: Path) -> None:
    session = open_session(recorded)
    assert not session.damage and [camera.name for camera in session.rig.cameras] == list(NAMES)
    stamps = [np.array([ref.stamp for refs in session.sets for ref in refs if ref.camera == c]) for c in range(3)]
    for own in stamps:
        assert len(own) > 0.65 * SECONDS * FPS  # also those of the seconds in which a recorder loads
        assert abs(np.median(np.diff(own)) - 1 / FPS) < 0.01
    assert np.mean([len(refs) == 3 for refs in session.sets]) > 0.5
    for roi, camera in zip(session.roi, rig().cameras, strict=True):
        assert np.abs(roi.polygon - corners_at(0.0, camera, 2.0)).max() <= 0.05 + 1e-9
        assert roi.stamp < stamps[roi.camera][0]


@pytest.mark.slow  # such a sheet is followed in test_region
def test_the_recorded_sheet_is_tracked_as_it_was_pushed(recorded: Path, tmp_path: Path) -> None:
    run_track(recorded, tmp_path / "out")
    poses = read_tum(tmp_path / "out" / "poses.tum", exact=False).base_from_surface
    off = sheet_error(poses)
    assert len(off) > 30 and np.median(off) < 0.1
    assert np.ptp(poses[:, 0, 3]) > 5.0  # mm: the table did not move


@pytest.mark.slow
def test_the_recorded_sheet_is_smoothed(recorded: Path, tmp_path: Path) -> None:
    assert main(["smooth", str(recorded), "-o", str(tmp_path / "out"), "--rate", "200"]) == 0
    poses = read_tum(tmp_path / "out" / "smoothed.tum", exact=False)
    assert np.median(sheet_error(poses.base_from_surface)) < 0.1
    rows = (tmp_path / "out" / "smoothed.csv").read_text().count("\n") - 1
    assert abs(rows - 200 * (poses.stamps[-1] - poses.stamps[0])) <= 1


@pytest.mark.slow
def test_the_recorded_pictures_are_segmented(recorded: Path, tmp_path: Path) -> None:
    assert main(["segment", str(recorded), "-o", str(tmp_path / "masks")]) == 0
    with (tmp_path / "masks" / "wounds.csv").open() as file:
        names = [row["name"] for row in csv.DictReader(file)]
    refs = [ref for refs in open_session(recorded).sets for ref in refs]
    assert sorted(names) == sorted(f"try_{NAMES[ref.camera]}_{ref.number:06d}" for ref in refs)
    mask = decode((tmp_path / "masks" / f"{names[-1]}.png").read_bytes(), tmp_path, "mask")
    assert mask.shape[:2] == SIZE[::-1]


@pytest.mark.slow
def test_a_plan_looks_for_its_wound_in_a_recording(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = ["plan", "--example", "forearm", "-o", str(tmp_path / "path.csv"), "--no-pictures"]
    assert main([*plan, "--session", str(recorded)]) == 0
    placed = [line for line in capsys.readouterr().out.splitlines() if "placed" in line or "open" in line]
    assert placed, "what became of the scan in pictures that show none of it is said"


@pytest.mark.slow
def test_cameras_are_calibrated_from_a_recorded_board(place: Path, tmp_path: Path) -> None:
    write_board(tmp_path / "board.toml", BOARD)
    with outside(tmp_path, "board") as rig_file:
        recording = CameraRecording(RecordOrder(rig_file, tmp_path / "board.mcap", 9.0, page=False))
        recording()
    assert not recording.failed, recording.words
    told = ["--board", str(tmp_path / "board.toml"), "-o", str(tmp_path / "new.toml")]
    main(["calibrate", "cameras", str(tmp_path / "board.mcap"), *told])
    found = read_rig(tmp_path / "new.toml").rig
    for camera, lens, true in zip(found.cameras, LENSES, small_rig().cameras, strict=True):
        assert abs(camera.matrix[0, 0] / lens[0] - 1) < 0.02
        away = se3.inverse(found.cameras[0].base_from_camera) @ camera.base_from_camera
        expected = se3.inverse(small_rig().cameras[0].base_from_camera) @ true.base_from_camera
        assert np.linalg.norm(away[:3, 3] - expected[:3, 3]) < 10.0  # mm of 400


# -- whatever ends it


@pytest.fixture
def streams(tmp_path: Path) -> Iterator[list[HttpCamera]]:
    """Three cameras of 160 x 120 px, named in rig.toml."""
    cameras = [HttpCamera(20.0) for _ in range(3)]
    with served(*cameras):
        small = [f'name = "{n}"\nsize = [160, 120]\nmatrix = [[150, 0, 80], [0, 150, 60], [0, 0, 1]]' for n in "abc"]
        text = "".join(
            f'[[camera]]\n{each}\ndistortion = [0, 0, 0, 0, 0]\nsource = "{camera.url}"\n'
            f"base_from_camera = [[1, 0, 0, {100 * k}], [0, -1, 0, 0], [0, 0, -1, 400], [0, 0, 0, 1]]\n"
            for k, (each, camera) in enumerate(zip(small, cameras, strict=True))
        )
        (tmp_path / "rig.toml").write_text(text)
        yield cameras


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Start]:
    running: list[Running] = []

    def start(*more: str, limits: Callable[[], None] | None = None) -> Running:
        words = str(tmp_path / "rig.toml"), "-o", str(tmp_path / "x.mcap"), *more
        program = "hardware.cli.main", "record"
        running.append(Running(*words, cache=tmp_path, limits=limits, program=program))
        return running[-1]

    yield start
    for run in running:
        run.close()


def counts(session: Session) -> list[int]:
    """Pictures of each camera."""
    return [sum(ref.camera == c for refs in session.sets for ref in refs) for c in range(len(session.rig))]


def until_written(file: Path, size: int) -> None:
    end = CLOCK.now() + 60
    while not (file.exists() and file.stat().st_size > size):
        assert CLOCK.now() < end
        CLOCK.wait_until(CLOCK.now() + 0.05)


@pytest.mark.slow
def test_a_lost_camera_is_named_the_others_go_on_and_ctrl_c_keeps_all(
    streams: list[HttpCamera], started: Start, tmp_path: Path
) -> None:
    run = started("--no-page", "--jpeg-quality", "0")
    until_written(tmp_path / "x.mcap", 2_000_000)
    streams[1].online = False
    run.wait_for("b (cannot be opened|delivers nothing) since")
    until_written(tmp_path / "x.mcap", (tmp_path / "x.mcap").stat().st_size + 1_500_000)
    run.process.send_signal(signal.SIGINT)
    assert run.end() == 0
    session = open_session(tmp_path / "x.mcap")
    stamps = [[ref.stamp for refs in session.sets for ref in refs if ref.camera == c] for c in range(3)]
    assert not session.damage and min(map(len, stamps)) > 10
    assert all(sum(stamp > stamps[1][-1] + 0.1 for stamp in stamps[c]) > 5 for c in (0, 2))
    with_reader = session.open_reader()
    first = next(ref for refs in session.sets for ref in refs)
    assert with_reader.encoded(first)[0] == "png"  # exactly as they came
    with_reader.close()


@pytest.mark.slow
def test_a_full_disk_ends_it_in_words_and_what_was_written_is_kept(
    streams: list[HttpCamera], started: Start, tmp_path: Path
) -> None:
    most = 6_000_000
    run = started(
        "--no-page", "--jpeg-quality", "0", limits=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    )
    assert run.end() == 1, run.said
    session = open_session(tmp_path / "x.mcap")
    assert session.damage and min(counts(session)) > 5


@pytest.mark.slow
def test_the_recorder_killed_ends_it_and_what_was_written_is_kept(
    streams: list[HttpCamera], started: Start, tmp_path: Path
) -> None:
    run = started("--no-page", "--jpeg-quality", "0")
    until_written(tmp_path / "x.mcap", 2_000_000)
    run.kill("recorder")
    assert run.end() == 1
    assert min(counts(open_session(tmp_path / "x.mcap"))) > 5


@pytest.mark.slow
def test_where_nothing_comes_no_file_is_left_and_it_is_said(tmp_path: Path, streams: list[HttpCamera]) -> None:
    for camera in streams:
        camera.online = False
    recording = CameraRecording(RecordOrder(tmp_path / "rig.toml", tmp_path / "x.mcap", 1.0, page=False))
    recording()
    assert recording.failed and "no pictures came" in recording.words and "a cannot be opened" in recording.words
    assert not (tmp_path / "x.mcap").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"out": "x.mp4"}, "ends in .mcap"),
        ({"out": "no/x.mcap"}, "a folder that exists"),
        ({"out": "there.mcap"}, "--force"),
        ({"jpeg_quality": 101}, "1 to 100"),
        ({"seconds": 0.0}, "above 0"),
        ({"region": RegionSettings(RegionBy.POLYGON)}, "a page to draw them on"),
    ],
)
def test_an_order_that_makes_no_sense_is_refused(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    (tmp_path / "there.mcap").write_bytes(b"kept")
    order: dict[str, object] = {"rig": tmp_path / "rig.toml", "out": "x.mcap", "page": False} | changes
    with pytest.raises(InputError, match=words):
        check_order(RecordOrder(**(order | {"out": tmp_path / str(order["out"])})), force=False)
    assert (tmp_path / "there.mcap").read_bytes() == b"kept"


def test_a_session_that_is_no_rig_is_refused_by_its_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_rig(tmp_path / "rig.toml", rig(), [ImageSource("images", "a/*")] * 3)
    (tmp_path / "session.toml").write_text('[cameras]\nrig = "sessions/monday"\n')
    for file, words in (("session.toml", "cameras.rig"), ("rig.toml", "source = missing")):
        assert main(["record", str(tmp_path / file), "-o", str(tmp_path / "x.mcap")]) == 2
        said = capsys.readouterr().err
        assert words in said.replace("'", "") and said.count("\n") == 1
    assert not (tmp_path / "x.mcap").exists() and json.dumps(said)
