"""`python -m tests.campaigns fuzz`: every reader of outside data, given inputs that are valid except in a few places.

A reader may accept an input or refuse it with one of our own errors. Anything else counts as a failure: another
exception, more than `MAX_SECONDS` of processor time, more than `MAX_MEMORY` of memory, the end of the process. The
input that caused it is kept. `--log` records how far each reader is and what failed; a run goes on from there.
"""

from __future__ import annotations

import argparse
import hashlib
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from estimation import se3
from estimation.batch.smoothed import SampledStates
from estimation.errors import InputError
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm import protocol
from hardware.arm.driver import G1, Reply, ReplyKind
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import FRAME_LENGTH, FRAME_TAILS, REPLY_LENGTH, REPLY_TAILS, FrameStream
from hardware.bench.figures import Figure, require_positive
from hardware.calibration.corners import read_corners, write_corners
from hardware.calibration.rig_formats import FORMATS
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.folder_tables import read_heads, read_rows, write_heads
from hardware.files.images import encode
from hardware.files.mesh_file import read_mesh, read_raw_mesh, write_ply
from hardware.files.mesh_reader import STL_TRIANGLE, MeshReader
from hardware.files.path_file import read_contour, read_path, read_progress, write_progress_durably
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.files.rig_file import ImageSource, read_board, read_rig, write_board, write_rig
from hardware.files.session import PrintHeadLog
from hardware.live.prepared import SurfacePlacement, placement_text, read_placement
from hardware.live.settings import read_settings, settings_text
from hardware.offline.trajectory_files import read_pose_series, write_instants
from hardware.operator.broadcast import parse_message
from hardware.plan.order import in_mm
from hardware.process.clock import WallClock
from hardware.process.faults import fault_from_text
from hardware.process.progress import Progress
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import open_session
from hardware.simulator.arm.settings import ArmSettings, read_virtual_arm, write_virtual_arm
from hardware.simulator.scenario import read_scenario
from hardware.simulator.trace_file import read_trace
from perception.boards.board import Board, CornerTable
from perception.frames import Frame, Image
from perception.tracking.step import STAGES, report_without_offsets
from perception.wound.network import WoundNetwork, shipped_model
from perception.wound.shape_matching import read_shape_model
from planning.layers.repair import repair_mesh
from planning.path import fingerprint
from tests.campaigns.fuzz_process import (
    Reader,
    ReaderSum,
    Task,
    append_log,
    fuzz_figures,
    print_failure,
    read_log,
    run_tasks,
)

PATH_TEXT = (
    "x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude\n"
    "-6,-2,0,0,0,0,5,1,20,0,0\n6,-2,0,0,0,0,5,1,20,0,1\n6,2,0,0,0,0,5,1,20,0,1\n"
)
SCENARIO_TEXT = """
title = "x"
seconds = 2.0
seed = 3
path = "path.csv"
faults = ["arm stall 600ms at 1s"]
[scene]
body = "chest"
[[motion]]
kind = "breathing"
amplitude_mm = 2.0
rate_hz = 0.4
[rig]
angles_deg = [0, 36, 84]
size = [320, 180]
[cameras]
fps = 20.0
offset_s = [0, 0.01, 0]
[limits]
p95_mm = 0.5
"""
TRACE_TEXT = "t_s,tx_mm,ty_mm,tz_mm\n" + "".join(f"{k / 10},{k / 5},0,0\n" for k in range(12))
CONTOUR_TEXT = "x_mm,y_mm\n0,0\n10,0\n10,8\n0,8\n"
PAGE_MESSAGE = b'{"ask": "pause", "turn": 3, "tag": 5}'
OBJ_TEXT = "v 0 0 0\nv 20 0 0\nv 0 20 0\nv 20 20 1\nvn 0 0 1\nf 1 2 3\nf 2//1 4//1 -2//1\n"
STL_FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 20 0 0\nvertex 0 20 0\nendloop\nendfacet\n"
BINARY_PLY_HEADER = (
    "ply\nformat binary_big_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    "property uchar red\nelement face 5\nproperty list uchar uint vertex_indices\nend_header\n"
)
PCD_HEADER = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA binary\n"
OFF_TEXT = "OFF\n4 2 0\n0 0 0\n20 0 0\n0 20 0\n20 20 1\n3 0 1 2\n3 1 3 2\n"
GLTF_TEXT = """{"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "accessors": [
{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [20, 20, 0]},
{"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}],
"bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
"buffers": [{"byteLength": 44, "uri":
"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACgQQAAAAAAAAAAAAAAAAAAoEEAAAAAAAABAAIAAAA="}]}"""
SCAN_VERTICES = np.array([[0.0, 0, 0], [20, 0, 1], [20, 20, 0], [0, 20, 2], [10, 10, 3]])
SCAN_TRIANGLES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
SKIN_NODES = 6  # a side of the scan that is planned on, so that it has the triangles that repair asks for
SMALL_SIZE, VIDEO_RATE, FRAME_COUNT = (48, 32), 30, 3  # px, Hz
CORNERS_KEY = "0123456789abcdef" * 4  # of the recording that the corners belong to
FORMAT_SUFFIX = {"kalibr": ".yaml", "anipose": ".toml"}  # the others are folders with a file for each camera
XYZ_TEXT = "".join(f"{k % 9} {k // 9} {k % 7 / 10}\n" for k in range(81))


