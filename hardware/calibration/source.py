"""The recording that cameras are calibrated from: any session, calibrated already or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from estimation.rig import Rig
from estimation.se3 import Array
from hardware.calibration.inputs import pictures_of
from hardware.calibration.material import Material
from hardware.files.rig_file import ImageSource, is_calibrated, read_rig, read_uncalibrated
from hardware.files.session import Session, open_session
from hardware.files.session_folder import open_folder
from perception.boards.collection import CornerTable


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A session, the rig that it names, if any, where its images are, and how well its lenses are known, if told."""

    session: Session
    given: Rig | None
    images: Sequence[ImageSource | None]
    lens_sigma: Sequence[Array | None]

    def material(self, table: CornerTable) -> Material:
        """What it is calibrated from, once the corners are found."""
        session = self.session
        title, given = session.path.name, self.given is not None
        return Material(
            title, session.rig, given, self.images, self.lens_sigma, table, lambda c: pictures_of(session, c)
        )


def open_source(path: Path) -> Source:
    """Open a session folder, whose rig.toml may lack lenses and places, or an .mcap file; InputError if it is wrong."""
    rig_toml = path / "rig.toml"
    if path.is_dir() and rig_toml.is_file():
        if is_calibrated(rig_toml):
            session = open_folder(path)
            told = read_rig(rig_toml)
            return Source(session, session.rig, told.sources, told.lens_sigma)
        bare = read_uncalibrated(rig_toml)
        return Source(open_folder(path, bare), None, bare.sources, bare.lens_sigma)
    session = open_session(path)
    nothing = [None] * len(session.rig)
    return Source(session, session.rig, nothing, nothing)
