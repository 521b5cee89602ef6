"""The folder of a run: readable however the run ends; the page that is watched while a run goes on."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig, pixels_from_points
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.device import DONE, ArmState, ArmStatus
from hardware.files import folder_tables
from hardware.files.arm_file import read_arm
from hardware.files.folder_tables import SessionFolderWriter, read_tum
from hardware.files.images import encode
from hardware.files.path_file import read_path
from hardware.files.pose_file import read_poses
from hardware.motion.loop import Tick
from hardware.recording.session_reader import open_session
from hardware.simulator.cameras import Fate, Shot
from hardware.simulator.deposit import planned_line
from hardware.simulator.run_folder import MAIN_TILE, SIDE_TILE, WATCH_INTERVAL, RunFolder, WatchPage
from hardware.simulator.scenario import Scenario, read_scenario
from perception.frames import Frame, FrameSet, Image, PrintHead, Roi
from perception.tracking.step import STAGES, StepReport, report_without_offsets
from planning.command import Command, Hold, Move
from planning.path import PrintPhase, PrintProgress
from tests.nozzle_logs import nozzle_log, part, read_nozzle, straight
from tests.simulated_worlds import IDEAL, SMALL, write_scenario

ROIS = tuple(Roi(c, 0.1, np.array([[10.0, 5], [80, 5], [50, 60]])) for c in range(3))


def scenario(folder: Path, *tables: dict[str, object]) -> Scenario:
    return read_scenario(write_scenario(folder, SMALL, {"rig": {"size": [96, 64], "focal_px": 140}}, *tables))


def moving(times: Array) -> Array:
    """base_from_surface (N, 4, 4): 3 mm/s upwards."""
    poses = np.broadcast_to(BASE_FROM_REST, (len(times), 4, 4)).copy()
    poses[:, 2, 3] += 3.0 * times
    return poses


def opened(folder: Path, asked: Scenario) -> RunFolder:
    (folder / "out").mkdir()
    return RunFolder(folder / "out", asked, planned_line(read_path(asked.path)), ROIS, moving, None)


def picture(camera: int, number: int) -> tuple[str, bytes]:
    return encode(np.full((64, 96, 3), 7 * number + 60 * camera, np.uint8), 95)


def shot(camera: int, number: int, offset: float = 0.0) -> Shot:
    """One that exposes `offset` s after its stamp."""
    stamp = 0.1 + number / 10
    return Shot(camera, number, number, stamp + offset, stamp, stamp + 0.03, 0.008, 1.0, Fate.DELIVERED)


def feed(folder: RunFolder, count: int, offset: float = 0.0) -> None:
    """Pictures at 10 Hz of all cameras with a pose each, and a log row each millisecond, ends told every 0.2 s."""
    log = nozzle_log(straight(8.0), seconds=count / 10)
    for number in range(count):
        for camera in range(3):
            folder.picture(shot(camera, number, offset), *picture(camera, number))
        stamp = 0.1 + number / 10
        folder.pose(frames(stamp), pose(stamp), report(stamp), 0.01)
        folder.tick(tick(move(stamp, number > 3)), progress())
        folder.wire(stamp, bytes(48), True)
        folder.rows(part(log, slice(100 * number + 1, 100 * number + 101)))


def tick(command: Command) -> Tick:
    nowhere = np.zeros(6)
    status = ArmStatus(command.stamp, ArmState.ARMED, "", nowhere, None, 0.0, 0.0, 0.0, 0.0, 0, 1, 0, 0)
    return Tick(command.stamp, command, bytes(48), 0.0, status, DONE)


def frames(stamp: float) -> FrameSet:
    return FrameSet(stamp, tuple(Frame(c, stamp, np.full((64, 96, 3), 90, np.uint8)) for c in range(3)))


def pose(stamp: float, state: TrackState = TrackState.TRACKING) -> SurfacePose:
    return SurfacePose(stamp, moving(np.array([stamp]))[0], np.eye(6), np.zeros(6), state)


def report(stamp: float) -> StepReport:
    return report_without_offsets(no_observations(stamp), np.zeros(3, np.int64), np.zeros(len(STAGES)))


def move(stamp: float, extrude: bool) -> Move:
    return Move(stamp, np.zeros(6), 5.0, 1, extrude)


def progress() -> PrintProgress:
    return PrintProgress(PrintPhase.PRINTING, 1, 2, 3.0, 8.0, 0.4)


@pytest.mark.parametrize("ending", [None, KeyboardInterrupt(), OSError("disk")], ids=["whole", "Ctrl-C", "failed"])
def test_however_a_run_ends_everything_until_then_can_be_read(ending: BaseException | None, tmp_path: Path) -> None:
    folder = opened(tmp_path, scenario(tmp_path))
    out = tmp_path / "out"
    if ending is None:
        with folder:
            feed(folder, 9)
    else:
        with pytest.raises(type(ending)), folder:
            feed(folder, 9)
            raise ending
    for name in ("session", "session.mcap"):
        session = open_session(out / name)
        assert len(session) == 9
        assert [set(f.camera for f in s.frames) for s in session.frame_sets()] == [{0, 1, 2}] * 9
        assert len(session.roi) == 3 and session.damage == ""
        assert session.truth is not None and session.truth.exact
        assert session.truth.base_from_surface == pytest.approx(moving(session.truth.stamps), abs=1e-6)
    assert len(read_poses(out / "tracking" / "poses.csv")) == 9
    assert len(read_nozzle(out / "nozzle.csv")) == 900
    assert out.joinpath("frames.bin").read_bytes() == bytes(48 * 9)


def test_before_it_is_closed_the_folder_holds_all_but_the_truth(tmp_path: Path) -> None:
    folder = opened(tmp_path, scenario(tmp_path))
    with folder:
        feed(folder, 4)
        session = open_session(tmp_path / "out" / "session")
        assert (len(session), session.truth) == (4, None)
        assert len(read_nozzle(tmp_path / "out" / "nozzle.csv")) == 400
    assert not (tmp_path / "out" / "session" / "head.csv").exists()  # the arm never moved


def test_the_truth_holds_every_row_and_every_exposure_once_in_order(tmp_path: Path) -> None:
    folder = opened(tmp_path, scenario(tmp_path))
    with folder:
        feed(folder, 12, offset=0.01234567)  # hidden clocks: exposures fall between the rows
    truth = read_tum(tmp_path / "out" / "session" / "truth.tum", exact=True)
    wanted = np.unique(np.concatenate([np.arange(1, 1201) / 1000, 0.11234567 + np.arange(12) / 10]).round(9))
    assert truth.stamps == pytest.approx(wanted, abs=1e-9)


def test_the_print_head_is_kept_in_both_sessions_and_an_instant_told_again_is_one(tmp_path: Path) -> None:
    heads = [PrintHead(BASE_FROM_REST @ se3.exp(np.array([0.1, 0, 0.2 * n, n, 0, 3.0])), n > 2) for n in range(4)]
    folder = opened(tmp_path, scenario(tmp_path))
    with folder:
        feed(folder, 1)  # before the first move nobody knows where the arm is
        for n, head in enumerate(heads, 1):
            for camera in range(3):
                folder.picture(shot(camera, n), *picture(camera, n))
            for _ in range(1 + n % 2):
                stamp = 0.1 + n / 10
                folder.head(stamp, head)
                folder.pose(frames(stamp), pose(stamp), report(stamp), 0.01)
    for name in ("session", "session.mcap"):
        none, *found = (frames.head for frames in open_session(tmp_path / "out" / name).frame_sets())
        assert none is None
        for back, head in zip(found, heads, strict=True):
            assert back is not None and back.base_from_nozzle == pytest.approx(head.base_from_nozzle, abs=1e-12)
            assert back.extruding == head.extruding


def test_the_pictures_to_show_are_of_the_printing_where_there_is_one(tmp_path: Path) -> None:
    folder = opened(tmp_path, scenario(tmp_path))
    with folder:
        feed(folder, 3)
        assert folder.pictures == {c: picture(c, 2)[1] for c in range(3)}
        folder.tick(tick(move(0.4, True)), progress())
        folder.picture(shot(0, 3), *picture(0, 3))
        folder.tick(tick(Hold(0.5, 0.001, "blind")), progress())
        folder.picture(shot(0, 4), *picture(0, 4))
        assert folder.pictures[0] == picture(0, 3)[1]


def test_a_run_without_pictures_has_no_session(tmp_path: Path) -> None:
    folder = opened(tmp_path, read_scenario(write_scenario(tmp_path, IDEAL)))
    log = nozzle_log(straight(8.0), seconds=0.3)
    with folder:
        folder.pose(FrameSet(0.1, ()), pose(0.1), report(0.1), 0.0)
        folder.rows(part(log, slice(1, None)))
        folder.event(0.1, "nobody hears it")
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert names == {"tracking", "commands.csv", "frames.bin", "nozzle.csv", "arm.toml", "scenario.toml"}


def test_changes_of_state_and_holds_are_told_once_each(tmp_path: Path) -> None:
    told = list[str]()

    class Told(RunFolder):
        def event(self, stamp: float, text: str, level: int = 0) -> None:
            told.append(text)

    asked = scenario(tmp_path)
    (tmp_path / "out").mkdir()
    with Told(tmp_path / "out", asked, planned_line(read_path(asked.path)), ROIS, moving, None) as folder:
        states = [TrackState.TRACKING, TrackState.TRACKING, TrackState.LOST, TrackState.TRACKING]
        for i, state in enumerate(states):
            folder.pose(frames(0.1 + i), pose(0.1 + i, state), report(0.1 + i), 0.0)
        commands: list[Command] = [move(0.1, True), *(Hold(0.2 + i, 0.001, "blind") for i in range(3)), move(4.0, True)]
        for command in [*commands, Hold(5.0, 0.001, "blind")]:
            folder.tick(tick(command), progress())
    state_words = [text.split(":")[0] for text in told if not text.startswith("hold")]
    assert state_words == [s.value for s in (TrackState.TRACKING, TrackState.LOST, TrackState.TRACKING)]
    assert [text for text in told if text.startswith("hold")] == ["hold: blind"] * 2


def test_what_the_arm_was_taken_for_and_what_was_simulated_are_kept(tmp_path: Path) -> None:
    asked = scenario(tmp_path, {"planted": {"arm_offset_mm": [1, 2, 3]}})
    with opened(tmp_path, asked):
        pass
    profile = read_arm(tmp_path / "out" / "arm.toml")
    assert profile.arm.arm_from_base == pytest.approx(asked.profile.arm.arm_from_base)  # what it was told
    assert (tmp_path / "out" / "scenario.toml").read_bytes() == asked.file.read_bytes()


def test_a_session_folder_numbers_its_frames_and_names_them_by_kind(tmp_path: Path) -> None:
    rig: Rig = scenario(tmp_path).rig
    with SessionFolderWriter(tmp_path / "session", rig, ()) as session:
        session.picture(1, 0.1, *picture(1, 0))
        session.picture(1, 0.2, "png", encode(np.zeros((64, 96, 3), np.uint8), None)[1])
    assert sorted(f.name for f in (tmp_path / "session" / "cam_1").iterdir()) == ["000000.jpg", "000001.png"]
    assert (tmp_path / "session" / "frames.csv").read_text().splitlines()[1:] == ["cam_1,0,0.1", "cam_1,1,0.2"]
    assert not (tmp_path / "session" / "roi.toml").exists()
    assert not (tmp_path / "session" / "truth.tum").exists()


def test_a_picture_without_its_line_after_an_interrupt_does_not_spoil_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig: Rig = scenario(tmp_path).rig
    with pytest.raises(KeyboardInterrupt), SessionFolderWriter(tmp_path / "session", rig, ()) as session:
        for number in range(2):
            for camera in range(3):
                session.picture(camera, 0.1 * number, *picture(camera, number))
        monkeypatch.setattr(folder_tables, "frame_line", interrupted)  # the picture is written, its line is not
        session.picture(1, 0.2, *picture(1, 2))
    assert len(open_session(tmp_path / "session")) == 2
    assert sorted(f.name for f in (tmp_path / "session" / "cam_1").iterdir()) == ["000000.jpg", "000001.jpg"]


def interrupted(*_: object) -> str:
    raise KeyboardInterrupt


RIG = arc_rig()
DOTTED = np.array([[x, y, 0.0] for x in (-8.0, 8.0) for y in (-5.0, 5.0)])
POSE = SurfacePose(1.0, BASE_FROM_REST, np.eye(6), np.zeros(6), TrackState.TRACKING)


def watch_frames(stamp: float = 1.0, cameras: tuple[int, ...] = (0, 1, 2), gray: bool = False) -> FrameSet:
    shape = (720, 1280) if gray else (720, 1280, 3)
    return FrameSet(stamp, tuple(Frame(camera, stamp, np.full(shape, 60, np.uint8)) for camera in cameras))


def shown(folder: Path, pose: SurfacePose = POSE, line: np.ndarray | None = DOTTED, **more: object) -> Image:
    WatchPage(folder, RIG, "A <title>").show(watch_frames(**more), pose, line, [("arm", "prints & waits")])
    picture = cv2.imread(str(folder / "watch.jpg"))
    assert picture is not None
    return np.asarray(picture, np.uint8)


def drawn(picture: Image) -> np.ndarray:
    """Where (540, 960) something bright stands in the first camera's tile, its label and the frame left out."""
    bright = picture[: MAIN_TILE[1], : MAIN_TILE[0]].max(axis=2) > 130
    bright[:50] = bright[:, :20] = bright[-20:] = bright[:, -20:] = False
    return np.asarray(bright)


