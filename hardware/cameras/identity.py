"""Which camera is meant: by what stays the same when cables move or the machine restarts, never by an index."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from estimation.errors import InputError

ROOT = Path("/")
URLS = ("rtsp://", "rtsps://", "http://", "https://")
USB = "usb:"  # before a USB serial number
STAYS = "a path in /dev/v4l/by-id or /dev/v4l/by-path, usb:SERIAL, a URL (rtsp, http) or a video file"
_INDEX = re.compile(r"-?\d+|(/dev/)?video\d+")
_PASSWORD = re.compile(r"(://[^/@:]*:)[^/]*@")
_LINKS = ("dev/v4l/by-id", "dev/v4l/by-path")


class Kind(Enum):
    """What sort of source it is."""

    DEVICE = "device"
    STREAM = "stream"
    FILE = "file"


@dataclass(frozen=True, slots=True)
class Identity:
    """A camera's name as written. A file's is absolute."""

    kind: Kind
    text: str

    @property
    def shown(self) -> str:
        """The name without a password, for screens and recordings."""
        return _PASSWORD.sub(r"\1***@", self.text)


@dataclass(frozen=True, slots=True)
class Device:
    """A camera that this machine has now. node: such as /dev/video0; serial, by_id, by_path: "" where there is none."""

    node: Path
    name: str
    serial: str
    by_id: str
    by_path: str

    @property
    def identity(self) -> str:
        """What to write for it: its own name before the socket's that it is plugged into."""
        return self.by_id or self.by_path or (USB + self.serial if self.serial else "")


def identity_from_text(where: object, key: str, text: str, folder: Path, root: Path = ROOT) -> Identity:
    """The identity that is written; files are looked for in `folder`. InputError where it would not stay the same.

    A device need not be plugged in. root: of the file system, for tests.
    """
    if _INDEX.fullmatch(text):
        raise InputError(where, key, text, _instead(text, root))
    if text.startswith(URLS):
        return Identity(Kind.STREAM, text)
    if text.startswith("/dev/") or (text.startswith(USB) and text != USB):
        return Identity(Kind.DEVICE, text)
    path = folder / text
    if "://" in text or not path.exists() or path.is_dir():
        raise InputError(where, key, text, STAYS)
    return Identity(Kind.FILE, str(path.resolve()))


def _instead(text: str, root: Path) -> str:
    """What to write instead of an index, which changes with the order of plugging."""
    number = re.sub(r"\D", "", text)
    there = [device for device in list_devices(root) if device.identity]
    for device in there:
        if device.node.name == f"video{number}":
            return f"a name that stays when cables move: {device.identity} is this one now"
    if there:
        return f"a name that stays when cables move, such as {there[0].identity}"
    return f"a name that stays when cables move: {STAYS}; `stillbed cameras` lists what is plugged in"


def list_devices(root: Path = ROOT) -> tuple[Device, ...]:
    """The cameras that the system shows now, in the order of their nodes; nodes that carry no pictures are left out."""
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=lambda p: int("0" + p.name[5:]))
    return tuple(_device(entry, root) for entry in nodes if _read(entry / "index") in ("", "0"))


def _device(entry: Path, root: Path) -> Device:
    node = root / "dev" / entry.name
    serial = _read((entry / "device").resolve().parent / "serial") if (entry / "device").exists() else ""
    by_id, by_path = (_link_to(node, root / link) for link in _LINKS)
    return Device(node, _read(entry / "name"), serial, by_id, by_path)


def _link_to(node: Path, folder: Path) -> str:
    """The first name in a folder of links that leads to a node, as it is seen without the tests' root."""
    links = sorted(folder.iterdir()) if folder.is_dir() else []
    for link in links:
        if link.resolve() == node.resolve():
            return str(Path("/", *folder.parts[-3:], link.name))
    return ""


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def device_node(identity: Identity, root: Path = ROOT) -> Path | None:
    """Where a device is now; None while it is unplugged, or where two cameras carry the same serial number."""
    if identity.text.startswith(USB):
        serial = identity.text.removeprefix(USB)
        nodes = [device.node for device in list_devices(root) if device.serial == serial]
        return nodes[0] if len(nodes) == 1 else None
    link = root / identity.text.lstrip("/")
    return link if link.exists() else None