def _small_picture(number: int) -> Image:
    """Noise (H, W, 3) that follows from the number."""
    return np.random.default_rng(number).integers(0, 256, (SMALL_SIZE[1], SMALL_SIZE[0], 3), np.uint8)


def _write_cameras(folder: Path, kind: str, pattern: str) -> list[str]:
    """rig.toml and frames.csv of a small session; the names of its cameras."""
    rig = arc_rig(size=SMALL_SIZE, focal=40)
    names = [camera.name for camera in rig.cameras]
    write_rig(folder / "rig.toml", rig, [ImageSource(kind, pattern.format(name)) for name in names])
    rows = [f"{name},{k},{k / VIDEO_RATE!r}" for name in names for k in range(FRAME_COUNT)]
    (folder / "frames.csv").write_text("\n".join(["camera,frame,stamp_s", *rows]) + "\n")
    return names


def _make_videos(folder: Path) -> None:
    for name in _write_cameras(folder, "video", "{}.avi"):
        motion_jpeg = cv2.VideoWriter.fourcc(*"MJPG")
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.CAP_OPENCV_MJPEG, motion_jpeg, VIDEO_RATE, SMALL_SIZE)
        for k in range(FRAME_COUNT):
            writer.write(_small_picture(k))
        writer.release()


def _make_session(folder: Path) -> None:
    names = _write_cameras(folder, "images", "{}/*.png")
    for name in names:
        (folder / name).mkdir()
        for k in range(FRAME_COUNT):
            (folder / name / f"{k}.png").write_bytes(encode(_small_picture(k))[1])
    region = f'camera = "{names[0]}"\nframe = 1\npolygon = [[1, 2], [40, 3], [20, 30]]'
    (folder / "roi.toml").write_text(f"[[roi]]\n{region}\n")
    rows = [f"{k / VIDEO_RATE} 1 2 {300 + k} 0 0 0 1" for k in range(FRAME_COUNT)]
    (folder / "truth.tum").write_text("\n".join(rows) + "\n")


def _read_session(path: Path) -> object:
    return [frames.stamp for frames in open_session(path).frame_sets()]


def _make_recording(folder: Path) -> None:
    rig = arc_rig(size=SMALL_SIZE, focal=40)
    with Recorder(folder / "x.mcap", rig) as recorder:
        for k in range(FRAME_COUNT):
            for camera in range(len(rig)):
                recorder.frame(Frame(camera, k / VIDEO_RATE, _small_picture(k)))
            recorder.event(k / VIDEO_RATE, "something", 1)


def _make_scenario(folder: Path) -> None:
    (folder / "path.csv").write_text(PATH_TEXT)
    (folder / "x.toml").write_text(SCENARIO_TEXT)


def _make_progress(folder: Path) -> None:
    (folder / "path.csv").write_text(PATH_TEXT)
    write_progress_durably(folder / "x.toml", fingerprint(read_path(folder / "path.csv")), 1.25)


