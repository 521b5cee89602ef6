"""Camera sources: a camera's identity, which survives replugging and restarts, and its settings in rig.toml.

[[camera]]
source = "/dev/v4l/by-id/usb-046d_HD_Pro_Webcam_C920_A1B2C3D4-video-index0"
exposure_s = 0.008             # locked, as are the following where given
gain = 32                      # in the driver's own units
focus_abs = 40                 # in the driver's own units
white_balance_k = 4500
fps = 30.0
format = "MJPG"                # the driver's name: MJPG, YUYV

[[camera]]
source = "genicam://Basler-21876543"  # GigE Vision or USB3 Vision: Aravis's name, the serial number, MAC or IP address
exposure_s = 0.004
gain = 6.0                     # in the camera's own units
fps = 30.0
format = "BayerRG8"            # a name of PIXEL_FORMATS
trigger = "software"           # or a line of the camera, such as "Line1"; without it the camera runs freely
ptp = true                     # its clock follows the network's
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from estimation.errors import InputError
from estimation.rig import Rig
from hardware.files.rig_file import LIVE_KEYS, RECORDED_KEYS, rig_from_table
from hardware.process import checks
from hardware.process.checks import Table

FILE_ROOT = Path("/")
URL_SCHEMES = ("rtsp://", "rtsps://", "http://", "https://")
USB_PREFIX = "usb:"  # before a USB serial number
GENICAM_PREFIX = "genicam://"  # before an industrial camera's name
IDENTITY_FORMS = (
    "a path in /dev/v4l/by-id or /dev/v4l/by-path, usb:SERIAL, genicam://ID, a URL (rtsp, http) or a video file"
)
SOFTWARE_TRIGGER = "Software"  # as the standard (SFNC) names it; a line's name is any other
MAX_NAME = 128  # characters of an industrial camera's name or of a line's
DEPTHS = ("8", "10", "12", "16")  # bits of a pixel; more than 8 come in two bytes each, and lose the lowest
PIXEL_FORMATS = (  # by the standard's names (PFNC), in the order of preference; packed ones are not read
    *("Mono" + depth for depth in DEPTHS),
    *("Bayer" + order + depth for depth in DEPTHS for order in ("RG", "BG", "GR", "GB")),
    "RGB8",
    "BGR8",
)
CONTROL_RANGES = {  # both ends included
    "exposure_s": (1e-5, 1.0),
    "gain": (0.0, 1e5),
    "focus_abs": (0.0, 1e5),
    "white_balance_k": (1000.0, 20000.0),
    "fps": (1.0, 1000.0),
}
CONTROL_FIELDS = ("exposure", "gain", "focus", "white_balance", "fps")  # of CameraSource, in that order
_INDEX = re.compile(r"-?\d+|(/dev/)?video\d+")
_PASSWORD = re.compile(r"(://[^/@:]*:)[^/]*@")
_LINKS = ("dev/v4l/by-id", "dev/v4l/by-path")


class SourceKind(Enum):
    """Kind of source."""

    DEVICE = "device"
    STREAM = "stream"
    FILE = "file"
    GENICAM = "genicam"


@dataclass(frozen=True, slots=True)
class Identity:
    """A camera's name as written."""

    kind: SourceKind
    text: str  # a file's path is absolute

    @property
    def shown(self) -> str:
        """The name without a password, for screens and recordings."""
        return _PASSWORD.sub(r"\1***@", self.text)


@dataclass(frozen=True, slots=True)
class CameraDevice:
    """A camera that is plugged in now; "" for what it does not have."""

    node: Path  # such as /dev/video0
    name: str
    serial: str
    by_id: str
    by_path: str

    @property
    def identity(self) -> str:
        """What to write in rig.toml: the camera's own name rather than that of its socket."""
        return self.by_id or self.by_path or (USB_PREFIX + self.serial if self.serial else "")


