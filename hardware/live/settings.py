"""session.toml: all settings of a live run in one file that is checked as a whole; flags override it.

`stillbed init FOLDER` writes one with a comment for each key; every run writes the one that it used beside its
recording. Files in it are relative to it. The operator's page is served to this machine alone unless an address is
named, and then encrypted (TLS) alone.
"""

# ruff: noqa: RUF009
# (`_key` makes a dataclass field)

from __future__ import annotations

import importlib.util
import os
import re
import socket
import ssl
from collections.abc import Collection
from dataclasses import Field, dataclass, field, fields, replace
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from estimation.errors import InputError
from hardware.files.region_table import ANY_REGION, RegionSettings, region_from_table, region_lines
from hardware.operator.settings import LOOPBACK, OperatorSettings
from hardware.process import checks

FROM_CAMERAS = "from the cameras"  # instead of a scan's file: they scan, and it is planned, before the run
VIRTUAL_ARM = "virtual"  # the arm that needs no device
RANGES = {  # of numbers: lowest, highest, unit; lifted by more, the arm may leave the checked space
    "lift": (0, 100, "mm"), "patience": (1, 600, "s"), "jpeg_quality": (0, 100, ""),
}  # fmt: skip
MAX_CORES = 1024
MAX_PORT = 65535
HOST_NAME = re.compile(r"(?!.*\.\.)[A-Za-z0-9][A-Za-z0-9.-]{0,252}")  # of a machine


def _key(name: str, example: str, about: str = "", default: object = None) -> Any:
    """A setting: "table.key" in the file, an example as TOML, what it means, and the default."""
    return field(default=default, metadata={"name": name, "example": example, "about": about})


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """All settings of a run, in the order of the file."""

    rig: Path | None = _key(
        "cameras.rig", '"rig.toml"', "rig.toml, session folder or recording with the calibrated cameras"
    )
    simulated: Path | None = _key(
        "cameras.simulated", '"x.toml"', "instead of cameras: scenario, rendered once, then played in real time"
    )
    patience: float = _key(  # s: enough to find a loose cable
        "cameras.patience_s", "10.0", "s without pictures until the arm is stopped; 1 to 600", 10.0
    )
    model: Path | None = _key(
        "cameras.model",
        '"x.onnx"',
        "your own network that finds the wound; default: the one of stillbed",
    )
    path: Path | None = _key(
        "print.path", '"path.csv"', "path to print, with its checkpoints; not for a scenario, which has one"
    )
    scan: Path | None = _key(
        "print.scan",
        '"scan.ply"',
        f'scan of the surface, mm, in the path\'s frame, or "{FROM_CAMERAS}"; without it you place the path by hand',
    )
    look: str = _key(
        "print.look",
        '"layer"',
        'when the needle moves aside to measure the print: "layer": after each layer; "4": after every 4 beads',
        "",
    )
    adapt: bool = _key(
        "print.adapt", "true", "adapt the flow of each layer to the measured layer below; needs look", False
    )
    dry_run: bool = _key(
        "print.dry_run", "false", "true: nothing is extruded, and the nozzle stays above the surface", False
    )
    lift: float = _key(  # mm: above the rim of a wound, too low for a hand below it
        "print.lift_mm", "10.0", "mm above the surface in a dry run; 0 to 100", 10.0
    )
    unattended: bool = _key(
        "print.unattended",
        "false",
        "true: no confirmation by an operator; the scan must be found with certainty",
        False,
    )
    arm: str = _key("arm.device", '"/dev/ttyUSB0"', 'serial port, URL of pyserial, or "virtual": a simulated arm', "")
    profile: Path | None = _key("arm.profile", '"arm.toml"', "arm file: its place, limits, protocol, lag and tool")
    stands_home: bool = _key(
        "arm.stands_home",
        "false",
        "true: the arm is at its home position now; for an arm that reports no position",
        False,
    )
    pause_frame: bool = _key(
        "arm.pause_frame", "true", "true: the controller supports the pause frame, which stops the arm at once", True
    )
    real_time: bool = _key("arm.real_time", "true", "request real-time priority from the operating system", True)
    dispensers: Path | None = _key(
        "material.dispensers", '"dispenser.toml"', "dispenser file; default: nothing is extruded"
    )
    record: Path | None = _key(
        "record.file", '"run.mcap"', "recording; the other files of the run are written beside it"
    )
    jpeg_quality: int = _key(  # three cameras' exact pictures take three cores to encode
        "record.jpeg_quality", "90", "for pictures that are not compressed by the camera, 1 to 100; 0: lossless", 90
    )
    trace: bool = _key("record.trace", "true", "record the times of each frame set, for stillbed trace", True)
    operator: str = _key("record.operator", '"A. Name"', "name of the operator, for recording and reports", "")
    foxglove_port: int = _key("record.foxglove_port", "8765", "port for Foxglove on this machine; 0: none", 0)
    page: bool = _key("page.serve", "true", "the operator's page in the browser", True)
    page_address: str = _key(
        "page.address", '"0.0.0.0"', "address of the page; access from other machines needs TLS", LOOPBACK
    )
    page_port: int = _key("page.port", "8443", "port of the page; 0: any free one", 0)
    page_certificate: Path | None = _key(
        "page.certificate", '"page.pem"', "certificate for TLS: PEM file with the whole chain"
    )
    page_key: Path | None = _key(
        "page.key", '"page.key"', "private key of the certificate: PEM file without a password"
    )
    page_names: tuple[str, ...] = _key("page.names", '["printer.local"]', "host names of this machine in browsers", ())
    cores_tracking: tuple[int, ...] = _key("cores.tracking", "[0]", "processor cores of tracking; default: all", ())
    cores_motion: tuple[int, ...] = _key("cores.motion", "[1]", "of the motion process", ())
    cores_recorder: tuple[int, ...] = _key("cores.recorder", "[0]", "of the recorder", ())
    region: RegionSettings = ANY_REGION  # a table of its own, whose keys are cameras


