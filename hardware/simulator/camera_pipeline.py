"""What becomes of the cameras' shots in virtual time: pictures, frame sets, and poses once the tracker had its time."""

from __future__ import annotations

import hashlib
import heapq
import sqlite3
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from logging import WARNING
from pathlib import Path
from typing import Any, Protocol

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
from hardware.simulator.scene.render import cover_wound, render
from hardware.simulator.scene.scene import Scene, WorldState
from perception.frames import Frame, FrameSet, Pairing, PrintHead
from perception.tracking.step import StepReport

Action = Callable[[float], None]  # of the instant, s
ARRIVAL_EVENT, POSE_EVENT, TICK_EVENT, EXPOSURE_EVENT, RENDER_EVENT = range(5)  # what goes first at one instant


class EventQueue:
    """A queue of actions by instant; what falls on one instant goes by rank, then in the order in which it came."""

    def __init__(self, clock: SimClock) -> None:
        """clock: is moved on to each instant."""
        self._clock = clock
        self._heap: list[tuple[float, int, int, Action]] = []
        self._count = 0

    def at(self, instant: float, rank: int, action: Action) -> None:
        """Do `action` at `instant`, s."""
        heapq.heappush(self._heap, (instant, rank, self._count, action))
        self._count += 1

    def run(self, until: Callable[[], float]) -> Iterator[float]:
        """Do everything due before `until()`, s, in order; gives each instant after what happened at it."""
        while self._heap and self._heap[0][0] < until():
            instant, _, _, action = heapq.heappop(self._heap)
            self._clock.wait_until(instant)
            action(instant)
            yield instant


RENDERER = Path(__file__).parent / "scene"  # its files make what a picture shows
KEPT_RUNS = 2  # whose pictures are kept: two ways to track one scene in turn find theirs again
PUTS = 60  # pictures from commit to commit: of a run that is killed no more are lost


class PictureStore:
    """Encoded pictures of one scenario from earlier runs, in a file of the cache, by all that they show.

    Where the nozzle went another way than in those runs, or the code that renders is another, nothing is found, and
    pictures are rendered. So is all where the file cannot be written, or another run writes it.
    """

    def __init__(self, scenario: Path, cache: Path) -> None:
        made_by = [each.read_bytes() for each in sorted(RENDERER.glob("*.py"))]
        text = [content_of(scenario), *made_by, np.__version__.encode(), cv2.__version__.encode()]
        name = hashlib.sha256(b"".join(b"%d " % len(part) + part for part in text)).hexdigest()[:12]
        self.folder = cache / f"{scenario.stem}-{name}-pictures"
        self._kept = self._run = 0
        self._base: sqlite3.Connection | None = None
        with suppress(OSError, sqlite3.Error):
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "scenario").write_text(str(scenario.resolve()), encoding="utf-8")
            self._base = sqlite3.connect(self.folder / "pictures.db", timeout=0)
            self._base.execute(
                "CREATE TABLE IF NOT EXISTS picture (key BLOB PRIMARY KEY, run INT, kind TEXT, data BLOB)"
            )
            self._run = 1 + (self._base.execute("SELECT MAX(run) FROM picture").fetchone()[0] or 0)

    def get(self, key: bytes) -> tuple[str, bytes] | None:
        """Format and bytes of a picture; None where there is none."""
        row = self._do("SELECT kind, data FROM picture WHERE key = ?", key)
        if row is not None:
            self._do("UPDATE picture SET run = ? WHERE key = ?", self._run, key)
        return None if row is None else (str(row[0]), bytes(row[1]))

    def put(self, key: bytes, picture: tuple[str, bytes]) -> None:
        """Keep a picture."""
        self._do("INSERT OR REPLACE INTO picture VALUES (?, ?, ?, ?)", key, self._run, *picture)
        self._kept += 1
        if self._base is not None and self._kept % PUTS == 0:
            with suppress(sqlite3.Error):
                self._base.commit()

    def finish(self) -> None:
        """The run is over: what neither it nor the one before looked at goes."""
        self._do("DELETE FROM picture WHERE run <= ?", self._run - KEPT_RUNS)

    def close(self) -> None:
        """Close the file."""
        if self._base is not None:
            with suppress(sqlite3.Error):
                self._base.commit()
            self._base.close()
        if self._kept:
            print(f"pictures are kept in {self.folder}: {size_text(folder_size(self.folder))}", file=sys.stderr)

    def _do(self, text: str, *values: object) -> Any:
        """The first row of what a statement gives; None without one, and of a file that cannot be used."""
        if self._base is None:
            return None
        try:
            return self._base.execute(text, values).fetchone()
        except sqlite3.Error:  # another run writes it, or the disk is full
            self._base.close()
            self._base = None
            return None


