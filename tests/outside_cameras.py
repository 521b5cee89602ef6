"""Three cameras of another program: `python -m tests.outside_cameras FOLDER [WHAT]` serves them over HTTP, as MJPEG.

WHAT they show, to and fro in real time: a printed sheet that is pushed over a table, a calibration board that is waved,
or a wound that breathes. FOLDER/rig.toml names them; standard output says "ready". Of the wound, FOLDER/shown.csv has a
line for each picture: stamp_s by the monotonic clock, the camera, and the first three rows of base_from_surface, mm.
While there is a file FOLDER/hand, something blotchy is before all cameras.
"""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from estimation import se3
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.files.rig_file import ImageSource, write_rig
from hardware.simulator.scenario_tables import scene_from_table
from hardware.simulator.scene.appearance import Sensor
from hardware.simulator.scene.render import BoardView, render
from hardware.simulator.scene.scene import Scene, WorldState
from perception.frames import Image
from tests.board_session import BOARD, RATE, small_rig
from tests.boards import motion
from tests.camera_streams import CLOCK, HttpCamera, served
from tests.printed_sheet import FPS, pictures, rig

SETS = 40
BOARD_INSTANTS = 20
ROOT = Path(__file__).parents[1]


WOUND_FPS = 15.0
BREATH = 2.4  # s
WOUND_SEED = 3
WOUND_SCENE = {"body": "chest", "wound_size_mm": [14, 10], "wound_depth_mm": 1.2}


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What is shown."""

    rig: Rig
    images: list[list[Image]]  # each camera's
    fps: float  # their rate, Hz
    poses: Array | None = None  # (N, 4, 4) mm, base_from_surface of each


def sheet() -> Shown:
    """A sheet on a table."""
    sets = list(pictures(np.arange(SETS) / FPS))
    return Shown(rig(), [[frames.frames[c].image for frames in sets] for c in range(3)], FPS)


def board() -> Shown:
    """A board; all cameras expose at once."""
    cameras, draw = small_rig(), np.random.default_rng(5)
    poses = motion(np.arange(BOARD_INSTANTS) / RATE, np.random.default_rng(11), BOARD.corners.mean(0), 1.5)
    views = [BoardView(camera, BOARD) for camera in cameras.cameras]
    return Shown(cameras, [[view.picture(pose, 0.6, 1.5, draw) for pose in poses] for view in views], RATE)


def wound_scene() -> Scene:
    """The chest with a small wound; it is painted when somebody looks."""
    return scene_from_table("wound", WOUND_SCENE, ROOT, WOUND_SEED)


def wound_rig() -> Rig:
    """The cameras over it."""
    return arc_rig(size=(640, 360), focal=1100.0)


def breath_at(stamps: Array) -> Array:
    """base_from_surface (N, 4, 4) mm at stamps (N,), s: 2 mm up, a little aside, and a degree of tilt."""
    lifted = (1 - np.cos(2 * np.pi / BREATH * stamps)) / 2
    return np.asarray(BASE_FROM_REST @ se3.exp(lifted[:, None] * np.array([0.017, 0.006, 0.0, 0.4, 0.3, 2.0])))


def wound() -> Shown:
    """The wound from breathed out to breathed in: the way back is the same."""
    scene, cameras, sensor, still = wound_scene(), wound_rig(), Sensor(), np.zeros(6)
    poses, draw = breath_at(np.arange(round(BREATH / 2 * WOUND_FPS) + 1) / WOUND_FPS), np.random.default_rng(9)
    sets = [
        render(scene, cameras.cameras, [WorldState(0.0, 0.0, pose, still)] * 3, sensor, draw.spawn(3)) for pose in poses
    ]
    return Shown(cameras, [list(images) for images in zip(*sets, strict=True)], WOUND_FPS, poses)


def blotches(size: tuple[int, int], seed: int) -> Image:
    """A picture (H, W, 3) of something near and out of focus; another seed has other noise."""
    large = np.random.default_rng(1).normal(140, 25, (9, 16, 3)).astype(np.float32)
    noise = np.random.default_rng(seed).normal(0, 3, (*size[::-1], 3))
    return np.clip(cv2.resize(large, size, interpolation=cv2.INTER_CUBIC) + noise, 0, 255).astype(np.uint8)


SHOWN: dict[str, Callable[[], Shown]] = {"sheet": sheet, "board": board, "wound": wound}


def main(folder: Path, what: str = "sheet") -> None:
    """Serve until the standard input ends."""
    shown = SHOWN[what]()
    images = [[cv2.imencode(".jpg", image)[1].tobytes() for image in own] for own in shown.images]
    hand = [cv2.imencode(".jpg", blotches(shown.rig.cameras[0].size, seed))[1].tobytes() for seed in range(7)]
    log = None if shown.poses is None else (folder / "shown.csv").open("w", encoding="utf-8")

    def seen(camera: int) -> bytes:
        """What there is to be seen at the next tick, which all cameras have in common."""
        tick, way = math.floor(CLOCK.now() * shown.fps) + 1, 2 * len(images[camera]) - 2
        CLOCK.wait_until(tick / shown.fps)
        k = min(tick % way, way - tick % way)
        if log is not None and shown.poses is not None:
            log.write(",".join(map(repr, [tick / shown.fps, camera, *shown.poses[k, :3].ravel().tolist()])) + "\n")
            log.flush()
        return hand[tick % len(hand)] if (folder / "hand").exists() else images[camera][k]

    streams = [HttpCamera(1e3, lambda _, c=c: seen(c)) for c in range(3)]  # their own beat is too fast to matter
    with served(*streams):
        write_rig(folder / "rig.toml", shown.rig, [ImageSource("source", stream.url) for stream in streams])
        print("ready", flush=True)
        threading.Thread(target=sys.stdin.read).run()


@contextmanager
def outside(folder: Path, what: str = "sheet") -> Iterator[Path]:
    """The rig.toml of cameras that another process serves."""
    command = [sys.executable, "-m", "tests.outside_cameras", str(folder), what]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdin is not None
    try:
        assert process.stdout.readline() == "ready\n"
        yield folder / "rig.toml"
    finally:
        process.stdin.close()
        process.wait(10)
        process.stdout.close()


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main(Path(sys.argv[1]), *sys.argv[2:])