SETTING_KEYS: dict[str, dict[str, Field[Any]]] = {}  # table and key in the file to the setting
for _setting in (each for each in fields(LiveSettings) if each.metadata):
    _table, _, _name = _setting.metadata["name"].partition(".")
    SETTING_KEYS.setdefault(_table, {})[_name] = _setting
CAMERAS_ALLOWED = "one of rig (cameras, or a session) and simulated (a scenario)"
FILE_HEADER = "# A live run of stillbed: `stillbed live session.toml`. Lines that begin with # are examples.\n"


def key_of(setting: str) -> str:
    """The "table.key" of a setting by its name."""
    return str(LiveSettings.__dataclass_fields__[setting].metadata["name"])


def read_settings(file: Path) -> LiveSettings:
    """The settings in a session.toml; InputError names the key that makes no sense."""
    tables = checks.read_toml(file)
    checks.check_keys(file, "", tables, (), [*SETTING_KEYS, "region"])
    values: dict[str, Any] = {"region": region_from_table(file, tables.get("region", {}))}
    for name, settings in SETTING_KEYS.items():
        keys = {key: (setting.name, CHECKS[setting.type]) for key, setting in settings.items()}
        table = checks.table_at(file, "", tables, name)
        values |= checks.record_from_table(file, f"{name}.", table, dict, keys)
    return LiveSettings(**values)


def _cores(file: Path, key: str, value: object) -> tuple[int, ...]:
    if not (isinstance(value, list) and all(isinstance(core, int) and 0 <= core < MAX_CORES for core in value)):
        raise InputError(file, key, value, "a list of core numbers, such as [0]")
    return tuple(value)


def parse_host_names(where: object, key: str, names: object) -> tuple[str, ...]:
    """Names of this machine; InputError unless they are a list of such."""
    if not (isinstance(names, list) and all(isinstance(name, str) and HOST_NAME.fullmatch(name) for name in names)):
        raise InputError(where, key, names, 'a list of names of this machine, such as ["printer.local"]')
    return tuple(names)


