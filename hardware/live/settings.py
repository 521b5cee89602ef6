"""session.toml: all settings of a live run in one file that is checked as a whole; flags override it.

`stillbed init FOLDER` writes one with a comment for each key; every run writes the one that it used beside its
recording. Files in it are relative to it. The operator's page is served to this machine alone unless an address is
named, and then encrypted (TLS) alone.
"""

from __future__ import annotations

import os
import re
import socket
import ssl
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from estimation.errors import InputError
from hardware.operator.settings import OperatorSettings
from hardware.process import checks

LOOPBACK = "127.0.0.1"  # nobody but this machine
VIRTUAL_ARM = "virtual"  # the arm that needs no device
MAX_LIFT_MM = 100.0  # mm of a dry run: above, the arm leaves the room that was looked at
MAX_PATIENCE = 600.0  # s of patience
MAX_CORES = 1024
MAX_PORT = 65535  # the highest
HOST_NAME = re.compile(r"(?!.*\.\.)[A-Za-z0-9][A-Za-z0-9.-]{0,252}")  # of a machine


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """What a run is told.

    rig: session folder, MCAP or rig.toml whose cameras are used; simulated: a scenario instead. path: checkpoints; of
    a scenario, its own. arm: device, URL of pyserial's or "virtual". profile: arm file. record: the recording.
    jpeg_quality: of pictures that come unencoded; 0 keeps them exactly. dry_run: nothing is extruded, the
    nozzle `lift` mm higher. unattended: nobody confirms. stands_home: the operator says that the arm does. pause_frame:
    the arm knows the frame that stops it. page: serve the operator's page, at page_address and page_port (0: any that
    is free); other machines are let in only encrypted, by page_certificate and page_key, and under page_names.
    patience: s without pictures that stop the arm. real_time: ask for that priority. cores_*: to run on, or all.
    """

    rig: Path | None = None
    simulated: Path | None = None
    path: Path | None = None
    arm: str = ""
    profile: Path | None = None
    record: Path | None = None
    jpeg_quality: int = 90  # three cameras' exact pictures take three cores to encode
    dry_run: bool = False
    lift: float = 10.0  # above a wound's rim, below what a hand would be put under
    unattended: bool = False
    stands_home: bool = False
    pause_frame: bool = True
    page: bool = True
    page_address: str = LOOPBACK
    page_port: int = 0
    page_certificate: Path | None = None
    page_key: Path | None = None
    page_names: tuple[str, ...] = ()
    patience: float = 10.0  # somebody finds a loose cable in that
    real_time: bool = True
    cores_tracking: tuple[int, ...] = ()
    cores_motion: tuple[int, ...] = ()
    cores_recorder: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class SettingKey:
    """One key of the file: its table and name there, the setting it is, what it means, and an example."""

    table: str
    name: str
    setting: str
    about: str
    example: str


