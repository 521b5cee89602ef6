"""When each camera exposes, which camera truly takes a picture, and what becomes of each frame on its way."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.rig import Camera
from estimation.se3 import Array
from hardware.process import checks
from hardware.process.checks import Table
from hardware.process.faults import Fault, FaultKind, FaultPart, fault_rng, faults_striking
from hardware.simulator.scenario_tables import TableReader


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Timing and faults of all cameras of a rig, as a table [cameras] gives them: s, Hz, and shares of 1."""

    phases: tuple[float, ...]  # phase_s, one per camera: shutters that do not fire together, as their stamps tell
    offsets: tuple[float, ...]  # offset_s, hidden: true instant = stamp + offset; a list, or cameras by name
    fps: float = 30.0
    exposure: float = 0.008  # at most 1 / fps
    transport: float = 0.025  # from the end of an exposure until its frame has arrived
    every: int = 1  # only every n-th frame is taken
    start: float = 0.1  # middle of the first exposure
    jitter: float = 0.0  # hidden, standard deviation of a stamp
    transport_jitter: float = 0.0  # mean of what comes on top of the transport
    drop: float = 0.0  # frames lost
    duplicate: float = 0.0  # shown again with the next stamp
    garble: float = 0.0  # damaged
    gain_drift: float = 0.0  # the exposure control wanders by this share
    gain_period: float = 7.0
    flicker: float = 0.0  # lamps on the mains: their light goes up and down by this share
    flicker_hz: float = 100.0
    off: tuple[tuple[int, float, float], ...] = ()  # [camera, from, to], true time, without frames

    @property
    def period(self) -> float:
        """s between two frames of one camera."""
        return self.every / self.fps


def camera_settings_from_table(where: object, table: Table, names: Sequence[str]) -> CameraSettings:
    """The settings in a table [cameras]; names: the cameras', in the rig's order. InputError names the key."""
    usual = CameraSettings((), ())
    keys = TableReader(where, "cameras.", table)
    fps = keys.number("fps", usual.fps, 0.1, 1000)
    every = keys.take("every", checks.whole(1), usual.every)
    settings = CameraSettings(
        phases=_per_camera(keys, "phase_s", names, 0.0),
        offsets=_per_camera(keys, "offset_s", names, -1.0),
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
        off=_outages(keys, names),
    )
    keys.done()
    if (total := settings.drop + settings.duplicate + settings.garble) > 1:
        raise InputError(where, "cameras.drop + duplicate + garble", total, "at most 1")
    return settings


def _per_camera(keys: TableReader, key: str, names: Sequence[str], low: float) -> tuple[float, ...]:
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


def _outages(keys: TableReader, names: Sequence[str]) -> tuple[tuple[int, float, float], ...]:
    if not keys.has("off"):
        return ()
    given, allowed = keys.table["off"], f"[[camera, from, to], ...], s, camera one of {', '.join(names)}"
    if not isinstance(given, list) or not all(isinstance(one, list) and len(one) == 3 for one in given):
        raise keys.wrong("off", allowed)
    out = []
    for i, (name, *span) in enumerate(given):
        if name not in names:
            raise InputError(keys.where, f"{keys.prefix}off[{i}]", name, checks.one_of_text(str(name), names))
        start, end = (float(v) for v in checks.numbers(keys.where, f"{keys.prefix}off[{i}]", span, (2,), "from, to, s"))
        if not start < end:
            raise InputError(keys.where, f"{keys.prefix}off[{i}]", span, "from < to, s")
        out.append((list(names).index(name), start, end))
    return tuple(out)


FATE_STREAM, GAIN_STREAM = 22, 23  # of the scenario's seed: no other draw of the simulator shares them
JITTER_LIMIT = 3.0  # standard deviations, or means of the transport's exponential, at which a draw is cut
QUEUE_DELAY = 1e-4  # s by which a frame that would overtake its camera's last one arrives after it instead
JPEG_SCAN = b"\xff\xda"  # a JPEG's start of scan: all that follows its header is entropy-coded
HEADER_BYTES = 64  # bytes kept of what is no JPEG
MIN_DAMAGE, MAX_DAMAGE_SHARE = 64, 0.25  # of a damaged stretch: bytes, and share of the picture
FLASH_GAIN, BLACK_GAIN = 20.0, 0.0  # gain: light that a sensor cannot hold, and none
TRUNCATED_SHARE = 0.2  # share of damaged pictures that end early: OpenCV decodes none of them, and most of the others