def _make_placement(folder: Path) -> None:
    (folder / "x.mcap").write_bytes(b"")
    placement = SurfacePlacement(folder / "x.mcap", 1.0, se3.inverse(BASE_FROM_REST), BASE_FROM_REST)
    (folder / "x.toml").write_text(placement_text(placement))


def _make_poses(folder: Path) -> None:
    with PoseWriter(folder, ["a", "b"], STAGES) as writer:
        for k in range(FRAME_COUNT):
            pose = SurfacePose(k / VIDEO_RATE, BASE_FROM_REST, np.eye(6) * 1e-4, np.zeros(6), TrackState.TRACKING)
            tracks = no_observations(k / VIDEO_RATE)
            writer.write(pose, 2, report_without_offsets(tracks, np.zeros(2, np.int64), np.zeros(len(STAGES))), 0.01)


def _make_heads(folder: Path) -> None:
    rows = np.array([[k / VIDEO_RATE, 1.0, 2.0, 300.0 + k, 0, 0, 0, 1] for k in range(FRAME_COUNT)])
    write_heads(folder / "head.csv", PrintHeadLog(rows, np.array([False, True, True])))


def _make_corners(folder: Path) -> None:
    count, cameras = 4, np.zeros(2, np.int64)
    pixels = np.random.default_rng(1).uniform(0, 48, (2, count, 2))
    ones, instants = np.ones(2), np.arange(2)
    table = CornerTable(cameras, instants, instants / VIDEO_RATE, pixels, ones, ones, ones, cameras, cameras[:0], 2)
    write_corners(folder / "corners.npz", CORNERS_KEY, table)


def _make_smoothed(folder: Path) -> None:
    stamps = np.arange(FRAME_COUNT) / VIDEO_RATE
    spread = np.broadcast_to(np.eye(6) * 1e-4, (FRAME_COUNT, 6, 6))
    poses = BASE_FROM_REST @ se3.exp(np.outer(stamps, [0.1, 0, 0, 0, 0, 1.0]))
    write_instants(folder / "smoothed.csv", SampledStates(stamps, poses, spread, np.zeros((FRAME_COUNT, 6)), spread))


def _make_binary_ply(folder: Path) -> None:
    """Big-endian, with a colour, and with a polygon of four corners among the triangles."""
    vertices = b"".join(np.array(place, ">f4").tobytes() + b"\x7f" for place in SCAN_VERTICES)
    faces = b"".join(bytes([len(face)]) + np.array(face, ">u4").tobytes() for face in [*SCAN_TRIANGLES, [0, 3, 2, 1]])
    (folder / "x.ply").write_bytes(BINARY_PLY_HEADER.encode() + vertices + faces)


def _make_binary_stl(folder: Path) -> None:
    table = np.zeros(len(SCAN_TRIANGLES), STL_TRIANGLE)
    table["corners"] = SCAN_VERTICES[SCAN_TRIANGLES]
    (folder / "x.stl").write_bytes(bytes(80) + np.uint32(len(table)).tobytes() + table.tobytes())


def _make_skin(folder: Path) -> None:
    """A curved square with enough triangles to be planned on."""
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(0, 60, SKIN_NODES)]))
    corner = (np.arange(SKIN_NODES - 1)[:, None] * SKIN_NODES + np.arange(SKIN_NODES - 1)).ravel()
    low = np.column_stack([corner, corner + 1, corner + SKIN_NODES])
    high = np.column_stack([corner + 1, corner + SKIN_NODES + 1, corner + SKIN_NODES])
    write_ply(folder / "x.ply", np.column_stack([x, y, 3 + x * y / 1000]), np.concatenate([low, high]))


@cache
def _kept_reader() -> MeshReader:
    """The process that reads all meshes of this one, and ends with it."""
    return MeshReader()


def _read_mesh(path: Path) -> object:
    return read_mesh(path, _kept_reader())


