"""A recorded session shown in real time by a process of its own, as cameras would show it.

A pre-rendered session, whose truth is smooth, goes on for ever: it is shown forwards and backwards in turn, between two
instants at which the surface hardly moves, so that the motion has no corner there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from ctypes import c_double
from dataclasses import dataclass, replace
from multiprocessing import parent_process
from multiprocessing.connection import Connection

import numpy as np

from estimation.errors import StillbedError
from estimation.pose import Trajectory
from hardware.files.images import decode
from hardware.files.session import FrameReader, FrameRef, Session
from hardware.live.frame_source import Encoded, FrameRing
from hardware.live.prepared import Prepared
from hardware.offline.replay import FrameFaults
from hardware.process.clock import WallClock
from hardware.process.faults import Fault
from hardware.process.system import set_up_process
from hardware.recording.session_reader import open_session
from perception.frames import Frame, FrameSet, frame_set

TRANSPORT_DELAY = 0.025  # s from the middle of an exposure to the picture in the computer, as a scenario has it
REQUEST_POLL_PERIOD = 0.02  # s between looks whether the tracker asks for frames
TURN_SEARCH_SHARE = 0.25  # share of a session at each end in which a turn is looked for
DECODE_LEAD = 1.5  # of the time that decoding takes: so long before a set is due it is begun
DECODE_DECAY = 0.9  # of that time, from set to set
PICTURE_CACHE_BYTES = 2**30  # of encoded pictures, kept where a session is shown again and again


@dataclass(frozen=True, slots=True)
class SetShowing:
    """One showing of one set."""

    index: int  # of the set in the session
    live: float  # s, the stamp that its first frame gets
    backwards: bool  # whether the session's time runs backwards


def turning_sets(truth: Trajectory, stamps: np.ndarray) -> tuple[int, int]:
    """First and last set (N stamps, s) between which a session is shown to and fro: where the surface is slowest."""
    count = len(stamps)
    places = np.stack([np.interp(stamps, truth.stamps, truth.base_from_surface[:, i, 3]) for i in range(3)], 1)
    speed = np.linalg.norm(np.gradient(places, stamps, axis=0), axis=1)
    share = max(int(TURN_SEARCH_SHARE * count), 1)
    return int(np.argmin(speed[:share])), count - share + int(np.argmin(speed[count - share :]))


def schedule(stamps: np.ndarray, begin: float, between: tuple[int, int] | None) -> Iterator[SetShowing]:
    """When each set, of stamps (N,), is shown: once, or to and fro for ever between two of them."""
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
    """The body of the process: show the run's session until it is over or the other end is closed.

    The last notice is a text that says why it ended.
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
    clock, pictures = WallClock(), _PictureCache(session, again)
    inject = FrameFaults(faults, session.rig, "command line")
    parent = parent_process()  # a session that is shown once begins when the tracker is ready for it
    while not ring.requested.value and (parent is None or parent.is_alive()):
        clock.wait_until(clock.now() + REQUEST_POLL_PERIOD)
    stamps = np.array([np.mean([ref.stamp for ref in refs]) for refs in session.sets])
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    between = turning_sets(session.truth, stamps) if again and session.truth is not None else None
    spent = period  # s that decoding a set took
    for showing in schedule(stamps, clock.now(), between):
        due = showing.live + TRANSPORT_DELAY
        if clock.now() > due + period:
            continue  # as a camera whose host is late loses a frame
        refs, anchor = session.sets[showing.index], float(stamps[showing.index])
        clock.wait_until(due - DECODE_LEAD * spent)  # not before: the tracker wants the cores for the set before
        decoding = clock.now()
        encoded, frames = pictures.decoded(refs)
        spent = max(clock.now() - decoding, DECODE_DECAY * spent)
        ahead = -1 if showing.backwards else 1  # backwards, what was earlier is later
        restamped = [replace(f, stamp=showing.live + ahead * (f.stamp - anchor)) for f in frames]
        head = session.heads.at(anchor)
        intact = FrameSet(frame_set(restamped).stamp, tuple(restamped), head)
        struck = inject(intact, showing.live - start.value)
        same = {frame.camera for frame in struck.frames if frame in intact.frames}
        clock.wait_until(due)
        if struck.frames:
            unchanged = {camera: stored for camera, stored in encoded.items() if camera in same}
            notices.send(ring.put(struck, unchanged, clock.now, anchor))


class _PictureCache:
    """Reads and decodes pictures; of a session that is shown again and again, keeps them as they were encoded."""

    def __init__(self, session: Session, keep: bool) -> None:
        self._session, self._keep, self._cache, self._size = session, keep, dict[FrameRef, Encoded](), 0
        self._reader: FrameReader = session.open_reader()

    def decoded(self, refs: tuple[FrameRef, ...]) -> tuple[dict[int, Encoded], list[Frame]]:
        """The pictures of a set, as stored and as arrays."""
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
