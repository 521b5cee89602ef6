"""Dispenser files: one or several `[[dispenser]]` tables, in mm, s and degrees C; docs/dispenser.md lists their keys.

Keys that a file leaves out have their preset's values. A preset is one of PRESETS, or says that the arm itself does it:
arm_pwm, whose frames switch it, or arm_axis, whose axis E pushes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from estimation.errors import InputError
from hardware.arm.profile import DRIVERS, ArmProfile, Extruder, driver_kind
from hardware.dispenser.dispenser import ArmAxisDispenser, ArmPwmDispenser, Dispenser, DispenserProfile, Dispensers
from hardware.dispenser.line_dispenser import LineDispenser, opener_for
from hardware.dispenser.messages import PRESETS, DispenserLine, DispenserMessages, MessageValues, Preset
from hardware.process import checks
from hardware.process.progress import write_atomically
from planning.material import Outlet, Outlets, SwitchDelay

ARM_PWM, ARM_AXIS = "arm_pwm", "arm_axis"
PRESET_NAMES = (*PRESETS, ARM_PWM, ARM_AXIS)
DELAY_KEYS = {f"{name}_s": name for name in ("on_dead_time", "on_lag", "off_dead_time", "off_lag")}


def _materials(where: object, key: str, value: object) -> tuple[str, ...]:
    names = value if isinstance(value, list) else []
    if not names or not all((isinstance(w, str) and w) or type(w) is int for w in names):
        raise InputError(where, key, value, "a list of names or whole numbers, one or more")
    return tuple(map(str, names))


PROFILE_KEYS: checks.Keys = {
    "name": ("name", checks.text),
    "materials": ("materials", _materials),
    **{key: (name, checks.number) for key, name in DELAY_KEYS.items()},
    "flow_range_mm3_s": ("flow_range", checks.pair()),
    "temperature_range_c": ("temperature_range", checks.pair()),
    "nozzle_offset_mm": ("nozzle_offset", checks.array((3,), "mm")),
    "watchdog_s": ("watchdog", checks.number),
    "metered": ("metered", checks.flag),
    "flow_mm3_s": ("flow", checks.number),
    "kept_at_c": ("kept_at", checks.number),
    "prime_mm3": ("prime_volume", checks.number),
    "retract_mm3": ("retract_volume", checks.number),
}
LINE_KEYS: checks.Keys = {
    "port": ("port", checks.text),
    "baud": ("baud", checks.whole(300)),
    "keepalive_s": ("keepalive", checks.within(0.01, 10.0, "s")),
    "start_s": ("start", checks.within(0.0, 30.0, "s")),
    "gap_s": ("gap", checks.within(0.0, 1.0, "s")),
    "timeout_s": ("timeout", checks.within(0.05, 5.0, "s")),
    "plunger_mm2": ("plunger", checks.within(0.01, 10_000.0, "mm^2")),
}
PWM_NUMBER = checks.within(-1e6, 1e6)  # as a binary32 it is exact to a tenth there
PWM_KEYS: checks.Keys = {key: (key, PWM_NUMBER) for key in ("pwm_on", "pwm_off")}
AXIS_KEYS: checks.Keys = {"plunger_mm2": LINE_KEYS["plunger_mm2"]}
KEEPALIVE_SHARE = 0.4  # of the watchdog, at most: one keepalive may be lost and the next late


@dataclass(frozen=True, slots=True)
class DispenserSettings:
    """One table of a dispenser file.

    line: None where the arm itself switches or pushes it.
    pwm: of arm_pwm, the numbers for on and off.
    extruder: of arm_axis.
    """

    profile: DispenserProfile
    preset: str
    line: DispenserLine | None
    pwm: tuple[float, float] | None = None
    extruder: Extruder | None = None


def read_dispensers(path: str | Path) -> tuple[DispenserSettings, ...]:
    """What is in a dispenser file; InputError names the key that makes no sense."""
    return _settings(Path(path), checks.read_toml(Path(path)))


def dispensers_from_text(text: str, where: str | Path) -> tuple[DispenserSettings, ...]:
    """What is in the text of a dispenser file; InputError (where) as `read_dispensers`."""
    return _settings(Path(where), checks.toml_from_text(where, text))


def dispenser_from_settings(settings: DispenserSettings) -> Dispenser:
    """The driver of one; nothing is opened yet."""
    if settings.pwm is not None:
        return ArmPwmDispenser(settings.profile, *settings.pwm)
    if settings.line is None:
        return ArmAxisDispenser(settings.profile)
    return LineDispenser(settings.profile, settings.line)


def outlets_from(settings: Sequence[DispenserSettings], where: object = "dispenser") -> Outlets:
    """The outlet of each material; InputError (where) for a delay that is too long to be led."""
    outlets: dict[str, Outlet] = {}
    for each in settings:
        profile = each.profile
        try:
            delay = SwitchDelay(profile.on_delay, profile.off_delay, with_moves=each.line is None)
        except InputError as error:
            what = f"{profile.name}: {error.what}"
            raise InputError(where, what, error.got, f"{error.allowed} (dead time + 0.69 lag)") from None
        x, y, z = profile.nozzle_offset.tolist()
        outlets |= {material: Outlet(delay, (x, y, z)) for material in profile.materials}
    return outlets


def arm_with_dispensers(profile: ArmProfile, text: str) -> ArmProfile:
    """The profile of the arm, which itself switches or pushes what the text of a dispenser file says; "": nothing."""
    for each in dispensers_from_text(text, "dispenser.toml") if text else ():
        if each.pwm is not None:
            on, off = each.pwm
            profile = replace(profile, dialect=replace(profile.dialect, pwm=off, pwm_on=on))
        profile = replace(profile, extruder=each.extruder)
    return profile


def check_arm_moves(settings: Sequence[DispenserSettings], arm: str, where: object) -> None:
    """InputError (where) for a dispenser that the arm at that address cannot switch or push by itself."""
    for preset in (each.preset for each in settings if each.line is None):
        if preset != driver_kind(arm).dispenser:
            kinds = " or ".join(kind.name for kind in DRIVERS if kind.dispenser == preset)
            raise InputError(where, "dispenser.preset", preset, f"one for {arm}; this one needs a {kinds} as the arm")


def drivers_of(settings: Sequence[DispenserSettings], where: object = "dispensers") -> Dispensers:
    """The drivers of what is in a file, closed."""
    return Dispensers([dispenser_from_settings(each) for each in settings], where)


def _settings(path: Path, table: checks.Table) -> tuple[DispenserSettings, ...]:
    checks.check_keys(path, "", table, ("dispenser",))
    tables = checks.tables(path, "dispenser", table["dispenser"])
    settings = [_one(path, each) for each in tables]
    names = [each.profile.name for each in settings]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(path, "dispenser.name", name, "a name, and each once")
    for each in settings if len(settings) > 1 else ():
        if each.line is None:
            raise InputError(path, "dispenser.preset", each.preset, "the only one: the arm's moves say not for which")
    Dispensers([ArmPwmDispenser(each.profile, 0, 0) for each in settings], path)  # whether two carry one material
    return tuple(settings)


def _one(path: Path, table: checks.Table) -> DispenserSettings:
    preset = checks.word(PRESET_NAMES)(path, "dispenser.preset", table["preset"]) if "preset" in table else ""
    keys = {ARM_PWM: PWM_KEYS, ARM_AXIS: AXIS_KEYS}.get(preset)
    special, required = ({**LINE_KEYS, "messages": ()}, ["port"]) if keys is None else (keys, list(keys))
    required += ["flow_range_mm3_s"] if preset == ARM_AXIS else []
    checks.check_keys(path, "dispenser.", table, ("name", "materials", "preset", *required), [*PROFILE_KEYS, *special])
    if preset == ARM_AXIS:
        for key in ("metered", "temperature_range_c", "watchdog_s", "prime_mm3", "flow_mm3_s"):
            if table.get(key):
                raise InputError(path, f"dispenser.{key}", table[key], "left out of arm_axis, a part of the moves")
        axis = replace(_profile(path, table, None), metered=True)
        area = checks.table_fields(path, "dispenser.", table, AXIS_KEYS)["plunger"]
        extruder = Extruder(area, axis.flow_range[1], axis.retract_volume)
        return DispenserSettings(axis, preset, None, extruder=extruder)
    if preset == ARM_PWM:
        for key in ("metered", "temperature_range_c", "watchdog_s", "prime_mm3", "retract_mm3"):
            if table.get(key):
                raise InputError(path, f"dispenser.{key}", table[key], "left out of arm_pwm, which can only switch")
        pwm = checks.table_fields(path, "dispenser.", table, PWM_KEYS)
        if pwm["pwm_on"] == pwm["pwm_off"]:
            raise InputError(path, "dispenser.pwm_on", table["pwm_on"], "another number than pwm_off")
        return DispenserSettings(_profile(path, table, None), preset, None, (pwm["pwm_on"], pwm["pwm_off"]))
    kind = PRESETS[preset]
    profile, line = _profile(path, table, kind), _line(path, table, kind)
    _check_both(path, table, kind, profile, line)
    return DispenserSettings(profile, preset, line)


def _profile(path: Path, table: checks.Table, preset: Preset | None) -> DispenserProfile:
    usual: dict[str, Any] = {}
    if preset is not None:
        usual = {"metered": preset.metered, "watchdog": preset.watchdog, "flow_range": preset.flow_range}

    def profile(**values: Any) -> DispenserProfile:
        values = usual | values
        return DispenserProfile(**values | {"watchdog": values.get("watchdog") or None})

    return checks.record_from_table(path, "dispenser.", table, profile, PROFILE_KEYS, also=table)


def _line(path: Path, table: checks.Table, preset: Preset) -> DispenserLine:
    changes = checks.table_fields(path, "dispenser.", table, LINE_KEYS)
    for key in preset.settings:
        if key not in table:
            raise InputError(path, f"dispenser.{key}", "missing", f"this key, which the preset {table['preset']} needs")
    line = replace(preset.line, messages=_messages(path, table, preset.line.messages), **changes)
    try:
        line.messages.check(MessageValues(plunger=line.plunger))
    except InputError as error:
        raise InputError(path, f"dispenser.messages.{error.what}", error.got, error.allowed) from None
    try:
        opener_for(line).release()
    except InputError as error:
        raise InputError(path, "dispenser.port", error.got, error.allowed) from None
    return line


def _messages(path: Path, table: checks.Table, preset: DispenserMessages) -> DispenserMessages:
    own, words = checks.table_at(path, "dispenser.", table, "messages"), fields(DispenserMessages)
    keys: checks.Keys = {each.name: (each.name, checks.any_text) for each in words}
    return checks.record_from_table(path, "dispenser.messages.", own, partial(replace, preset), keys)


def _check_both(
    path: Path, table: checks.Table, preset: Preset, profile: DispenserProfile, line: DispenserLine
) -> None:
    """That the messages can do what the profile says."""
    messages, (low, high) = line.messages, preset.flow_range
    if profile.metered and not low <= profile.flow_range[0] < profile.flow_range[1] <= high:
        allowed = f"within {low:g} to {high:g} mm^3/s, what the messages of {table['preset']} can say"
        raise InputError(path, "dispenser.flow_range_mm3_s", list(profile.flow_range), allowed)
    if profile.metered and "{flow" not in messages.on and "{step" not in messages.on:
        raise InputError(path, "dispenser.messages.on", messages.on, "a text with a flow in it, as it is metered")
    for key, value, name in (
        ("temperature_range_c", profile.temperature_range, "temperature"),
        ("watchdog_s", profile.watchdog, "keepalive"),
        ("retract_mm3", profile.retract_volume, "retract"),
        ("prime_mm3", profile.prime_volume, "prime"),
    ):
        if value and not getattr(messages, name):
            raise InputError(path, f"dispenser.{key}", table.get(key), f"left out, or messages.{name} for it")
    if (
        profile.watchdog
        and line.keepalive > KEEPALIVE_SHARE * profile.watchdog * (1 + 1e-9)
        and "{step" not in messages.on
    ):
        allowed = f"at most {KEEPALIVE_SHARE * profile.watchdog:g} s, {KEEPALIVE_SHARE:g} of watchdog_s"
        raise InputError(path, "dispenser.keepalive_s", line.keepalive, allowed)


HEADER = re.compile(r"^\s*\[")


def write_delays(path: str | Path, name: str, delays: DispenserProfile) -> None:
    """Write the four delays of a profile into the table of dispenser `name`; all else in the file stays as it is.

    InputError where there is no such table. The file is whole at every instant.
    """
    path = Path(path)
    names = [each.profile.name for each in read_dispensers(path)]
    if name not in names:
        raise InputError(path, "dispenser.name", name, checks.one_of_text(name, names))
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    heads = [i for i, line in enumerate(lines) if re.match(r"\s*\[\[\s*dispenser\s*\]\]", line)]
    if len(heads) != len(names):
        raise InputError(path, "dispenser", f"{len(heads)} of {len(names)} tables", "[[dispenser]], each on its line")
    start = heads[names.index(name)] + 1
    end = next((i for i in range(start, len(lines)) if HEADER.match(lines[i])), len(lines))
    body, replacement = lines[start:end], []
    for key, field_name in DELAY_KEYS.items():
        value = checks.toml_value(round(getattr(delays, field_name), 6))
        at = next((i for i, line in enumerate(body) if re.match(rf"\s*{key}\s*=", line)), None)
        if at is None:
            replacement.append(f"{key} = {value}")
        else:
            body[at] = re.sub(r"=\s*[^#\s]+", f"= {value}", body[at], count=1)
    text = "\n".join([*lines[:start], *replacement, *body, *lines[end:]]) + "\n"
    dispensers_from_text(text, path)
    write_atomically(path, text)