SETTING_KEYS = (
    SettingKey(
        "cameras", "rig", "rig", "session folder, recording or rig.toml: which cameras, where they stand", '"rig.toml"'
    ),
    SettingKey(
        "cameras", "simulated", "simulated", "a scenario instead, rendered once and then shown in real time", '"x.toml"'
    ),
    SettingKey(
        "cameras", "patience_s", "patience", "without pictures, after which the arm is stopped; 1 to 600", "10.0"
    ),
    SettingKey("print", "path", "path", "checkpoints on the surface; a scenario has its own", '"path.csv"'),
    SettingKey("print", "dry_run", "dry_run", "nothing is extruded, and the nozzle stays above", "false"),
    SettingKey("print", "lift_mm", "lift", "how far above, in a dry run; 0 to 100", "10.0"),
    SettingKey("print", "unattended", "unattended", "nobody confirms the path and the start", "false"),
    SettingKey("arm", "device", "arm", 'path of a port, URL of pyserial\'s, or "virtual"', '"/dev/ttyUSB0"'),
    SettingKey("arm", "profile", "profile", "arm file: place, limits, dialect, lag, tool", '"arm.toml"'),
    SettingKey("arm", "stands_home", "stands_home", "an arm that does not answer stands at its home now", "false"),
    SettingKey("arm", "pause_frame", "pause_frame", "its controller knows the frame that stops it at once", "true"),
    SettingKey("arm", "real_time", "real_time", "ask the system for real-time priority", "true"),
    SettingKey("record", "file", "record", "the recording; what else a run leaves stands beside it", '"run.mcap"'),
    SettingKey("record", "jpeg_quality", "jpeg_quality", "of pictures that come unencoded, 1 to 100; 0: exact", "90"),
    SettingKey("page", "serve", "page", "the operator's page in the browser", "true"),
    SettingKey(
        "page", "address", "page_address", "where it is served; other machines are let in by TLS alone", '"0.0.0.0"'
    ),
    SettingKey("page", "port", "page_port", "0: any that is free", "8443"),
    SettingKey(
        "page", "certificate", "page_certificate", "PEM file, with all between it and an authority", '"page.pem"'
    ),
    SettingKey("page", "key", "page_key", "its PEM file, without a password", '"page.key"'),
    SettingKey("page", "names", "page_names", "by which browsers call this machine", '["printer.local"]'),
    SettingKey("cores", "tracking", "cores_tracking", "processor cores to run on; left out: all", "[0]"),
    SettingKey("cores", "motion", "cores_motion", "", "[1]"),
    SettingKey("cores", "recorder", "cores_recorder", "", "[0]"),
)
FILE_SETTINGS = ("rig", "simulated", "path", "profile", "record", "page_certificate", "page_key")
SWITCH_SETTINGS = ("dry_run", "unattended", "stands_home", "pause_frame", "page", "real_time")
SETTING_TABLES = tuple(dict.fromkeys(key.table for key in SETTING_KEYS))
FILE_HEADER = "# A live run of stillbed: `stillbed live session.toml`. Lines that begin with # are examples.\n"


def read_settings(file: Path) -> LiveSettings:
    """The settings in a session.toml; InputError names the key that makes no sense."""
    tables = checks.read_toml(file)
    checks.check_keys(file, "", tables, (), SETTING_TABLES)
    given: dict[str, Any] = {}
    for name in SETTING_TABLES:
        table = tables.get(name, {})
        if not isinstance(table, dict):
            raise InputError(file, name, table, f"a table [{name}]")
        checks.check_keys(file, f"{name}.", table, (), [key.name for key in SETTING_KEYS if key.table == name])
        for key in SETTING_KEYS:
            if key.table == name and key.name in table:
                given[key.setting] = _value(file, key, table[key.name])
    return LiveSettings(**given)


def _value(file: Path, key: SettingKey, value: object) -> Any:
    where = f"{key.table}.{key.name}"
    if key.setting in FILE_SETTINGS:
        return file.parent / checks.text(file, where, value)
    if key.setting in SWITCH_SETTINGS:
        if not isinstance(value, bool):
            raise InputError(file, where, value, "true or false")
        return value
    if key.setting.startswith("cores"):
        if not (isinstance(value, list) and all(isinstance(core, int) and 0 <= core < MAX_CORES for core in value)):
            raise InputError(file, where, value, "a list of core numbers, such as [0]")
        return tuple(value)
    if key.setting == "page_names":
        return parse_host_names(file, where, value)
    if key.setting in ("arm", "page_address"):
        return checks.text(file, where, value)
    if key.setting in ("jpeg_quality", "page_port"):
        return checks.integer(file, where, value, 0)
    return checks.number(file, where, value)


def parse_host_names(where: object, key: str, names: object) -> tuple[str, ...]:
    """Names of this machine; InputError unless they are a list of such."""
    if not (isinstance(names, list) and all(isinstance(name, str) and HOST_NAME.fullmatch(name) for name in names)):
        raise InputError(where, key, names, 'a list of names of this machine, such as ["printer.local"]')
    return tuple(names)