def _make_cloud(folder: Path) -> None:
    """A curved square of points in a binary PCD file."""
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(0, 30, SKIN_NODES + 2)]))
    points = np.column_stack([x, y, x * y / 100]).astype("<f4")
    (folder / "x.pcd").write_bytes(PCD_HEADER.format(len(points)).encode() + points.tobytes())


def _read_skin(path: Path) -> object:
    """A scan as `stillbed plan` reads it: its unit checked, and repaired."""
    raw = read_raw_mesh(path, _kept_reader())
    return repair_mesh(in_mm(raw.vertices, raw.triangles, "mm", path), raw.triangles, path)


def _make_model(folder: Path) -> None:
    """A file whose hash its settings state: any other network is refused before its content is read."""
    data = bytes(range(256)) * 4
    (folder / "wound.onnx").write_bytes(data)
    settings = shipped_model(suffix=".toml").read_text(encoding="utf-8")
    digest = hashlib.sha256(data).hexdigest()
    (folder / "wound.toml").write_text(re.sub(r'sha256 = ".*"', f'sha256 = "{digest}"', settings), encoding="utf-8")


def _read_model(path: Path) -> object:
    return WoundNetwork(path.with_suffix(".onnx"), threads=1)


def _plain(file: str, content: str | bytes, read: Callable[[Path], object]) -> Reader:
    """A reader of one file with this content."""
    data = content.encode() if isinstance(content, str) else content
    return Reader(file, lambda folder: (folder / file).write_bytes(data), read)


def _format_reader(name: str) -> Reader:
    """A reader of another program's rig format."""
    form = FORMATS[name]
    suffix = FORMAT_SUFFIX.get(name)
    file = "cam_0.yaml" if suffix is None else f"x{suffix}"
    return Reader(file, lambda folder: form.write(folder if suffix is None else folder / file, arc_rig()), form.read)


def _decoded(path: Path) -> str:
    return path.read_bytes().decode("utf-8", "replace")


