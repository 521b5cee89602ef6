"""What a calibration is made from, be it recorded or live: cameras, the corners that they saw, and a few pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.calibration.lens_model import KnownLenses, lens_of
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.calibration.inputs import Pictures
from hardware.files.rig_file import ImageSource
from perception.boards.collection import CornerTable


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """title: for the report. rig: names and sizes of the cameras; the rest of it holds only where `given`.

    images: where each camera's pictures are, as the new rig.toml will say. lens_sigma: how well given lenses are known,
    (9,) per camera or None. pictures: a few of each camera.
    """

    title: str
    rig: Rig
    given: bool
    images: Sequence[ImageSource | None]
    lens_sigma: Sequence[Array | None]
    table: CornerTable
    pictures: Pictures

    @property
    def names(self) -> tuple[str, ...]:
        """Of the cameras."""
        return tuple(camera.name for camera in self.rig.cameras)

    @property
    def lenses(self) -> KnownLenses:
        """The lenses that are given; those whose doubt nobody told are taken as exact."""
        sigma = [np.zeros(9) if told is None else told for told in self.lens_sigma]
        return KnownLenses(np.stack([lens_of(camera) for camera in self.rig.cameras]), np.stack(sigma))
