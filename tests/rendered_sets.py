"""What tests of perception look at: the simulator's pictures of a small patch, with exactly known truth.

`frame_sets(patch(), arc_rig(), breathing, stamps, rng)` gives pictures, `write_session(folder)` a session folder.
Tracks without pictures are those of `estimation.synthetic`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import Trajectory
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.files.folder_tables import SessionFolderWriter
from hardware.files.images import encode
from hardware.files.mesh_file import write_ply
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import render
from hardware.simulator.scene.scene import Scene, WorldState, rois
from hardware.simulator.scene.shape import Wound, cylinder, flat, with_wound
from perception.frames import Frame, FrameSet, Image

Motion = Callable[[float], Array]  # stamp, s -> base_from_surface (4, 4), mm

RADIUS = 70.0  # mm, of a bent patch
LOOK = Appearance(texel=0.2, wetness=0.3, drape=False)  # a finer texture only costs time: a pixel is 0.36 mm or more
WOUND, WIDE = Wound((26.0, 18.0)), Wound((70.0, 54.0))  # the second fills a patch: all of it has strong texture
NOISY = Sensor()
CLEAN = Sensor(noise=0.0, blur=0.0)
AWAY = BASE_FROM_REST @ se3.make(np.eye(3), [5000.0, 0.0, 0.0])  # base_from_surface, out of every camera's view
SCAN_FROM_SURFACE = se3.make(se3.exp_rotation([0.3, -0.2, 0.6]), [12.0, -7.0, 31.0])  # a scanner has its own frame


def patch(
    seed: int = 0,
    size: tuple[float, float] = (80.0, 60.0),
    radius: float = RADIUS,
    wound: Wound = WOUND,
    look: Appearance = LOOK,
) -> Scene:
    """A patch of skin with a wound drawn on it, bent about its x axis to `radius` mm (inf: flat)."""
    shape = flat(size) if np.isinf(radius) else cylinder(size, radius)
    return Scene(with_wound(shape, wound, seed), look, seed=seed)


def still(stamp: float) -> Array:
    """A motion: none."""
    return BASE_FROM_REST


def breathing(
    stamp: float, amplitude: float = 4.0, turn: float = 0.03, drift: float = 0.05, rate: float = 0.25
) -> Array:
    """A motion: breathing of `amplitude` mm along the normal and `turn` rad at `rate` Hz, and a slow drift, mm/s."""
    phase = 2 * np.pi * rate * stamp
    rise = 0.5 * (1 - np.cos(phase)) + 0.1 * np.sin(2 * phase)
    w = turn * np.array([rise, 0.5 * np.sin(phase), 0.2 * np.sin(0.7 * phase)])
    v = np.array([0.12 * amplitude * np.sin(phase) + drift * stamp, 0.25 * amplitude * rise, amplitude * rise])
    return BASE_FROM_REST @ se3.make(se3.exp_rotation(w), v)


def pictures(
    scene: Scene, cameras: Sequence[Camera], base_from_surface: Array, rng: np.random.Generator, sensor: Sensor = NOISY
) -> list[Image]:
    """The cameras' sharp images of one instant, in their order."""
    instant = WorldState(0.0, 0.0, base_from_surface, np.zeros(6))
    return render(scene, cameras, [instant] * len(cameras), sensor, rng.spawn(len(cameras)))


def frame_sets(
    scene: Scene, rig: Rig, motion: Motion, stamps: Iterable[float], rng: np.random.Generator
) -> Iterator[FrameSet]:
    """Frame sets of all cameras at `stamps`, s, each rendered when it is asked for."""
    for stamp in stamps:
        images = pictures(scene, rig.cameras, motion(float(stamp)), rng)
        yield FrameSet(float(stamp), tuple(Frame(c, float(stamp), image) for c, image in enumerate(images)))


def trajectory(motion: Motion, stamps: Iterable[float]) -> Trajectory:
    """The motion at `stamps`, s."""
    times = np.array(list(stamps), float)
    return Trajectory(times, np.stack([motion(float(t)) for t in times]), exact=True)


def write_session(
    folder: Path,
    seconds: float = 4.0,
    rate: float = 30.0,
    seed: int = 0,
    motion: Motion = breathing,
    quality: int | None = 95,
    cameras: Rig | None = None,
    scan: bool = False,
) -> Trajectory:
    """Render a session of patch(seed) into `folder`; returns its truth.

    quality: of JPEG, 0-100; None: PNG, which keeps every pixel.
    scan: also write surface.ply, in the scanner's own frame, which then is the surface frame of truth.tum.
    """
    scene, cameras = patch(seed), cameras or arc_rig()
    stamps = np.arange(max(1, round(seconds * rate))) / rate
    truth = trajectory(motion, stamps)
    sets = frame_sets(scene, cameras, motion, stamps, np.random.default_rng([seed, 3]))
    polygons = rois(scene, cameras, truth.base_from_surface[0], 0.0)
    if scan:
        truth = Trajectory(truth.stamps, truth.base_from_surface @ se3.inverse(SCAN_FROM_SURFACE), exact=True)
    with SessionFolderWriter(folder, cameras, polygons) as session:
        session.truth(truth)
        for frames in sets:
            for frame in frames.frames:
                session.picture(frame.camera, frame.stamp, *encode(frame.image, quality))
    if scan:
        write_ply(folder / "surface.ply", *scan_of(scene))
    return truth


def scan_of(scene: Scene, step: float = 1.0) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) mm in the scanner's frame and triangles (T, 3), seen anticlockwise from outside, of the patch."""
    vertices, triangles = scene.shape.mesh(step)
    return se3.transform_points(SCAN_FROM_SURFACE, vertices), triangles
