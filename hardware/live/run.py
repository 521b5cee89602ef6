"""`stillbed live`: the process that the user started conducts the run; others see, move and write.

It starts them, looks at their reports, keys, signals and the page, asks the conductor what follows, and gives the
orders. It does nothing that takes long, so that a stop waits for nothing here.
"""

from __future__ import annotations

import importlib
import math
import signal
import socket
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import wait
from pathlib import Path as File
from types import FrameType
from typing import TYPE_CHECKING

from estimation.errors import InputError
from hardware.arm.profile import ArmProfile
from hardware.arm_status import ArmState
from hardware.live.beside import Found, write_found
from hardware.live.bodies import track
from hardware.live.checklist import table
from hardware.live.console import HELP, Console
from hardware.live.halting import halt
from hardware.live.injected import Injector
from hardware.live.keeper import Keeper
from hardware.live.kept import kept_begin
from hardware.live.laid import Laid
from hardware.live.lines import Body, started
from hardware.live.page_address import page_settings
from hardware.live.prepared import Prepared
from hardware.live.records import Begin, EventEntry, UsedEntry
from hardware.live.settings import settings_text
from hardware.live.state_machine import Conductor, Orders, Seen
from hardware.live.tally import Tally
from hardware.live.view import Viewer
from hardware.live.words import stage_line, status_line
from hardware.motion.loop import Order
from hardware.operator.process import OperatorPage
from hardware.operator.scene import scene_from
from hardware.operator.shared_state import Request, Wish
from hardware.operator.view import Stage
from hardware.process.clock import WallClock
from hardware.recording.schemas import INFO, WARNING

if TYPE_CHECKING:
    from hardware.live.outcome import Outcome

LOOK = 0.02  # s between looks while nothing happens
SHOW = 0.15  # s between views for the page
SAY = 5.0  # s between lines
AT_REST = 1.0  # s that the arm gets to say that it is at rest
HUNG = 2.0  # s without a word of the motion process, after which it is ended and the arm stopped for it
ENDED_BY = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "the terminal was closed"}
MOTION, TRACKING, RECORDER = "motion", "tracking", "recorder"