def picture_key(shot: Shot, instant: WorldState, camera: Camera, scene: Scene) -> bytes:
    """A hash of all in a picture that the scenario alone does not say."""
    words: list[object] = [shot.camera, shot.number, shot.picture, shot.fate, shot.covered, scene.deformation]
    words += [instant.stamp, instant.exposure, instant.strain, instant.gain]
    arrays = [
        instant.base_from_surface,
        instant.twist,
        instant.base_from_nozzle,
        camera.base_from_camera,
        camera.matrix,
    ]
    parts = [repr(words).encode(), scene.laid, *(b"" if array is None else array.tobytes() for array in arrays)]
    return hashlib.sha256(b"".join(b"%d " % len(part) + part for part in parts)).digest()


NOISE_STREAM, DAMAGE_STREAM = 5, 6  # streams of random numbers of one picture


Pending = list[tuple[Shot, WorldState]]  # exposed and not yet rendered
Rendered = list[tuple[Shot, bytes, tuple[str, bytes]]]  # with the picture's key


class PictureRenderer:
    """Renders and encodes what was exposed, in the background while time goes on.

    What waits is rendered together, one picture of each camera at a time, with the printed material as it was at the
    first of them.
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
        self._seed, self._threads, self._print_beads, self._store = seed, threads, print_beads, store
        self._waiting: Pending = []
        self._done: dict[tuple[int, int], tuple[str, bytes]] = {}
        self._background = ThreadPoolExecutor(1)
        self._job: Future[Rendered] | None = None

    def expose(self, shot: Shot, instant: WorldState) -> None:
        """Remember the world as this shot meets it."""
        self._waiting.append((shot, instant))

    def start(self) -> None:
        """Begin to render what waits, once what was begun before is done: no bead is laid while pictures are made."""
        if not self._waiting:
            return
        self._join()
        self._print_beads(min(instant.stamp for _, instant in self._waiting))
        missing = [(*pair, self._key(*pair)) for pair in self._waiting]
        missing = [each for each in missing if not self._found(each[0], each[2])]
        self._waiting = []
        if missing:
            self._job = self._background.submit(self._render_all, missing)

    def take(self, shot: Shot) -> tuple[str, bytes]:
        """Format and bytes of a picture that was exposed; each once."""
        key = shot.camera, shot.number
        if key not in self._done:
            self._join()
        if key not in self._done:
            self.start()
            self._join()
        return self._done.pop(key)

    def _join(self) -> None:
        """Wait until what was begun is rendered."""
        job, self._job = self._job, None
        for shot, key, picture in () if job is None else job.result():
            self._done[shot.camera, shot.number] = picture
            if self._store is not None:
                self._store.put(key, picture)

    def _found(self, shot: Shot, key: bytes) -> bool:
        """Take a picture from the store, if it is there."""
        picture = None if self._store is None else self._store.get(key)
        if picture is not None:
            self._done[shot.camera, shot.number] = picture
        return picture is not None

    def _key(self, shot: Shot, instant: WorldState) -> bytes:
        return picture_key(shot, instant, self._true_cameras(shot), self._scene)

    def _render_all(self, waiting: list[tuple[Shot, WorldState, bytes]]) -> Rendered:
        done: Rendered = []
        while waiting:
            batch = {each[0].camera: each for each in reversed(waiting)}  # the first of each camera
            waiting = [each for each in waiting if each is not batch[each[0].camera]]
            shots, instants, keys = zip(*batch.values(), strict=True)
            done += zip(shots, keys, self._render(shots, instants), strict=True)
        return done

    def _render(self, shots: Sequence[Shot], instants: Sequence[WorldState]) -> list[tuple[str, bytes]]:
        cameras = [self._true_cameras(shot) for shot in shots]
        rngs = [self._rng(NOISE_STREAM, shot.camera, shot.picture) for shot in shots]
        images = render(self._scene, cameras, instants, self._sensor, rngs, self._threads)
        for i, (shot, camera, instant) in enumerate(zip(shots, cameras, instants, strict=True)):
            if shot.covered is not None:
                images[i] = cover_wound(images[i], camera, instant.base_from_surface, shot.covered)
        with ThreadPoolExecutor(self._threads) as pool:
            encoded = list(pool.map(lambda image: encode(image, self._quality), images))
        return [
            (kind, garble(data, self._rng(DAMAGE_STREAM, shot.camera, shot.number)))
            if shot.fate is Fate.GARBLED
            else (kind, data)
            for shot, (kind, data) in zip(shots, encoded, strict=True)
        ]

    def _rng(self, stream: int, camera: int, number: int) -> np.random.Generator:
        """A picture's own random numbers: they depend on nothing but its camera and number."""
        return np.random.default_rng([self._seed, stream, camera, number])


