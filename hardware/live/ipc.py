"""The processes of a live run: a group that starts and ends them, their bodies, and the channels between them.

Each process is spawned and runs one of the functions `run_*` below, which import the modules of that process only.
"""

from __future__ import annotations

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from ctypes import c_double
from dataclasses import dataclass, field, replace
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path as File
from typing import Any

import numpy as np

from estimation.errors import StillbedError
from estimation.pose import Trajectory
from hardware.files.images import decode
from hardware.files.session import FrameReader, FrameRef, Session
from hardware.live.frame_source import COLOUR_CHANNELS, Encoded, FrameRing
from hardware.live.prepared import Prepared
from hardware.live.recorder_process import RecorderSender, record
from hardware.live.records import MotionChannels, SharedState, TrackingChannels
from hardware.live.settings import VIRTUAL_ARM
from hardware.offline.replay import FrameFaults
from hardware.process.clock import WallClock, WatchedClock
from hardware.process.faults import Fault
from hardware.process.system import SPAWN, ask_for_real_time, blocked_sigint, set_up_process
from hardware.recording.session_reader import open_session
from perception.frames import Frame, FrameSet, frame_set

TRANSPORT_DELAY = 0.025  # s from the middle of an exposure to the picture in the computer, as in scenarios
REQUEST_POLL_PERIOD = 0.02  # s between checks for the tracker's request
TURN_SEARCH_SHARE = 0.25  # share of a session at each end that is searched for a turn
DECODE_LEAD = 1.5  # of the decoding time: decoding starts so long before display
DECODE_DECAY = 0.9  # of the decoding time, per set
PICTURE_CACHE_BYTES = 2**30  # of encoded pictures, kept if a session is repeated
DECODED_CACHE_BYTES = 2**29  # of decoded pictures: a session up to this size is decoded in advance


@dataclass(frozen=True, slots=True)
class SetShowing:
    """One display of one set."""

    index: int  # of the set in the session
    live: float  # s, stamp of its first frame
    backwards: bool  # whether the session's time runs backwards


def turning_sets(truth: Trajectory, stamps: np.ndarray) -> tuple[int, int]:
    """First and last set (N stamps, s) of a session played to and fro: where the surface is slowest."""
    count = len(stamps)
    places = np.stack([np.interp(stamps, truth.stamps, truth.base_from_surface[:, i, 3]) for i in range(3)], 1)
    speed = np.linalg.norm(np.gradient(places, stamps, axis=0), axis=1)
    share = max(int(TURN_SEARCH_SHARE * count), 1)
    return int(np.argmin(speed[:share])), count - share + int(np.argmin(speed[count - share :]))


def schedule(stamps: np.ndarray, begin: float, between: tuple[int, int] | None) -> Iterator[SetShowing]:
    """The display of each set of stamps (N,): once, or to and fro for ever between two of them."""
    if between is None:
        yield from (SetShowing(i, begin + float(s - stamps[0]), False) for i, s in enumerate(stamps))
        return
    first, last = between
    live = begin
    yield SetShowing(first, live, False)
    while True:
        for i in range(first + 1, last + 1):
            live += float(stamps[i] - stamps[i - 1])
            yield SetShowing(i, live, False)
        for i in range(last - 1, first - 1, -1):
            live += float(stamps[i + 1] - stamps[i])
            yield SetShowing(i, live, True)


def play(prepared: Prepared, ring: FrameRing, notices: Connection, start: c_double) -> None:
    """The body of the process: play the run's session until its end or until the other end is closed.

    The last notice is a text with the reason of the end.
    """
    set_up_process("feed")
    with suppress(BrokenPipeError, ConnectionError):
        try:
            session = open_session(prepared.session)
            play_session(session, prepared.again, prepared.faults, ring, notices, start)
            notices.send(f"{prepared.session.name} is over")
        except StillbedError as error:
            notices.send(str(error))


