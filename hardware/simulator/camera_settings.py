"""When the cameras of a rig expose, and how their frames fare on the way: settings and their table.

[cameras]
fps = 30.0
exposure_s = 0.008
transport_s = 0.025            # from the end of an exposure until its frame has arrived
every = 1                      # only every n-th frame is taken
start_s = 0.1                  # middle of the first exposure
phase_s = [0, 0.005, 0.011]    # shutters that do not fire together: each camera's delay, which its stamps tell
offset_s = {side = 0.016}      # hidden: true instant = stamp + offset; a list, or cameras by name, the others 0
jitter_s = 0.0                 # hidden, standard deviation of a stamp
transport_jitter_s = 0.0       # mean of what comes on top of the transport
drop = 0.0                     # shares of frames: lost,
duplicate = 0.0                # shown again with the next stamp,
garble = 0.0                   # damaged
gain_drift = 0.0               # the exposure control wanders by this share
gain_period_s = 7.0
flicker = 0.0                  # lamps on the mains: their light goes up and down by this share
flicker_hz = 100.0
off = [["side", 5.0, 8.0]]     # a camera that delivers nothing from .. to, s
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from estimation.errors import InputError
from hardware.process import checks
from hardware.process.checks import Table
from hardware.simulator.scenario_tables import Keys


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Timing and faults of all cameras of a rig, s, Hz and shares; what each field does stands at the file's top.

    phases, offsets: one per camera, s. off: (camera's number in the rig, from, to), s, true time.
    """

    phases: tuple[float, ...]
    offsets: tuple[float, ...]
    fps: float = 30.0
    exposure: float = 0.008
    transport: float = 0.025
    every: int = 1
    start: float = 0.1
    jitter: float = 0.0
    transport_jitter: float = 0.0
    drop: float = 0.0
    duplicate: float = 0.0
    garble: float = 0.0
    gain_drift: float = 0.0
    gain_period: float = 7.0
    flicker: float = 0.0
    flicker_hz: float = 100.0
    off: tuple[tuple[int, float, float], ...] = ()

    @property
    def period(self) -> float:
        """s between two frames of one camera."""
        return self.every / self.fps


def camera_settings_from_table(where: object, table: Table, names: Sequence[str]) -> CameraSettings:
    """The settings in a table [cameras]; names: the cameras', in the rig's order. InputError names the key."""
    usual = CameraSettings((), ())
    keys = Keys(where, "cameras.", table)
    fps = keys.number("fps", usual.fps, 0.1, 1000)
    every = keys.whole("every", usual.every, 1)
    settings = CameraSettings(
        phases=_each(keys, "phase_s", names, 0.0),
        offsets=_each(keys, "offset_s", names, -1.0),
        fps=fps,
        exposure=keys.number("exposure_s", min(usual.exposure, 1 / fps), 0, 1 / fps),
        transport=keys.number("transport_s", usual.transport, 0, 10),
        every=every,
        start=keys.number("start_s", usual.start, 0),
        jitter=keys.number("jitter_s", usual.jitter, 0, every / fps / 8),  # or a stamp could come before the last
        transport_jitter=keys.number("transport_jitter_s", usual.transport_jitter, 0, 10),
        drop=keys.number("drop", usual.drop, 0, 1),
        duplicate=keys.number("duplicate", usual.duplicate, 0, 1),
        garble=keys.number("garble", usual.garble, 0, 1),
        gain_drift=keys.number("gain_drift", usual.gain_drift, 0, 0.9),
        gain_period=keys.number("gain_period_s", usual.gain_period, 0, open=True),
        flicker=keys.number("flicker", usual.flicker, 0, 0.9),
        flicker_hz=keys.number("flicker_hz", usual.flicker_hz, 0, open=True),
        off=_off(keys, names),
    )
    keys.done()
    if settings.drop + settings.duplicate + settings.garble > 1:
        total = settings.drop + settings.duplicate + settings.garble
        raise InputError(where, "cameras.drop + duplicate + garble", total, "at most 1")
    return settings


def _each(keys: Keys, key: str, names: Sequence[str], low: float) -> tuple[float, ...]:
    """One number per camera, from a list in the rig's order or from a table by name; 0 for what is not named."""
    if not keys.has(key):
        return (0.0,) * len(names)
    given = keys.table[key]
    if isinstance(given, dict):
        checks.check_keys(keys.where, f"{keys.prefix}{key}.", given, (), names)
        values = [checks.number(keys.where, f"{keys.prefix}{key}.{n}", given[n]) if n in given else 0.0 for n in names]
    else:
        values = checks.numbers(keys.where, keys.prefix + key, given, (len(names),), "one per camera").tolist()
    if not all(low <= value <= 1 for value in values):
        raise keys.wrong(key, f"{low:g} to 1 s each")
    return tuple(values)


def _off(keys: Keys, names: Sequence[str]) -> tuple[tuple[int, float, float], ...]:
    if not keys.has("off"):
        return ()
    given, allowed = keys.table["off"], f"[[camera, from, to], ...], s, camera one of {', '.join(names)}"
    if not isinstance(given, list) or not all(isinstance(one, list) and len(one) == 3 for one in given):
        raise keys.wrong("off", allowed)
    out = []
    for i, (name, *span) in enumerate(given):
        if name not in names:
            raise InputError(keys.where, f"{keys.prefix}off[{i}]", name, checks.meant(str(name), names))
        start, end = (float(v) for v in checks.numbers(keys.where, f"{keys.prefix}off[{i}]", span, (2,), "from, to, s"))
        if not start < end:
            raise InputError(keys.where, f"{keys.prefix}off[{i}]", span, "from < to, s")
        out.append((list(names).index(name), start, end))
    return tuple(out)
