"""`stillbed bench fuzz`: every reader of what comes from outside, given inputs that are valid but for a few places.

A reader may take an input or refuse it with one of our own errors. Anything else counts: another exception, more than
`MAX_SECONDS` of processor time, more than `MAX_MEMORY` of memory, the end of the process. What made it so is kept.
`--log` keeps how far each reader is, and what went wrong; a run goes on from there.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import (
    FRAME_LENGTH,
    FRAME_TAILS,
    G1,
    REPLY_LENGTH,
    REPLY_TAILS,
    THESIS_DIALECT,
    FrameStream,
    Reply,
    ReplyKind,
    decode,
    decode_reply,
    encode_reply,
)
from hardware.arm.protocol import encode as frame_of
from hardware.bench.campaigns.fuzz_inputs import (
    FOLDER_READERS,
    FRAME_COUNT,
    SMALL_SIZE,
    make_binary_ply,
    make_binary_stl,
    make_obj,
    make_ply,
    make_skin,
    make_stl,
    skin,
    small_picture,
)
from hardware.bench.campaigns.fuzz_process import Block, Reader, Task, append_log, read_log, run_tasks
from hardware.bench.figures import Figure, at_most, require_positive
from hardware.calibration.rig_formats import FORMATS
from hardware.files.arm_file import read_arm, write_arm
from hardware.files.folder_tables import read_rows
from hardware.files.images import encode
from hardware.files.mesh_file import read_mesh
from hardware.files.path_file import read_contour, read_path, read_progress, write_progress_durably
from hardware.files.pose_file import PoseWriter, read_poses
from hardware.files.rig_file import ImageSource, read_board, read_rig, write_board, write_rig
from hardware.live.prepared import SurfacePlacement, read_placement, write_placement
from hardware.live.settings import read_settings, settings_text
from hardware.operator.broadcast import parse_message
from hardware.process.clock import WallClock
from hardware.process.faults import fault_from_text
from hardware.process.progress import Progress
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import open_session
from hardware.simulator.arm.settings import ArmSettings, read_virtual_arm, write_virtual_arm
from hardware.simulator.scenario import read_scenario
from hardware.simulator.trace_file import read_trace
from perception.boards.board import Board
from perception.frames import Frame
from perception.tracking.step import STAGES, report_without_offsets
from perception.wound.network import WoundNetwork, shipped_model
from perception.wound.shape_matching import read_shape_model
from planning.progress import fingerprint

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
PAGE_MESSAGE = b'{"ask": "pause", "turn": 3, "tag": 5}'


def _text(text: str | bytes, name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)

    return make


def _frames(path: Path) -> object:
    return FrameStream(FRAME_LENGTH, FRAME_TAILS, decode)(path.read_bytes())


def _replies(path: Path) -> object:
    return FrameStream(REPLY_LENGTH, REPLY_TAILS, decode_reply)(path.read_bytes())


def _whole_session(path: Path) -> object:
    return [frames.stamp for frames in open_session(path).frame_sets()]


def _make_session(folder: Path) -> None:
    rig = arc_rig(size=SMALL_SIZE, focal=40)
    names = [camera.name for camera in rig.cameras]
    write_rig(folder / "rig.toml", rig, [ImageSource("images", f"{name}/*.png") for name in names])
    lines = ["camera,frame,stamp_s"]
    for name in names:
        (folder / name).mkdir()
        for k in range(FRAME_COUNT):
            (folder / name / f"{k}.png").write_bytes(encode(small_picture(k))[1])
            lines.append(f"{name},{k},{k / 30!r}")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    region = f'camera = "{names[0]}"\nframe = 1\npolygon = [[1, 2], [40, 3], [20, 30]]'
    (folder / "roi.toml").write_text(f"[[roi]]\n{region}\n")
    rows = [f"{k / 30} 1 2 {300 + k} 0 0 0 1" for k in range(FRAME_COUNT)]
    (folder / "truth.tum").write_text("\n".join(rows) + "\n")


def _make_recording(folder: Path) -> None:
    rig = arc_rig(size=SMALL_SIZE, focal=40)
    with Recorder(folder / "x.mcap", rig) as recorder:
        for k in range(FRAME_COUNT):
            for camera in range(len(rig)):
                recorder.frame(Frame(camera, k / 30, small_picture(k)))
            recorder.event(k / 30, "something", 1)


def _make_scenario(folder: Path) -> None:
    (folder / "path.csv").write_text(PATH_TEXT)
    (folder / "x.toml").write_text(SCENARIO_TEXT)


def _make_progress(folder: Path) -> None:
    (folder / "path.csv").write_text(PATH_TEXT)
    write_progress_durably(folder / "x.toml", fingerprint(read_path(folder / "path.csv")), 1.25)


def _make_found(folder: Path) -> None:
    (folder / "x.mcap").write_bytes(b"")
    write_placement(
        folder / "x.toml", SurfacePlacement(folder / "x.mcap", 1.0, se3.inverse(BASE_FROM_REST), BASE_FROM_REST)
    )


def _make_poses(folder: Path) -> None:
    with PoseWriter(folder, ["a", "b"], STAGES) as writer:
        for k in range(FRAME_COUNT):
            pose = SurfacePose(k / 30, BASE_FROM_REST, np.eye(6) * 1e-4, np.zeros(6), TrackState.TRACKING)
            report = report_without_offsets(no_observations(k / 30), np.zeros(2, np.int64), np.zeros(len(STAGES)))
            writer.write(pose, 2, report, 0.01)


def _make_model(folder: Path) -> None:
    """What its settings take for the network: anything else is refused by its hash before anybody looks at it."""
    data = bytes(range(256)) * 4
    (folder / "wound.onnx").write_bytes(data)
    settings = shipped_model(suffix=".toml").read_text(encoding="utf-8")
    digest = hashlib.sha256(data).hexdigest()
    (folder / "wound.toml").write_text(re.sub(r'sha256 = ".*"', f'sha256 = "{digest}"', settings), encoding="utf-8")


def _model(path: Path) -> object:
    return WoundNetwork(path.with_suffix(".onnx"), threads=1)


def _make_shape(folder: Path) -> None:
    shutil.copyfile(shipped_model("shape", ".toml"), folder / "shape.toml")


def readers() -> dict[str, Reader]:
    """All of them by name."""
    move = frame_of(G1(np.array([202.5, 225, 113, 0, 0.1, 0]), 5.0), THESIS_DIALECT) * 4
    answer = encode_reply(Reply(ReplyKind.PLACE, np.array([1.0, 2, 3]))) * 6
    found = {
        "frames of the arm": Reader("x.bin", _text(move, "x.bin"), _frames),
        "answers of the arm": Reader("x.bin", _text(answer, "x.bin"), _replies),
        "messages of the page": Reader(
            "x.json", _text(PAGE_MESSAGE, "x.json"), lambda p: parse_message(p.read_bytes().decode("utf-8", "replace"))
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
        "path": Reader("x.csv", _text(PATH_TEXT, "x.csv"), read_path),
        "contour": Reader("x.csv", _text("x_mm,y_mm\n0,0\n10,0\n10,8\n0,8\n", "x.csv"), read_contour),
        "progress": Reader("x.toml", _make_progress, lambda p: read_progress(p, read_path(p.with_name("path.csv")))),
        "surface": Reader("x.toml", _make_found, read_placement),
        "board": Reader("x.toml", lambda f: write_board(f / "x.toml", Board()), read_board),
        "poses": Reader("poses.csv", _make_poses, read_poses),
        "TUM": Reader("x.tum", _text("".join(f"{k} 1 2 3 0 0 0 1\n" for k in range(5)), "x.tum"), read_rows),
        "trace": Reader("x.csv", _text(TRACE_TEXT, "x.csv"), read_trace),
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
        "shape model": Reader("shape.toml", _make_shape, read_shape_model),
    }
    found |= {name: Reader(*entry) for name, entry in FOLDER_READERS.items()}
    for name, each in FORMATS.items():
        file = "cam_0.yaml" if each.folder else f"x{FORMAT_SUFFIX[name]}"
        found[f"rig of {name}"] = Reader(file, _exported(name, "." if each.folder else file), each.read)
    return found


FORMAT_SUFFIX = {"kalibr": ".yaml", "anipose": ".toml"}


def _exported(name: str, file: str) -> Callable[[Path], None]:
    return lambda folder: FORMATS[name].write(folder / file, arc_rig())


MAX_KEPT = 5  # inputs of each reader that are kept; the others can be made again from their seed and number


@dataclass(slots=True)
class ReaderSum:
    """What came of one reader so far."""

    count: int = 0
    refused: int = 0
    seconds: float = 0.0
    wrong: int = 0

    def add(self, block: Block) -> None:
        """Count a block."""
        self.count += block.count
        self.refused += block.refused
        self.seconds += block.seconds
        self.wrong += bool(block.wrong)


def run_fuzz(options: argparse.Namespace) -> list[Figure]:
    """Fuzz the readers, in processes of their own, and say what they did."""
    names = list(readers())
    if options.only is not None and options.only not in names:
        raise InputError("command line", "--only", options.only, f"one of {', '.join(names)}")
    require_positive(options, "count", "jobs")
    sums = {name: ReaderSum() for name in names if options.only in (None, name)}
    if options.log is not None and options.log.exists():
        for block in read_log(options.log, options.seed):
            if block.name in sums:
                sums[block.name].add(block)
                _tell(block, "")
    share = -(-options.count // len(sums))
    _go_on(options, sums, [Task(name, range(done.count, share)) for name, done in sums.items() if done.count < share])
    for name, done in sums.items():
        each = 1e6 * done.seconds / max(done.count, 1)
        print(f"{name:<24}{done.count:>9}  refused {done.refused:>9}  wrong {done.wrong:>3}  {each:>7.0f} us each")
    return fuzz_figures(list(sums.values()))


def _go_on(options: argparse.Namespace, sums: dict[str, ReaderSum], tasks: list[Task]) -> None:
    """Do the tasks; whatever goes wrong is said, kept and logged when it does."""
    done, total = 0, sum(len(task.numbers) for task in tasks)
    with Progress("fuzz", "inputs", WallClock().now) as progress:
        for block in run_tasks(tasks, options.seed, options.jobs, readers):
            sums[block.name].add(block)
            if options.log is not None:
                append_log(options.log, options.seed, block)
            if block.wrong:
                progress.close()
                keep = options.out is not None and sums[block.name].wrong <= MAX_KEPT
                _tell(block, _kept(options.out, block) if keep else "")
            done += block.count
            progress(done, total)


def _tell(block: Block, kept: str) -> None:
    if block.wrong:
        print(f"{block.name}, input {block.number}: {block.wrong}{kept}", flush=True)


def _kept(out: Path, block: Block) -> str:
    """Where an input that went wrong is kept, in words."""
    file = out / f"{block.name.replace(' ', '_')}_{block.number}.bin"
    file.write_bytes(block.case)
    return f"; kept as {file}"


def fuzz_figures(sums: Sequence[ReaderSum]) -> list[Figure]:
    """The figures of all readers."""
    count, refused = sum(each.count for each in sums), sum(each.refused for each in sums)
    seconds, least = sum(each.seconds for each in sums), min(each.count for each in sums)
    note = f"of {len(sums)} readers, {least} or more each; {refused} refused with one error"
    return [
        Figure("inputs", count, "", None, "", note),
        Figure("inputs that went wrong", sum(each.wrong for each in sums), "", at_most(0)),
        Figure("processor time of an input", 1e6 * seconds / max(count, 1), "us"),
    ]
