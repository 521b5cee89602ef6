"""Valid input for readers: files of several in a folder or that stillbed wrote itself, scans in every form, a video.

The video is made by hand: JPEGs in an AVI container (Microsoft, AVI RIFF File Reference), with its index.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.batch.smoothed import Instants
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.calibration.corners import read_corners, write_corners
from hardware.files.folder_tables import read_heads, write_heads
from hardware.files.images import encode
from hardware.files.mesh_file import STL_TRIANGLE, in_mm, read_raw_mesh
from hardware.files.ply_file import write_ply
from hardware.files.rig_file import ImageSource, write_rig
from hardware.files.session import PrintHeadLog
from hardware.offline.trajectory_files import read_pose_series, write_instants
from hardware.recording.session_reader import open_session
from perception.boards.corners import CornerTable
from planning.layers.repair import repair_mesh

HAS_INDEX, KEY_FRAME = 0x10, 0x10


def mjpeg_avi(pictures: Sequence[bytes], size: tuple[int, int], rate: int) -> bytes:
    """The file of pictures that are encoded as JPEG. size: W, H px. rate: frames per second."""
    most, (width, height), count = max(map(len, pictures)), size, len(pictures)
    usual = 1_000_000 // rate, most * rate, 0, HAS_INDEX, count, 0, 1, most, width, height, 0, 0, 0, 0
    stream = struct.pack(
        "<4s4sIHHIIIIIIiI4H", b"vids", b"MJPG", 0, 0, 0, 0, 1, rate, 0, count, most, -1, 0, 0, 0, *size
    )
    bitmap = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", 3 * width * height, 0, 0, 0, 0)
    strl = _list(b"strl", _chunk(b"strh", stream) + _chunk(b"strf", bitmap))
    chunks, entries, at = [], [], 4
    for picture in pictures:
        chunks.append(_chunk(b"00dc", picture))
        entries.append(struct.pack("<4sIII", b"00dc", KEY_FRAME, at, len(picture)))
        at += len(chunks[-1])
    header = _list(b"hdrl", _chunk(b"avih", struct.pack("<14I", *usual)) + strl)
    body = header + _list(b"movi", b"".join(chunks)) + _chunk(b"idx1", b"".join(entries))
    return _chunk(b"RIFF", b"AVI " + body)


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2)


def _list(name: bytes, data: bytes) -> bytes:
    return _chunk(b"LIST", name + data)


SMALL_SIZE, VIDEO_RATE = (48, 32), 30  # px, Hz
FRAME_COUNT = 3
CORNERS_KEY = "0123456789abcdef" * 4  # of the recording that corners were found in


def make_videos(folder: Path) -> None:
    """A session whose cameras' pictures are videos."""
    rig = arc_rig(size=SMALL_SIZE, focal=40)
    names = [camera.name for camera in rig.cameras]
    write_rig(folder / "rig.toml", rig, [ImageSource("video", f"{name}.avi") for name in names])
    lines = ["camera,frame,stamp_s"]
    for name in names:
        pictures = [encode(small_picture(k), 90)[1] for k in range(FRAME_COUNT)]
        (folder / f"{name}.avi").write_bytes(mjpeg_avi(pictures, SMALL_SIZE, VIDEO_RATE))
        lines += [f"{name},{k},{k / VIDEO_RATE!r}" for k in range(FRAME_COUNT)]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")


def whole_session(path: Path) -> object:
    """The session in the folder of `path`, its frame sets decoded."""
    return [frames.stamp for frames in open_session(path.parent).frame_sets()]


def make_heads(folder: Path) -> None:
    """head.csv."""
    rows = np.array([[k / VIDEO_RATE, 1.0, 2.0, 300.0 + k, 0, 0, 0, 1] for k in range(FRAME_COUNT)])
    write_heads(folder / "head.csv", PrintHeadLog(rows, np.array([False, True, True])))


def make_corners(folder: Path) -> None:
    """corners.npz of a camera calibration."""
    count, whole = 4, np.zeros(2, np.int64)
    pixels = np.random.default_rng(1).uniform(0, 48, (2, count, 2))
    ones, instants = np.ones(2), np.arange(2)
    told = CornerTable(whole, instants, instants / VIDEO_RATE, pixels, ones, ones, ones, whole, whole[:0], 2)
    write_corners(folder / "corners.npz", CORNERS_KEY, told)


def corners(path: Path) -> object:
    """The corners in a file; whatever else it holds is as if there were none."""
    return read_corners(path, CORNERS_KEY)


