"""The recording that cameras are calibrated from: any session, calibrated already or not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from estimation.rig import Rig
from hardware.folder import open_folder
from hardware.rig_file import ImageSource, is_calibrated, read_rig, read_uncalibrated
from hardware.session import Session, open_session


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A session, the rig that it names, if any, and where its images are."""

    session: Session
    given: Rig | None
    images: Sequence[ImageSource | None]


def open_source(path: Path) -> Source:
    """Open a session folder, whose rig.toml may lack lenses and places, or an .mcap file; InputError if it is wrong."""
    rig_toml = path / "rig.toml"
    if path.is_dir() and rig_toml.is_file():
        if is_calibrated(rig_toml):
            session = open_folder(path)
            return Source(session, session.rig, read_rig(rig_toml).sources)
        bare = read_uncalibrated(rig_toml)
        return Source(open_folder(path, bare), None, bare.sources)
    session = open_session(path)
    return Source(session, session.rig, [None] * len(session.rig))