CHECKS: dict[Any, Any] = {  # of a setting's annotation: the check of its value
    "Path | None": lambda file, key, value: file.parent / checks.text(file, key, value),
    "bool": checks.flag,
    "tuple[int, ...]": _cores,
    "tuple[str, ...]": parse_host_names,
    "str": checks.text,
    "int": checks.whole(0),
    "float": checks.number,
}


def check_settings(settings: LiveSettings, where: object) -> LiveSettings:
    """The settings, with an arm; InputError names what is missing or out of range."""
    s = settings
    for name in ("rig", "simulated", "model", "path", "scan", "profile", "dispensers"):
        file = getattr(s, name)
        if file is not None and not file.exists():
            raise InputError(where, key_of(name), file, "a file that exists")
    if (s.rig is None) == (s.simulated is None):
        raise InputError(where, "cameras", "both" if s.rig else "neither", CAMERAS_ALLOWED)
    if s.path is None and s.simulated is None:
        raise InputError(where, "print.path", "missing", "the file of the checkpoints")
    if not s.arm and s.simulated is None:
        raise InputError(where, "arm.device", "missing", 'a device, or "virtual"')
    if s.record is None or s.record.suffix != ".mcap":
        raise InputError(where, "record.file", s.record or "missing", "a file that ends in .mcap")
    for name, (low, high, unit) in RANGES.items():
        if not low <= (value := getattr(s, name)) <= high:
            raise InputError(where, key_of(name), value, checks.range_text(low, high, unit))
    if s.adapt and not s.look:
        raise InputError(where, "print.adapt", "true", "with print.look")
    if s.region.drawn and not s.page:
        raise InputError(
            where, "region", "no corners", "corners of two cameras or more, as no page is there to draw on"
        )
    usable = available_cores()
    for key, setting in SETTING_KEYS["cores"].items():
        if not set(usable).issuperset(cores := getattr(s, setting.name)):
            allowed = f"cores that there are: {', '.join(map(str, usable))}"
            raise InputError(where, f"cores.{key}", list(cores), allowed)
    _check_foxglove(s.foxglove_port, where)
    if not 0 <= s.page_port <= MAX_PORT:
        raise InputError(where, "page.port", s.page_port, f"1 to {MAX_PORT}, or 0: any that is free")
    return replace(s, arm=s.arm or VIRTUAL_ARM)


def _check_foxglove(port: int, where: object) -> None:
    """InputError unless the port is 0, or one of this machine's that is free while the library is there."""
    key, free = "record.foxglove_port", f"1 to {MAX_PORT}, free on this machine, or 0: none"
    if port and importlib.util.find_spec("foxglove") is None:
        raise InputError(where, key, port, "0, or stillbed with its extra: pip install 'stillbed[foxglove]'")
    if not 0 <= port <= MAX_PORT:
        raise InputError(where, key, port, free)
    if reason := port and _port_problem(LOOPBACK, port):
        raise InputError(where, key, port, f"{free} ({reason})")


def _port_problem(host: str, port: int) -> str:
    """Why nobody can listen at an address of this machine; "" where one can."""
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        return str(error.strerror)
    return ""


def looks_between(settings: LiveSettings) -> int | str | None:
    """What the setting says of looks: a number of beads, "layer", or None; anything else as it stands."""
    return int(settings.look) if settings.look.isdecimal() else settings.look or None


def used_files(settings: LiveSettings) -> list[Path]:
    """The files that the settings name, a session by its rig.toml."""
    s, rig = settings, settings.rig
    rig = rig / "rig.toml" if rig is not None and rig.is_dir() else rig
    named = rig, s.simulated, s.model, s.path, s.scan, s.profile, s.dispensers
    return [file for file in named if file is not None]


