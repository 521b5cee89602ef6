"""From the cameras' shots to pictures, frame sets and, after the tracker's processing time, poses; in virtual time."""

from __future__ import annotations

import hashlib
import heapq
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from logging import WARNING
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.rig import Camera
from hardware.files.images import decode, encode
from hardware.offline.track import FrameSetStep
from hardware.process.clock import Clock, SimClock
from hardware.process.faults import FaultPart, WorkRates, faults_striking
from hardware.process.progress import content_of, folder_size, size_text
from hardware.simulator.cameras import Fate, Shot, SimulatedCameras, TrueCameras, garble
from hardware.simulator.scenario import Scenario
from hardware.simulator.scene.appearance import Sensor
from hardware.simulator.scene.render import begin_render, cover_wound, submit_after
from hardware.simulator.scene.scene import Scene, WorldState
from perception.frames import Frame, FrameSet, Image, Pairing, PrintHead
from perception.tracking.step import StepReport

Action = Callable[[float], None]  # of the instant, s
ARRIVAL_EVENT, POSE_EVENT, TICK_EVENT, EXPOSURE_EVENT, RENDER_EVENT = range(5)  # rising rank at one instant


class EventQueue:
    """A queue of actions by instant; at one instant by rank, then in the order of arrival."""

    def __init__(self, clock: SimClock) -> None:
        """clock: advanced to each instant."""
        self._clock = clock
        self._heap: list[tuple[float, int, int, Action]] = []
        self._count = 0

    def at(self, instant: float, rank: int, action: Action) -> None:
        """Do `action` at `instant`, s."""
        heapq.heappush(self._heap, (instant, rank, self._count, action))
        self._count += 1

    def run(self, until: Callable[[], float]) -> Iterator[float]:
        """Perform all actions before `until()`, s, in order; yields each instant after its action."""
        while self._heap and self._heap[0][0] < until():
            instant, _, _, action = heapq.heappop(self._heap)
            self._clock.wait_until(instant)
            action(instant)
            yield instant


RENDERER_FOLDER = Path(__file__).parent / "scene"  # of the code that renders
STORED_RUNS = 2  # whose pictures are kept: two methods that track one scene in turn find theirs again
COMMIT_INTERVAL = 60  # pictures between commits: a killed run loses no more


class PictureStore:
    """Encoded pictures of one scenario from earlier runs, in a file of the cache, by a hash of all that they show.

    Pictures are rendered where the nozzle's motion or the rendering code differs from those runs, where the file cannot
    be written, and where another run writes it.
    """

    def __init__(self, scenario: Path, cache: Path) -> None:
        sources = [each.read_bytes() for each in sorted(RENDERER_FOLDER.glob("*.py"))]
        parts = [content_of(scenario), *sources, np.__version__.encode(), cv2.__version__.encode()]
        name = hashlib.sha256(b"".join(b"%d " % len(part) + part for part in parts)).hexdigest()[:12]
        self.folder = cache / f"{scenario.stem}-{name}-pictures"
        self._put_count, self._run, self._lock = 0, 0, threading.RLock()
        self._database: sqlite3.Connection | None = None
        with suppress(OSError, sqlite3.Error):
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "scenario").write_text(str(scenario.resolve()), encoding="utf-8")
            self._database = sqlite3.connect(self.folder / "pictures.db", timeout=0, check_same_thread=False)
            self._database.execute(
                "CREATE TABLE IF NOT EXISTS picture (key BLOB PRIMARY KEY, run INT, kind TEXT, data BLOB)"
            )
            self._run = 1 + (self._database.execute("SELECT MAX(run) FROM picture").fetchone()[0] or 0)

    def get(self, key: bytes) -> tuple[str, bytes] | None:
        """Format and bytes of a picture; None where there is none."""
        row = self._execute("SELECT kind, data FROM picture WHERE key = ?", key)
        if row is not None:
            self._execute("UPDATE picture SET run = ? WHERE key = ?", self._run, key)
        return None if row is None else (str(row[0]), bytes(row[1]))

    def put(self, key: bytes, picture: tuple[str, bytes]) -> None:
        """Store a picture; from any thread."""
        with self._lock:
            self._execute("INSERT OR REPLACE INTO picture VALUES (?, ?, ?, ?)", key, self._run, *picture)
            self._put_count += 1
            if self._database is not None and self._put_count % COMMIT_INTERVAL == 0:
                with suppress(sqlite3.Error):
                    self._database.commit()

    def finish(self) -> None:
        """The run is over: delete the pictures that neither it nor the one before used."""
        self._execute("DELETE FROM picture WHERE run <= ?", self._run - STORED_RUNS)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._database is not None:
                with suppress(sqlite3.Error):
                    self._database.commit()
                self._database.close()
                self._database = None  # a picture may still be in progress
        if self._put_count:
            print(f"pictures are kept in {self.folder}: {size_text(folder_size(self.folder))}", file=sys.stderr)

    def _execute(self, text: str, *values: object) -> Any:
        """The first row of a statement's result; None without one, or without a usable file."""
        with self._lock:
            if self._database is None:
                return None
            try:
                return self._database.execute(text, values).fetchone()
            except sqlite3.Error:  # another run writes it, or the disk is full
                self._database.close()
                self._database = None
                return None


