"""`stillbed track` from a session folder to its files, also when it is cut short, and its recording as a session."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from pathlib import Path
from time import monotonic, sleep

import cv2
import numpy as np
import pytest

from estimation.rig import Rig
from estimation.synthetic.world import arc_rig
from hardware.cli.main import main
from hardware.files.folder_tables import write_frames
from hardware.files.pose_file import read_poses
from hardware.files.rig_file import ImageSource, write_rig
from hardware.files.session import FrameRef
from hardware.offline.convert import TrackRecorder
from hardware.recording.session_reader import open_session
from hardware.recording.session_reader import read_poses as read_recorded_poses
from tests.command_processes import started
from tests.recording_samples import events
from tests.rendered_sets import still, write_session
from tests.session_files import change
from tests.tracking_runs import Replayed

SMALL = arc_rig(size=(640, 360), focal=700.0)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frame sets at 10 Hz of a simulated surface, breathing, in videos."""
    folder = tmp_path_factory.mktemp("session") / "breathing"
    write_session(folder, seconds=1.0, rate=10.0, seed=2, cameras=SMALL)
    for name in ("cam_0", "cam_1", "cam_2"):
        film(folder, name)
    return folder


def film(folder: Path, name: str) -> None:
    """Make one video of a camera's pictures."""
    images = [cv2.imread(str(path)) for path in sorted((folder / name).iterdir())]
    quality = [cv2.VIDEOWRITER_PROP_QUALITY, 95]
    path, code = str(folder / f"{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(path, cv2.CAP_OPENCV_MJPEG, code, 10.0, images[0].shape[1::-1], quality)
    for image in images:
        writer.write(image)
    writer.release()
    shutil.rmtree(folder / name)
    change(folder / "rig.toml", f'images = "{name}/*"', f'video = "{name}.avi"')


@pytest.fixture(scope="module")
def tracked(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `stillbed track --record --graph` made of it."""
    out = tmp_path_factory.mktemp("tracked") / "out"
    out.mkdir()
    (out / "wound.csv").write_text("of an earlier run")
    also = ["--force", "--record", str(out.parent / "run.mcap"), "--graph", str(out.parent / "window.dot")]
    assert main(["track", str(session), "-o", str(out), *also]) == 0
    return out


def test_the_recording_of_a_run_is_its_session_again(session: Path, tmp_path: Path) -> None:
    original, step = open_session(session), Replayed([])
    with TrackRecorder(tmp_path / "run.mcap", original, overwrite=False) as recorder:
        for frames in original.frame_sets():
            recorder.write(frames, step(frames), step.last)
    again = open_session(tmp_path / "run.mcap")
    assert np.array_equal(again.truth.stamps, original.truth.stamps)
    assert np.allclose(again.truth.base_from_surface, original.truth.base_from_surface)
    assert [r.stamp for r in again.roi] == [r.stamp for r in original.roi]
    for a, b in zip(again.frame_sets(), original.frame_sets(), strict=True):
        assert a.stamp == pytest.approx(b.stamp)
        assert all(np.array_equal(x.image, y.image) for x, y in zip(a.frames, b.frames, strict=True))
    poses = list(read_recorded_poses(tmp_path / "run.mcap"))
    assert [p.state for p in poses] == list(step.table.states[:10])
    assert [event.text.split(":")[0] for event in events(tmp_path / "run.mcap")] == ["INITIALISING", "TRACKING"]


def test_a_run_leaves_its_files_and_they_agree(tracked: Path) -> None:
    assert sorted(f.name for f in tracked.iterdir()) == ["poses.csv", "poses.tum", "report.html", "summary.json"]
    table = read_poses(tracked / "poses.csv")
    summary = json.loads((tracked / "summary.json").read_text())
    assert (len(table), summary["frame_sets"], summary["complete"]) == (10, 10, True)
    assert len((tracked / "poses.tum").read_text().splitlines()) - 1 == table.measured.sum()
    assert np.isfinite(table.offset_sigmas).all() and (table.offset_sigmas[-1] < table.offset_sigmas[0]).all()
    assert np.abs(table.offsets[-1]).max() < 0.001  # the cameras were triggered together
    assert list(summary["clocks_ms"]) == list(table.cameras)
    assert (table.seconds[:, -1] >= table.seconds[:, :-1].sum(axis=1) - 1e-4).all()


def test_the_simulated_surface_is_followed(tracked: Path) -> None:
    summary = json.loads((tracked / "summary.json").read_text())
    assert summary["measured_share"] >= 0.6  # four of the ten frame sets are averaged into the first pose
    assert summary["errors"]["against"] == "truth"
    assert summary["errors"]["start"]["translation_mm"]["max"] < 0.5
    assert summary["errors"]["start"]["rotation_deg"]["max"] < 0.5
    assert summary["errors"]["off_by_more_than_10_mm_while_tracking"] == 0


@pytest.mark.slow
def test_the_recording_of_the_run_tracks_to_the_same_poses(tracked: Path, tmp_path: Path) -> None:
    assert main(["track", str(tracked.parent / "run.mcap"), "-o", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "poses.tum").read_bytes() == (tracked / "poses.tum").read_bytes()


def test_the_graph_holds_the_newest_pose_and_joins_what_it_names(tracked: Path) -> None:
    text, stamps = (tracked.parent / "window.dot").read_text(encoding="utf-8"), read_poses(tracked / "poses.csv").stamps
    assert f"pose\\n{stamps[-1]:.3f} s" in text and text.count("pose\\n") == text.count("twist\\n") > 1
    named, joined = (set(re.findall(pattern, text)) for pattern in (r"  ([xv]\d+) \[label", r"-- ([xv]\d+);"))
    assert named == joined
    assert text.count("white noise on acceleration") == text.count("pose\\n") - 1


@pytest.mark.parametrize("options", [["--method", "thesis"], []])
def test_a_graph_that_cannot_be_written_is_refused_before_anything_is_tracked(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    folder = tmp_path if not options else tmp_path / "new.dot"
    assert main(["track", str(session), "-o", str(tmp_path / "out"), "--graph", str(folder), *options]) == 2
    assert "--graph" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_an_early_end_costs_only_the_rest(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = shutil.copytree(session, tmp_path / "broken")
    whole = (broken / "cam_1.avi").read_bytes()
    (broken / "cam_1.avi").write_bytes(whole[: len(whole) * 6 // 10])
    assert main(["track", str(broken), "-o", str(tmp_path / "out")]) == 2
    assert "cam_1.avi" in capsys.readouterr().err
    if (tmp_path / "out").exists():  # the fault came up on the way, not at the door
        assert 3 <= len(read_poses(tmp_path / "out" / "poses.csv")) < 10
        assert json.loads((tmp_path / "out" / "summary.json").read_text())["complete"] is False


def endless(folder: Path) -> Path:
    """A session of 2000 frame sets, all the same three pictures."""
    write_session(folder, seconds=0.1, rate=10.0, motion=still, quality=None, cameras=SMALL)
    rig = open_session(folder).rig
    for camera in rig.cameras:
        first = next((folder / camera.name).glob("*.png"))
        for i in range(2000):
            os.link(first, folder / camera.name / f"{i + 1:06d}x.png")
        first.unlink()
    write_table(folder, rig)
    return folder


def write_table(folder: Path, rig: Rig) -> None:
    refs = [FrameRef(c, i, i / 10, i / 10) for c in range(len(rig)) for i in range(2000)]
    write_frames(folder / "frames.csv", rig, refs)
    write_rig(folder / "rig.toml", rig, [ImageSource("images", f"{c.name}/*.png") for c in rig.cameras])


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_written_and_says_so(tmp_path: Path) -> None:
    folder, out = endless(tmp_path / "endless"), tmp_path / "out"
    running = started(["track", str(folder), "-o", str(out)])
    deadline = monotonic() + 60
    while running.poll() is None and monotonic() < deadline:
        if (out / "poses.csv").exists() and (out / "poses.csv").read_bytes().count(b"\n") > 5:
            break
        sleep(0.05)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "interrupted; kept in" in said
    assert "Traceback" not in said
    assert 5 <= len(read_poses(out / "poses.csv")) < 2000
    assert json.loads((out / "summary.json").read_text())["complete"] is False
    assert "incomplete" in (out / "report.html").read_text()
