"""A synthetic session with exactly known truth: a patch of skin with a wound that moves before three cameras.

`frame_sets(Scene(), rig(), breathing, stamps, rng)` gives pictures, `tracks(seed=1)` gives observations, and
`write_session(folder)` a session folder; `python -m tests.synthetic FOLDER --seconds 4` does the last from a shell.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.observations import Observations
from estimation.rig import Camera, Rig, ideal_pixels, pixels_from_points
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.folder_tables import write_frames, write_roi
from hardware.images import encode
from hardware.ply_file import write_ply
from hardware.progress import Progress, Report, silent
from hardware.rig_file import ImageSource, write_rig
from hardware.session import FrameRef
from hardware.tum import write_tum
from perception.frames import Frame, FrameSet, Image, Roi
from tests.scene import TARGET, Scene, patch_points, render_one

Motion = Callable[[float], Array]  # stamp, s -> base_from_surface (4, 4), mm

ANGLES = (0.0, 36.0, 84.0)  # degrees about the patch, thesis Fig. 4.3
TILT = np.deg2rad(-38.0)  # of the patch, so that its normal stands amid the cameras and none of them grazes it
REST = se3.make(se3.exp_rotation([TILT, 0.0, 0.0]), TARGET)  # base_from_surface
SCAN_FROM_SURFACE = se3.make(se3.exp_rotation([0.3, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame


def rig(
    angles: Sequence[float] = ANGLES,
    distance: float = 400.0,
    focal: float = 1100.0,
    size: tuple[int, int] = (1280, 720),
    distortion: Sequence[float] = (-0.12, 0.06, 6e-4, -4e-4, 0.0),
) -> Rig:
    """Cameras on an arc about TARGET, `angles` in degrees from straight above, `distance` mm away, focal in px."""
    cameras = []
    for i, angle in enumerate(np.deg2rad(angles)):
        out = np.array([0.0, np.sin(angle), np.cos(angle)])  # from the patch to the camera
        right = np.array([1.0, 0.0, 0.0])
        rotation = np.stack([right, np.cross(-out, right), -out], axis=1)
        centre = np.array(
            [[focal * (1 + 0.01 * i), 0, size[0] / 2 - 3 + 5 * i], [0, focal, size[1] / 2 + 4 - 3 * i], [0, 0, 1]]
        )
        pose = se3.make(rotation, TARGET + distance * out)
        cameras.append(Camera(f"cam_{i}", size, centre, np.array(distortion, float), pose))
    return Rig(tuple(cameras))


def still(stamp: float) -> Array:
    """A motion: none."""
    return REST


def breathing(
    stamp: float, amplitude: float = 4.0, turn: float = 0.03, drift: float = 0.05, rate: float = 0.25
) -> Array:
    """A motion: breathing of `amplitude` mm along the normal and `turn` rad at `rate` Hz, and a slow drift, mm/s."""
    phase = 2 * np.pi * rate * stamp
    rise = 0.5 * (1 - np.cos(phase)) + 0.1 * np.sin(2 * phase)
    w = turn * np.array([rise, 0.5 * np.sin(phase), 0.2 * np.sin(0.7 * phase)])
    v = np.array([0.12 * amplitude * np.sin(phase) + drift * stamp, 0.25 * amplitude * rise, amplitude * rise])
    return REST @ se3.make(se3.exp_rotation(w), v)


def render(scene: Scene, rig: Rig, base_from_surface: Array, rng: np.random.Generator) -> list[Image]:
    """The cameras' images of one instant, in the rig's order."""
    return [scene.add_grain(render_one(scene, camera, base_from_surface), rng) for camera in rig.cameras]


def frame_sets(
    scene: Scene, rig: Rig, motion: Motion, stamps: Iterable[float], rng: np.random.Generator
) -> Iterator[FrameSet]:
    """Frame sets of all cameras at `stamps`, s, each rendered when it is asked for."""
    for stamp in stamps:
        images = render(scene, rig, motion(float(stamp)), rng)
        yield FrameSet(float(stamp), tuple(Frame(c, float(stamp), image) for c, image in enumerate(images)))


def rois(scene: Scene, rig: Rig, base_from_surface: Array, stamp: float, part: float = 0.75) -> tuple[Roi, ...]:
    """Polygons around what each camera sees of the ellipse that fills the central `part` of the patch."""
    flat = scene.grid(2.0, part)
    flat = flat[np.linalg.norm(flat / (part * np.array(scene.size) / 2), axis=1) <= 1]
    points = se3.transform_points(base_from_surface, scene.points(flat))
    normals = scene.normals(flat) @ base_from_surface[:3, :3].T
    found = []
    for number, camera in enumerate(rig.cameras):
        facing = np.einsum("ni,ni->n", normals, camera.base_from_camera[:3, 3] - points) > 0
        pixels, depth = pixels_from_points(camera, points)
        seen = pixels[facing & (depth > 1)].astype(np.float32)
        if len(seen) >= 3:
            found.append(Roi(number, stamp, cv2.convexHull(seen).reshape(-1, 2).astype(float)))
    return tuple(found)


def trajectory(motion: Motion, stamps: Iterable[float]) -> Trajectory:
    """The motion at `stamps`, s."""
    times = np.array(list(stamps), float)
    return Trajectory(times, np.stack([motion(float(t)) for t in times]), exact=True)


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Observations of known landmarks. landmarks: (N, 3) mm, surface frame; a track's id is its landmark's number."""

    rig: Rig
    landmarks: Array
    truth: Trajectory
    observations: tuple[Observations, ...]