class Fate(Enum):
    """What becomes of a frame on its way."""

    DELIVERED = "delivered"
    DROPPED = "dropped"
    DUPLICATED = "duplicated"
    GARBLED = "garbled"


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame of one camera, from its exposure to its arrival."""

    camera: int  # number in the rig
    number: int  # counts the camera's frames from 0
    picture: int  # number of the shot whose picture it carries, its own unless duplicated
    exposed: float  # s, true middle of that picture's exposure
    stamp: float  # s, what the software says it is
    arrival: float  # s, when the computer has it
    exposure: float  # s
    gain: float  # of the picture, 1 is nominal
    fate: Fate
    lens: int | None = None  # the camera that truly took it, None for its own
    bump: Fault | None = None  # the fault that moved that camera
    covered: Fault | None = None  # the fault that covers the wound


class SimulatedCameras:
    """The cameras of a rig in time. A frame's draws depend on seed, camera and number alone."""

    def __init__(self, settings: CameraSettings, seed: int, faults: Sequence[Fault] = ()) -> None:
        """seed: >= 0. faults: those of cameras and their clock count, and what covers the surface."""
        self.settings, self._seed = settings, seed
        of_cameras = faults_striking(faults, FaultPart.CAMERA)
        self._faults = [[f for f in of_cameras if f.number == camera] for camera in range(len(settings.phases))]
        self._swaps = faults_striking(faults, FaultPart.CAMERA, FaultKind.SWAP)
        self._jumps = faults_striking(faults, FaultPart.CLOCK)
        self._covers = faults_striking(faults, FaultPart.SURFACE, FaultKind.COVER)
        rng = np.random.default_rng([seed, GAIN_STREAM])
        self._gain_phases = rng.uniform(0, 2 * math.pi, len(settings.phases)).tolist()

    def shots(self, camera: int, until: float = math.inf) -> Iterator[Shot]:
        """A camera's frames in order, those that are due before `until`, s, true time; without it they never end.

        Stamps and, but for what is dropped, arrivals rise.
        """
        arrival, number = -math.inf, 0
        while self.due(camera, number) < until:
            shot = self._shot(camera, number, arrival + QUEUE_DELAY)
            if shot.fate is not Fate.DROPPED:
                arrival = shot.arrival
            yield shot
            number += 1

    def due(self, camera: int, number: int) -> float:
        """True middle, s, of a camera's exposure."""
        settings = self.settings
        return settings.start + settings.phases[camera] + number * settings.every / settings.fps

    def _shot(self, camera: int, number: int, earliest: float) -> Shot:
        settings, due = self.settings, self.due(camera, number)
        lot, stamp_jitter, transport_jitter = self._draw(camera, number)
        fate = self._fate(camera, number, lot)
        picture = number
        while picture and self._fate(camera, picture, self._draw(camera, picture)[0]) is Fate.DUPLICATED:
            picture -= 1
        exposed = self.due(camera, picture)
        lens = self._lens(camera, exposed)
        arrival = due + settings.exposure / 2 + settings.transport + transport_jitter
        arrival += sum(fault.amount for fault in self._strike(camera, due, FaultKind.SLOW))
        jump = sum(fault.amount for fault in self._jumps if fault.covers(due))
        return Shot(
            camera=camera,
            number=number,
            picture=picture,
            exposed=exposed,
            stamp=due - settings.offsets[camera] + stamp_jitter + jump,
            arrival=max(arrival, earliest),
            exposure=settings.exposure,
            gain=self._gain(lens, exposed),
            fate=fate,
            lens=lens,
            bump=next(iter(self._strike(lens, exposed, FaultKind.BUMP)), None),
            covered=next((fault for fault in self._covers if fault.covers(exposed)), None),
        )

    def _strike(self, camera: int, instant: float, *kinds: FaultKind) -> list[Fault]:
        return [fault for fault in self._faults[camera] if fault.kind in kinds and fault.covers(instant)]

    def _lens(self, camera: int, exposed: float) -> int:
        for fault in self._swaps:
            pair = fault.number, (fault.number + 1) % len(self._faults)
            if fault.covers(exposed) and camera in pair:
                camera = pair[1 - pair.index(camera)]
        return camera

    def _draw(self, camera: int, number: int) -> tuple[float, float, float]:
        """What chance decides of one frame: its lot in [0, 1), and s added to its stamp and to its transport."""
        rng = np.random.default_rng([self._seed, FATE_STREAM, camera, number])
        stamp = float(np.clip(rng.standard_normal(), -JITTER_LIMIT, JITTER_LIMIT)) * self.settings.jitter
        transport = min(rng.standard_exponential(), JITTER_LIMIT) * self.settings.transport_jitter
        return float(rng.random()), stamp, transport

    def _fate(self, camera: int, number: int, lot: float) -> Fate:
        settings, due = self.settings, self.due(camera, number)
        off = any(which == camera and start <= due < end for which, start, end in settings.off)
        kinds = [fault.kind for fault in self._strike(camera, due, FaultKind.OFF, FaultKind.STUCK, FaultKind.GARBLE)]
        if off or FaultKind.OFF in kinds or lot < settings.drop:
            return Fate.DROPPED
        if (FaultKind.STUCK in kinds or lot < settings.drop + settings.duplicate) and number:
            return Fate.DUPLICATED
        if FaultKind.GARBLE in kinds or 0 <= lot - settings.drop - settings.duplicate < settings.garble:
            return Fate.GARBLED
        return Fate.DELIVERED

    def _gain(self, camera: int, exposed: float) -> float:
        settings = self.settings
        drift = math.sin(2 * math.pi * exposed / settings.gain_period + self._gain_phases[camera])
        light = math.sin(2 * math.pi * settings.flicker_hz * exposed) * np.sinc(settings.flicker_hz * settings.exposure)
        kinds = [fault.kind for fault in self._strike(camera, exposed, FaultKind.BLACK, FaultKind.FLASH)]
        fault_gain = BLACK_GAIN if FaultKind.BLACK in kinds else FLASH_GAIN if FaultKind.FLASH in kinds else 1.0
        return float((1 + settings.gain_drift * drift) * (1 + settings.flicker * light)) * fault_gain