def check_settings(settings: LiveSettings, where: object) -> LiveSettings:
    """The settings themselves, if a run can be made of them; InputError names what is missing or out of range."""
    s = settings
    if (s.rig is None) == (s.simulated is None):
        raise InputError(where, "cameras", "both" if s.rig else "neither", "one of rig and simulated")
    if s.path is None and s.simulated is None:
        raise InputError(where, "print.path", "missing", "the file of the checkpoints")
    if not s.arm and s.simulated is None:
        raise InputError(where, "arm.device", "missing", 'a device, or "virtual"')
    if s.record is None or s.record.suffix != ".mcap":
        raise InputError(where, "record.file", s.record or "missing", "a file that ends in .mcap")
    if not 0 <= s.lift <= MAX_LIFT_MM:
        raise InputError(where, "print.lift_mm", s.lift, f"0 to {MAX_LIFT_MM:g} mm")
    if not 1 <= s.patience <= MAX_PATIENCE:
        raise InputError(where, "cameras.patience_s", s.patience, f"1 to {MAX_PATIENCE:g} s")
    if not 0 <= s.jpeg_quality <= 100:
        raise InputError(where, "record.jpeg_quality", s.jpeg_quality, "0 to 100")
    for key in (key for key in SETTING_KEYS if key.table == "cores"):
        _check_cores(where, f"cores.{key.name}", getattr(s, key.setting))
    if not 0 <= s.page_port <= MAX_PORT:
        raise InputError(where, "page.port", s.page_port, f"1 to {MAX_PORT}, or 0: any that is free")
    for name in ("rig", "simulated", "path", "profile"):
        file = getattr(s, name)
        if file is not None and not file.exists():
            raise InputError(where, name, file, "a file that exists")
    return replace(s, arm=s.arm or VIRTUAL_ARM)


def _check_cores(where: object, key: str, cores: Collection[int]) -> None:
    there = available_cores()
    if not set(there).issuperset(cores):
        raise InputError(where, key, list(cores), f"cores that there are: {', '.join(map(str, there))}")


def available_cores() -> tuple[int, ...]:
    """The processor cores that this process may run on, by number."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or MAX_CORES))


def settings_text(settings: LiveSettings | None = None) -> str:
    """A session.toml: of these settings, with whole paths, or one of comments and examples to begin with."""
    default, lines = LiveSettings(), [FILE_HEADER]
    for table in SETTING_TABLES:
        lines.append(f"[{table}]")
        for key in (key for key in SETTING_KEYS if key.table == table):
            value = getattr(settings or default, key.setting)
            shown = _shown(value)
            remark = f"  # {key.about}" if key.about else ""
            if shown is None:
                lines.append(f"# {key.name} = {key.example}{remark}")
            else:
                lines.append(f"{key.name} = {shown}{remark}")
        lines.append("")
    return "\n".join(lines)


def _shown(value: object) -> str | None:
    """A value as TOML writes it; None for one that is left out."""
    if value is None or value in ("", ()):
        return None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    if isinstance(value, Path):
        value = str(value.resolve())
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)


def override_settings(settings: LiveSettings, flags: dict[str, Any]) -> LiveSettings:
    """The settings with what was given on the command line; None was not given. InputError: a lift of a real print."""
    names = {f.name for f in fields(LiveSettings)}
    made = replace(settings, **{name: value for name, value in flags.items() if name in names and value is not None})
    if flags.get("lift") is not None and not made.dry_run:
        raise InputError("command line", "--lift", flags["lift"], "with --dry-run")
    return made


def page_settings(settings: LiveSettings, where: object) -> OperatorSettings:
    """What the page's process is told; InputError (where) names the key that lets nobody in, or too many."""
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
    made = OperatorSettings(
        host=s.page_address,
        port=s.page_port,
        elsewhere=not address.is_loopback,
        certificate=s.page_certificate,
        key=s.page_key,
        names=s.page_names,
    )
    _check_certificate(made, where)
    _check_free(made, where)
    return made


def _check_certificate(settings: OperatorSettings, where: object) -> None:
    if settings.certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.certificate, settings.key, lambda: "")
    except (OSError, ssl.SSLError):
        allowed = f"a PEM certificate with the key in {settings.key}, which has no password"
        raise InputError(where, "page.certificate", settings.certificate, allowed) from None


def _check_free(settings: OperatorSettings, where: object) -> None:
    """That this machine has that address, and nobody listens there."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        socket.create_server((settings.host, settings.port), family=family).close()
    except OSError as error:
        value = f"{settings.host} port {settings.port}"
        raise InputError(
            where, "page.address", value, f"one that is this machine's and free ({error.strerror})"
        ) from None
