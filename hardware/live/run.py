"""`stillbed live`: the process that the user started; it supervises the processes that track, move and record.

In each cycle it reads their reports, the keys, signals and the page's requests, calls the state machine with them, and
sends the orders that follow. It does nothing that takes long, so that a stop never waits here.
"""

from __future__ import annotations

import importlib
import math
import signal
import socket
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from logging import INFO, WARNING
from multiprocessing.connection import wait
from pathlib import Path as File
from threading import Thread

import numpy as np

from estimation import se3
from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.profile import ArmProfile, emergency_stop
from hardware.dispenser.dispenser import switch_off
from hardware.files.dispenser_file import dispensers_from_text, drivers_of
from hardware.files.path_file import ProgressWriter
from hardware.live.checklist import PlacedPath, checks_table
from hardware.live.fault_injection import FaultInjector
from hardware.live.ipc import ProcessBody, run_tracker, start_processes
from hardware.live.outcome import RunOutcome, RunStatistics
from hardware.live.prepared import Prepared, SurfacePlacement, placement_text
from hardware.live.records import EventEntry, PlacedScanEntry, RunReports, SearchOrder, UsedEntry
from hardware.live.settings import page_settings, settings_text, used_files
from hardware.live.state_machine import Orders, RunStateMachine
from hardware.live.view import KEYS_HELP, Console, ViewBuilder, stage_line, status_line
from hardware.motion.loop import Order
from hardware.motion.step import BeginPrint
from hardware.operator.process import OperatorPage
from hardware.operator.shared_state import OperatorRequest, PageScene, ScanDrawing, scene_from
from hardware.operator.view import RunResult, RunStage, Wish
from hardware.process.clock import WallClock
from hardware.process.progress import write_atomically
from hardware.process.system import answer_first, handled_signals, state_inputs
from hardware.recording.loop_record import LOOP_ARM_ATTACHMENT, recorded_arm, recorded_begin
from planning.material import with_offsets
from planning.placement import PlacedBy

POLL_PERIOD, VIEW_PERIOD = 0.02, 0.15  # s between looks while nothing happens, and between views for the page
STATUS_PERIOD = 5.0  # s between status lines
REST_TIMEOUT = 1.0  # s in which the arm has to report that it is at rest
MOTION_HANG_TIMEOUT = 2.0  # s without a report, after which the motion process is ended and the arm stopped for it
SIGNAL_TEXTS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "the terminal was closed"}
MOTION, TRACKING, RECORDER = "motion", "tracking", "recorder"