class LiveRun:
    """One run from its check to its report."""

    def __init__(self, prepared: Prepared, console: Console, tracker: Body = track) -> None:
        """tracker: what the tracking process does; given what `hardware.live.bodies.track` is given."""
        self._prepared, self._console, self._clock = prepared, console, WallClock()
        self._tracker = tracker
        self._conductor, self._tally, self._seen = Conductor(prepared.task), Tally(), Seen()
        self._signal = 0
        self._viewer, self._viewed = Viewer(prepared), -1e9
        self._page: OperatorPage | None = None
        self._stopped_at: list[float] = []  # s, decisions whose frame is not on the wire yet
        self._stops, self._requests = 0, 0
        self._turn = 0  # that was told last
        self._said = self._heard = -1e9
        self._found = prepared.found is not None
        self._halted = self._missing = False
        self._laid: Laid | None = None  # as the page shows it
        self._landmarks = 0  # of the surface that it shows
        self._used: ArmProfile | None = None  # since the path was begun

    def __call__(self) -> Outcome:
        """Run to the end; what came of it. Files are whole and all processes have ended on return."""
        prepared = self._prepared
        with tempfile.TemporaryDirectory() as folder, _wakened(self) as wake, ExitStack() as stack:
            lines = self._lines = started(prepared, File(folder), self._tracker)
            stack.callback(lines.close)
            prepared.beside.session.write_text(settings_text(prepared.settings), encoding="utf-8")
            lines.outbox.put(UsedEntry("session.toml", settings_text(prepared.settings)))
            keeper = Keeper(prepared.beside.progress, prepared.task.fingerprint, lines.place)
            stack.callback(keeper.close)
            self._open_page(stack)
            page = "" if self._page is None else self._page.address
            self._injector = Injector(prepared.faults, lines.crew, prepared.beside.record, lines.begun, page)
            importlib.import_module("scipy.interpolate")  # predicting takes it; now nobody waits for this process
            for note in prepared.notes:
                self._console.say(note)
            while not self._conductor.ended:
                self._look(wake, keeper)
            self._come_to_rest(wake)
            self._say_farewell()
            self._shut_down()
        from hardware.live.outcome import Outcome  # loads what reports need, once the arm is at rest

        return Outcome(prepared, self._conductor, self._tally, self._seen, self._signal, lines.place.fraction)

    def signalled(self, number: int, frame: FrameType | None) -> None:
        """A signal asks the run to end."""
        self._signal = number

    # -- one look

    def _look(self, wake: socket.socket, keeper: Keeper) -> None:
        ready = wait([wake, *self._lines.crew.sentinels(), *self._terminal()], LOOK)
        if wake in ready:
            wake.recv(64)
        requests = self._keys(ready) + self._lines.link.requests.take()
        seen, lines, now = self._seen, self._lines, self._clock.now()
        seen.tracking, seen.motion, seen.recorder = lines.tracking.get(), lines.motion.get(), lines.recorder.get()
        self._count_stops(now)
        conductor = self._conductor
        for words in self._injector.look(now):
            self._say(f"on purpose: {words}", WARNING)
        orders = self._ended(keeper, now) + conductor(now, seen, requests)
        self._give(orders)
        self._tally.look(now, conductor.stage, seen, None if conductor.laid is None else conductor.laid.profile.arm)
        self._viewer.look(seen, self._used)
        self._note_surface()
        self._show(now)
        self._tell(now)

    def _terminal(self) -> list[int]:
        return [] if self._console.file is None else [self._console.file]

    def _keys(self, ready: Sequence[object]) -> list[Request]:
        if self._console.file is None or self._console.file not in ready:
            return []
        found = []
        for wish in self._console.wishes():
            self._requests -= 1  # the page's count upwards
            found.append(Request(self._requests, wish, self._conductor.turn))
        return found

    def _ended(self, keeper: Keeper, now: float) -> Orders:
        """What ends a run from outside the stages: a signal, a process that is gone or hangs, a bookmark not kept."""
        conductor, crew = self._conductor, self._lines.crew
        if self._signal:
            return conductor.end(f"ended: {ENDED_BY[signal.Signals(self._signal)]}", now, Stage.ENDED)
        for name in crew.dead():
            if name == MOTION and (trouble := self._lines.trouble.get()):
                return conductor.end(trouble, now)
            if name == MOTION:
                self._halt()
            ended = self._lines.tracking.get()
            if name == TRACKING and ended is not None and ended.ended:
                continue  # the conductor knows whether pictures are still needed
            if name in (MOTION, TRACKING, RECORDER):
                failed = self._lines.recorder.get()
                why = f": {failed.failed}" if name == RECORDER and failed is not None and failed.failed else ""
                return conductor.end(f"the {name} process {crew.ending(name)}{why}", now)
        if keeper.failed:
            return conductor.end(f"the place on the path cannot be kept: {keeper.failed}", now)
        motion = self._seen.motion
        if motion is not None and now - motion.tick.stamp > HUNG:
            crew.kill(MOTION)
            self._halt()
            return conductor.end(f"the motion process said nothing for {HUNG:g} s and was ended", now)
        return []

    def _halt(self) -> None:
        """Stop the arm in place of the motion process."""
        if self._halted:
            return
        self._halted = True
        decided = self._clock.now()
        sent, reason = halt(self._lines.url, self._prepared.task.profile)
        if reason:
            self._say(f"the arm could not be stopped: {reason}; its queue ends within 50 ms", WARNING)
        else:
            self._tally.times.add("motion process gone to stop on the wire", sent - decided)

    def _give(self, orders: Orders) -> None:
        for order in orders:
            if order is Order.STOP:
                self._stopped_at.append(self._clock.now())
            if isinstance(order, Begin):
                try:
                    order = self._noted(order)
                except InputError as error:
                    why = f"{error.what} = {error.got}, allowed {error.allowed}"
                    self._give(
                        self._conductor.end(f"what lies on the surface cannot be printed: {why}", self._clock.now())
                    )
                    return
            with suppress(OSError):  # nobody is there: seen by its end
                self._lines.orders.send(order)

    def _noted(self, order: Begin) -> Begin:
        """The order as a recording keeps it, to the last digit, so that a replay of that gives the same bytes."""
        kept, order = kept_begin(order)
        for name, text in kept.items():
            self._lines.outbox.put(UsedEntry(name, text))
        lag = 1000 * order.profile.lag
        self._used = order.profile
        self._say(f"begun at checkpoint {order.start:.2f}, the arm's lag taken as {lag:.0f} ms")
        return order

    def _count_stops(self, now: float) -> None:
        """How long a stop took from the decision to the end of its frame on the wire."""
        motion = self._seen.motion
        if motion is None or motion.stop is None or motion.stops == self._stops:
            return
        self._stops = motion.stops
        if self._stopped_at and motion.stop[1] >= self._stopped_at[0]:
            self._tally.times.add("stop decided to on the wire", motion.stop[1] - self._stopped_at[0])
        self._stopped_at.clear()

    # -- what it shows and says

    def _open_page(self, stack: ExitStack) -> None:
        if not self._prepared.settings.page:
            return
        link = self._lines.link
        settings = self._prepared.settings
        self._page = OperatorPage(link, page_settings(settings, self._prepared.beside.session))
        stack.callback(self._page.close)
        self._page.tend(self._clock.now())
        link.scene.put(scene_from(self._prepared.rig))
        self._console.say(f"open {self._page.address} to see and operate the run")

    def _show(self, now: float) -> None:
        """The page's view, and the page itself: where it died, whoever looked at it sees nothing, so the arm waits."""
        page, conductor = self._page, self._conductor
        if page is None or now < self._viewed + SHOW:
            return
        self._viewed = now
        if page.process is not None and not page.process.is_alive():
            self._say("the operator's page has ended, and is started again", WARNING)
            if Wish.PAUSE in conductor.offers and not self._prepared.task.unattended:
                self._give(conductor.pause("the operator's page was lost", now))
        page.tend(now)
        self._lines.link.views.put(self._viewer(now, conductor, self._seen, self._tally))

    def _note_surface(self) -> None:
        """Keep where the path lies as soon as that is known, for a run that resumes."""
        tracking, laid, prepared = self._seen.tracking, self._conductor.laid, self._prepared
        surface = None if tracking is None else tracking.surface
        count = 0 if surface is None else len(surface)
        if laid is not self._laid or count != self._landmarks:
            self._laid, self._landmarks = laid, count
            self._lines.link.scene.put(scene_from(prepared.rig, None if laid is None else laid.path, surface))
        if self._found or laid is None or tracking is None or tracking.surface_from_path is None:
            return
        self._found = True
        arm_from_base = laid.profile.arm.arm_from_base
        found = Found(prepared.beside.record, tracking.registered, tracking.surface_from_path, arm_from_base)
        write_found(prepared.beside.surface, found)

    def _tell(self, now: float) -> None:
        conductor = self._conductor
        if conductor.missed and not self._missing:
            self._lines.outbox.put(EventEntry(now, conductor.missed, WARNING, "run"))
        self._missing = bool(conductor.missed)
        if conductor.turn != self._turn:
            self._turn = conductor.turn
            if conductor.stage is Stage.PRINT and math.isnan(self._lines.begun.instant):
                self._lines.begun.instant = now
            self._say(stage_line(conductor.stage, conductor.reason))
            if conductor.stage is Stage.FIND:
                self._console.say(table(conductor.checks))
            elif conductor.stage in (Stage.CONFIRM, Stage.READY):
                key = "y: the path is right" if conductor.stage is Stage.CONFIRM else "s: start"
                self._console.say(f"  {HELP}\n  now: {key}")
            self._said = now
        elif now > self._said + SAY:
            self._said = now
            self._console.say(status_line(conductor, self._seen))

    def _say(self, text: str, level: int = INFO) -> None:
        self._console.say(text)
        self._lines.outbox.put(EventEntry(self._clock.now(), text, level, "run"))

    # -- the end

    def _come_to_rest(self, wake: socket.socket) -> None:
        """Wait until the arm was told to stop and has nothing under way."""
        until = self._clock.now() + AT_REST
        while (now := self._clock.now()) < until and self._lines.crew.alive(MOTION):
            motion = self._seen.motion = self._lines.motion.get() or self._seen.motion
            self._count_stops(now)
            if motion is None:
                return
            status = motion.tick.status
            if status.state is not ArmState.ARMED and not status.in_flight > 0 and status.stamp > now - 2 * LOOK:
                return
            wait([wake, *self._lines.crew.sentinels()], LOOK / 4)

    def _say_farewell(self) -> None:
        """Show on the page how the run ended; then it goes, so that nothing looks as if it could be asked."""
        if self._page is None:
            return
        now = self._clock.now()
        self._lines.link.views.put(self._viewer(now, self._conductor, self._seen, self._tally))
        self._page.close()

    def _shut_down(self) -> None:
        lines = self._lines
        self._injector.close()
        with suppress(OSError):
            lines.orders.send(Order.QUIT)
        lines.end()
        self._seen.tracking = lines.tracking.get() or self._seen.tracking
        self._seen.motion = lines.motion.get() or self._seen.motion
        self._seen.recorder = lines.recorder.get()


@contextmanager
def _wakened(run: LiveRun) -> Iterator[socket.socket]:
    """Signals that end a run wake up whoever waits on the socket."""
    ours, theirs = socket.socketpair()
    for end in (ours, theirs):
        end.setblocking(False)
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, run.signalled) for number in numbers]
    file = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    try:
        yield ours
    finally:
        signal.set_wakeup_fd(file)
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        ours.close()
        theirs.close()
