"""A virtual arm before simulated cameras, all of it known exactly, to test a calibration of the arm.

The arm is served on a pseudo-terminal in real time, or in virtual time; either way its position at each instant is
known afterwards, and the pictures that the cameras took meanwhile are rendered then.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.arm.profile import ArmProfile, placed
from hardware.files.folder_tables import SessionFolderWriter
from hardware.files.images import encode
from hardware.process.clock import Clock, WatchedClock
from hardware.process.progress import ProgressReport
from hardware.simulator.arm.controller import VirtualArm
from hardware.simulator.arm.ports import run_virtual_arm
from hardware.simulator.arm.settings import ArmSettings
from hardware.simulator.camera_pipeline import NOISE_STREAM
from hardware.simulator.cameras import CameraSettings, Shot, SimulatedCameras
from hardware.simulator.scene.appearance import Appearance, Sensor
from hardware.simulator.scene.render import StillScene
from hardware.simulator.scene.scene import Scene, WorldState
from hardware.simulator.scene.shape import cylinder
from perception.lens import undistort
from planning.kinematics import SimpleArm, nozzle_from_axes

DEAD_TIME_RANGE, LAG_RANGE = (0.005, 0.025), (0.012, 0.03)  # s between which the virtual arm's own are drawn
PLACEMENT_SIGMA = np.array([0.02] * 3 + [4.0] * 3)  # rad and mm, from where its file says that it stands
TOOL_SIGMA = 1.5  # mm, likewise of the tip
PICTURE_RATE = 12.0  # a second; one in KEPT_EVERY is rendered, as that takes long, but all at high acceleration
KEPT_EVERY, MIN_ACCELERATION = 3, 300.0  # mm/s^2: what tells dead time from lag
ACCELERATION_SPAN = 0.02  # s on both sides between which that is measured
OPEN_TIMEOUT = 5.0  # s that a pseudo-terminal may take to appear
LOSSLESS = None  # no JPEG: a needle two pixels wide is seen by its colour, which JPEG stores at half the resolution


@dataclass(frozen=True, slots=True, eq=False)
class WatchedArm:
    """A virtual arm and its cameras."""

    rig: Rig  # as it is
    profile: ArmProfile  # the arm as its file says
    true: SimpleArm  # the arm as it is
    settings: ArmSettings  # of the controller
    cameras: CameraSettings
    begin: Array  # (6,) where it stands first
    seed: int


def watched_arm(seed: int) -> WatchedArm:
    """An arm before the cameras, with its own placement, tool and timing errors for each seed."""
    rng = np.random.default_rng([seed, 89])
    rig, profile = arc_rig(), placed(ArmProfile(), BASE_FROM_REST)
    placement_error = se3.exp(rng.normal(size=6) * PLACEMENT_SIGMA)
    tool = rng.normal(size=3) * TOOL_SIGMA
    true = replace(profile.arm, arm_from_base=profile.arm.arm_from_base @ placement_error, tool_offset=tool)
    settings = ArmSettings(dead_time=float(rng.uniform(*DEAD_TIME_RANGE)), servo_lag=float(rng.uniform(*LAG_RANGE)))
    phases = tuple(float(v) for v in rng.uniform(0, 0.01, len(rig)))
    cameras = CameraSettings(phases, (0.0,) * len(rig), fps=PICTURE_RATE)
    return WatchedArm(rig, profile, true, settings, cameras, profile.arm.home - [0, 0, 3.0, 0, 0, 0], seed)


@dataclass(slots=True)
class ServedArm:
    """A virtual arm on a pseudo-terminal."""

    device: str  # its name
    arm: VirtualArm | None = None  # once it is served no more
    begun: float = 0.0  # s, its time 0 by the clock, likewise


@contextmanager
def serve_arm(watched: WatchedArm, link: Path, clock: Clock) -> Iterator[ServedArm]:
    """Serve the arm on a pseudo-terminal at `link`, in a thread, until the context ends."""
    stop, since, result = threading.Event(), WatchedClock(clock), ServedArm(str(link))
    standing = replace(watched.profile, arm=replace(watched.profile.arm, home=watched.begin))

    failures: list[BaseException] = []

    def serve() -> None:
        try:
            result.arm = run_virtual_arm(watched.settings, standing, (), link, None, since, stop, lambda text: None)
        except BaseException as error:  # raised where the context ends
            failures.append(error)

    thread = threading.Thread(target=serve, name="virtual arm", daemon=True)
    thread.start()
    end = clock.now() + OPEN_TIMEOUT
    while not link.exists() and clock.now() < end and thread.is_alive():
        clock.wait_until(clock.now() + 0.01)
    try:
        yield result
    finally:
        stop.set()
        thread.join()
        result.begun = since.begun or 0.0
        if failures:
            raise failures[0]


def take_pictures(
    watched: WatchedArm, arm: VirtualArm, begun: float, span: tuple[float, float], folder: Path, report: ProgressReport
) -> None:
    """Write the session folder of what the cameras saw of the arm from one instant to another, s, by the clock.

    begun: the arm's time 0 by the clock.
    """
    scene = Scene(cylinder((80.0, 60.0), 80.0), Appearance(texel=0.3, drape=False), seed=watched.seed)
    exposure, sensor = watched.cameras.exposure, Sensor()
    still_scene = StillScene(scene, watched.rig.cameras, WorldState(0.0, exposure, BASE_FROM_REST, np.zeros(6)))
    cameras = SimulatedCameras(watched.cameras, watched.seed)
    until = min(span[1] - begun, arm.now)
    streams = [cameras.shots(c, until) for c in range(len(watched.rig))]
    rounds = [shots for shots in zip(*streams, strict=False) if shots[0].exposed + begun >= span[0]]
    instants = np.array([shots[0].exposed for shots in rounds])
    offsets = (-ACCELERATION_SPAN, 0.0, ACCELERATION_SPAN)
    past, now, next_place = (arm.axes_at(np.clip(instants + h, 0.0, arm.now))[:, :3] for h in offsets)
    change = np.linalg.norm(next_place - 2 * now + past, axis=1)
    accelerates = change > MIN_ACCELERATION * ACCELERATION_SPAN**2
    rounds = [shots for number, shots in enumerate(rounds) if accelerates[number] or number % KEPT_EVERY == 0]

    def picture_of(shot: Shot) -> tuple[str, bytes]:
        axes = arm.axes_at(np.array([min(shot.exposed, arm.now)]))[0]
        nozzle = nozzle_from_axes(watched.true, axes)
        instant = WorldState(shot.exposed, exposure, BASE_FROM_REST, np.zeros(6), 0.0, nozzle, shot.gain)
        rng = np.random.default_rng([watched.seed, NOISE_STREAM, shot.camera, shot.picture])
        return encode(still_scene(shot.camera, instant, sensor, rng), LOSSLESS)

    with SessionFolderWriter(folder, watched.rig, ()) as session, ThreadPoolExecutor(2) as pool:
        for number, shots in enumerate(rounds):
            for shot, picture in zip(shots, pool.map(picture_of, shots), strict=True):
                session.picture(shot.camera, shot.stamp + begun, *picture)
            report(number + 1, len(rounds))


SHEET_SIZE, SHEET_STEP = (180.0, 120.0), 0.05  # mm, of a painted sheet, and of what it is painted in
SHEET_COLOUR, LINE_COLOUR = (196.0, 204.0, 208.0), (150.0, 60.0, 40.0)  # BGR
SHEET_BLUR, SHEET_NOISE = 0.15, 2.0  # mm and grey levels, one sigma
SHEET_PICTURES = 2  # of each camera, before and after
MAP_STEP = 8  # px between which a camera's view of the sheet is interpolated: to 0.001 px


def paint_sheet(
    watched: WatchedArm, sheet: Array, places: Array, radii: Array, folder: Path, stamps: tuple[Array, Array]
) -> None:
    """Write the session folder of what the cameras see of a sheet at (4, 4), mm, base_from_sheet, the arm away.

    places: (N, 2) mm, the middles of the discs that were laid, and radii (N,). stamps: of pictures before and after, s.
    """
    size = tuple(round(v / SHEET_STEP) for v in SHEET_SIZE)
    laid = np.zeros(size[::-1], np.uint8)
    middle = np.array(size) / 2
    drawn = radii / SHEET_STEP - 0.5  # OpenCV's discs are larger by half a pixel
    sixteenths = np.round(16 * np.column_stack([places / SHEET_STEP + middle, drawn])[drawn > 0]).astype(int)
    for x, y, radius in sixteenths.tolist():
        cv2.circle(laid, (x, y), radius, 255, -1, cv2.LINE_AA, 4)
    laid = np.asarray(cv2.GaussianBlur(laid, (0, 0), SHEET_BLUR / SHEET_STEP))
    with SessionFolderWriter(folder, watched.rig, ()) as session:
        for number, camera in enumerate(watched.rig.cameras):
            x, y = np.moveaxis(_view_of_sheet(camera, sheet) / SHEET_STEP + middle, -1, 0).astype(np.float32)
            ink = np.asarray(cv2.remap(laid, x, y, cv2.INTER_LINEAR)) / 255.0
            rng = np.random.default_rng([watched.seed, number])
            for some, cover in zip(stamps, (np.zeros_like(ink), ink), strict=True):
                image = SHEET_COLOUR + cover[..., None] * (np.array(LINE_COLOUR) - SHEET_COLOUR)
                for stamp in some[:: max(len(some) // SHEET_PICTURES, 1)][:SHEET_PICTURES]:
                    noisy = image + SHEET_NOISE * rng.standard_normal(image.shape)
                    picture = encode(np.asarray(np.clip(np.round(noisy), 0, 255), np.uint8), LOSSLESS)
                    session.picture(number, float(stamp) - camera.clock_offset, *picture)


def _view_of_sheet(camera: Camera, sheet: Array) -> Array:
    """Where on the sheet, mm, each pixel of a camera looks: (H, W, 2)."""
    w, h = camera.size
    x, y = np.arange(0, w + MAP_STEP, MAP_STEP), np.arange(0, h + MAP_STEP, MAP_STEP)
    pixels = undistort(camera, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(float))
    rays = (pixels - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    camera_in_sheet = se3.inverse(sheet) @ camera.base_from_camera
    ways = np.column_stack([rays, np.ones(len(rays))]) @ camera_in_sheet[:3, :3].T
    eye = camera_in_sheet[:3, 3]
    seen = (eye[:2] - ways[:, :2] * (eye[2] / ways[:, 2:])).reshape(len(y), len(x), 2).astype(np.float32)
    fine = np.meshgrid(np.arange(w, dtype=np.float32) / MAP_STEP, np.arange(h, dtype=np.float32) / MAP_STEP)
    return np.asarray(cv2.remap(seen, *fine, cv2.INTER_LINEAR))
