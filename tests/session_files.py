"""A small made-up session as a folder, and the ways to change one thing in it."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from estimation import se3
from estimation.pose import Trajectory
from estimation.rig import Camera, Rig
from hardware.files.folder_tables import write_tum
from hardware.files.rig_file import ImageSource, write_rig
from perception.frames import Image

SIZE = (64, 48)
NAMES = ("left", "top", "right")
PERIOD = 1 / 30
SURFACE = b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"


def camera(name: str, place: int, offset: float = 0.0) -> Camera:
    """A camera 60 mm beside the one before, looking along z."""
    base_from_camera = se3.make(se3.exp_rotation([0.1 * place, 0.2, 0.03]), [60.0 * place, 1.0 / 3.0, -2.0])
    matrix = np.array([[70.1, 0.0, 31.7], [0.0, 70.3, 24.2], [0.0, 0.0, 1.0]])
    return Camera(name, SIZE, matrix, np.array([-0.1, 0.01, 1e-4, -2e-4, 0.0]), base_from_camera, offset)


def rig(cameras: int = 3, offset: float = 0.0) -> Rig:
    """A rig of up to three cameras; the last one's clock is `offset` s late."""
    return Rig(tuple(camera(NAMES[i], i, offset if i == cameras - 1 else 0.0) for i in range(cameras)))


def image(camera: int, number: int) -> Image:
    """An image (48, 64, 3) that no other camera and number has."""
    return np.random.default_rng(1000 * camera + number).integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8)


def stamps(count: int, start: float = -0.1) -> list[float]:
    """Stamps, s, with digits that no decimal holds."""
    return [start + PERIOD * k + 1e-4 * math.sin(k) for k in range(count)]


def trajectory(count: int, exact: bool) -> Trajectory:
    """A turning and rising surface."""
    t = np.array(stamps(count))
    xi = np.stack([t, 0.3 * t, -t, 5 * t, t, 10 * t], axis=-1)
    return Trajectory(t, se3.make(se3.exp_rotation([2.0, 0.4, -0.3]), [1.0, 2.0, 300.0]) @ se3.exp(xi), exact)


def write_video(path: Path, camera: int, count: int) -> None:
    """A lossless video of `image(camera, 0..count-1)`."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 30.0, SIZE)
    assert writer.isOpened()
    for number in range(count):
        writer.write(image(camera, number))
    writer.release()


def make_folder(folder: Path, count: int = 6, cameras: int = 2, pictures: bool = False, offset: float = 0.0) -> Path:
    """A whole session folder: videos (or PNG pictures), stamps, polygons, truth and scan."""
    folder.mkdir(parents=True)
    names = NAMES[:cameras]
    for number, name in enumerate(names):
        if pictures:
            (folder / name).mkdir()
            for k in range(count):
                assert cv2.imwrite(str(folder / name / f"{k}.png"), image(number, k))
        else:
            write_video(folder / f"{name}.avi", number, count)
    sources = [ImageSource("images", f"{n}/*.png") if pictures else ImageSource("video", f"{n}.avi") for n in names]
    write_rig(folder / "rig.toml", rig(cameras, offset), sources)
    lines = [f"{name},{k},{stamp!r}" for name in names for k, stamp in enumerate(stamps(count))]
    (folder / "frames.csv").write_text("camera,frame,stamp_s\n" + "\n".join(lines) + "\n")
    roi = '[[roi]]\ncamera = "left"\nframe = 1\npolygon = [[-3.5, 2], [40.25, 3], [20.0, 44.1]]\n'
    (folder / "roi.toml").write_text(roi)
    write_tum(folder / "truth.tum", trajectory(count, True))
    (folder / "surface.ply").write_bytes(SURFACE)
    return folder


def change(path: Path, old: str, new: str) -> None:
    """Replace the first `old` in a text file; it must be there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
