"""When each camera exposes and what becomes of each frame; nothing here knows what is in the pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from hardware.process.faults import Fault, Kind, Part, struck
from hardware.simulator.camera_settings import CameraSettings

FATE_STREAM, GAIN_STREAM = 22, 23  # of the scenario's seed: no other draw of the simulator shares them
JITTER_LIMIT = 3.0  # standard deviations, or means of the transport's exponential, at which a draw is cut
QUEUE = 1e-4  # s by which a frame that would overtake its camera's last one arrives after it instead
SCAN = b"\xff\xda"  # a JPEG's start of scan: all that follows its header is entropy-coded
HEAD = 64  # bytes kept of what is no JPEG
SHORTEST, LONGEST = 64, 0.25  # of a damaged stretch: bytes, and share of the picture
FLASHED, BLACKENED = 20.0, 0.0  # gain: light that a sensor cannot hold, and none
CUT_SHORT = 0.2  # share of damaged pictures that end early: OpenCV decodes none of them, and most of the others


class Fate(Enum):
    """What becomes of a frame on its way."""

    DELIVERED = "delivered"
    DROPPED = "dropped"
    DUPLICATED = "duplicated"
    GARBLED = "garbled"


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame of one camera, from its exposure to its arrival.

    camera: its number in the rig. number: counts the camera's frames from 0. picture: number of the shot whose picture
    it carries, its own unless duplicated. exposed: s, true middle of that picture's exposure. stamp: s, what the
    software says it is. arrival: s, when the computer has it. exposure: s. gain: of the picture, 1 is nominal. lens:
    the camera that truly took it, None for its own; bump: the fault by which that one stands aside. covered: the fault
    that lies something over the wound.
    """

    camera: int
    number: int
    picture: int
    exposed: float
    stamp: float
    arrival: float
    exposure: float
    gain: float
    fate: Fate
    lens: int | None = None
    bump: Fault | None = None
    covered: Fault | None = None


@dataclass(frozen=True, slots=True)
class _Draw:
    """What chance decides of one frame: its lot in [0, 1), and s added to its stamp and to its way."""

    lot: float
    stamp: float
    transport: float


