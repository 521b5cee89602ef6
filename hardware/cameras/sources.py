"""Where a rig's live pictures come from and what each camera is told: keys of rig.toml's [[camera]].

source = "/dev/v4l/by-id/usb-046d_HD_Pro_Webcam_C920_A1B2C3D4-video-index0"
exposure_s = 0.008             # locked; so are the following, each where it is given
gain = 32                      # in the driver's own units
focus_abs = 40                 # in the driver's own units
white_balance_k = 4500
fps = 30.0
format = "MJPG"                # as the driver calls it: MJPG, YUYV
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from estimation.errors import InputError
from estimation.rig import Rig
from hardware.cameras.identity import STAYS, Identity, identity_from_text
from hardware.files.rig_file import LIVE_KEYS, RECORDED_KEYS, rig_from_table
from hardware.process import checks
from hardware.process.checks import Table

RANGES = {  # both ends included
    "exposure_s": (1e-5, 1.0),
    "gain": (0.0, 1e5),
    "focus_abs": (0.0, 1e5),
    "white_balance_k": (1000.0, 20000.0),
    "fps": (1.0, 1000.0),
}


@dataclass(frozen=True, slots=True)
class CameraSource:
    """One camera of a live rig. None: left as the camera has it, and not locked.

    exposure: s. gain, focus: the driver's units. white_balance: K. fps: Hz. format: four characters.
    """

    identity: Identity
    exposure: float | None = None
    gain: float | None = None
    focus: float | None = None
    white_balance: float | None = None
    fps: float | None = None
    format: str | None = None


def read_live_rig(path: str | Path) -> tuple[Rig, tuple[CameraSource, ...]]:
    """The rig in a rig.toml and each camera's live source; InputError names the camera that has none."""
    path = Path(path)
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ["camera"], ["surface"])
    rig = rig_from_table(path, table, (*RECORDED_KEYS, *LIVE_KEYS))
    sources = tuple(source_from_table(path, camera["name"], camera, path.parent) for camera in table["camera"])
    return rig, _all_different(path, rig, sources)


def source_from_table(where: object, name: str, camera: Table, folder: Path) -> CameraSource:
    """The live source in a table [[camera]]; files are looked for in `folder`."""
    key = f"camera {name!r}: "
    if "source" not in camera:
        raise InputError(where, key + "source", "missing", STAYS)
    written = camera["source"]
    text = str(written) if isinstance(written, int) else checks.text(where, key + "source", written)
    identity = identity_from_text(where, key + "source", text, folder)
    exposure, gain, focus, white, fps = (_number(where, key, camera, one) for one in RANGES)
    return CameraSource(identity, exposure, gain, focus, white, fps, _format(where, key + "format", camera))


def _number(where: object, key: str, camera: Table, name: str) -> float | None:
    if name not in camera:
        return None
    value, (low, high) = checks.number(where, key + name, camera[name]), RANGES[name]
    if not low <= value <= high:
        raise InputError(where, key + name, value, f"{low:g} to {high:g}")
    return value


def _format(where: object, key: str, camera: Table) -> str | None:
    if "format" not in camera:
        return None
    text = checks.text(where, key, camera["format"])
    if len(text) != 4 or not text.isascii():
        raise InputError(where, key, text, "four characters, such as MJPG or YUYV")
    return text


def _all_different(where: object, rig: Rig, sources: tuple[CameraSource, ...]) -> tuple[CameraSource, ...]:
    seen: dict[Identity, str] = {}
    for camera, source in zip(rig.cameras, sources, strict=True):
        if source.identity in seen:
            allowed = f"a source of its own; camera {seen[source.identity]!r} has this one"
            raise InputError(where, f"camera {camera.name!r}: source", source.identity.shown, allowed)
        seen[source.identity] = camera.name
    return sources