def play_session(
    session: Session, again: bool, faults: Sequence[Fault], ring: FrameRing, notices: Connection, start: c_double
) -> None:
    """Put the sets of a session into the ring in real time. faults: of cameras, counted from `start`, s."""
    clock, pictures = WallClock(), PictureCache(session, again)
    pictures.decode_ahead()
    inject = FrameFaults(faults, session.rig, "command line")
    parent = parent_process()  # start when the tracker is ready
    while not ring.requested.value and (parent is None or parent.is_alive()):
        clock.wait_until(clock.now() + REQUEST_POLL_PERIOD)
    stamps = np.array([np.mean([ref.stamp for ref in refs]) for refs in session.sets])
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    between = turning_sets(session.truth, stamps) if again and session.truth is not None else None
    decode_time = period  # s, decoding time of a set
    for showing in schedule(stamps, clock.now(), between):
        display_time = showing.live + TRANSPORT_DELAY
        if clock.now() > display_time + period:
            continue  # a late host loses frames
        refs, anchor = session.sets[showing.index], float(stamps[showing.index])
        clock.wait_until(display_time - DECODE_LEAD * decode_time)  # not earlier: the tracker needs the cores
        decode_start = clock.now()
        encoded, frames = pictures.decoded(refs)
        decode_time = max(clock.now() - decode_start, DECODE_DECAY * decode_time)
        direction = -1 if showing.backwards else 1  # of time
        restamped = [replace(f, stamp=showing.live + direction * (f.stamp - anchor)) for f in frames]
        head = session.heads.at(anchor)
        intact = FrameSet(frame_set(restamped).stamp, tuple(restamped), head)
        faulty = inject(intact, showing.live - start.value)
        unchanged_cameras = {frame.camera for frame in faulty.frames if frame in intact.frames}
        clock.wait_until(display_time)
        if faulty.frames:
            unchanged = {camera: stored for camera, stored in encoded.items() if camera in unchanged_cameras}
            notices.send(ring.put(faulty, unchanged, clock.now, anchor))


class PictureCache:
    """Reads and decodes pictures; keeps the encoded pictures of a repeated session."""

    def __init__(self, session: Session, keep: bool) -> None:
        self._session, self._keep, self._cache, self._size = session, keep, dict[FrameRef, Encoded](), 0
        self._reader: FrameReader = session.open_reader()
        self._decoded = dict[tuple[FrameRef, ...], tuple[dict[int, Encoded], list[Frame]]]()

    def decode_ahead(self) -> None:
        """Decode the whole session now, if it is repeated and fits into memory.

        Then decoding takes no processor time of the measured run: a set is only copied into the ring.
        """
        sizes = [camera.size for camera in self._session.rig.cameras]
        pixels = sum(sizes[ref.camera][0] * sizes[ref.camera][1] for refs in self._session.sets for ref in refs)
        if self._keep and COLOUR_CHANNELS * pixels <= DECODED_CACHE_BYTES:
            self._decoded = {refs: self.decoded(refs) for refs in self._session.sets}

    def decoded(self, refs: tuple[FrameRef, ...]) -> tuple[dict[int, Encoded], list[Frame]]:
        """The pictures of a set, as stored and as arrays."""
        if refs in self._decoded:
            return self._decoded[refs]
        encoded, frames = dict[int, Encoded](), list[Frame]()
        for ref in refs:
            stored = self._encoded(ref)
            if stored is None:
                image = self._reader.read(ref)
            else:
                encoded[ref.camera] = stored
                image = decode(stored[1], self._session.path, f"image {ref.number} of camera {ref.camera}")
            frames.append(Frame(ref.camera, ref.stamp, image))
        return encoded, frames

    def _encoded(self, ref: FrameRef) -> Encoded | None:
        if ref in self._cache:
            return self._cache[ref]
        stored = self._reader.encoded(ref)
        if self._keep and stored is not None and self._size < PICTURE_CACHE_BYTES:
            self._cache[ref] = stored
            self._size += len(stored[1])
        return stored


EXIT_TIMEOUT = 10.0  # s that a process gets to close its files, on a busy machine
EARLY_EXIT_TIME = 0.5, 0.2  # s for the tracker before printing (it may adjust a map), and after the request to end
ARM_POLL_PERIOD = 0.02  # s between checks for the virtual arm's device
ARM_START_TIMEOUT = 60.0  # s for the device to appear, on a busy machine
ARM_AFTERLIFE = 2.0  # s that a virtual arm continues without the run, to come to rest
EXECUTED_STEP = 0.002  # s between rows of the executed motion