class SimulatedCameras:
    """The cameras of a rig in time. A frame's draws depend on seed, camera and number alone."""

    def __init__(self, settings: CameraSettings, seed: int, faults: Sequence[Fault] = ()) -> None:
        """seed: >= 0. faults: those of cameras and their clock count, and what covers the surface."""
        self.settings, self._seed = settings, seed
        self._faults = [struck(faults, Part.CAMERA) for _ in settings.phases]
        for camera, mine in enumerate(self._faults):
            self._faults[camera] = [fault for fault in mine if fault.number == camera]
        self._swaps = struck(faults, Part.CAMERA, Kind.SWAP)
        self._jumps, self._covers = struck(faults, Part.CLOCK), struck(faults, Part.SURFACE, Kind.COVER)
        rng = np.random.default_rng([seed, GAIN_STREAM])
        self._gain_phases = rng.uniform(0, 2 * math.pi, len(settings.phases)).tolist()

    def shots(self, camera: int, until: float = math.inf) -> Iterator[Shot]:
        """A camera's frames in order, those that are due before `until`, s, true time; without it they never end.

        Stamps and, but for what is dropped, arrivals rise.
        """
        arrival, number = -math.inf, 0
        while self.due(camera, number) < until:
            shot = self._shot(camera, number, arrival + QUEUE)
            if shot.fate is not Fate.DROPPED:
                arrival = shot.arrival
            yield shot
            number += 1

    def due(self, camera: int, number: int) -> float:
        """True middle, s, of a camera's exposure."""
        settings = self.settings
        return settings.start + settings.phases[camera] + number * settings.every / settings.fps

    def _shot(self, camera: int, number: int, earliest: float) -> Shot:
        settings, due, draw = self.settings, self.due(camera, number), self._draw(camera, number)
        fate = self._fate(camera, number, draw.lot)
        picture = number
        while picture and self._fate(camera, picture, self._draw(camera, picture).lot) is Fate.DUPLICATED:
            picture -= 1
        exposed = self.due(camera, picture)
        lens = self._lens(camera, exposed)
        arrival = due + settings.exposure / 2 + settings.transport + draw.transport
        arrival += sum(fault.amount for fault in self._strike(camera, due, Kind.SLOW))
        jump = sum(fault.amount for fault in self._jumps if fault.covers(due))
        return Shot(
            camera=camera,
            number=number,
            picture=picture,
            exposed=exposed,
            stamp=due - settings.offsets[camera] + draw.stamp + jump,
            arrival=max(arrival, earliest),
            exposure=settings.exposure,
            gain=self._gain(lens, exposed),
            fate=fate,
            lens=lens,
            bump=next(iter(self._strike(lens, exposed, Kind.BUMP)), None),
            covered=next((fault for fault in self._covers if fault.covers(exposed)), None),
        )

    def _strike(self, camera: int, instant: float, *kinds: Kind) -> list[Fault]:
        """The faults of some kinds that strike a camera at an instant, s."""
        return [fault for fault in self._faults[camera] if fault.kind in kinds and fault.covers(instant)]

    def _lens(self, camera: int, exposed: float) -> int:
        """The camera whose cable is plugged in for this one."""
        for fault in self._swaps:
            pair = fault.number, (fault.number + 1) % len(self._faults)
            if fault.covers(exposed) and camera in pair:
                camera = pair[1 - pair.index(camera)]
        return camera

    def _draw(self, camera: int, number: int) -> _Draw:
        rng = np.random.default_rng([self._seed, FATE_STREAM, camera, number])
        stamp = float(np.clip(rng.standard_normal(), -JITTER_LIMIT, JITTER_LIMIT)) * self.settings.jitter
        transport = min(rng.standard_exponential(), JITTER_LIMIT) * self.settings.transport_jitter
        return _Draw(float(rng.random()), stamp, transport)

    def _fate(self, camera: int, number: int, lot: float) -> Fate:
        settings, due = self.settings, self.due(camera, number)
        off = any(which == camera and start <= due < end for which, start, end in settings.off)
        struck = [fault.kind for fault in self._strike(camera, due, Kind.OFF, Kind.STUCK, Kind.GARBLE)]
        if off or Kind.OFF in struck or lot < settings.drop:
            return Fate.DROPPED
        if (Kind.STUCK in struck or lot < settings.drop + settings.duplicate) and number:
            return Fate.DUPLICATED
        if Kind.GARBLE in struck or 0 <= lot - settings.drop - settings.duplicate < settings.garble:
            return Fate.GARBLED
        return Fate.DELIVERED

    def _gain(self, camera: int, exposed: float) -> float:
        """Exposure control and lamps, whose light an exposure averages."""
        settings = self.settings
        drift = math.sin(2 * math.pi * exposed / settings.gain_period + self._gain_phases[camera])
        light = math.sin(2 * math.pi * settings.flicker_hz * exposed) * np.sinc(settings.flicker_hz * settings.exposure)
        struck = [fault.kind for fault in self._strike(camera, exposed, Kind.BLACK, Kind.FLASH)]
        given = BLACKENED if Kind.BLACK in struck else FLASHED if Kind.FLASH in struck else 1.0
        return float((1 + settings.gain_drift * drift) * (1 + settings.flicker * light)) * given


def garble(data: bytes, rng: np.random.Generator) -> bytes:
    """An encoded picture as a bad transfer leaves it: a stretch of it zeroed, repeated or missing, or no end.

    The header stays whole. Most JPEGs still decode, with a damaged part; some do not.
    """
    first = _scan_start(data)
    most = max(SHORTEST, int(LONGEST * len(data)))
    length = int(np.exp(rng.uniform(np.log(SHORTEST), np.log(most + 1))))
    start = int(rng.integers(first, max(first + 1, len(data) - length)))
    end = min(start + length, len(data))
    if rng.random() < CUT_SHORT:
        return data[:start]
    stretch = (bytes(end - start), data[max(first, start - (end - start)) : start], b"")[int(rng.integers(3))]
    return data[:start] + stretch + data[end:]


def _scan_start(data: bytes) -> int:
    """Where the coded picture of a JPEG begins; of anything else, after its first bytes."""
    marker = data.find(SCAN)
    if data[:2] != b"\xff\xd8" or marker < 0:
        return min(HEAD, len(data) // 2)
    return min(marker + 2 + int.from_bytes(data[marker + 2 : marker + 4], "big"), len(data) - 1)