def available_cores() -> tuple[int, ...]:
    """The processor cores that this process may run on, by number."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or MAX_CORES))


def settings_text(settings: LiveSettings | None = None) -> str:
    """A session.toml: of these settings, with whole paths, or one of comments and examples to begin with."""
    lines = [FILE_HEADER]
    for table, keys in SETTING_KEYS.items():
        lines.append(f"[{table}]")
        for key, setting in keys.items():
            value = _toml_value(getattr(settings or LiveSettings(), setting.name))
            about, example = setting.metadata["about"], setting.metadata["example"]
            line = f"# {key} = {example}" if value is None else f"{key} = {value}"
            lines.append(f"{line}  # {about}" if about else line)
        lines.append("")
    return "\n".join([*lines, *region_lines((settings or LiveSettings()).region), ""])


def _toml_value(value: object) -> str | None:
    """A value as TOML writes it; None for one that is left out."""
    if value is None or value in ("", ()):
        return None
    return checks.toml_value(str(value.resolve()) if isinstance(value, Path) else value)


FLAG_NAMES = {  # of settings whose flag has another name
    "unattended": "--yes", "page": "--no-page", "foxglove_port": "--foxglove", "page_certificate": "--page-cert",
    "page_names": "--page-name",
}  # fmt: skip


def named_by_flag(error: InputError, given: Collection[str]) -> InputError:
    """The error with the flag's name where a flag gave the value, or where no file is there to name its key.

    given: names of the settings that flags gave.
    """
    for setting in fields(LiveSettings):
        named = error.what == setting.metadata.get("name")
        if named and (setting.name in given or error.where == "command line"):
            flag = FLAG_NAMES.get(setting.name, f"--{setting.name.replace('_', '-')}")
            return InputError("command line", flag, error.got, error.allowed)
    return error


def override_settings(settings: LiveSettings, flags: dict[str, Any]) -> LiveSettings:
    """The settings overridden by the command line's, None for a flag left out. InputError: a lift without a dry run."""
    names = {f.name for f in fields(LiveSettings)}
    merged = replace(settings, **{name: value for name, value in flags.items() if name in names and value is not None})
    if flags.get("lift") is not None and not merged.dry_run:
        raise InputError("command line", "--lift", flags["lift"], "with --dry-run")
    return merged


def page_settings(settings: LiveSettings, where: object) -> OperatorSettings:
    """Settings of the page's process; InputError (where) names the key that lets nobody in, or too many."""
    s = settings
    try:
        address = ip_address(s.page_address)
    except ValueError:
        raise InputError(where, "page.address", s.page_address, "an IP address of this machine, or 0.0.0.0") from None
    for name, value in (("certificate", s.page_certificate), ("key", s.page_key)):
        if value is None and (not address.is_loopback or s.page_certificate or s.page_key):
            allowed = f"a PEM file: {s.page_address} is served encrypted or not at all"
            raise InputError(where, f"page.{name}", "missing", allowed)
        if value is not None and not value.is_file():
            raise InputError(where, f"page.{name}", value, "a PEM file that exists")
    if address.is_unspecified and not s.page_names:
        allowed = "the names by which browsers call this machine, as its certificate has them"
        raise InputError(where, "page.names", "missing", allowed)
    page = OperatorSettings(s.page_address, s.page_port, certificate=s.page_certificate, key=s.page_key)
    page = replace(page, elsewhere=not address.is_loopback, names=s.page_names)
    _check_certificate(page, where)
    if reason := _port_problem(page.host, page.port):
        allowed = f"one that is this machine's and free ({reason})"
        raise InputError(where, "page.address", f"{page.host} port {page.port}", allowed)
    return page


def _check_certificate(settings: OperatorSettings, where: object) -> None:
    if settings.certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.certificate, settings.key, lambda: "")
    except (OSError, ssl.SSLError):
        allowed = f"a PEM certificate with the key in {settings.key}, which has no password"
        raise InputError(where, "page.certificate", settings.certificate, allowed) from None