ProcessBody = Callable[..., None]


@dataclass(slots=True)
class ProcessGroup:
    """The processes of a run by name, each in a process group of its own."""

    members: dict[str, BaseProcess] = field(default_factory=dict)

    def start(self, name: str, body: ProcessBody, arguments: tuple[Any, ...], ends: Sequence[Connection] = ()) -> None:
        """Start a process. ends: pipe ends among its arguments, which only it owns from now on."""
        process = SPAWN.Process(target=body, args=arguments, name=name)
        with blocked_sigint():
            process.start()
        self.members[name] = process
        for end in ends:
            end.close()

    def alive(self, name: str) -> bool:
        """Whether a process was started and has not ended."""
        member = self.members.get(name)
        return member is not None and member.is_alive()

    def dead(self) -> list[str]:
        """Names of those that have ended."""
        return [name for name, member in self.members.items() if not member.is_alive()]

    def ending(self, name: str) -> str:
        """The end of a process as a text."""
        code = self.members[name].exitcode
        if code is None:
            return "runs"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"

    def sentinels(self) -> list[int]:
        """Handles that become ready when a process ends."""
        return [member.sentinel for member in self.members.values() if member.is_alive()]

    def end(self, name: str, patience: float = EXIT_TIMEOUT, grace: float = EXIT_TIMEOUT) -> None:
        """Wait `patience` s for a process, request its end, and `grace` s later kill it with its children."""
        member = self.members.get(name)
        if member is None:
            return
        member.join(0 if not member.is_alive() else patience)
        if member.is_alive():
            member.terminate()
            member.join(grace)
        self.kill(name)

    def kill(self, name: str) -> None:
        """Kill a process and its group at once."""
        member = self.members.get(name)
        if member is None or member.pid is None:
            return
        if member.is_alive():
            member.kill()
            member.join()
        with suppress(OSError):
            os.killpg(member.pid, signal.SIGKILL)

    def kill_all(self) -> None:
        """Leave no process behind."""
        for name in self.members:
            self.kill(name)


def run_tracker(prepared: Prepared, channels: TrackingChannels) -> None:
    """Track the surface."""
    from hardware.live.tracking_process import track

    track(prepared, channels)


def run_motion(prepared: Prepared, channels: MotionChannels) -> None:
    """Plan the motion, and send it to the arm."""
    from hardware.live.motion_process import move

    move(prepared, channels)


def run_arm(prepared: Prepared, device: File, lifeline: Connection) -> None:
    """Serve a virtual arm at `device` until SIGTERM or the end of the lifeline; then write the executed motion."""
    from hardware.simulator.arm.ports import run_virtual_arm
    from hardware.simulator.arm.settings import ArmSettings, ReplyMode, read_virtual_arm

    set_up_process("arm", outlives=True)
    settings, faults = ArmSettings(replies=ReplyMode.STREAM), tuple[Fault, ...]()
    if prepared.virtual is not None:
        settings, faults = read_virtual_arm(prepared.virtual)
    if prepared.settings.real_time:
        ask_for_real_time()  # a real controller has its own processor
    clock, stop = WatchedClock(WallClock()), threading.Event()
    threading.Thread(target=_stop_after, args=(lifeline, stop), daemon=True).start()
    arm = run_virtual_arm(
        settings, prepared.task.profile, faults, device, clock=clock, stop=stop, say=lambda text: None
    )
    assert clock.begun is not None
    stamps = np.arange(0.0, arm.now, EXECUTED_STEP)  # (N,) s
    axes = arm.axes_at(stamps) if len(stamps) else np.zeros((0, 6))  # (N, 6)
    counts = {"ignored": len(arm.ignored), "refused": len(arm.refused), "garbage": sum(len(d) for _, d in arm.garbage)}
    spans = {"deepest": arm.peak_work, "held_up": clock.longest, "left": arm.in_flight}
    executed: dict[str, Any] = {"stamps": stamps + clock.begun, "axes": axes, "frames": arm.frames, **counts, **spans}
    with prepared.files.executed.open("wb") as file:
        np.savez(file, **executed)