def observations(
    rig: Rig,
    landmarks: Array,
    base_from_surface: Array,
    stamp: float,
    rng: np.random.Generator,
    sigma: float = 0.3,
    outliers: float = 0.0,
    visible: NDArray[np.bool_] | None = None,
) -> Observations:
    """Where the cameras see landmarks (N, 3), surface frame: undistorted pixels with white noise of `sigma` px.

    outliers: the share of observations that stand up to 40 px anywhere else instead. visible: (C, N); by default
    whatever falls into a camera's image.
    """
    points = se3.transform_points(base_from_surface, landmarks)
    cameras, ids, pixels = [], [], []
    for number, camera in enumerate(rig.cameras):
        ideal, depth = ideal_pixels(camera, points)
        imaged, _ = pixels_from_points(camera, points)
        seen = (depth > 1) & (imaged > 0).all(1) & (imaged < np.array(camera.size) - 1).all(1)
        track = np.flatnonzero(seen if visible is None else seen & visible[number])
        noise = sigma * rng.standard_normal((len(track), 2))
        wrong = rng.random(len(track)) < outliers
        noise[wrong] = rng.uniform(-40, 40, (int(wrong.sum()), 2))
        cameras.append(np.full(len(track), number))
        ids.append(track)
        pixels.append(ideal[track] + noise)
    camera_of = np.concatenate(cameras)
    return Observations(stamp, camera_of, np.concatenate(ids), np.concatenate(pixels), np.full(len(camera_of), sigma))


def tracks(
    seconds: float = 4.0,
    rate: float = 30.0,
    count: int = 100,
    motion: Motion = breathing,
    sigma: float = 0.3,
    outliers: float = 0.0,
    seed: int = 0,
    size: tuple[float, float] = (60.0, 45.0),
    radius: float = 70.0,
) -> Tracks:
    """Trajectory, rig, landmarks, pixels and noise in one line: `count` landmarks at random on a patch."""
    rng = np.random.default_rng([seed, 11])
    flat = rng.uniform(-0.5, 0.5, (count, 2)) * size
    landmarks = patch_points(flat, radius)
    truth = trajectory(motion, np.arange(round(seconds * rate)) / rate)
    cameras = rig()
    poses = zip(truth.stamps, truth.base_from_surface, strict=True)
    seen = tuple(observations(cameras, landmarks, pose, float(t), rng, sigma, outliers) for t, pose in poses)
    return Tracks(cameras, landmarks, truth, seen)


