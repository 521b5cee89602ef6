"""Everything that reads what comes from outside, each with a small valid input to begin with."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import G1, LENGTH, TAILS, THESIS, FrameStream, decode
from hardware.arm.protocol import encode as frame_of
from hardware.bench.campaigns.fuzz_inputs import FOLDERS
from hardware.bench.fuzz_meshes import make_binary_ply, make_binary_stl, make_obj, make_ply, make_skin, make_stl, skin
from hardware.bench.fuzz_try import Reader
from hardware.bookmark_file import keep_bookmark, read_start
from hardware.calibration.board_file import read_board, write_board
from hardware.calibration.formats import formats
from hardware.contour_file import read_contour
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.images import encode
from hardware.files.mesh_file import read_mesh
from hardware.files.path_file import read_path
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.files.rig_file import ImageSource, read_rig, write_rig
from hardware.files.session import open_session
from hardware.live.beside import Found, read_found, write_found
from hardware.live.settings import read_settings, settings_text
from hardware.operator.words import parsed
from hardware.process.faults import fault_from_text
from hardware.recording.recorder import Recorder
from hardware.replies import REPLY_LENGTH, REPLY_TAILS, Reply, ReplyKind, decode_reply, encode_reply
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.scenario_file import read_scenario
from hardware.simulator.trace_file import read_trace
from hardware.simulator.virtual_arm_file import read_virtual_arm, write_virtual_arm
from hardware.tum import read_rows
from perception.boards.board import Board
from perception.frames import Frame
from perception.tracking.step import STAGES, trusting_report
from perception.wound.network import WoundNetwork, shipped
from perception.wound.shape_matching import read_shape_model
from planning.progress import fingerprint

SMALL = 48, 32  # px
FRAMES = 3
PATH = (
    "x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg,speed_mm_s,material,temperature_c,layer,extrude\n"
    "-6,-2,0,0,0,0,5,1,20,0,0\n6,-2,0,0,0,0,5,1,20,0,1\n6,2,0,0,0,0,5,1,20,0,1\n"
)
SCENARIO = """
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
POSES = "t_s,tx_mm,ty_mm,tz_mm\n" + "".join(f"{k / 10},{k / 5},0,0\n" for k in range(12))
MESSAGE = b'{"ask": "pause", "turn": 3, "tag": 5}'


def _text(text: str | bytes, name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)

    return make


def _frames(path: Path) -> object:
    return FrameStream(LENGTH, TAILS, decode)(path.read_bytes())


def _replies(path: Path) -> object:
    return FrameStream(REPLY_LENGTH, REPLY_TAILS, decode_reply)(path.read_bytes())


def _whole_session(path: Path) -> object:
    return [frames.stamp for frames in open_session(path).frame_sets()]


