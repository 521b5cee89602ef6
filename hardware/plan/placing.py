"""Where a plan lies on the patient: its scan laid into a session's first pictures, and the wound they show beside it.

The scan is registered as in tracking, point to plane, with its verdict. What it says is checked by the thesis's own way
(5.2): the middle of the segmented wound, by image moments, beside the middle of the planned outline as each camera
would see it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose
from estimation.rig import Camera
from estimation.se3 import Array
from hardware.files.session import open_session
from perception.frames import FrameSet

MOST_SETS = 12  # frame sets that are tried: the first map, its confirmation, the averaging, and some that fail
FAR = 3.0  # mm between the two middles: a wound seen aslant by a network is drawn to about a millimetre


@dataclass(frozen=True, slots=True)
class Sight:
    """What one camera shows. off: mm, across its view, from the planned middle to that of the wound it shows; nan
    where it shows none. share: of the two outlines' areas, the smaller over the larger."""

    camera: str
    off: float
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class Placing:
    """base_from_scan: (4, 4) mm, or None where the scan was not placed. verdict: in words."""

    base_from_scan: Array | None
    verdict: str
    sights: tuple[Sight, ...]

    def lines(self) -> list[str]:
        """What it says, for a person."""
        lines = [f"placed: {self.verdict}"]
        for sight in self.sights:
            if not np.isfinite(sight.off):
                lines.append(f"placed: {sight.camera} shows no wound")
                continue
            far = f", more than {FAR:g} mm: is it the same wound?" if sight.off > FAR else ""
            lines.append(
                f"placed: in {sight.camera} the wound's middle is {sight.off:.2f} mm from the plan's{far}; "
                f"their areas are as {sight.share:.2f} to 1"
            )
        return lines


def placing_in(session_path: Path, scan_file: Path, outline: Array) -> Placing:
    """Where a scan lies in a session's first pictures. outline: (N, 3) mm, of the planned wound, scan frame."""
    from hardware.tracker import tracker  # loads gtsam and cv2, which a plan alone does not need

    session = open_session(session_path)
    pose, frames = None, None
    with tracker(session.rig, session.roi, scan_file) as step:
        for number, frames in enumerate(session.frame_sets()):
            pose = step(frames)
            step.idle()
            if pose.state.measured or number + 1 == MOST_SETS:
                break
    if pose is None or frames is None:
        return Placing(None, "the session holds no frame set", ())
    if not pose.state.measured:
        return Placing(None, f"not placed: {pose.reason or pose.state.value}", ())
    return Placing(pose.base_from_surface, _verdict(pose), _sights(session.rig.cameras, frames, pose, outline))


def _verdict(pose: SurfacePose) -> str:
    sigma = np.sqrt(np.diag(pose.covariance))
    good = f"good to {np.linalg.norm(sigma[3:]):.3f} mm and {np.rad2deg(np.linalg.norm(sigma[:3])):.2f} degrees"
    return f"{pose.state.value}, {good}" + (f"; {pose.reason}" if pose.reason else "")


def _sights(cameras: Sequence[Camera], frames: FrameSet, pose: SurfacePose, outline: Array) -> tuple[Sight, ...]:
    from perception.wound.network import WoundNetwork, shipped
    from perception.wound.segmentation import NetworkSegmenter  # loads onnxruntime

    network = WoundNetwork(shipped(), threads=1)
    segmenter = NetworkSegmenter(network, network.settings)
    found = []
    for frame in frames.frames:
        mask = segmenter(frame.image).mask
        found.append(_sight(cameras[frame.camera], mask, pose.base_from_surface, outline))
    return tuple(found)


def _sight(camera: Camera, mask: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], pose: Array, outline: Array) -> Sight:
    from perception.lens import undistort
    from perception.wound.segmentation import centroid

    if not mask.any():
        return Sight(camera.name, float("nan"), float("nan"))
    seen = se3.transform_points(se3.inverse(camera.base_from_camera) @ pose, outline)
    pixels = seen[:, :2] / seen[:, 2:] * camera.matrix[[0, 1], [0, 1]] + camera.matrix[:2, 2]
    area, middle = _middle(pixels)
    off = np.linalg.norm(undistort(camera, centroid(mask)[None])[0] - middle)
    scale = float(seen[:, 2].mean()) / float(camera.matrix[0, 0])  # mm per px
    areas = sorted([area, float(mask.sum())])
    return Sight(camera.name, float(off) * scale, areas[0] / max(areas[1], 1e-9))


def _middle(ring: Array) -> tuple[float, Array]:
    """Area and middle (2,) of what a ring (N, 2) encloses."""
    (x, y), (u, v) = ring.T, np.roll(ring, -1, axis=0).T
    cross = x * v - u * y
    area = float(cross.sum()) / 2
    return abs(area), np.array([(x + u) @ cross, (y + v) @ cross]) / (6 * area)