def readers() -> dict[str, Reader]:
    """All of them by name."""
    move = protocol.encode(G1(np.array([202.5, 225, 113, 0, 0.1, 0]), 5.0), protocol.THESIS_DIALECT) * 4
    reply = protocol.encode_reply(Reply(ReplyKind.PLACE, np.array([1.0, 2, 3]))) * 6
    frames, replies = (FRAME_LENGTH, FRAME_TAILS, protocol.decode), (REPLY_LENGTH, REPLY_TAILS, protocol.decode_reply)
    sources = [ImageSource("video", f"{k}.avi") for k in range(3)]
    fault, rows = "camera0 bump 2mm at 5s for 2s seed 3", "".join(f"{k} 1 2 3 0 0 0 1\n" for k in range(5))
    solid = f"solid x\n{STL_FACET}{STL_FACET.replace('20', '30')}endsolid x\n"
    series = "".join(f"{k / VIDEO_RATE},1,2,{300 + k},0,0,0,1\n" for k in range(FRAME_COUNT))
    return {
        "frames of the arm": _plain("x.bin", move, lambda p: FrameStream(*frames)(p.read_bytes())),
        "answers of the arm": _plain("x.bin", reply, lambda p: FrameStream(*replies)(p.read_bytes())),
        "messages of the page": _plain("x.json", PAGE_MESSAGE, lambda p: parse_message(_decoded(p))),
        "faults": _plain("x.txt", fault, lambda p: fault_from_text(p, "fault", _decoded(p))),
        "rig": Reader("x.toml", lambda f: write_rig(f / "x.toml", arc_rig(), sources), read_rig),
        "arm": Reader("x.toml", lambda f: write_arm(f / "x.toml", ArmProfile(), "an arm"), read_arm),
        "session.toml": _plain("x.toml", settings_text(), read_settings),
        "scenario": Reader("x.toml", _make_scenario, read_scenario),
        "virtual arm": Reader("x.toml", lambda f: write_virtual_arm(f / "x.toml", ArmSettings(), ()), read_virtual_arm),
        "path": _plain("x.csv", PATH_TEXT, read_path),
        "contour": _plain("x.csv", CONTOUR_TEXT, read_contour),
        "progress": Reader("x.toml", _make_progress, lambda p: read_progress(p, read_path(p.with_name("path.csv")))),
        "surface": Reader("x.toml", _make_placement, read_placement),
        "board": Reader("x.toml", lambda f: write_board(f / "x.toml", Board()), read_board),
        "poses": Reader("poses.csv", _make_poses, read_poses),
        "TUM": _plain("x.tum", rows, read_rows),
        "trace": _plain("x.csv", TRACE_TEXT, read_trace),
        "table of frames": Reader("frames.csv", _make_session, lambda p: open_session(p.parent)),
        "region": Reader("roi.toml", _make_session, lambda p: open_session(p.parent)),
        "picture": Reader("cam_0/1.png", _make_session, lambda p: _read_session(p.parent.parent)),
        "recording": Reader("x.mcap", _make_recording, _read_session),
        "PLY": Reader("x.ply", lambda f: write_ply(f / "x.ply", SCAN_VERTICES, SCAN_TRIANGLES), _read_mesh),
        "binary PLY": Reader("x.ply", _make_binary_ply, _read_mesh),
        "STL": _plain("x.stl", solid, read_mesh),
        "binary STL": Reader("x.stl", _make_binary_stl, read_mesh),
        "OBJ": _plain("x.obj", OBJ_TEXT, read_mesh),
        "OFF": _plain("x.off", OFF_TEXT, _read_mesh),
        "glTF": _plain("x.gltf", GLTF_TEXT, _read_mesh),
        "cloud": Reader("x.pcd", _make_cloud, _read_mesh),
        "text of a cloud": _plain("x.xyz", XYZ_TEXT, _read_mesh),
        "scan to plan on": Reader("x.ply", _make_skin, _read_skin),
        "settings of a network": Reader("wound.toml", _make_model, _read_model),
        "network": Reader("wound.onnx", _make_model, _read_model),
        "shape model": _plain("shape.toml", shipped_model("shape", ".toml").read_bytes(), read_shape_model),
        "video": Reader("cam_0.avi", _make_videos, lambda p: _read_session(p.parent)),
        "print head": Reader("head.csv", _make_heads, read_heads),
        "corners": Reader("corners.npz", _make_corners, lambda p: read_corners(p, CORNERS_KEY)),
        "smoothed": Reader("smoothed.csv", _make_smoothed, lambda p: read_pose_series(str(p))),
        "trajectory": _plain("x.csv", series, lambda p: read_pose_series(str(p))),
        **{f"rig of {name}": _format_reader(name) for name in FORMATS},
    }


MAX_SAVED_INPUTS = 5  # of each reader; the others can be made again from their seed and number


def run_fuzz(options: argparse.Namespace) -> list[Figure]:
    """Fuzz the readers, in processes of their own; print, save and log each failure as it happens."""
    names = list(readers())
    if options.only is not None and options.only not in names:
        raise InputError("command line", "--only", options.only, f"one of {', '.join(names)}")
    require_positive(options, "count", "jobs")
    sums = {name: ReaderSum() for name in names if options.only in (None, name)}
    if options.log is not None and options.log.exists():
        for block in read_log(options.log, options.seed):
            if block.name in sums:
                sums[block.name].add(block)
                print_failure(block)
    share = -(-options.count // len(sums))
    tasks = [Task(name, range(done.count, share)) for name, done in sums.items() if done.count < share]
    count, total = 0, sum(len(task.numbers) for task in tasks)
    with Progress("fuzz", "inputs", WallClock().now) as progress:
        for block in run_tasks(tasks, options.seed, options.jobs, readers):
            sums[block.name].add(block)
            if options.log is not None:
                append_log(options.log, options.seed, block)
            if block.wrong:
                progress.close()
                save = options.out is not None and sums[block.name].wrong <= MAX_SAVED_INPUTS
                print_failure(block, options.out if save else None)
            count += block.count
            progress(count, total)
    for name, done in sums.items():
        each = 1e6 * done.seconds / max(done.count, 1)
        print(f"{name:<24}{done.count:>9}  refused {done.refused:>9}  wrong {done.wrong:>3}  {each:>7.0f} us each")
    return fuzz_figures(list(sums.values()))
