"""The arm on its line: armed by an operator only, sent no more than its queue may hold, stopped at once.

The loop that owns an Arm calls `poll` every few milliseconds and `send` once a tick, with the instant; Arm reads no
clock and never waits. A model of the arm's queue says how much motion is under way; where the arm answers, its answers
are compared with the model. This module decides what is sent; `hardware/arm/device.py` sends it, and keeps the model
and the answers.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimation.errors import InputError
from estimation.se3 import Array
from hardware.arm.device import BY_OPERATOR, DONE, ArmDevice, ArmState, ArmStatus, LinkCode, Reason
from hardware.arm.driver import G1, ArmDriver, Pause, Reply, UnpluggedError
from hardware.arm.jog import AbortRecovery, OwnMoves, RecalledMoves
from hardware.arm.profile import ArmProfile, LinkSettings
from hardware.arm.protocol import frame_from_command, motion_from_frame
from hardware.arm.queue import ArmQueue, FlowControl
from hardware.process.clock import Clock
from planning.command import MIN_FEED, Command, Hold, Move

DEFAULT_SETTINGS = LinkSettings()
RECALLED = Reason("what was queued is called back", LinkCode.RECALLED)
ORIGIN_ROUNDING = 0.11  # mm: an answer counts 0.1 mm
MIN_SHUTDOWN_TIME = 0.05  # s in which a last frame goes out
MAX_FLOW_GAP = 3  # ticks without a command over which a flow goes on: no more is under way
MAX_SHUTDOWN_TIME = 1.0  # s in which the stop is repeated to an arm that goes on moving


class Arm(ArmDevice):
    """One arm on one line. Methods that follow an operator's order return the reason for a refusal, "" without one.

    command_frame: of the last command given to `send`, whether it was sent or not.
    """

    def __init__(
        self, driver: ArmDriver, profile: ArmProfile, now: float, settings: LinkSettings = DEFAULT_SETTINGS
    ) -> None:
        """As ArmDevice's."""
        self._flow = FlowControl(profile, settings)
        self._own_moves = OwnMoves(settings.speed, settings.turning, profile.tick)
        self._recovery = AbortRecovery(self._flow.flight - profile.tick, settings.speed, profile.lag)
        self._deviation_start: float | None = None
        self.command_frame = b""
        self._material = False  # whether the last frame let material flow
        self._last_flow = 0.0, -math.inf  # mm^3/s that flow as the last command ends, and s, when it does
        super().__init__(driver, profile, now, settings)

    # -- an operator's orders

    def stand(self, axes: Array, now: float) -> Reason:
        """Assume that the arm is at `axes` (6,), mm and rad; only while it is not armed."""
        if self.state is ArmState.ARMED:
            return Reason("the arm is armed", LinkCode.ARMED)
        if axes.shape != (6,) or not np.isfinite(axes).all():
            raise InputError("arm", "axes", axes.tolist(), "6 finite numbers X Y Z A B C, mm and rad")
        self._queue = ArmQueue(axes.tolist(), self.profile.frame_time, now)
        self._feedback.restart()
        return DONE

    def arm(self, now: float, goal: Array | None = None) -> Reason:
        """Permit moves. goal: (6,), last target of the motion: the arm first goes there slowly, if it is near."""
        if self.state is ArmState.ARMED:
            return DONE
        if not self._online:
            return Reason(f"the arm is unplugged: {self.reason}", LinkCode.UNPLUGGED)
        if self.in_flight(now) > 0 or not self._feedback.still(now):
            return Reason("the arm still moves", LinkCode.MOVING)
        if fault := self._enable(now):
            return Reason(fault, LinkCode.ARM_FAULT)
        self._adopt_answers(now)
        if self._queue is None:
            fault = "nobody knows where the arm stands: it does not answer, and was not told"
            return Reason(fault, LinkCode.UNKNOWN_PLACE)
        place = np.array(self._queue.target)
        if goal is not None and (distance := float(np.linalg.norm((goal - place)[:3]))) > self.settings.lost:
            text = f"the arm is {distance:.1f} mm from where the motion left off, limit {self.settings.lost:g} mm"
            return Reason(text, LinkCode.FAR_FROM_PATH)
        self._recovery.resume(place)
        if goal is not None and not self._recovery.undone:
            self._own_moves.go(place, goal)
        self._feedback.forgive()
        self._stop_retry.drop()
        self._deviation_start = None
        self._change(ArmState.ARMED, BY_OPERATOR, now)
        return DONE

    def disarm(self, now: float) -> None:
        """Send nothing more, except a stop that is still pending; the motion in flight, 50 ms at most, is completed."""
        if self.state in (ArmState.ARMED, ArmState.STOPPED) and self._online:
            stop_pending = self.stop_pending(now)
            self._drop_unsent()
            if stop_pending:
                self._call_back(now)
            if self._online:
                self._change(ArmState.DISARMED, BY_OPERATOR, now)

    def stop(self, reason: str, now: float) -> None:
        """Stop at once: drop the frames that wait, and send the control frame that stops the arm next."""
        if not self._online:
            return
        self._drop_unsent()
        if self.settings.pause_frame:
            self._call_back(now)
        if self._online:  # the port may be lost over that
            self._change(ArmState.STOPPED, reason, now)

    def go(self, axes: Array, now: float, lift: bool = False) -> Reason:
        """Go to `axes` (6,), mm and rad, slowly and in steps. lift: up first and down last."""
        limits = self.profile.limits
        if self.state is not ArmState.ARMED or self._queue is None:
            return self._not_armed()
        if self._recovery.goal is not None:
            return RECALLED
        if axes.shape != (6,) or not ((axes >= limits.low) & (axes <= limits.high)).all():
            return Reason(f"{axes.tolist()} is out of bounds", LinkCode.OUT_OF_BOUNDS)
        self._own_moves.go(np.array(self._queue.target), axes, lift)
        return DONE

    def home(self, now: float) -> Reason:
        """Go home by the arm's own way where it has one, or in slow steps; by default X202.5 Y225 Z113, thesis 6.3."""
        if self.state is ArmState.ARMED and not self.travels and self.driver.home(now):
            self.busy = True
            return DONE
        return self.go(self.profile.arm.home, now, lift=True)

    def set_origin(self, origin: Array, now: float) -> Reason:
        """Make `origin` (3,), mm in machine axes, the arm's (0, 0, 0) by G54; callers go on in machine axes."""
        if self.state is not ArmState.ARMED or self._queue is None or self._queue.in_flight(now) > 0 or self.travels:
            return Reason("an origin is set while the arm is armed and at rest", LinkCode.MOVING)
        try:
            self._book(self.driver.set_origin(origin, now), now)
        except UnpluggedError as error:
            self._unplugged(str(error), now)
        return DONE

    # -- the loop's calls

    def poll(self, now: float) -> None:
        """Read, write waiting frames, reopen a lost device, repeat a stop, send own moves; every few milliseconds."""
        if not self._online:
            if now >= self._reopen_at:
                try:
                    self._open(now)
                except InputError as error:  # another program has it now
                    self._reopen_at, self.reason = now + self.settings.reopen, str(error)
            return
        try:
            was_busy = self.busy
            for reply in self._read(now):
                self._check_origin(reply, now)
            if was_busy and not self.busy:
                self._feedback.forgive()
                self._adopt_answers(now)
            if self.fault and self.state is ArmState.ARMED:
                self.stop(f"the arm has stopped by itself: {self.fault}", now)
            if not self._online:  # the port may be lost over that
                return
            self._book(self.driver.flush(now), now)
        except UnpluggedError as error:
            self._unplugged(str(error), now)
            return
        self._repeat_stop(now)
        if self.state is ArmState.ARMED and not self.busy:
            self._supervise(now)
        pending = self.state is ArmState.ARMED and self._own_moves.step is not None
        if pending and self.in_flight(now) <= self.profile.tick and not self._wait(now):  # one step ahead of the arm
            self._give(self._own_moves.take(), now)

    def hold(self, now: float) -> Reason:
        """Why no command may be sent now, "" where one may."""
        if self.state is not ArmState.ARMED:
            return self._not_armed()
        if self.travels:
            return Reason("the arm is on its way", LinkCode.OWN_MOVE)
        return RECALLED if self._recovery.goal is not None else self._wait(now)

    def send(self, command: Command, now: float) -> Reason:
        """Send a command; why it was not sent, "" if it was. One that breaks a limit of the link stops the arm.

        The command is encoded here and nowhere else. Queue and flow control are given what the arm reads in the frame,
        rounded to binary32. InputError for what no frame holds.
        """
        dialect = self.profile.dialect
        if isinstance(command, Hold) and self._material and self._queue is not None:  # a pause switches nothing
            command = Move(command.stamp, np.array(self._queue.target), MIN_FEED, 0, extrude=False)
        self.command_frame = frame_from_command(command, dialect)
        instruction = motion_from_frame(self.command_frame, dialect)
        leaving, self._last_flow = self._last_flow, (0.0, -math.inf)
        if reason := self.hold(now):
            return reason
        assert self._queue is not None
        if excess := self._flow.excess(instruction, self._queue, now):
            self.stop(excess, now)
            return Reason(excess, LinkCode.LIMIT)
        self._own_moves.last = None
        self._material = dialect.pwm_on is not None and isinstance(instruction, G1) and instruction.material
        if isinstance(instruction, G1) and isinstance(command, Move):
            instruction = replace(instruction, volume=self._volume(command, *leaving))
        self._give(instruction, now)
        return DONE

    def _volume(self, move: Move, previous_flow: float, since: float) -> float:
        """mm^3 that leave from `since`, s, to a tick after the move. previous_flow: mm^3/s, until the move's begins."""
        flow_start, end = move.stamp + move.flow_after, move.stamp + self.profile.tick
        gap = flow_start - since if flow_start - since <= MAX_FLOW_GAP * self.profile.tick else 0.0
        self._last_flow = move.flow, end
        return max(previous_flow * gap + move.flow * (end - flow_start), 0.0)

    def take_up(self) -> RecalledMoves | None:
        """The moves that were called back, once the arm obeys again; None before, and no command is sent until then."""
        place, queue = self._recovery.place, self._queue
        if not self._recovery.obeys or place is None or queue is None:
            return None
        self._recovery.drop()
        return RecalledMoves(place, np.array(queue.target))

    @property
    def lag(self) -> float:
        """Measured delay from set-point to answer, s; NaN until known."""
        return self._feedback.lag

    @property
    def travels(self) -> bool:
        """Whether link or arm make a move of their own: home, or back to the last target."""
        return self._own_moves.step is not None or self.busy

    def arrived(self, now: float) -> bool:
        """Whether the arm is at its target, by dead reckoning and, where it answers, by its answers."""
        if self._queue is None or self.travels or self._recovery.goal is not None or self._queue.in_flight(now) > 0:
            return False
        if self._feedback.axes(now) is None:
            return self._feedback.count == 0
        return self._feedback.still(now) and not self._feedback.doubt(now)

    def stop_pending(self, now: float) -> bool:
        """Whether a stop was sent that the arm may not have read."""
        retry = self._stop_retry
        return self._online and retry.active and (self._blocked(now) or retry.pending(self._feedback, now))

    def status(self, now: float) -> ArmStatus:
        """All that is known."""
        queued, feedback = 0 if self._queue is None else self._queue.frames(now), self._feedback
        measured, counts = (feedback.off, feedback.lag, feedback.rate), (self.frames, feedback.count, self.strays)
        places = self.reckoned(now), feedback.axes(now)
        return ArmStatus(now, self.state, self.reason, *places, *measured, self.in_flight(now), queued, *counts)

    # -- own moves, supervision, stops

    def _unplugged(self, reason: str, now: float) -> None:
        """The device is gone, and the commands in flight are lost."""
        self._own_moves.drop()
        self._recovery.break_off(self._feedback.last)
        super()._unplugged(reason, now)

    def _enable(self, now: float) -> str:
        """Have the driver clear the fault that stopped its arm; the reason if it cannot."""
        try:
            return self.driver.enable(now)
        except UnpluggedError as error:
            self._unplugged(str(error), now)
            return str(error)

    def _not_armed(self) -> Reason:
        return Reason(f"the arm is {self.state.value}: {self.reason}", LinkCode(self.state.value))

    def _check_origin(self, reply: Reply, now: float) -> None:
        origin = self.driver.origin
        if np.abs(reply.values - origin).max() > ORIGIN_ROUNDING and self.state is ArmState.ARMED:
            self.stop(f"the arm's origin is {reply.values.tolist()}, not {origin.tolist()}", now)

    def _drop_unsent(self) -> None:
        """Drop own moves, and the frames of which no byte is on the wire."""
        if self._online:
            self.driver.recall()
        self._own_moves.drop()
        self._recovery.break_off()

    def _wait(self, now: float) -> Reason:
        """Why no command of a tick may be sent now, "" where one may."""
        assert self._online and self._queue is not None
        backlog = self._feedback.backlog(self._queue, now)
        if reason := self._flow.full(self.driver, self._queue, self.profile.tick, now, backlog):
            return Reason(reason, LinkCode.FLOW_CONTROL)
        return Reason(self._feedback.doubt(now), LinkCode.FEEDBACK)

    def _supervise(self, now: float) -> None:
        """Stop the arm where a fault lasts for `patience`, or is too large to wait."""
        if (blocked := self.driver.blocked_for(now) or 0.0) > self.settings.write_timeout:
            self.stop(f"the port took no bytes for {blocked:.2f} s, limit {self.settings.write_timeout:g} s", now)
        elif self._feedback.off > self.settings.lost:
            self.stop(f"the arm is {self._feedback.off:.1f} mm off its way, limit {self.settings.lost:g} mm", now)
        elif doubt := self._recovery.why or self._feedback.doubt(now):
            self._deviation_start = now if self._deviation_start is None else self._deviation_start
            if now - self._deviation_start > self.settings.patience:
                self.stop(f"{doubt}, for {self.settings.patience:g} s", now)
        else:
            self._deviation_start = None
        if self.state is ArmState.ARMED and self.settings.pause_frame:
            self._recover(now)

    def _recover(self, now: float) -> None:
        """Call back the queue of an arm that does not follow; once it is at rest, test whether it obeys again."""
        assert self._queue is not None
        recovery, feedback = self._recovery, self._feedback
        if recovery.goal is None and (doubt := feedback.doubt(now)):
            recovery.begin(f"{RECALLED}: {doubt}", np.array(self._queue.target), self._own_moves.break_off(), now)
            self._note(recovery.why, now)
            self._call_back(now)
        elif recovery.goal is not None and not (recovery.obeys or self._blocked(now) or self._queue.in_flight(now) > 0):
            if recovery.stepped is None and feedback.settled(recovery.since):
                self._adopt_answers(now)
            for instruction in recovery.next(feedback, np.array(self._queue.target), now):
                if isinstance(instruction, Pause):
                    if recovery.stood is not None:  # the trial step is repeated from where it began
                        self._queue = ArmQueue(recovery.stood.tolist(), self.profile.frame_time, now)
                    self._call_back(now)
                elif self._online:  # the port may be lost over the pause
                    self._give(instruction, now)
            if recovery.obeys:
                self._stop_retry.drop()
                if recovery.rest is not None:
                    self._own_moves.go(np.array(self._queue.target), recovery.goal, then=recovery.rest)
                    recovery.drop()

    def _blocked(self, now: float) -> bool:
        """Whether bytes wait because the line accepts no more."""
        return self.driver.blocked_for(now) is not None

    def _repeat_stop(self, now: float) -> None:
        """Send the stop once more to an arm that goes on moving."""
        stopped = self.state is not ArmState.ARMED or self._recovery.waits
        if stopped and not self._blocked(now) and self._stop_retry.due(self._feedback, now):
            self._give(Pause(), now)

    def _call_back(self, now: float) -> None:
        self._stop_retry.begin(now)
        self._give(Pause(), now)


def shut_down(arm: Arm, reason: str, clock: Clock, poll_period: float) -> None:
    """Stop an armed arm, and poll it every `poll_period` s while its last stop is pending, 1 s at most."""
    start = clock.now()
    if arm.state is ArmState.ARMED:
        arm.stop(reason, start)
    while (now := clock.now()) < start + MIN_SHUTDOWN_TIME or (
        arm.stop_pending(now) and now < start + MAX_SHUTDOWN_TIME
    ):
        arm.poll(now)
        clock.wait_until(now + poll_period)
