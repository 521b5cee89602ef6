"""Images with their stamps, the sets of frames that belong together, and the print head as the arm reports it.

Light to import: the motion process needs the tool's profile, and must not load OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array

Image = NDArray[np.uint8]
StampedBy = Literal["", "driver", "stream", "arrival"]  # source of a live frame's stamp; "" of a recorded one


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of one camera."""

    camera: int  # number in the rig
    stamp: float  # s, middle of the exposure
    image: Image  # (H, W) grey or (H, W, 3) BGR
    by: StampedBy = ""


@dataclass(frozen=True, slots=True, eq=False)
class PrintHead:
    """Where the print head is, by the arm."""

    base_from_nozzle: Array  # (4, 4) mm, z from the tip up into the head
    extruding: bool  # whether ink flows


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """The frames of one instant, at most one per camera, in the rig's order; a camera may be missing."""

    stamp: float  # s
    frames: tuple[Frame, ...]
    head: PrintHead | None = None  # the print head at that instant, where an arm is known


@dataclass(frozen=True, slots=True, eq=False)
class Roi:
    """Region of interest: where the surface is in one image."""

    camera: int  # number in the rig
    stamp: float  # s
    polygon: Array  # (N, 2) px, may reach beyond the image


ROI_LEAD = 0.1  # s before the stamp of a region from which it counts: cameras that run freely are less out of step
ROI_SLACK = 1e-3  # s by which the set that a region counts from is safely later than that


def region_since(roi: Roi, stamp: float) -> Roi:
    """The region with the stamp by which it counts from the frame set at `stamp`, s, on, and from none before."""
    return replace(roi, stamp=stamp + ROI_LEAD - ROI_SLACK)


def whole_pictures(sizes: Sequence[tuple[int, int]], stamp: float) -> tuple[Roi, ...]:
    """Every camera's whole picture as a region. sizes: (W, H) px by camera."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    return tuple(Roi(camera, stamp, corners * size) for camera, size in enumerate(sizes))


def of_whole_pictures(roi: Sequence[Roi], sizes: Sequence[tuple[int, int]]) -> bool:
    """Whether regions, if any, leave out nothing of any picture, and so do not tell what the surface is."""
    for region in roi:
        low, high = region.polygon.min(0), region.polygon.max(0)
        if (low > 0).any() or (high < sizes[region.camera]).any() or len(region.polygon) != 4:
            return False
    return True


def region_polygons(roi: Sequence[Roi], frames: FrameSet, sizes: Sequence[tuple[int, int]]) -> dict[int, Array] | str:
    """The region of interest (N, 2) px in each image of the set, by camera, or why it is not known yet.

    Without any the whole images are taken. sizes: (W, H) px by camera.
    """
    roi = roi or whole_pictures(sizes, frames.stamp)
    start = max(r.stamp for r in roi)
    if frames.stamp < start - ROI_LEAD:
        return f"waiting for the region of interest at {start:.3f} s"
    cameras = {f.camera for f in frames.frames}
    return {r.camera: r.polygon for r in sorted(roi, key=lambda r: r.camera) if r.camera in cameras}


COMPARED_ROW_STEP = 16  # rows: noise makes two pictures differ in the first rows compared


class DuplicateFilter:
    """Remembers the last picture of each camera."""

    def __init__(self) -> None:
        self._last: dict[int, Image] = {}

    def __call__(self, camera: int, image: Image) -> bool:
        """Whether a camera's image (H, W) differs from its last one in a single bit.

        A sensor's noise never repeats. A picture without noise of a scene at rest counts as repeated, too: a scene that
        stands still and a camera that hangs then look the same.
        """
        last = self._last.get(camera)
        self._last[camera] = image
        if last is None or not np.array_equal(last[::COMPARED_ROW_STEP], image[::COMPARED_ROW_STEP]):
            return True
        return not np.array_equal(last, image)


Result = TypeVar("Result")

MAX_THREADS = 3  # that a rig usually has; more of them wait for each other
_POOL = ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="camera")


def parallel_map(function: Callable[..., Result], *arguments: Iterable[object]) -> list[Result]:
    """As list(map(function, *arguments)); the function must not call this itself."""
    return list(_POOL.map(function, *arguments))


# Height above the tip and radius, mm: a luer needle of half an inch on a 5 ml cartridge in its holder.
SYRINGE = np.array([[0, 0.5], [12.7, 0.5], [13.6, 2.5], [23, 3.6], [27, 4.8], [50, 4.8], [58, 8], [96, 8]], float)


def check_profile(where: object, what: str, profile: Array) -> None:
    """InputError unless a profile (K, 2) of [height, radius], mm, is that of a tool."""
    rising = profile.ndim == 2 and profile.shape[1:] == (2,) and len(profile) > 1
    if not (rising and np.isfinite(profile).all() and (np.diff(profile[:, 0]) > 0).all() and (profile >= 0).all()):
        allowed = "two or more [height, radius] in mm, none negative, heights rising"
        raise InputError(where, what, profile.tolist(), allowed)