def _begin_rendering(pictures: PictureRenderer, now: float) -> None:
    pictures.start()


Exposures = dict[tuple[int, float], Shot]  # by camera and stamp, s


class PipelineSink(Protocol):
    """Receives pictures, print head and poses as they come."""

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        """A picture that can be decoded has arrived, as encoded by its camera."""

    def head(self, stamp: float, head: PrintHead) -> None:
        """Where the print head was at the stamp of a frame set, s, which may yet find the tracker busy."""

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        """A pose was made of a frame set in `spent` s of real time."""

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        """Something that a person should know."""


OnPose = Callable[[SurfacePose, FrameSet, Observations], None]  # a pose has reached the motion


class CameraPipeline:
    """The cameras and the tracker of one run. tracked, skipped: frame sets, and those the tracker had no time for."""

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
        instant: Callable[[Shot, float], WorldState] | None = None,
        head: Callable[[float], PrintHead | None] = lambda stamp: None,
    ) -> None:
        """exposures: filled with the shot of each picture, for a step that may know. clock: measures tracking times.

        pictures, instant: what renders the shots, and the world as one meets it; without them nobody looks. head: where
        the print head was at a stamp, s.
        """
        self.tracked, self.skipped = 0, 0
        self._scenario, self._events, self._step, self._exposures = scenario, events, step, exposures
        self._sink, self._clock, self._on_pose = sink, clock, on_pose
        self._pictures, self._instant, self._head = pictures, instant, head
        self._cameras = SimulatedCameras(scenario.cameras, scenario.seed, scenario.faults)
        self._pairer = Pairing(len(scenario.rig), scenario.cameras.period)
        self._rates = WorkRates(faults_striking(scenario.faults, FaultPart.TRACKING))
        self._busy = False  # the tracker
        self._tracked_now: FrameSet | None = None  # its pose is found when it is due
        self._waiting: FrameSet | None = None  # the newest that came meanwhile

    def begin(self) -> None:
        """Put the first exposure of each camera into the queue."""
        for camera in range(len(self._scenario.rig)):
            self._next_shot(self._cameras.shots(camera, self._scenario.seconds))

    def finish(self) -> None:
        """The run is over: find the pose that was due after its end, which nobody waits for any more."""
        if self._tracked_now is not None:
            self._step_through(self._tracked_now)

    def _next_shot(self, shots: Iterator[Shot]) -> None:
        shot = next(shots, None)
        if shot is not None:
            due = self._cameras.due(shot.camera, shot.number)
            self._events.at(due, EXPOSURE_EVENT, partial(self._expose, shot, shots))

    def _expose(self, shot: Shot, shots: Iterator[Shot], now: float) -> None:
        """Half of a camera's exposure is over: from here on the world may change, the picture may not."""
        self._next_shot(shots)
        if shot.fate is Fate.DROPPED:
            return
        self._exposures[shot.camera, shot.stamp] = shot
        if self._pictures is not None and self._instant is not None:
            self._pictures.expose(shot, self._instant(shot, now))
            self._events.at(now, RENDER_EVENT, partial(_begin_rendering, self._pictures))
        self._events.at(shot.arrival, ARRIVAL_EVENT, partial(self._arrive, shot))

    def _arrive(self, shot: Shot, now: float) -> None:
        frame = Frame(shot.camera, shot.stamp, np.zeros((0, 0), np.uint8))  # without renderer nobody looks at it
        if self._pictures is not None:
            kind, data = self._pictures.take(shot)
            try:
                image = decode(data, f"camera {self._scenario.rig.cameras[shot.camera].name}", f"picture {shot.number}")
            except InputError as error:  # as a driver drops what it cannot decode
                self._sink.event(now, str(error))
                return
            self._sink.picture(shot, kind, data)
            frame = replace(frame, image=image)
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
        """Let the tracker begin; what it finds is worked out when it is due, while the next pictures are rendered."""
        assert self._waiting is not None
        frames, self._waiting, self._busy = self._waiting, None, True
        processing = self._scenario.tracking.processing
        if processing is not None:
            self._tracked_now = frames
            self._events.at(self._rates.done(now, processing), POSE_EVENT, partial(self._find_pose, frames))
            return
        pose, observations, spent = self._step_through(frames)
        delivery = self._rates.done(now, spent)
        self._events.at(delivery, POSE_EVENT, partial(self._deliver, pose, frames, observations))

    def _find_pose(self, frames: FrameSet, now: float) -> None:
        self._tracked_now = None
        pose, observations, _ = self._step_through(frames)
        self._deliver(pose, frames, observations, now)

    def _step_through(self, frames: FrameSet) -> tuple[SurfacePose, Observations, float]:
        """What the tracker makes of a frame set, and in how many seconds."""
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
