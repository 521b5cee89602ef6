"""Three cameras of another program: `python -m tests.outside_cameras FOLDER [board]` serves them over HTTP, as MJPEG.

They show, to and fro in real time, a printed sheet that is pushed over a table, or a calibration board that is waved.
FOLDER/rig.toml names them; its standard output says "ready".
"""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from estimation.rig import Rig
from hardware.files.rig_file import ImageSource, write_rig
from hardware.simulator.scene.ground_truth_views import BoardView
from perception.frames import Image
from tests.board_session import BOARD, RATE, small_rig
from tests.boards import motion
from tests.printed_sheet import FPS, pictures, rig
from tests.streams import CLOCK, HttpCamera, served

SETS = 40
BOARD_INSTANTS = 20
ROOT = Path(__file__).parents[1]


def sheet() -> tuple[Rig, list[list[Image]], float]:
    """The cameras, each one's pictures, and their rate, Hz."""
    sets = list(pictures(np.arange(SETS) / FPS))
    return rig(), [[frames.frames[c].image for frames in sets] for c in range(3)], FPS


def board() -> tuple[Rig, list[list[Image]], float]:
    """The same of a board; all cameras expose at once."""
    cameras, draw = small_rig(), np.random.default_rng(5)
    poses = motion(np.arange(BOARD_INSTANTS) / RATE, np.random.default_rng(11), BOARD.corners.mean(0), 1.5)
    views = [BoardView(camera, BOARD) for camera in cameras.cameras]
    return cameras, [[view.picture(pose, 0.6, 1.5, draw) for pose in poses] for view in views], RATE


def main(folder: Path, what: str = "sheet") -> None:
    """Serve until the standard input ends."""
    cameras, images, rate = board() if what == "board" else sheet()

    def seen(camera: int) -> Image:
        """What there is to be seen at the next tick, which all cameras have in common."""
        tick, way = math.floor(CLOCK.now() * rate) + 1, 2 * len(images[camera]) - 2
        CLOCK.wait_until(tick / rate)
        return images[camera][min(tick % way, way - tick % way)]

    streams = [HttpCamera(1e3, lambda _, c=c: seen(c)) for c in range(3)]  # their own beat is too fast to matter
    with served(*streams):
        write_rig(folder / "rig.toml", cameras, [ImageSource("source", stream.url) for stream in streams])
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
