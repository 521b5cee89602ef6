"""The processes of a run and what joins them, as the conducting process holds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path as File

from estimation.errors import StillbedError
from hardware.live.bodies import move, move_virtually, record, show
from hardware.live.frame_source import FrameRing
from hardware.live.injected import Begun
from hardware.live.ipc import CONTEXT, Crew
from hardware.live.outbox import Outbox
from hardware.live.place import Place
from hardware.live.prepared import Prepared
from hardware.live.records import Handed, LiveMotionReport, RecorderReport, TrackingReport
from hardware.live.settings import VIRTUAL
from hardware.operator.link import OperatorLink
from hardware.process.clock import WallClock
from hardware.process.shared_latest import Newest

Body = Callable[..., None]

LOOK = 0.02  # s between looks for it
TROUBLE = 4096  # bytes of a sentence that says what is wrong with the arm
READY = 60.0  # s in which a virtual arm's device must be there, on a busy machine


@dataclass(slots=True)
class Lines:
    """What joins the processes. url: of the arm's port. lifeline, arm_line: nothing is ever said on them; they end
    with us. trouble: why the arm cannot be used at all. begun: when printing began."""

    crew: Crew
    url: str
    place: Place
    tracking: Newest[TrackingReport]
    motion: Newest[LiveMotionReport]
    recorder: Newest[RecorderReport]
    orders: Connection
    lifeline: Connection
    arm_line: Connection
    outbox: Outbox
    link: OperatorLink
    trouble: Newest[str]
    begun: Begun

    def end(self) -> None:
        """End the processes in the order in which nobody misses anybody: the arm's first, the recorder last."""
        self.crew.end("motion")
        self.lifeline.close()
        self.crew.end("tracking")
        self.crew.end("feed", 1.0)
        self.outbox.close()
        self.crew.end("recorder", 30.0)
        self.crew.end("arm", 0.1)

    def close(self) -> None:
        """Leave no process behind."""
        for name in list(self.crew.members):
            self.crew.kill(name)


def started(prepared: Prepared, folder: File, tracker: Body) -> Lines:
    """Start all processes, or none. folder: for a virtual arm's device. tracker: what the tracking process does."""
    crew = Crew()
    try:
        return _started(crew, prepared, folder, tracker)
    except BaseException:
        for name in list(crew.members):
            crew.kill(name)
        raise


def _started(crew: Crew, prepared: Prepared, folder: File, tracker: Body) -> Lines:
    url = prepared.settings.arm
    arm_line = CONTEXT.Pipe(duplex=False)
    if url == VIRTUAL:
        url = str(folder / "arm")
        _start_arm(crew, prepared, File(url), arm_line[0])
    place, ring = Place(), FrameRing([camera.size for camera in prepared.rig.cameras])
    poses, tracking, motion = Newest[Handed](), Newest[TrackingReport](), Newest[LiveMotionReport]()
    recorder, link, trouble, begun = Newest[RecorderReport](), OperatorLink(), Newest[str](TROUBLE), Begun()
    senders = [CONTEXT.Pipe(duplex=False) for _ in range(3)]
    lifeline, words, orders = (CONTEXT.Pipe(duplex=False) for _ in range(3))
    crew.start("recorder", record, (prepared, [end for end, _ in senders], recorder))
    crew.start("motion", move, (prepared, url, place, poses, motion, orders[0], link, trouble, senders[0][1]))
    if not prepared.live:
        crew.start("feed", show, (prepared, ring, words[1], begun))
    told = prepared, ring, words[0], poses, tracking, motion, link, senders[1][1], lifeline[0]
    crew.start("tracking", tracker, told)
    ends = orders[1], lifeline[1], arm_line[1], Outbox(senders[2][1])
    return Lines(crew, url, place, tracking, motion, recorder, *ends, link, trouble, begun)


def _start_arm(crew: Crew, prepared: Prepared, link: File, lifeline: Connection) -> None:
    """Start a virtual arm, and wait for its device."""
    crew.start("arm", move_virtually, (prepared, link, lifeline))
    clock = WallClock()
    until = clock.now() + READY
    while not link.is_symlink():
        if not crew.alive("arm") or clock.now() > until:
            raise StillbedError("the virtual arm did not start")
        clock.wait_until(clock.now() + LOOK)