def test_the_page_says_what_is_told_and_renews_itself_until_the_run_is_over(tmp_path: Path) -> None:
    watch = WatchPage(tmp_path, RIG, "A <title>")
    watch.show(watch_frames(), POSE, None, [("arm", "prints & waits")])
    text = watch.page.read_text()
    assert 'http-equiv="refresh"' in text
    assert "A &lt;title&gt;" in text and "prints &amp; waits" in text and POSE.state.value in text
    watch.finish("It was <good>.")
    text = watch.page.read_text()
    assert "refresh" not in text
    assert "It was &lt;good&gt;." in text and 'href="report.html"' in text


def test_there_is_one_picture_for_each_half_second_of_the_run(tmp_path: Path) -> None:
    watch = WatchPage(tmp_path, RIG, "x")
    written = set()
    for i in range(31):
        stamp = i * WATCH_INTERVAL / 10
        watch.show(watch_frames(stamp, cameras=()), SurfacePose(stamp, *_rest()), None, [])
        written.add(watch.page.read_text().split("watch.jpg?")[1].split('"')[0])
    assert written == {"1", "2", "3", "4"}


def _rest() -> tuple[np.ndarray, np.ndarray, np.ndarray, TrackState]:
    return BASE_FROM_REST, np.eye(6), np.zeros(6), TrackState.TRACKING