def picture_key(shot: Shot, state: WorldState, camera: Camera, scene: Scene) -> bytes:
    """A hash of all that a picture depends on besides the scenario."""
    values: list[object] = [shot.camera, shot.number, shot.picture, shot.fate, shot.covered, scene.deformation]
    values += [state.stamp, state.exposure, state.strain, state.gain]
    arrays = [
        state.base_from_surface,
        state.twist,
        state.base_from_nozzle,
        camera.base_from_camera,
        camera.matrix,
    ]
    parts = [repr(values).encode(), scene.bead_hash, *(b"" if array is None else array.tobytes() for array in arrays)]
    return hashlib.sha256(b"".join(b"%d " % len(part) + part for part in parts)).digest()


NOISE_STREAM, DAMAGE_STREAM = 5, 6  # streams of random numbers of one picture


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture as its camera sent it."""

    kind: str  # "jpeg" or "png"
    data: bytes
    image: Image | InputError  # decoded, or why it cannot be


class PictureRenderer:
    """Renders, encodes and decodes exposed pictures in the background while time goes on.

    Pending pictures are rendered together, one of each camera at a time, with the printed material of the first one's
    instant.
    """

    def __init__(
        self,
        scene: Scene,
        true_cameras: TrueCameras,
        sensor: Sensor,
        jpeg_quality: int | None,
        seed: int,
        threads: int,
        print_beads: Callable[[float], None] = lambda until: None,
        store: PictureStore | None = None,
    ) -> None:
        """print_beads: brings the scene's printed material up to an instant, s. store: pictures of earlier runs."""
        self._scene, self._true_cameras, self._sensor, self._quality = scene, true_cameras, sensor, jpeg_quality
        self._seed, self._print_beads, self._store, self._names = seed, print_beads, store, true_cameras.names
        self._waiting: list[tuple[Shot, WorldState]] = []
        self._pictures: dict[tuple[int, int], Future[Picture]] = {}
        self._in_progress: list[Future[Picture]] = []
        self._pool = ThreadPoolExecutor(threads)

    def expose(self, shot: Shot, state: WorldState) -> None:
        """Queue a shot with the world at its exposure."""
        self._waiting.append((shot, state))

    def start(self) -> None:
        """Begin to make the pending pictures after those in progress: no bead is printed during rendering."""
        if not self._waiting:
            return
        wait(self._in_progress)
        self._print_beads(min(state.stamp for _, state in self._waiting))
        pending = list[tuple[Shot, WorldState, bytes]]()
        for shot, state in self._waiting:
            key = picture_key(shot, state, self._true_cameras(shot), self._scene)
            stored = None if self._store is None else self._store.get(key)
            if stored is None:
                pending.append((shot, state, key))
            else:
                self._pictures[shot.camera, shot.number] = self._pool.submit(self._decode, shot, *stored)
        self._waiting = []
        while pending:
            batch = {entry[0].camera: entry for entry in reversed(pending)}  # the first of each camera
            pending = [entry for entry in pending if entry is not batch[entry[0].camera]]
            wait(self._in_progress)
            self._begin(*zip(*batch.values(), strict=True))

    def take(self, shot: Shot) -> Picture:
        """An exposed picture; each once."""
        if (shot.camera, shot.number) not in self._pictures:
            self.start()
        return self._pictures.pop((shot.camera, shot.number)).result()

    def _begin(self, shots: Sequence[Shot], states: Sequence[WorldState], keys: Sequence[bytes]) -> None:
        cameras = [self._true_cameras(shot) for shot in shots]
        rngs = [self._rng(NOISE_STREAM, shot.camera, shot.picture) for shot in shots]
        images = begin_render(self._pool, self._scene, cameras, states, self._sensor, rngs)
        parts = zip(shots, states, keys, images, strict=True)
        self._in_progress = [submit_after(self._pool, self._encode, *each) for each in parts]
        self._pictures |= {(s.camera, s.number): p for s, p in zip(shots, self._in_progress, strict=True)}

    def _encode(self, shot: Shot, state: WorldState, key: bytes, image: Image) -> Picture:
        if shot.covered is not None:
            image = cover_wound(image, self._true_cameras(shot), state.base_from_surface, shot.covered)
        kind, data = encode(image, self._quality)
        if shot.fate is Fate.GARBLED:
            data = garble(data, self._rng(DAMAGE_STREAM, shot.camera, shot.number))
        if self._store is not None:
            self._store.put(key, (kind, data))
        return self._decode(shot, kind, data)

    def _decode(self, shot: Shot, kind: str, data: bytes) -> Picture:
        try:
            return Picture(kind, data, decode(data, f"camera {self._names[shot.camera]}", f"picture {shot.number}"))
        except InputError as error:
            return Picture(kind, data, error)

    def _rng(self, stream: int, camera: int, number: int) -> np.random.Generator:
        """A picture's own random numbers: they depend on nothing but its camera and number."""
        return np.random.default_rng([self._seed, stream, camera, number])