def _picture(number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(number).integers(0, 256, (SMALL[1], SMALL[0], 3), np.uint8)


def _make_session(folder: Path) -> None:
    rig = arc_rig(size=SMALL, focal=40)
    names = [camera.name for camera in rig.cameras]
    write_rig(folder / "rig.toml", rig, [ImageSource("images", f"{name}/*.png") for name in names])
    lines = ["camera,frame,stamp_s"]
    for name in names:
        (folder / name).mkdir()
        for k in range(FRAMES):
            (folder / name / f"{k}.png").write_bytes(encode(_picture(k))[1])
            lines.append(f"{name},{k},{k / 30!r}")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    region = f'camera = "{names[0]}"\nframe = 1\npolygon = [[1, 2], [40, 3], [20, 30]]'
    (folder / "roi.toml").write_text(f"[[roi]]\n{region}\n")
    rows = [f"{k / 30} 1 2 {300 + k} 0 0 0 1" for k in range(FRAMES)]
    (folder / "truth.tum").write_text("\n".join(rows) + "\n")


def _make_recording(folder: Path) -> None:
    rig = arc_rig(size=SMALL, focal=40)
    with Recorder(folder / "x.mcap", rig) as recorder:
        for k in range(FRAMES):
            for camera in range(len(rig)):
                recorder.frame(Frame(camera, k / 30, _picture(k)))
            recorder.event(k / 30, "something", 1)


def _make_scenario(folder: Path) -> None:
    (folder / "path.csv").write_text(PATH)
    (folder / "x.toml").write_text(SCENARIO)


def _make_progress(folder: Path) -> None:
    (folder / "path.csv").write_text(PATH)
    keep_bookmark(folder / "x.toml", fingerprint(read_path(folder / "path.csv")), 1.25)


def _make_found(folder: Path) -> None:
    (folder / "x.mcap").write_bytes(b"")
    write_found(folder / "x.toml", Found(folder / "x.mcap", 1.0, se3.inverse(REST), REST))


def _make_poses(folder: Path) -> None:
    with PoseWriter(folder, ["a", "b"], STAGES) as writer:
        for k in range(FRAMES):
            pose = SurfacePose(k / 30, REST, np.eye(6) * 1e-4, np.zeros(6), TrackState.TRACKING)
            report = trusting_report(no_observations(k / 30), np.zeros(2, np.int64), np.zeros(len(STAGES)))
            writer.write(pose, 2, report, 0.01)


def _make_model(folder: Path) -> None:
    """What its settings take for the network: anything else is refused by its hash before anybody looks at it."""
    data = bytes(range(256)) * 4
    (folder / "wound.onnx").write_bytes(data)
    settings = shipped(suffix=".toml").read_text(encoding="utf-8")
    digest = hashlib.sha256(data).hexdigest()
    (folder / "wound.toml").write_text(re.sub(r'sha256 = ".*"', f'sha256 = "{digest}"', settings), encoding="utf-8")


def _model(path: Path) -> object:
    return WoundNetwork(path.with_suffix(".onnx"), threads=1)


def _shape_model(path: Path) -> object:
    return read_shape_model(path)


def _make_shape(folder: Path) -> None:
    shutil.copyfile(shipped("shape", ".toml"), folder / "shape.toml")


def readers() -> dict[str, Reader]:
    """All of them by name."""
    move = frame_of(G1(np.array([202.5, 225, 113, 0, 0.1, 0]), 5.0), THESIS) * 4
    answer = encode_reply(Reply(ReplyKind.PLACE, np.array([1.0, 2, 3]))) * 6
    found = {
        "frames of the arm": Reader("x.bin", _text(move, "x.bin"), _frames),
        "answers of the arm": Reader("x.bin", _text(answer, "x.bin"), _replies),
        "messages of the page": Reader(
            "x.json", _text(MESSAGE, "x.json"), lambda p: parsed(p.read_bytes().decode("utf-8", "replace"))
        ),
        "faults": Reader(
            "x.txt",
            _text("camera0 bump 2mm at 5s for 2s seed 3", "x.txt"),
            lambda p: fault_from_text(p, "fault", p.read_bytes().decode("utf-8", "replace")),
        ),
        "rig": Reader(
            "x.toml",
            lambda f: write_rig(f / "x.toml", arc_rig(), [ImageSource("video", f"{k}.avi") for k in range(3)]),
            read_rig,
        ),
        "arm": Reader("x.toml", lambda f: write_arm(f / "x.toml", ArmProfile(), "an arm"), read_arm),
        "session.toml": Reader("x.toml", lambda f: _text(settings_text(), "x.toml")(f), read_settings),
        "scenario": Reader("x.toml", _make_scenario, read_scenario),
        "virtual arm": Reader("x.toml", lambda f: write_virtual_arm(f / "x.toml", ArmSettings(), ()), read_virtual_arm),
        "path": Reader("x.csv", _text(PATH, "x.csv"), read_path),
        "contour": Reader("x.csv", _text("x_mm,y_mm\n0,0\n10,0\n10,8\n0,8\n", "x.csv"), read_contour),
        "progress": Reader("x.toml", _make_progress, lambda p: read_start(p, read_path(p.with_name("path.csv")))),
        "surface": Reader("x.toml", _make_found, read_found),
        "board": Reader("x.toml", lambda f: write_board(f / "x.toml", Board()), read_board),
        "poses": Reader("poses.csv", _make_poses, read_poses),
        "TUM": Reader("x.tum", _text("".join(f"{k} 1 2 3 0 0 0 1\n" for k in range(5)), "x.tum"), read_rows),
        "trace": Reader("x.csv", _text(POSES, "x.csv"), read_trace),
        "table of frames": Reader("frames.csv", _make_session, lambda p: open_session(p.parent)),
        "region": Reader("roi.toml", _make_session, lambda p: open_session(p.parent)),
        "picture": Reader("cam_0/1.png", _make_session, lambda p: _whole_session(p.parent.parent)),
        "recording": Reader("x.mcap", _make_recording, _whole_session),
        "PLY": Reader("x.ply", make_ply, read_mesh),
        "binary PLY": Reader("x.ply", make_binary_ply, read_mesh),
        "STL": Reader("x.stl", make_stl, read_mesh),
        "binary STL": Reader("x.stl", make_binary_stl, read_mesh),
        "OBJ": Reader("x.obj", make_obj, read_mesh),
        "scan to plan on": Reader("x.ply", make_skin, skin),
        "settings of a network": Reader("wound.toml", _make_model, _model),
        "network": Reader("wound.onnx", _make_model, _model),
        "shape model": Reader("shape.toml", _make_shape, _shape_model),
    }
    found |= {name: Reader(*entry) for name, entry in FOLDERS.items()}
    for name, each in formats().items():
        file = "cam_0.yaml" if each.folder else f"x{SUFFIX[name]}"
        found[f"rig of {name}"] = Reader(file, _exported(name, "." if each.folder else file), each.read)
    return found


SUFFIX = {"kalibr": ".yaml", "anipose": ".toml"}


def _exported(name: str, file: str) -> Callable[[Path], None]:
    return lambda folder: formats()[name].write(folder / file, arc_rig())
