"""What others' readers make of a recording: rosbags and Rerun see the same world, in their own units, at real times."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from estimation import se3
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import distort, pixels_from_points
from hardware.files.folder_tables import rows_from_trajectory
from hardware.files.session import row_from_head
from hardware.recording import ros_messages
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import open_session
from perception.frames import PrintHead
from tests.recording_samples import write_frames
from tests.session_files import NAMES, rig, trajectory

ROOT = Path(__file__).parents[1]
STORE = get_typestore(Stores.ROS2_HUMBLE)
BEGAN = 1_764_150_000_123_456_789  # ns, UTC at stamp 0
SETS = 5
LANDMARKS = np.random.default_rng(0).normal(size=(30, 3)) * 8
PATH = np.stack([np.linspace(-10, 10, 40), np.sin(np.linspace(0, 6, 40)), np.zeros(40)], axis=1)
NOZZLE = se3.make(np.eye(3), np.array([1.0, 2.0, 310.0]))


def surface_at(k: int) -> SurfacePose:
    lies = se3.make(se3.exp(np.array([0.1, 0.2, 0.01 * k, 0, 0, 0]))[:3, :3], np.array([0.0, 0.5 * k, 300.0]))
    return SurfacePose(0.2 * k, lies, np.diag([1e-6] * 3 + [0.01] * 3), np.full(6, 0.5), TrackState.TRACKING)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("viewers") / "x.mcap"
    with Recorder(file, rig(), began=BEGAN) as recorder:
        write_frames(recorder, SETS, 3, 0.0)
        recorder.show_path(0.0, PATH, np.arange(40.0))
        recorder.show_surface(0.0, LANDMARKS, [PATH[:4]])
        recorder.show_scan(0.0, LANDMARKS + 1)
        for k in range(SETS):
            pose = surface_at(k)
            recorder.head_row(row_from_head(pose.stamp, PrintHead(NOZZLE, True)), True)
            pixels = np.array([[10.0, 20.0], [30.0, 5.0], [12.0, 8.0]])
            recorder.write(Observations(pose.stamp, np.arange(3), np.zeros(3, int), pixels, np.ones(3)))
            recorder.write(pose)
            recorder.progress(pose.stamp, 10.0 * k)
            recorder.error(pose.stamp, "nozzle", 0.1 * k)
            recorder.event(pose.stamp, f"set {k}")
    return file


def read(file: Path, topic: str) -> list[Any]:
    """All messages of a topic as rosbags' reader decodes them."""
    with AnyReader([file]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic == topic]
        return [reader.deserialize(raw, of.msgtype) for of, _, raw in reader.messages(chosen)]


def placed(transform: Any) -> np.ndarray:
    """A ROS transform as (4, 4), mm."""
    turned, moved = transform.rotation, transform.translation
    rotation = se3.rotation_from_quaternion(np.array([turned.x, turned.y, turned.z, turned.w]))
    return se3.make(rotation, 1000 * np.array([moved.x, moved.y, moved.z]))


def test_every_frame_is_where_it_is_in_metres(recording: Path) -> None:
    moving = [each for message in read(recording, "/tf") for each in message.transforms]
    seen = [placed(each.transform) for each in moving if each.child_frame_id == "surface"]
    assert np.allclose(seen, [surface_at(k).base_from_surface for k in range(SETS)], atol=1e-9)
    heads = [placed(each.transform) for each in moving if each.child_frame_id == "nozzle"]
    assert len(heads) == SETS and np.allclose(heads, NOZZLE, atol=1e-9)
    still = {each.child_frame_id: placed(each.transform) for each in read(recording, "/tf_static")[0].transforms}
    assert np.allclose([still[f"camera/{c.name}"] for c in rig().cameras], [c.base_from_camera for c in rig().cameras])
    assert {each.header.frame_id for each in moving} == {"base"}