def make_smoothed(folder: Path) -> None:
    """smoothed.csv."""
    stamps = np.arange(FRAME_COUNT) / VIDEO_RATE
    spread = np.broadcast_to(np.eye(6) * 1e-4, (FRAME_COUNT, 6, 6))
    poses = BASE_FROM_REST @ se3.exp(np.outer(stamps, [0.1, 0, 0, 0, 0, 1.0]))
    write_instants(folder / "smoothed.csv", Instants(stamps, poses, spread, np.zeros((FRAME_COUNT, 6)), spread))


def trajectory(path: Path) -> object:
    """The trajectory in a file, as `stillbed compare` reads it."""
    return read_pose_series(str(path))


def make_trajectory(folder: Path) -> None:
    """Rows of stamp, place and quaternion with commas."""
    (folder / "x.csv").write_text("".join(f"{k / VIDEO_RATE},1,2,{300 + k},0,0,0,1\n" for k in range(FRAME_COUNT)))


def small_picture(number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Noise (H, W, 3) that follows from the number."""
    return np.random.default_rng(number).integers(0, 256, (SMALL_SIZE[1], SMALL_SIZE[0], 3), np.uint8)


Entry = tuple[str, Callable[[Path], None], Callable[[Path], object]]
FOLDER_READERS: dict[str, Entry] = {  # the file that is struck, who makes it, who reads it
    "video": ("cam_0.avi", make_videos, whole_session),
    "print head": ("head.csv", make_heads, read_heads),
    "corners": ("corners.npz", make_corners, corners),
    "smoothed": ("smoothed.csv", make_smoothed, trajectory),
    "trajectory": ("x.csv", make_trajectory, trajectory),
}


SCAN_VERTICES = np.array([[0.0, 0, 0], [20, 0, 1], [20, 20, 0], [0, 20, 2], [10, 10, 3]])
SCAN_TRIANGLES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
SKIN_STEPS = 6  # of the scan that is planned on: more than its repair's fewest triangles


def make_ply(folder: Path) -> None:
    """x.ply, in text."""
    write_ply(folder / "x.ply", SCAN_VERTICES, SCAN_TRIANGLES)


def make_binary_ply(folder: Path) -> None:
    """x.ply, big-endian, with a colour, and with a polygon of four corners among the triangles."""
    head = f"""ply
format binary_big_endian 1.0
element vertex {len(SCAN_VERTICES)}
property float x
property float y
property float z
property uchar red
element face {len(SCAN_TRIANGLES) + 1}
property list uchar uint vertex_indices
end_header
"""
    body = b"".join(np.array(place, ">f4").tobytes() + b"\x7f" for place in SCAN_VERTICES)
    faces = b"".join(bytes([len(face)]) + np.array(face, ">u4").tobytes() for face in [*SCAN_TRIANGLES, [0, 3, 2, 1]])
    (folder / "x.ply").write_bytes(head.encode() + body + faces)


def make_stl(folder: Path) -> None:
    """x.stl, in text."""
    corner = "vertex 0 0 0\nvertex 20 0 0\nvertex 0 20 0\n"
    facet = f"facet normal 0 0 1\nouter loop\n{corner}endloop\nendfacet\n"
    (folder / "x.stl").write_text(f"solid x\n{facet}{facet.replace('20', '30')}endsolid x\n")


def make_binary_stl(folder: Path) -> None:
    """x.stl, binary."""
    table = np.zeros(len(SCAN_TRIANGLES), STL_TRIANGLE)
    table["corners"] = SCAN_VERTICES[SCAN_TRIANGLES]
    (folder / "x.stl").write_bytes(bytes(80) + np.uint32(len(table)).tobytes() + table.tobytes())


def make_obj(folder: Path) -> None:
    """x.obj."""
    (folder / "x.obj").write_text("v 0 0 0\nv 20 0 0\nv 0 20 0\nv 20 20 1\nvn 0 0 1\nf 1 2 3\nf 2//1 4//1 -2//1\n")


def make_skin(folder: Path) -> None:
    """x.ply: a curved square with enough triangles to be planned on."""
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(0, 60, SKIN_STEPS)]))
    corner = (np.arange(SKIN_STEPS - 1)[:, None] * SKIN_STEPS + np.arange(SKIN_STEPS - 1)).ravel()
    low = np.column_stack([corner, corner + 1, corner + SKIN_STEPS])
    high = np.column_stack([corner + 1, corner + SKIN_STEPS + 1, corner + SKIN_STEPS])
    write_ply(folder / "x.ply", np.column_stack([x, y, 3 + x * y / 1000]), np.concatenate([low, high]))


def skin(path: Path) -> object:
    """A scan as `stillbed plan` reads it: its unit checked, and repaired."""
    raw = read_raw_mesh(path)
    return repair_mesh(in_mm(raw.vertices, raw.triangles, "mm", path), raw.triangles, path)