class LiveRun:
    """One run from its check to its report."""

    def __init__(self, prepared: Prepared, console: Console, tracker: ProcessBody = run_tracker) -> None:
        """tracker: body of the tracking process, with the parameters of `hardware.live.ipc.run_tracker`."""
        self._prepared, self._console, self._clock = prepared, console, WallClock()
        self._tracker = tracker
        self._machine, self._statistics, self._reports = RunStateMachine(prepared.task), RunStatistics(), RunReports()
        self._view_builder, self._view_time = ViewBuilder(prepared), -1e9
        self._page: OperatorPage | None = None
        self._signal = 0  # that asks the run to end
        self._stop_order_times: list[float] = []  # s, of stops whose frame is not on the wire yet
        self._stops = self._key_requests = 0  # on the wire so far; requests of the terminal, counted downwards
        self._looks = 0  # searches for the surface that were ordered
        self._gaps = 0  # entries not recorded, when last logged
        self._turn = 0  # of the state machine, when its stage was last announced
        self._announced = -1e9  # s
        self._silence_logged = self._arm_halted = False
        self._written_placement: tuple[PlacedPath, bool] | None = None  # in run.surface.toml; whether confirmed
        self._scene_parts: tuple[object, ...] = None, 0, None, None  # path, landmarks, scan, result of a look
        self._placement_text = ""  # text of run.surface.toml
        self._prompted_stage: RunStage | None = None  # the stage whose keys were printed
        self._profile: ArmProfile | None = None  # of the arm since the path was begun

    def __call__(self) -> RunOutcome:
        """Run to the end. On return all files are complete and all processes have ended."""
        prepared, files = self._prepared, self._prepared.files
        state_inputs(used_files(prepared.settings), prepared.settings.operator)
        with tempfile.TemporaryDirectory() as folder, _signal_wakeup(self) as wake, ExitStack() as stack:
            text, profile = recorded_arm(prepared.task.profile)
            prepared = self._prepared = replace(prepared, task=replace(prepared.task, profile=profile))
            channels = self._channels = start_processes(prepared, File(folder), self._tracker)
            shared = self._shared = channels.shared
            stack.callback(channels.processes.kill_all)
            files.session.write_text(settings_text(prepared.settings), encoding="utf-8")
            for entry in (("session.toml", settings_text(prepared.settings)), (LOOP_ARM_ATTACHMENT, text)):
                channels.sender.put(UsedEntry(*entry))
            progress_writer = ProgressWriter(files.progress, prepared.task.fingerprint, shared.place)
            stack.callback(self._close_progress, progress_writer)
            self._open_page(stack)
            address = "" if self._page is None else self._page.address
            self._injector = FaultInjector(prepared.faults, channels.processes, files.record, shared.start, address)
            for note in prepared.notes:
                self._console.say(note)
            if prepared.settings.real_time:
                answer_first()
            while not self._machine.ended:
                self._cycle(wake, progress_writer)
            self._wait_for_rest(wake)
            self._put_view(self._clock.now(), self._outcome().result())
            self._shut_down()
            outcome = self._outcome().write()
            if self._page is not None:
                self._put_view(self._clock.now(), outcome.result())
                if self._profile is not None:  # else nothing was printed, and nobody waits for the report
                    self._page.hand_out_report()
        return outcome

    def _outcome(self) -> RunOutcome:
        end = self._signal, self._shared.place.value, self._shared.link.pictures.get()
        return RunOutcome(self._prepared, self._machine, self._statistics, self._reports, *end)

    def on_signal(self, number: int) -> None:
        """Handle a signal that asks the run to end."""
        self._signal = number

    def _cycle(self, wake: socket.socket, progress_writer: ProgressWriter) -> None:
        terminal = [] if self._console.file is None else [self._console.file]
        if wake in (ready := wait([wake, *self._channels.processes.sentinels(), *terminal], POLL_PERIOD)):
            wake.recv(64)
        requests = self._requests_by_key(ready) + self._shared.link.take()
        reports, shared, now = self._reports, self._shared, self._clock.now()
        reports.tracking, reports.motion = shared.tracking.get(), shared.motion.get()
        reports.recorder, reports.own_unrecorded = shared.recorder.get(), self._channels.sender.dropped
        self._time_stops()
        machine = self._machine
        for text in self._injector.update(now):
            self._log(f"on purpose: {text}", WARNING)
        self._send(self._check_failures(progress_writer, now) + machine(now, reports, requests))
        if self._looks != machine.looks:
            self._looks = machine.looks
            shared.search.put(SearchOrder(machine.looks, machine.outline))
        self._statistics.update(now, machine.stage, reports)
        self._statistics.add_true_error(*self._view_builder.update(reports, self._profile, self._statistics.claim))
        self._show_surface()
        self._announce(now)  # before the view: a new stage is in this one
        self._show_view(now)

    def _requests_by_key(self, ready: Sequence[object]) -> list[OperatorRequest]:
        if self._console.file is None or self._console.file not in ready:
            return []
        wishes, last = self._console.wishes(), self._key_requests - 1
        self._key_requests -= len(wishes)  # the numbers of the page go upwards
        return [OperatorRequest(last - k, wish, self._machine.turn) for k, wish in enumerate(wishes)]

    def _check_failures(self, progress_writer: ProgressWriter, now: float) -> Orders:
        """End the run for a signal, for a process that has ended or hangs, or for progress that cannot be kept."""
        machine, processes = self._machine, self._channels.processes
        if self._signal:
            return machine.end(f"ended: {SIGNAL_TEXTS[signal.Signals(self._signal)]}", now, RunStage.ENDED)
        for name in processes.dead():
            if name == MOTION and (trouble := self._shared.trouble.get()):
                return machine.end(trouble, now)
            if name == MOTION:
                self._halt_arm()
            tracking = self._shared.tracking.get()
            if name == TRACKING and tracking is not None and tracking.ended:
                continue  # the state machine knows whether pictures are still needed
            if name in (MOTION, TRACKING, RECORDER):
                recorder = self._shared.recorder.get()
                detail = f": {recorder.failed}" if name == RECORDER and recorder is not None and recorder.failed else ""
                return machine.end(f"the {name} process {processes.ending(name)}{detail}", now)
        if self._channels.sender.failed:
            return machine.end(f"this process records nothing any more: {self._channels.sender.failed}", now)
        if progress_writer.failed:
            return machine.end(f"the place on the path cannot be kept: {progress_writer.failed}", now)
        motion = self._reports.motion
        if motion is not None and now - motion.tick.stamp > MOTION_HANG_TIMEOUT:
            processes.kill(MOTION)
            self._halt_arm()
            return machine.end(f"the motion process said nothing for {MOTION_HANG_TIMEOUT:g} s and was ended", now)
        return []

    def _close_progress(self, progress_writer: ProgressWriter) -> None:
        progress_writer.close()
        if progress_writer.failed and not self._channels.processes.alive(MOTION):  # the last place was not told yet
            self._console.say(f"the place on the path was not kept: {progress_writer.failed}")

    def _halt_arm(self) -> None:
        """Stop the arm in place of the motion process."""
        if self._arm_halted:
            return
        self._arm_halted = True
        self._switch_off_material()
        decided = self._clock.now()
        sent, reason = emergency_stop(self._channels.url, self._prepared.task.profile)
        if reason:
            return self._log(f"the arm could not be stopped: {reason}; its queue ends within 50 ms", WARNING)
        self._statistics.times.add("motion process gone to stop on the wire", sent - decided)

    def _switch_off_material(self) -> None:
        """Switch the dispensers off in place of the motion process; those with a watchdog did it themselves."""
        if not (text := self._prepared.task.dispensers):
            return
        for failure in switch_off(drivers_of(dispensers_from_text(text, "dispenser.toml")), self._clock):
            self._log(f"a dispenser could not be switched off: {failure}: switch it off by hand", WARNING)

    def _send(self, orders: Orders) -> None:
        for order in orders:
            if order is Order.STOP:
                self._stop_order_times.append(self._clock.now())
            if isinstance(order, BeginPrint):
                try:
                    order = self._record_begin(order)
                except InputError as error:
                    detail = f"{error.what} = {error.got}, allowed {error.allowed}"
                    reason = f"what lies on the surface cannot be printed: {detail}"
                    return self._send(self._machine.end(reason, self._clock.now()))
            with suppress(OSError):  # the motion process is gone: the next cycle sees that
                self._channels.order(order)

    def _record_begin(self, order: BeginPrint) -> BeginPrint:
        """Record the order as texts, and return it as read from them: a replay of the texts gives the same bytes."""
        if (placement := self._machine.placement) is not None:
            self._shared.placed.put(placement.surface_from_path)
        texts, order = recorded_begin(order, self._prepared.task.dispensers)
        texts["surface.toml"] = self._placement_text
        for name, text in texts.items():
            self._channels.sender.put(UsedEntry(name, text))
        self._profile = order.profile
        self._statistics.begin(with_offsets(order.path, order.outlets), order.profile)
        self._log(f"begun at checkpoint {order.start:.2f}, the arm's lag taken as {1000 * order.profile.lag:.0f} ms")
        return order

    def _time_stops(self) -> None:
        """How long a stop took from the order to the end of its frame on the wire."""
        motion = self._reports.motion
        if motion is None or motion.stop is None or motion.stops == self._stops:
            return
        self._stops = motion.stops
        if self._stop_order_times and motion.stop[1] >= self._stop_order_times[0]:
            self._statistics.times.add("stop decided to on the wire", motion.stop[1] - self._stop_order_times[0])
        self._stop_order_times.clear()

    # -- page, terminal and log

    def _open_page(self, stack: ExitStack) -> None:
        if not self._prepared.settings.page:
            return
        link = self._shared.link
        self._page = OperatorPage(link, page_settings(self._prepared.settings, self._prepared.files.session))
        stack.callback(self._page.close)
        self._page.tend(self._clock.now())
        link.scene.put(scene_from(self._prepared.rig))
        self._console.offer_page(self._page.address)

    def _show_view(self, now: float) -> None:
        """Put a view for the page, and restart the page where it has died: the run pauses, as nobody saw it."""
        page, machine = self._page, self._machine
        if page is None or now < self._view_time + VIEW_PERIOD:
            return
        self._view_time = now
        if page.process is not None and not page.process.is_alive():
            self._log("the operator's page has ended, and is started again", WARNING)
            if Wish.PAUSE in machine.offers and not self._prepared.task.unattended:
                self._send(machine.pause("the operator's page was lost", now))
        page.tend(now)
        self._put_view(now)

    def _put_view(self, now: float, result: RunResult | None = None) -> None:
        self._shared.link.views.put(self._view_builder(now, self._machine, self._reports, self._statistics, result))

    def _show_surface(self) -> None:
        """Show path, surface and scan on the page; write the path's placement, for a run that resumes."""
        tracking, placed_path, link = self._reports.tracking, self._machine.placed_path, self._shared.link
        surface, scan = None if tracking is None else tracking.surface, link.scan.get()
        parts = placed_path, 0 if surface is None else len(surface), scan, link.laid.get()
        if any(a is not b and a != b for a, b in zip(parts, self._scene_parts, strict=True)):
            self._scene_parts = parts
            link.scene.put(replace(self._scene(surface, scan), laid=parts[3]))
        if (placement := self._placement()) is not None:
            self._placement_text = placement_text(placement)
            write_atomically(self._prepared.files.surface, self._placement_text)

    def _scene(self, surface: Array | None, scan: ScanDrawing | None) -> PageScene:
        """The static part of the view, in the surface frame: path and scan as they are placed, and the landmarks."""
        rig, placed_path, placement = self._prepared.rig, self._machine.placed_path, self._machine.placement
        path = None if placed_path is None else placed_path.path
        if scan is None or placement is None:
            return scene_from(rig, path, surface)
        surface_from_path = placement.surface_from_path
        lines = se3.transform_points(surface_from_path, scan.lines.reshape(-1, 3)).reshape(-1, 2, 3)
        points = se3.transform_points(surface_from_path, scan.points)
        self._channels.sender.put(PlacedScanEntry(self._clock.now(), points))
        return scene_from(rig, path, points, scan.triangles, lines)

    def _placement(self) -> SurfacePlacement | None:
        """The path's placement, if it has changed since it was written."""
        machine, tracking, prepared = self._machine, self._reports.tracking, self._prepared
        placed_path, placement = machine.placed_path, machine.placement
        if placed_path is None or placement is None or tracking is None:
            return None
        confirmed = placement.certain or machine.stage not in (RunStage.CHECK, RunStage.FIND, RunStage.CONFIRM)
        if self._written_placement is not None and self._written_placement[0] is placed_path:
            confirmed |= self._written_placement[1]
            if confirmed == self._written_placement[1]:
                return None
        self._written_placement = placed_path, confirmed
        verdict = f"{placement.verdict}; moved by hand" if machine.moves else placement.verdict
        surface_from_path, first, earlier = placement.surface_from_path, tracking.placement, prepared.placement
        if earlier is not None and first is not None and first.by is PlacedBy.EARLIER:  # in the frame of its recording
            displacement = se3.inverse(first.surface_from_path) @ surface_from_path if machine.moves else np.eye(4)
            surface_from_path = earlier.surface_from_path @ displacement
            return replace(earlier, surface_from_path=surface_from_path, certain=confirmed, verdict=verdict)
        placed = tracking.registered, surface_from_path, placed_path.profile.arm.arm_from_base
        return SurfacePlacement(prepared.files.record, *placed, tracking.since, confirmed, verdict)

    def _announce(self, now: float) -> None:
        """Log a new stage and a process that has become silent; write a status line now and then."""
        machine = self._machine
        if machine.silence and not self._silence_logged:
            self._channels.sender.put(EventEntry(now, machine.silence, WARNING, "run"))
        self._silence_logged = bool(machine.silence)
        if self._reports.unrecorded > 2 * self._gaps:  # not each time: it would fill the log
            self._gaps = self._reports.unrecorded
            self._log(self._reports.gaps[0], WARNING)
        if machine.turn != self._turn:
            self._turn, self._view_time = machine.turn, -1e9  # the page is told at once
            if machine.stage is RunStage.PRINT and math.isnan(self._shared.start.value):
                self._shared.start.value = now
            self._log(stage_line(machine.stage, machine.reason))
            if machine.stage is RunStage.FIND:
                self._console.say(checks_table(machine.checks, sys.stdout))
            elif machine.stage in (RunStage.CONFIRM, RunStage.READY):
                key = "s: start" if machine.stage is RunStage.READY else self._confirm_key()
                if self._prompted_stage is not machine.stage:
                    self._console.say(f"  {KEYS_HELP}\n  now: {key}")
            self._prompted_stage, self._announced = machine.stage, now
        elif now > self._announced + STATUS_PERIOD:
            self._announced = now
            self._console.say(status_line(machine, self._reports))

    def _confirm_key(self) -> str:
        """The keys that answer the placement of the path, for the terminal."""
        machine = self._machine
        if machine.confirmable:
            return "y: the path is right"
        movable = machine.placement is not None and machine.placement.usable
        return "move the path on the page, then y" if movable else "a: look again, q: end"

    def _log(self, text: str, level: int = INFO) -> None:
        self._console.say(text)
        self._view_builder.log(now := self._clock.now(), text, level >= WARNING)
        self._channels.sender.put(EventEntry(now, text, level, "run"))

    # -- the end

    def _wait_for_rest(self, wake: socket.socket) -> None:
        """Wait until the arm is disarmed and its queue is empty."""
        deadline = self._clock.now() + REST_TIMEOUT
        while (now := self._clock.now()) < deadline and self._channels.processes.alive(MOTION):
            motion = self._reports.motion = self._shared.motion.get() or self._reports.motion
            self._time_stops()
            if motion is None:
                return
            status = motion.tick.status
            if status.state is not ArmState.ARMED and not status.in_flight > 0 and status.stamp > now - 2 * POLL_PERIOD:
                return
            wait([wake, *self._channels.processes.sentinels()], POLL_PERIOD / 4)

    def _shut_down(self) -> None:
        channels, shared, reports = self._channels, self._shared, self._reports
        Thread(target=importlib.import_module, args=("hardware.report.report",), daemon=True).start()  # write needs it
        self._injector.close()
        with suppress(OSError):
            channels.orders.send(Order.QUIT)
        channels.end()
        if shared.motion.get() is None:  # ended while it loaded, perhaps between a dispenser and its first tick
            self._switch_off_material()
        reports.tracking = shared.tracking.get() or reports.tracking
        reports.motion = shared.motion.get() or reports.motion
        reports.recorder, reports.own_unrecorded = shared.recorder.get(), channels.sender.dropped


@contextmanager
def _signal_wakeup(run: LiveRun) -> Iterator[socket.socket]:
    """A socket that becomes readable when a signal asks the run to end."""
    ours, theirs = socket.socketpair()
    for end in (ours, theirs):
        end.setblocking(False)
    file = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    try:
        with handled_signals(run.on_signal):
            yield ours
    finally:
        signal.set_wakeup_fd(file)
        ours.close()
        theirs.close()