def write_session(
    folder: str | Path,
    seconds: float = 4.0,
    rate: float = 30.0,
    seed: int = 0,
    motion: Motion = breathing,
    video: bool = True,
    scene: Scene | None = None,
    cameras: Rig | None = None,
    scan: bool = False,
    lossless: bool = False,
    progress: Report = silent,
) -> Trajectory:
    """Render a session into `folder`, in the plain container that a person could make by hand; returns its truth.

    video: one file per camera, Motion JPEG at quality 95 or FFV1 where `lossless`; else one PNG folder per camera.
    scan: also write surface.ply, in the scanner's own frame, which then is the surface frame of truth.tum.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scene, cameras = scene or Scene(seed), cameras or rig()
    stamps = np.arange(max(1, round(seconds * rate))) / rate
    truth = trajectory(motion, stamps)
    sources = [
        ImageSource("video", f"{c.name}.avi") if video else ImageSource("images", f"{c.name}/*.png")
        for c in cameras.cameras
    ]
    write_rig(folder / "rig.toml", cameras, sources)
    refs = [FrameRef(c, i, float(t), float(t)) for c in range(len(cameras)) for i, t in enumerate(stamps)]
    write_frames(folder / "frames.csv", cameras, refs)
    polygons = rois(scene, cameras, truth.base_from_surface[0], 0.0)
    write_roi(folder / "roi.toml", cameras, polygons, [0] * len(polygons))
    if scan:
        write_ply(folder / "surface.ply", *scan_of(scene))
        truth = Trajectory(truth.stamps, truth.base_from_surface @ se3.inverse(SCAN_FROM_SURFACE), exact=True)
    write_tum(folder / "truth.tum", truth)
    sinks = [_sink(folder, camera, rate, video, lossless) for camera in cameras.cameras]
    try:
        for done, frames in enumerate(frame_sets(scene, cameras, motion, stamps, np.random.default_rng([seed, 3]))):
            for sink, frame in zip(sinks, frames.frames, strict=True):
                sink.write(frame.image)
            progress(done + 1, len(stamps))
    finally:
        for sink in sinks:
            sink.release()
    return truth


def scan_of(scene: Scene, step: float = 1.0) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) mm in the scanner's frame and triangles (T, 3), seen anticlockwise from outside, of the patch."""
    flat = scene.grid(step)
    columns = int(np.flatnonzero(np.diff(flat[:, 1]))[0]) + 1
    corner = np.arange(len(flat)).reshape(-1, columns)
    a, b, c, d = (m.ravel() for m in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return se3.transform_points(SCAN_FROM_SURFACE, scene.points(flat)), triangles


class _PngFolder:
    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self._folder, self._count = folder, 0

    def write(self, image: Image) -> None:
        (self._folder / f"{self._count:05d}.png").write_bytes(encode(image)[1])
        self._count += 1

    def release(self) -> None:
        """Nothing is open."""


def _sink(folder: Path, camera: Camera, rate: float, video: bool, lossless: bool) -> _PngFolder | cv2.VideoWriter:
    if not video:
        return _PngFolder(folder / camera.name)
    path = str(folder / f"{camera.name}.avi")
    if lossless:
        writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), rate, camera.size)
    else:
        quality = [cv2.VIDEOWRITER_PROP_QUALITY, 95]  # only OpenCV's own writer heeds it
        writer = cv2.VideoWriter(
            path, cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), rate, camera.size, quality
        )
    assert writer.isOpened(), path
    return writer


def main() -> None:
    """Write a session into the folder named on the command line."""
    from hardware.clock import WallClock

    parser = argparse.ArgumentParser(description="Render a synthetic session with exactly known truth.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--rate", type=float, default=30.0, help="frames per second")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scan", action="store_true", help="also write surface.ply")
    parser.add_argument("--png", action="store_true", help="pictures instead of videos")
    a = parser.parse_args()
    progress = Progress("render", "frame sets", WallClock().now)
    write_session(a.folder, a.seconds, a.rate, a.seed, video=not a.png, scan=a.scan, progress=progress)
    progress.close()


if __name__ == "__main__":
    main()
