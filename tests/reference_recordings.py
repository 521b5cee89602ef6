"""`python -m tests.reference_recordings` makes the reference recordings anew, from seeds; rarely needed."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from estimation.synthetic.world import World, synthetic_world
from hardware.files.path_file import write_path
from hardware.files.rig_file import ImageSource, write_rig
from hardware.live.prerender import prerender
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import open_session
from tests.moving_surfaces import raster
from tests.reference_cases import FOLDER

QUALITY = 75  # of the pictures, as JPEG
SCENARIO = """
title = "Small"
seconds = 1.0
seed = 3
path = "path.csv"
[scene]
body = "chest"
texel_mm = 0.3
[[motion]]
kind = "breathing"
amplitude_mm = 3.0
rate_hz = 0.5
[rig]
size = [320, 180]
focal_px = 275
[cameras]
fps = 15.0
"""


def main() -> None:
    """Make all of them."""
    write_path(FOLDER / "path.csv", raster())
    wound = {"movement": "breathing", "count": 36}
    late = {"outliers": 0.03, "offsets": (0.0, 8e-3, -5e-3), "dropouts": 0.05, "seed": 3}
    hidden = {"calibration": 0.3, "outages": ((1.5, 1.9), (2.5, 3.2, 1)), "seed": 4}
    _tracks("breathing", synthetic_world(seconds=12.0, rate=15.0, **wound, **late))  # forecasts begin after 8 s
    _tracks("outage", synthetic_world(seconds=4.0, **wound, **hidden))
    _pictures()


def _tracks(case: str, world: World) -> None:
    """Pixels are kept to 24 bits: that is 2e-5 px."""
    seen, folder = list(world), FOLDER / case
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(folder / "rig.toml", world.rig, [ImageSource("video", f"{c.name}.avi") for c in world.rig.cameras])
    np.savez_compressed(
        folder / "tracks.npz",
        stamps=np.array([each.stamp for each in seen]),
        counts=np.array([len(each) for each in seen]),
        camera=np.concatenate([each.camera for each in seen]).astype(np.uint8),
        track=np.concatenate([each.track for each in seen]).astype(np.uint16),
        pixels=np.concatenate([each.pixels for each in seen]).astype(np.float32),
        sigma=np.concatenate([each.sigma for each in seen]).astype(np.float32),
    )


def _pictures() -> None:
    folder = FOLDER / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as name:
        file = Path(name) / "small.toml"
        file.write_text(SCENARIO)
        write_path(Path(name) / "path.csv", raster())
        rendered = open_session(prerender(file, Path(name) / "cache").session)
        with Recorder(folder / "session.mcap", rendered.rig, overwrite=True) as recorder:
            for roi in rendered.roi:
                recorder.write(roi)
            for frames in rendered.frame_sets():
                for frame in frames.frames:
                    grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
                    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
                    recorder.encoded_frame(frame.camera, frame.stamp, "jpeg", data.tobytes())


if __name__ == "__main__":
    main()