def test_a_covariance_turns_with_the_pose_and_translations_come_first(recording: Path) -> None:
    """By its meaning: poses drawn about the surface's, each as ROS has it, scatter as the message says."""
    draw = np.random.default_rng(1)
    root = draw.normal(size=(6, 6)) * np.repeat([1e-3, 0.1], 3)[:, None]
    lies, spread = surface_at(3).base_from_surface, root @ root.T
    message = ros_messages.unpacked(
        ros_messages.ODOMETRY, ros_messages.odometry(lies, spread, np.arange(6.0), np.eye(6), 5)
    )
    moved = np.stack([lies @ se3.exp(root @ each) for each in draw.normal(size=(40_000, 6))])
    off = 1e-3 * (moved[:, :3, 3] - lies[:3, 3])
    turned = se3.log(se3.make(moved[:, :3, :3] @ lies[:3, :3].T, np.zeros((len(moved), 3))))[:, :3]
    sampled = np.cov(np.concatenate([off, turned], axis=1).T)
    told, scale = message.pose.covariance.reshape(6, 6), np.sqrt(np.diag(sampled))
    assert np.allclose(told / np.outer(scale, scale), sampled / np.outer(scale, scale), atol=0.05)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    assert (linear.x, linear.z, angular.y) == pytest.approx((3e-3, 5e-3, 1.0))
    assert message.header.frame_id == "base" and message.child_frame_id == "surface"


def test_clouds_are_in_metres_and_the_path_is_coloured_by_progress(recording: Path) -> None:
    (landmarks,), scan, paths = (read(recording, topic) for topic in ("/landmarks", "/scan", "/path"))
    points = np.frombuffer(landmarks.data.tobytes(), "<f4").reshape(-1, 3)
    assert np.allclose(1000 * points, LANDMARKS, atol=1e-4) and landmarks.header.frame_id == "surface"
    assert len(scan) == 1 and [field.name for field in paths[0].fields] == ["x", "y", "z", "rgb"]
    green = []
    for path in paths:
        rows = np.frombuffer(path.data.tobytes(), np.dtype([("at", "<f4", 3), ("bgr0", "u1", 4)]))
        assert np.allclose(1000 * rows["at"], PATH, atol=1e-4)
        green.append(int((rows["bgr0"][:, 1] == ros_messages.PRINTED_RGB[1]).sum()))
    assert green[0] == 1 and green == sorted(green)


def test_what_is_drawn_over_a_picture_lies_where_the_lens_puts_it(recording: Path) -> None:
    for number, camera in enumerate(rig().cameras):
        drawings = read(recording, f"/camera/{camera.name}/annotations")
        assert len(drawings) == SETS
        tracks, path, outline = drawings[2].points
        pixels = np.array([[10.0, 20.0], [30.0, 5.0], [12.0, 8.0]])[[number]]
        assert np.allclose([(p.x, p.y) for p in tracks.points], distort(camera, pixels)) and tracks.type == 1
        on_base = se3.transform_points(surface_at(2).base_from_surface, PATH)
        assert np.allclose([(p.x, p.y) for p in path.points], pixels_from_points(camera, on_base)[0])
        assert path.type == 3 and outline.type == 2 and len(outline.points) == 4


def test_errors_and_events_are_told_at_real_times(recording: Path) -> None:
    assert [message.data for message in read(recording, "/error/nozzle")] == pytest.approx(
        [1e-4 * k for k in range(SETS)]
    )
    assert [message.msg for message in read(recording, "/events")] == [f"set {k}" for k in range(SETS)]
    with AnyReader([recording]) as reader:
        stamps = [instant for of, instant, _ in reader.messages() if of.topic == "/events"]
    assert stamps == [BEGAN + 200_000_000 * k for k in range(SETS)]
    assert open_session(recording).began == BEGAN


def test_ros_knows_every_message_but_foxgloves_as_its_own(recording: Path) -> None:
    with AnyReader([recording]) as reader:
        own = {each.topic for each in reader.connections if each.msgtype == "__schemaless__"}
        for connection in reader.connections:
            if connection.topic not in own and not connection.msgtype.startswith("foxglove_msgs"):
                assert reader.typestore.fielddefs[connection.msgtype] == STORE.fielddefs[connection.msgtype]
    assert own == {"/rig", "/frames", "/head", "/observations", "/pose"}


def test_foxgloves_layout_shows_channels_that_there_are(recording: Path) -> None:
    layout = json.loads((ROOT / "data" / "viewers" / "foxglove.json").read_text(encoding="utf-8"))
    named = set(re.findall(r'"(/[a-z_0-9/]+)(?:\.data)?"', json.dumps(layout["configById"])))
    named = {re.sub(r"^/camera/cam_\d/", f"/camera/{NAMES[0]}/", topic) for topic in named}
    with AnyReader([recording]) as reader:
        assert named - set(reader.topics) == {"/error/tracking"}  # there is no truth in this one
    shown, panels = json.dumps(layout["layout"]), set(layout["configById"])
    assert all(f'"{panel}"' in shown for panel in panels) and len(panels) == 6