def identity_from_text(where: object, key: str, text: str, folder: Path, root: Path = FILE_ROOT) -> Identity:
    """The identity in a text; InputError where it could change, as an index does. A device need not be plugged in.

    folder: where files are. root: of the file system, for tests.
    """
    if _INDEX.fullmatch(text):
        raise InputError(where, key, text, _instead(text, root))
    if text.startswith(URL_SCHEMES):
        return Identity(SourceKind.STREAM, text)
    if text.startswith("/dev/") or (text.startswith(USB_PREFIX) and text != USB_PREFIX):
        return Identity(SourceKind.DEVICE, text)
    if text.startswith(GENICAM_PREFIX) and _is_name(text.removeprefix(GENICAM_PREFIX)):
        return Identity(SourceKind.GENICAM, text)
    path = folder / text
    if "://" in text or not path.exists() or path.is_dir():
        raise InputError(where, key, text, IDENTITY_FORMS)
    return Identity(SourceKind.FILE, str(path.resolve()))


def _is_name(text: str) -> bool:
    return 0 < len(text) <= MAX_NAME and text.isprintable() and text == text.strip()


def _instead(text: str, root: Path) -> str:
    """What to write instead of an index, as text."""
    number = re.sub(r"\D", "", text)
    there = [device for device in list_devices(root) if device.identity]
    for device in there:
        if device.node.name == f"video{number}":
            return f"a name that stays when cables move: {device.identity} is this one now"
    if there:
        return f"a name that stays when cables move, such as {there[0].identity}"
    return f"a name that stays when cables move: {IDENTITY_FORMS}; `stillbed cameras` lists what is plugged in"


def list_devices(root: Path = FILE_ROOT) -> tuple[CameraDevice, ...]:
    """The cameras plugged in, in the order of their nodes; without nodes that carry no pictures."""
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda p: int("0" + p.name[5:]))
    return tuple(_device(entry, root) for entry in nodes if _read(entry / "index") in ("", "0"))


def _device(entry: Path, root: Path) -> CameraDevice:
    node = root / "dev" / entry.name
    serial = _read((entry / "device").resolve().parent / "serial") if (entry / "device").exists() else ""
    by_id, by_path = (_link_to(node, root / link) for link in _LINKS)
    return CameraDevice(node, _read(entry / "name"), serial, by_id, by_path)


def _link_to(node: Path, folder: Path) -> str:
    """The first link in a folder to a node, without the tests' root; "" if there is none."""
    links = sorted(folder.iterdir()) if folder.is_dir() else []
    names = (link.name for link in links if link.resolve() == node.resolve())
    return next((str(Path("/", *folder.parts[-3:], name)) for name in names), "")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def device_node(identity: Identity, root: Path = FILE_ROOT) -> Path | None:
    """A device's node; None while it is unplugged, or if two cameras have its serial number."""
    if identity.text.startswith(USB_PREFIX):
        serial = identity.text.removeprefix(USB_PREFIX)
        nodes = [device.node for device in list_devices(root) if device.serial == serial]
        return nodes[0] if len(nodes) == 1 else None
    link = root / identity.text.lstrip("/")
    return link if link.exists() else None


@dataclass(frozen=True, slots=True)
class CameraSource:
    """One camera of a live rig. None: not requested and not locked."""

    identity: Identity
    exposure: float | None = None  # s
    gain: float | None = None  # the driver's units
    focus: float | None = None  # the driver's units
    white_balance: float | None = None  # K
    fps: float | None = None  # Hz
    format: str | None = None  # four characters; of an industrial camera one of PIXEL_FORMATS
    trigger: str | None = None  # of an industrial camera: SOFTWARE_TRIGGER or a line; None: it runs freely
    ptp: bool = False  # whether an industrial camera's clock is to follow the network's