def garble(data: bytes, rng: np.random.Generator) -> bytes:
    """An encoded picture as a bad transfer leaves it: a stretch of it zeroed, repeated or missing, or no end.

    The header stays whole. Most JPEGs still decode, with a damaged part; some do not.
    """
    marker, first = data.find(JPEG_SCAN), min(HEADER_BYTES, len(data) // 2)
    if data[:2] == b"\xff\xd8" and marker >= 0:
        first = min(marker + 2 + int.from_bytes(data[marker + 2 : marker + 4], "big"), len(data) - 1)
    max_length = max(MIN_DAMAGE, int(MAX_DAMAGE_SHARE * len(data)))
    length = int(np.exp(rng.uniform(np.log(MIN_DAMAGE), np.log(max_length + 1))))
    start = int(rng.integers(first, max(first + 1, len(data) - length)))
    end = min(start + length, len(data))
    if rng.random() < TRUNCATED_SHARE:
        return data[:start]
    stretch = (bytes(end - start), data[max(first, start - (end - start)) : start], b"")[int(rng.integers(3))]
    return data[:start] + stretch + data[end:]


class TrueCameras:
    """The true cameras of a rig; a bumped one is the same object for as long as its fault lasts."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras, self.names = cameras, [camera.name for camera in cameras]
        self._bumped: dict[tuple[int, Fault], Camera] = {}

    def __call__(self, shot: Shot) -> Camera:
        """The camera that took a shot's picture."""
        number = shot.camera if shot.lens is None else shot.lens
        camera = self._cameras[number]
        if shot.bump is None:
            return camera
        key = number, shot.bump
        if key not in self._bumped:
            self._bumped[key] = replace(camera, base_from_camera=camera.base_from_camera @ bump_transform(shot.bump))
        return self._bumped[key]


def bump_transform(fault: Fault) -> Array:
    """camera_from_bumped (4, 4): aside by the fault's amount, mm, across the line of sight."""
    angle = fault_rng(fault).uniform(0, 2 * np.pi)
    return se3.make(np.eye(3), fault.amount * np.array([np.cos(angle), np.sin(angle), 0.0]))
