"""What becomes of the cameras' shots in virtual time: pictures, frame sets, and poses once the tracker had its time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose
from hardware.files.images import decode
from hardware.offline.track import Step
from hardware.process.clock import Clock
from hardware.process.faults import Part, struck
from hardware.rates import Rates
from hardware.recording.schemas import WARNING
from hardware.simulator.agenda import ARRIVAL, EXPOSURE, KNOWN, Agenda
from hardware.simulator.cameras import Fate, Shot, SimulatedCameras
from hardware.simulator.instant import Instant
from hardware.simulator.pictures import Pictures
from hardware.simulator.scenario import Scenario
from perception.frames import Frame, FrameSet, PrintHead
from perception.pairing import Pairing
from perception.tracking.step import StepReport

NO_IMAGE = np.zeros((0, 0), np.uint8)  # of a frame that nobody looks at

Exposures = dict[tuple[int, float], Shot]  # by camera and stamp, s


class Watcher(Protocol):
    """What is told of everything that is seen."""

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        """A picture that can be decoded has arrived, as encoded by its camera."""
        ...

    def head(self, stamp: float, head: PrintHead) -> None:
        """Where the print head was at the stamp of a frame set, s, which may yet find the tracker busy."""
        ...

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        """A pose was made of a frame set in `spent` s of real time."""
        ...

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        """Something that a person should know."""
        ...


Known = Callable[[SurfacePose, FrameSet, Observations], None]  # a pose has reached the motion


class Sight:
    """The cameras and the tracker of one run. tracked, skipped: frame sets, and those the tracker had no time for."""

    def __init__(
        self,
        scenario: Scenario,
        agenda: Agenda,
        step: Step,
        exposures: Exposures,
        sink: Watcher,
        clock: Clock,
        known: Known,
        pictures: Pictures | None = None,
        instant: Callable[[Shot, float], Instant] | None = None,
        head: Callable[[float], PrintHead | None] = lambda stamp: None,
    ) -> None:
        """exposures: filled with the shot of each picture, for a step that may know. clock: measures tracking times.

        pictures, instant: what renders the shots, and the world as one meets it; without them nobody looks. head: where
        the print head was at a stamp, s.
        """
        self.tracked, self.skipped = 0, 0
        self._scenario, self._agenda, self._step, self._exposed = scenario, agenda, step, exposures
        self._sink, self._clock, self._known = sink, clock, known
        self._pictures, self._instant, self._head = pictures, instant, head
        self._cameras = SimulatedCameras(scenario.cameras, scenario.seed, scenario.faults)
        self._pairer = Pairing(len(scenario.rig), scenario.cameras.period)
        self._rates = Rates(struck(scenario.faults, Part.TRACKING))
        self._busy = False  # the tracker
        self._waiting: FrameSet | None = None  # the newest that came meanwhile

    def begin(self) -> None:
        """Put the first exposure of each camera on the agenda."""
        for camera in range(len(self._scenario.rig)):
            self._next_shot(self._cameras.shots(camera, self._scenario.seconds))

    def _next_shot(self, shots: Iterator[Shot]) -> None:
        shot = next(shots, None)
        if shot is not None:
            due = self._cameras.due(shot.camera, shot.number)
            self._agenda.at(due, EXPOSURE, partial(self._expose, shot, shots))

    def _expose(self, shot: Shot, shots: Iterator[Shot], now: float) -> None:
        """Half of a camera's exposure is over: from here on the world may change, the picture may not."""
        self._next_shot(shots)
        if shot.fate is Fate.DROPPED:
            return
        self._exposed[shot.camera, shot.stamp] = shot
        if self._pictures is not None and self._instant is not None:
            self._pictures.expose(shot, self._instant(shot, now))
        self._agenda.at(shot.arrival, ARRIVAL, partial(self._arrive, shot))

    def _arrive(self, shot: Shot, now: float) -> None:
        frame = Frame(shot.camera, shot.stamp, NO_IMAGE)
        if self._pictures is not None:
            kind, data = self._pictures.take(shot)
            try:
                image = decode(data, f"camera {self._scenario.rig.cameras[shot.camera].name}", f"picture {shot.number}")
            except InputError as error:  # as a driver drops what it cannot decode
                self._sink.event(now, str(error))
                return
            self._sink.picture(shot, kind, data)
            frame = replace(frame, image=image)
        self._formed(self._pairer.add(frame, now), now)
        self._agenda.at(now + self._pairer.patience, ARRIVAL, self._overdue)

    def _overdue(self, now: float) -> None:
        self._formed(self._pairer.due(now), now)

    def _formed(self, sets: Sequence[FrameSet], now: float) -> None:
        """New frame sets: the tracker takes the newest when it is free."""
        for frames in sets:
            if self._waiting is not None:
                self.skipped += 1
            self._waiting = self._with_head(frames)
        if not self._busy and self._waiting is not None:
            self._track(now)

    def _with_head(self, frames: FrameSet) -> FrameSet:
        """The frame set with its print head, which the sink is told of even if the set is left out."""
        head = self._head(frames.stamp)
        if head is None:
            return frames
        self._sink.head(frames.stamp, head)
        return replace(frames, head=head)

    def _track(self, now: float) -> None:
        assert self._waiting is not None
        frames, self._waiting, self._busy = self._waiting, None, True
        start = self._clock.now()
        pose = self._step(frames)
        spent = self._clock.now() - start
        self.tracked += 1
        self._sink.pose(frames, pose, self._step.last, spent)
        processing = self._scenario.tracking.processing
        known = self._rates.done(now, spent if processing is None else processing)
        self._agenda.at(known, KNOWN, partial(self._know, pose, frames, self._step.last.observations))
        self._step.idle()

    def _know(self, pose: SurfacePose, frames: FrameSet, seen: Observations, now: float) -> None:
        self._busy = False
        self._known(pose, frames, seen)
        if self._waiting is not None:
            self._track(now)
