"""Cameras as a command line names them: one by one, or all of a rig at once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from estimation.errors import InputError
from estimation.rig import Rig
from hardware.cameras.feed import Place
from hardware.cameras.identity import identity_from_text
from hardware.cameras.sources import CameraSource, read_live_rig


def sources_named(which: Sequence[str]) -> tuple[Rig | None, tuple[CameraSource, ...]]:
    """The rig of the one RIG.toml that is named, None where cameras are, and the source of each camera; InputError."""
    rigs = [text for text in which if text.endswith(".toml")]
    if rigs and len(which) > 1:
        raise InputError("command line", "cameras", " ".join(which), "one RIG.toml alone, or cameras without one")
    if rigs:
        return read_live_rig(rigs[0])
    return None, tuple(CameraSource(identity_from_text("command line", "camera", text, Path.cwd())) for text in which)


def places_without_rig(count: int) -> tuple[Place, ...]:
    """Places of cameras of which nothing is known, counted from 1."""
    return tuple(Place(i, f"camera {i + 1}", None) for i in range(count))