def test_the_line_is_drawn_where_the_pose_says_and_only_while_it_is_measured(tmp_path: Path) -> None:
    rows, columns = np.nonzero(drawn(shown(tmp_path)))
    assert len(rows) > 300
    assert abs(rows.mean() - MAIN_TILE[1] / 2) < 15 and abs(columns.mean() - MAIN_TILE[0] / 2) < 15  # close to the line
    lost = SurfacePose(1.0, BASE_FROM_REST, np.eye(6), np.zeros(6), TrackState.LOST, reason="blind")
    assert not drawn(shown(tmp_path, lost)).any()
    assert not drawn(shown(tmp_path, line=None)).any()


def test_a_line_behind_a_camera_is_not_drawn(tmp_path: Path) -> None:
    camera = RIG.cameras[0]
    behind = SurfacePose(1.0, camera.base_from_camera @ se3.make(np.eye(3), [0, 0, -300]), *_rest()[1:])
    assert (pixels_from_points(camera, se3.transform_points(behind.base_from_surface, DOTTED))[1] < 0).all()
    assert not drawn(shown(tmp_path, behind)).any()


def test_a_missing_camera_is_a_dark_tile_and_gray_pictures_are_shown(tmp_path: Path) -> None:
    both = shown(tmp_path, line=None, cameras=(0, 2), gray=True)
    assert both.shape == (max(MAIN_TILE[1], 2 * SIDE_TILE[1]), MAIN_TILE[0] + SIDE_TILE[0], 3)
    first, missing, third = both[300, 300], both[150, MAIN_TILE[0] + 200], both[SIDE_TILE[1] + 150, MAIN_TILE[0] + 200]
    assert abs(int(first[0]) - 60) < 8 and abs(int(third[0]) - 60) < 8
    assert missing.max() < 40


def test_rigs_of_one_camera_and_of_five_have_a_page(tmp_path: Path) -> None:
    for count in (1, 5):
        rig = arc_rig(tuple(20.0 * i for i in range(count)))
        WatchPage(tmp_path, rig, "x").show(watch_frames(cameras=tuple(range(count))), POSE, DOTTED, [])
        assert (tmp_path / "watch.jpg").stat().st_size > 1000