def _stop_after(lifeline: Connection, stop: threading.Event) -> None:
    """Set `stop` some time after the other end of the lifeline is closed."""
    try:
        lifeline.poll(None)
        stop.wait(ARM_AFTERLIFE)
    finally:
        stop.set()


@dataclass(slots=True)
class RunChannels:
    """The channels between the supervising process and the others."""

    processes: ProcessGroup
    shared: SharedState
    url: str  # of the arm's port
    orders: Connection  # to the motion process
    lifeline: Connection  # its closing tells the tracking process that this one has ended
    arm_lifeline: Connection  # the same for a virtual arm
    sender: RecorderSender

    def order(self, order: object) -> None:
        """Send an order to the motion process; OSError if it has ended."""
        self.orders.send(order)
        self.shared.bell.ring()

    def end(self) -> None:
        """End the processes in the order of their data: motion first, then the recorder's sources, the arm last.

        A process without a report is still loading; before printing there is little to lose either.
        """
        until = (clock := WallClock()).now() + EARLY_EXIT_TIME[0]
        self.lifeline.close()  # the motion process ends: it needs no more poses
        shared, printing = self.shared, not math.isnan(self.shared.place.value)
        has_tracked = shared.tracking.get() is not None
        self.processes.end("motion", 0.0 if shared.motion.get() is None else EXIT_TIMEOUT)
        patience = EXIT_TIMEOUT if printing else max(until - clock.now(), 0.0)
        grace = EXIT_TIMEOUT if printing else EARLY_EXIT_TIME[1]
        self.processes.end("tracking", patience if has_tracked else 0.0, grace)
        self.processes.kill("feed")  # it keeps nothing
        self.sender.close()
        self.processes.end("recorder", 30.0 if has_tracked or shared.recorder.get() is not None else 0.0)
        self.processes.end("arm", 0.1 if printing else 0.0)


def start_processes(prepared: Prepared, folder: File, tracker: ProcessBody) -> RunChannels:
    """Start all processes, or none. folder: for a virtual arm's device. tracker: body of the tracking process."""
    processes, shared = ProcessGroup(), SharedState(FrameRing([camera.size for camera in prepared.rig.cameras]))
    with ExitStack() as stack:
        stack.callback(processes.kill_all)
        url, arm_lifeline = prepared.settings.arm, SPAWN.Pipe(duplex=False)[1]
        if url == VIRTUAL_ARM:
            url = str(folder / "arm")
            arm_lifeline = start_arm(processes, prepared, File(url))
        to_recorder = [SPAWN.Pipe(duplex=False) for _ in range(3)]  # from the motion, the tracking and this process
        lifeline, notices, orders = (SPAWN.Pipe(duplex=False) for _ in range(3))
        ends = [end for end, _ in to_recorder]
        processes.start("recorder", record, (prepared.settings, ends, shared.recorder), ends)
        motion = MotionChannels(shared, url, orders[0], to_recorder[0][1])
        processes.start("motion", run_motion, (prepared, motion), (motion.orders, motion.recorder))
        if not prepared.live:
            processes.start("feed", play, (prepared, shared.ring, notices[1], shared.start), (notices[1],))
        tracking = TrackingChannels(shared, notices[0], to_recorder[1][1], lifeline[0])
        own_ends = tracking.notices, tracking.recorder, tracking.lifeline
        processes.start("tracking", tracker, (prepared, tracking), own_ends)
        sender = RecorderSender(to_recorder[2][1])
        stack.pop_all()
    return RunChannels(processes, shared, url, orders[1], lifeline[1], arm_lifeline, sender)


def start_arm(processes: ProcessGroup, prepared: Prepared, device: File) -> Connection:
    """Start a virtual arm, and wait for its device; returns the lifeline, whose closing ends it."""
    arm_end, lifeline = SPAWN.Pipe(duplex=False)
    processes.start("arm", run_arm, (prepared, device, arm_end), (arm_end,))
    clock = WallClock()
    until = clock.now() + ARM_START_TIMEOUT
    while not device.is_symlink():
        if not processes.alive("arm") or clock.now() > until:
            raise StillbedError("the virtual arm did not start")
        clock.wait_until(clock.now() + ARM_POLL_PERIOD)
    return lifeline