Exposures = dict[tuple[int, float], Shot]  # by camera and stamp, s


class PipelineSink:
    """Receives pictures, print head and poses; what a sink does not override is ignored."""

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        """A picture that can be decoded has arrived, as encoded by its camera."""

    def head(self, stamp: float, head: PrintHead) -> None:
        """The print head at the stamp of a frame set, s, which the tracker may still skip."""

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        """The pose of a frame set, computed in `spent` s of real time."""

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        """An event for a person."""


OnPose = Callable[[SurfacePose, FrameSet, Observations], None]  # a pose has reached the motion


class CameraPipeline:
    """The cameras and the tracker of one run. tracked, skipped: frame sets; skipped ones found the tracker busy."""

    def __init__(
        self,
        scenario: Scenario,
        events: EventQueue,
        step: FrameSetStep,
        exposures: Exposures,
        sink: PipelineSink,
        clock: Clock,
        on_pose: OnPose,
        pictures: PictureRenderer | None = None,
        state_at: Callable[[Shot, float], WorldState] | None = None,
        head: Callable[[float], PrintHead | None] = lambda stamp: None,
    ) -> None:
        """exposures: filled with the shot of each picture. clock: measures tracking times.

        pictures, state_at: the renderer, and the world at a shot's exposure; without them there are no pictures. head:
        the print head at a stamp, s.
        """
        self.tracked, self.skipped = 0, 0
        self._scenario, self._events, self._step, self._exposures = scenario, events, step, exposures
        self._sink, self._clock, self._on_pose = sink, clock, on_pose
        self._pictures, self._instant, self._head = pictures, state_at, head
        self._cameras = SimulatedCameras(scenario.cameras, scenario.seed, scenario.faults)
        self._pairer = Pairing(len(scenario.rig), scenario.cameras.period)
        self._rates = WorkRates(faults_striking(scenario.faults, FaultPart.TRACKING))
        self._busy = False  # the tracker
        self._current: FrameSet | None = None  # its pose is computed when it is due
        self._waiting: FrameSet | None = None  # the newest that has arrived since

    def begin(self) -> None:
        """Put the first exposure of each camera into the queue."""
        for camera in range(len(self._scenario.rig)):
            self._next_shot(self._cameras.shots(camera, self._scenario.seconds))

    def finish(self) -> None:
        """The run is over: compute the pose that was due after its end."""
        if self._current is not None:
            self._step_through(self._current)

    def _next_shot(self, shots: Iterator[Shot]) -> None:
        shot = next(shots, None)
        if shot is not None:
            due = self._cameras.due(shot.camera, shot.number)
            self._events.at(due, EXPOSURE_EVENT, partial(self._expose, shot, shots))

    def _expose(self, shot: Shot, shots: Iterator[Shot], now: float) -> None:
        """The middle of an exposure: later changes of the world do not change its picture."""
        self._next_shot(shots)
        if shot.fate is Fate.DROPPED:
            return
        self._exposures[shot.camera, shot.stamp] = shot
        if (pictures := self._pictures) is not None and self._instant is not None:
            pictures.expose(shot, self._instant(shot, now))
            self._events.at(now, RENDER_EVENT, lambda now: pictures.start())
        self._events.at(shot.arrival, ARRIVAL_EVENT, partial(self._arrive, shot))

    def _arrive(self, shot: Shot, now: float) -> None:
        frame = Frame(shot.camera, shot.stamp, np.zeros((0, 0), np.uint8))  # without renderer it is not used
        if self._pictures is not None:
            picture = self._pictures.take(shot)
            if isinstance(picture.image, InputError):  # as a driver drops what it cannot decode
                self._sink.event(now, str(picture.image))
                return
            self._sink.picture(shot, picture.kind, picture.data)
            frame = replace(frame, image=picture.image)
        self._take_sets(self._pairer.add(frame, now), now)
        self._events.at(
            now + self._pairer.patience, ARRIVAL_EVENT, lambda due: self._take_sets(self._pairer.due(due), due)
        )

    def _take_sets(self, sets: Sequence[FrameSet], now: float) -> None:
        for frames in sets:
            if self._waiting is not None:
                self.skipped += 1
            self._waiting, head = frames, self._head(frames.stamp)
            if head is not None:
                self._sink.head(frames.stamp, head)  # even if the set is left out
                self._waiting = replace(frames, head=head)
        if not self._busy and self._waiting is not None:
            self._track(now)

    def _track(self, now: float) -> None:
        """Start the tracker; its pose is computed when it is due, while the next pictures are rendered."""
        assert self._waiting is not None
        frames, self._waiting, self._busy = self._waiting, None, True
        processing = self._scenario.tracking.processing
        if processing is not None:
            self._current = frames
            self._events.at(self._rates.done(now, processing), POSE_EVENT, partial(self._find_pose, frames))
            return
        pose, observations, spent = self._step_through(frames)
        delivery = self._rates.done(now, spent)
        self._events.at(delivery, POSE_EVENT, partial(self._deliver, pose, frames, observations))

    def _find_pose(self, frames: FrameSet, now: float) -> None:
        self._current = None
        pose, observations, _ = self._step_through(frames)
        self._deliver(pose, frames, observations, now)

    def _step_through(self, frames: FrameSet) -> tuple[SurfacePose, Observations, float]:
        """The tracker's pose of a frame set, its observations, and its time, s."""
        start = self._clock.now()
        pose = self._step(frames)
        spent = self._clock.now() - start
        self.tracked += 1
        self._sink.pose(frames, pose, self._step.last, spent)
        observations = self._step.last.observations
        self._step.idle()
        return pose, observations, spent

    def _deliver(self, pose: SurfacePose, frames: FrameSet, observations: Observations, now: float) -> None:
        self._busy = False
        self._on_pose(pose, frames, observations)
        if self._waiting is not None:
            self._track(now)