def read_live_rig(path: str | Path) -> tuple[Rig, tuple[CameraSource, ...]]:
    """The rig in a rig.toml and each camera's live source; InputError names a camera without one."""
    path = Path(path)
    table = checks.read_toml(path)
    checks.check_keys(path, "", table, ["camera"], ["surface"])
    rig = rig_from_table(path, table, (*RECORDED_KEYS, *LIVE_KEYS))
    sources = tuple(source_from_table(path, camera["name"], camera, path.parent) for camera in table["camera"])
    owners: dict[Identity, str] = {}
    for camera, source in zip(rig.cameras, sources, strict=True):
        if (owner := owners.setdefault(source.identity, camera.name)) != camera.name:
            allowed = f"a source of its own; camera {owner!r} has this one"
            raise InputError(path, f"camera {camera.name!r}: source", source.identity.shown, allowed)
    _check_beat(path, rig, sources)
    return rig, sources


def _check_beat(path: Path, rig: Rig, sources: tuple[CameraSource, ...]) -> None:
    """Refuse cameras that are to be triggered at one instant, but at different rates."""
    fired = [i for i, source in enumerate(sources) if source.trigger == SOFTWARE_TRIGGER]
    for i in fired:
        if sources[i].fps != sources[fired[0]].fps:
            key, first = f"camera {rig.cameras[i].name!r}: fps", rig.cameras[fired[0]].name
            allowed = f"{sources[fired[0]].fps:g}, as camera {first!r}: one trigger for all"
            raise InputError(path, key, sources[i].fps, allowed)


def source_from_table(where: object, name: str, camera: Table, folder: Path) -> CameraSource:
    """The live source in a table [[camera]]; files are looked for in `folder`."""
    key = f"camera {name!r}: "
    if "source" not in camera:
        raise InputError(where, key + "source", "missing", IDENTITY_FORMS)
    written = camera["source"]
    text = str(written) if isinstance(written, int) else checks.text(where, key + "source", written)
    identity = identity_from_text(where, key + "source", text, folder)
    ranges = zip(CONTROL_FIELDS, CONTROL_RANGES.items(), strict=True)
    controls = checks.table_fields(where, key, camera, {k: (f, checks.within(*both)) for f, (k, both) in ranges})
    kind, form = identity.kind, _format(where, key + "format", camera, identity.kind)
    trigger, ptp = _trigger(where, key, camera, kind), _ptp(where, key, camera, kind)
    return CameraSource(identity, **controls, format=form, trigger=trigger, ptp=ptp)


def _format(where: object, key: str, camera: Table, kind: SourceKind) -> str | None:
    if "format" not in camera:
        return None
    text = checks.text(where, key, camera["format"])
    if kind is SourceKind.GENICAM and text not in PIXEL_FORMATS:
        raise InputError(where, key, text, "one of " + ", ".join(PIXEL_FORMATS))
    if kind is not SourceKind.GENICAM and (len(text) != 4 or not text.isascii()):
        raise InputError(where, key, text, "four characters, such as MJPG or YUYV")
    return text


def _trigger(where: object, key: str, camera: Table, kind: SourceKind) -> str | None:
    if "trigger" not in camera:
        return None
    _check_genicam(where, key + "trigger", camera["trigger"], kind)
    text = checks.text(where, key + "trigger", camera["trigger"])
    if not _is_name(text):
        raise InputError(where, key + "trigger", text, '"software", or a line of the camera, such as "Line1"')
    if text.lower() != SOFTWARE_TRIGGER.lower():
        return text
    if "fps" not in camera:
        allowed = checks.range_text(*CONTROL_RANGES["fps"])
        raise InputError(where, key + "fps", "missing", f"{allowed}: the rate at which software triggers")
    return SOFTWARE_TRIGGER


def _ptp(where: object, key: str, camera: Table, kind: SourceKind) -> bool:
    value = checks.flag(where, key + "ptp", camera.get("ptp", False))
    if "ptp" in camera:
        _check_genicam(where, key + "ptp", value, kind)
    return value


def _check_genicam(where: object, key: str, value: object, kind: SourceKind) -> None:
    if kind is not SourceKind.GENICAM:
        raise InputError(where, key, value, f"only for an industrial camera, {GENICAM_PREFIX}ID")