WORDS = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=12)
LAST = ros_messages.MAX_TIME_SECOND


@given(kind=WORDS, frame=WORDS, data=st.binary(max_size=70), instant=st.integers(0, (LAST + 9) * 10**9))
def test_pictures_come_back_and_ros_reads_them(kind: str, frame: str, data: bytes, instant: int) -> None:
    packed = ros_messages.image(kind, data, frame, instant)
    assert ros_messages.image_from(packed) == (kind, data)
    told = STORE.deserialize_cdr(packed, ros_messages.IMAGE)
    assert (told.format, told.header.frame_id, bytes(told.data)) == (kind, frame, data)
    assert (told.header.stamp.sec, told.header.stamp.nanosec) == (min(instant // 10**9, LAST), instant % 10**9)


@given(data=st.binary(max_size=30), cut=st.integers(0, 200))
def test_a_picture_that_is_cut_is_refused(data: bytes, cut: int) -> None:
    packed = ros_messages.image("png", data, "camera/left", 5)
    if cut < len(packed) - 8:  # behind the picture is padding
        with pytest.raises(ValueError, match="no sensor_msgs/msg/CompressedImage"):
            ros_messages.image_from(packed[:cut])


def rerun(*arguments: object) -> str:
    """What Rerun's command says."""
    command = [sys.executable, "-m", "rerun", *map(str, arguments)]
    quiet = {**os.environ, "RERUN_ANALYTICS": "0"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=quiet)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def columns(file: Path, folder: Path) -> dict[str, set[str]]:
    """What Rerun's converter makes of each channel."""
    rerun("mcap", "convert", file, "-o", folder / "x.rrd", "--application-id", "stillbed")
    found: dict[str, set[str]] = {}
    for line in rerun("rrd", "print", folder / "x.rrd").splitlines():
        if " - data columns: [" in line:
            entity, _, names = line.partition(" - data columns: [")
            found.setdefault(entity.split(" ")[-1], set()).update(names.rstrip("]").split())
    return found


def shows_the_run(found: dict[str, set[str]], names: Sequence[str]) -> None:
    """That Rerun shows pictures in their frusta, frames, landmarks and path in 3D, the error over time, and the log."""
    for name in names:
        assert {"Pinhole:image_from_camera", "Pinhole:resolution"} <= found[f"/camera/{name}/camera_info"]
        assert {"CoordinateFrame:frame", "EncodedImage:blob"} <= found[f"/camera/{name}/image"]
    for topic in ("/tf", "/tf_static"):
        assert {"Transform3D:translation", "Transform3D:quaternion", "Transform3D:child_frame"} <= found[topic]
    for topic in ("/landmarks", "/path"):
        assert {"Points3D:positions", "CoordinateFrame:frame"} <= found[topic]
    assert "std_msgs.msg.Float64:message" in found["/error/claimed"]
    assert "TextLog:text" in found["/events"]


def test_rerun_shows_pictures_in_their_frusta_and_the_world_in_three_dimensions(
    recording: Path, tmp_path: Path
) -> None:
    shows_the_run(columns(recording, tmp_path), NAMES)


def test_a_truth_at_the_stamp_of_a_pose_gives_the_trackers_error(tmp_path: Path) -> None:
    true_from_own = se3.make(np.eye(3), np.array([3.0, 0.0, 0.0]))
    with Recorder(tmp_path / "x.mcap", rig()) as recorder:
        for k in range(SETS):
            pose = surface_at(k)
            known = trajectory(1, True)
            off = se3.make(np.eye(3), np.array([0.0, 0.0, 0.2 if k == 3 else 0.0]))
            known.base_from_surface[0] = off @ pose.base_from_surface @ se3.inverse(true_from_own)
            known.stamps[0] = pose.stamp
            recorder.truth_row(rows_from_trajectory(known)[0], exact=True)
            recorder.write(pose)
    errors = [1000 * message.data for message in read(tmp_path / "x.mcap", "/error/tracking")]
    assert errors == pytest.approx([0, 0, 0, 0.2, 0], abs=1e-6)
