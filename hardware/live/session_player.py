"""A recorded session shown in real time by a process of its own, as cameras would show it.

A session whose truth is known to be smooth (a pre-rendered one) goes on for ever: it is shown forwards and backwards in
turn, between two instants at which the surface hardly moves, so that the motion has no corner there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from estimation.errors import StillbedError
from estimation.trajectory import Trajectory
from hardware.files.images import decode
from hardware.files.session import FrameReader, FrameRef, Session, open_session
from hardware.frame_faults import FrameFaults
from hardware.live.arrived import Encoded
from hardware.live.frame_source import FrameRing
from hardware.live.injected import Begun
from hardware.process.clock import WallClock
from hardware.process.faults import Fault
from hardware.process.system import settle
from perception.frames import Frame, FrameSet
from perception.pairing import frame_set

TRANSPORT = 0.025  # s from the middle of an exposure to the picture in the computer, as a scenario has it
LOOK = 0.02  # s between looks whether anybody wants to see it
ENDS = 0.25  # share of a session at each end in which a turn is looked for
EARLY = 1.5  # times what decoding took, before a set is due
FORGET = 0.9  # of what it took, from set to set
KEPT = 2**30  # bytes of encoded pictures that are kept for a session shown again and again


@dataclass(frozen=True, slots=True)
class FeedPlan:
    """What is shown. session: folder or MCAP. again: whether it never ends. faults: of cameras, from `begun` on."""

    session: Path
    again: bool
    faults: tuple[Fault, ...] = ()
    begun: Begun = field(default_factory=Begun)


@dataclass(frozen=True, slots=True)
class Showing:
    """One showing of one set. live: s, the stamp it gets, of its first frame. backwards: whether time runs so."""

    index: int
    live: float
    backwards: bool


def turns(truth: Trajectory, stamps: np.ndarray) -> tuple[int, int]:
    """First and last set (N stamps, s) between which a session is shown to and fro: where the surface is slowest."""
    count = len(stamps)
    places = np.stack([np.interp(stamps, truth.stamps, truth.base_from_surface[:, i, 3]) for i in range(3)], 1)
    speed = np.linalg.norm(np.gradient(places, stamps, axis=0), axis=1)
    share = max(int(ENDS * count), 1)
    return int(np.argmin(speed[:share])), count - share + int(np.argmin(speed[count - share :]))


def schedule(stamps: np.ndarray, begin: float, between: tuple[int, int] | None) -> Iterator[Showing]:
    """When each set, of stamps (N,), is shown: once, or to and fro for ever between two of them."""
    if between is None:
        yield from (Showing(i, begin + float(s - stamps[0]), False) for i, s in enumerate(stamps))
        return
    first, last = between
    live = begin
    yield Showing(first, live, False)
    while True:
        for i in range(first + 1, last + 1):
            live += float(stamps[i] - stamps[i - 1])
            yield Showing(i, live, False)
        for i in range(last - 1, first - 1, -1):
            live += float(stamps[i + 1] - stamps[i])
            yield Showing(i, live, True)


def feed_process(plan: FeedPlan, ring: FrameRing, words: Connection) -> None:
    """Show a session until it is over, or nobody looks any more; the last word says why it ended."""
    settle("feed")
    with suppress(BrokenPipeError, ConnectionError):
        try:
            session = open_session(plan.session)
            _show(session, plan, ring, words)
            words.send(f"{plan.session.name} is over")
        except StillbedError as error:
            words.send(str(error))


def _show(session: Session, plan: FeedPlan, ring: FrameRing, words: Connection) -> None:
    clock, pictures = WallClock(), _Pictures(session, plan.again)
    spoil = FrameFaults(plan.faults, session.rig, "command line")
    _wait_until_wanted(ring, clock)
    stamps = np.array([np.mean([ref.stamp for ref in refs]) for refs in session.sets])
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    between = turns(session.truth, stamps) if plan.again and session.truth is not None else None
    spent = period  # s that decoding a set took
    for showing in schedule(stamps, clock.now(), between):
        due = showing.live + TRANSPORT
        if clock.now() > due + period:
            continue  # as a camera whose host is late loses a frame
        refs, anchor = session.sets[showing.index], float(stamps[showing.index])
        clock.wait_until(due - EARLY * spent)  # not before: while the set before is tracked, cores are wanted there
        begun = clock.now()
        encoded, frames = pictures.decoded(refs)
        spent = max(clock.now() - begun, FORGET * spent)
        shown = [replace(f, stamp=_live(f.stamp, anchor, showing)) for f in frames]
        head = session.heads.at(anchor)
        whole = FrameSet(frame_set(shown).stamp, tuple(shown), head)
        seen = spoil(whole, showing.live - plan.begun.instant)
        same = {frame.camera for frame in seen.frames if frame in whole.frames}
        encoded = {camera: stored for camera, stored in encoded.items() if camera in same}
        clock.wait_until(due)
        if seen.frames:
            words.send(ring.put(seen, encoded, clock.now, anchor))


def _wait_until_wanted(ring: FrameRing, clock: WallClock) -> None:
    """A session that is shown once begins when the tracker is ready for it."""
    parent = parent_process()
    while not ring.wanted and (parent is None or parent.is_alive()):
        clock.wait_until(clock.now() + LOOK)


def _live(stamp: float, anchor: float, showing: Showing) -> float:
    """The stamp, s, of a frame whose set is shown at another instant; backwards, what was earlier is later."""
    return showing.live + (anchor - stamp if showing.backwards else stamp - anchor)


class _Pictures:
    """Reads and decodes pictures; of a session that is shown again and again, keeps them as they were encoded."""

    def __init__(self, session: Session, keep: bool) -> None:
        self._session, self._keep, self._kept, self._size = session, keep, dict[FrameRef, Encoded](), 0
        self._reader: FrameReader = session.store.open()

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
        if ref in self._kept:
            return self._kept[ref]
        stored = self._reader.encoded(ref)
        if self._keep and stored is not None and self._size < KEPT:
            self._kept[ref] = stored
            self._size += len(stored[1])
        return stored
