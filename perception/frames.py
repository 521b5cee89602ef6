"""Images with their stamps, the sets of frames that belong together, and what the arm tells of its print head.

Light to import: the motion process needs the tool's profile, and must not load OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimation.errors import InputError
from estimation.se3 import Array

Image = NDArray[np.uint8]
StampedBy = Literal["", "driver", "stream", "arrival"]  # who told a live frame's instant; "" where it was recorded


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image. camera: number in the rig. stamp: s, middle of the exposure. image: (H, W) grey or (H, W, 3) BGR.

    by: who told the stamp of a live frame.
    """

    camera: int
    stamp: float
    image: Image
    by: StampedBy = ""


@dataclass(frozen=True, slots=True, eq=False)
class PrintHead:
    """What the arm knows of itself. base_from_nozzle: (4, 4), z from the tip up into the head. extruding: ink flows."""

    base_from_nozzle: Array
    extruding: bool


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """The frames of one instant, at most one per camera, in the rig's order; a camera may be missing. stamp: s.

    head: the print head at that instant, where an arm is known.
    """

    stamp: float
    frames: tuple[Frame, ...]
    head: PrintHead | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Roi:
    """Where the surface is in one image. camera: number in the rig. stamp: s. polygon: (N, 2) px, may lie outside."""

    camera: int
    stamp: float
    polygon: Array


COMPARED_ROW_STEP = 16  # rows: noise makes two pictures differ in the first rows compared


class DuplicateFilter:
    """Remembers the last picture of each camera."""

    def __init__(self) -> None:
        self._last: dict[int, Image] = {}

    def __call__(self, camera: int, image: Image) -> bool:
        """Whether a camera's image (H, W) differs from its last one in a single bit.

        A sensor's noise never repeats. A picture without noise of a scene at rest passes for a repeated one, too: that
        nothing moves cannot be told from that nothing comes.
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
