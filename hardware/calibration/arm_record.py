"""Recording of an arm that moves before live cameras: planned moves, guarded driving, pictures and set-points.

The moves go to places all over the cameras' room, turned and not, and end with a swing. All set-points pass the guard
before the first one is sent, one per tick; whatever goes wrong stops the arm.

commanded.csv holds the set-points that the arm's controller was sent, as knots of a polyline, by the computer's clock:

    stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg

A line is written once nothing can change it any more, so an interrupted recording is complete up to then.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats.qmc import Halton

from estimation.calibration.arm_model import SetPoint
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.device import ArmState
from hardware.arm.driver import ArmDriver
from hardware.arm.link import Arm
from hardware.arm.profile import DISPLAY_UNITS, ArmProfile, LinkSettings
from hardware.arm.queue import QueuedCommand
from hardware.cameras.live import LiveCameras
from hardware.files.arm_file import write_arm
from hardware.files.folder_tables import SessionFolderWriter
from hardware.files.images import encode
from hardware.process.clock import Clock
from hardware.process.progress import ProgressReport, no_progress
from planning.command import AXIS_MARGIN, MotionLimits, Move, Refusal, feed_for
from planning.motion.guard import Guard

ARM_FILE = "arm.toml"  # of a recorded calibration: the arm before it
COMMANDED_FILE = "commanded.csv"
COMMANDED_HEADER = "stamp_s,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"
STAMP_RESOLUTION = 2e-6  # s: nearer knots are equal in six digits
PEAK_SPEED_RATIO = 1.875  # peak to mean speed of a minimum-jerk move (10 s^3 - 15 s^4 + 6 s^5)
UPRIGHT_EVERY = 3  # one place in so many has no turn
SWING_SINES = np.array([6.0, 5.0, 4.0]), np.array([2.2, 1.7, 1.3])  # mm and Hz of X Y Z
SWING_LOAD = 0.6  # of the speed and acceleration limits
STILL_VARIANCE = 1e-6  # mm^2 and rad^2, of a surface that is not tracked
LISTEN_TIME = 1.0  # s before the first move, in which an arm reports its position
SETTLE_TIME = 0.5  # s after the last move
FIRST_PICTURES_TIMEOUT = 20.0  # s for the first pictures; a network camera takes five to open
START_FRAME_SETS = 5  # before the arm begins to move


@dataclass(frozen=True, slots=True)
class MoveOptions:
    """Options of a calibration's moves; InputError for a value out of range."""

    places: int = 20  # number of resting places
    reach: float = 50.0  # mm about the start along X and Y
    up: float = 45.0  # mm above the start
    down: float = 20.0  # mm below the start
    turn: float = float(np.deg2rad(35.0))  # rad of A, B, C at most: as far as a needle is seen, to tell tool from arm
    speed: float = 80.0  # mm/s at most
    dwell: float = 0.6  # s at each place
    swing: float = 8.0  # s, at the end

    def __post_init__(self) -> None:
        most = {"places": 200, "reach": 300, "up": 300, "down": 300, "turn": np.pi / 3, "speed": 120, "swing": 60}
        for name, high in {**most, "dwell": 10.0}.items():
            value = getattr(self, name)
            low = 4 if name == "places" else 0.3 if name == "dwell" else 0.0
            if not (low <= value <= high):
                raise InputError("moves", name, value, f"{low:g} to {high:g}")


def plan_moves(start: Array, limits: MotionLimits, tick: float, options: MoveOptions) -> Array:
    """Set-points (K, 6), mm and rad, one per tick, from and back to `start` (6,); those of a dwell repeat."""
    parts, at = [], start
    for place in [*places(start, limits, options), start]:
        parts += list(straight_move(at, place, tick, options))
        parts.append(np.repeat(place[None], round(options.dwell / tick), axis=0))
        at = place
    parts.append(_swing(start, limits, tick, options))
    parts.append(np.repeat(start[None], round(options.dwell / tick), axis=0))
    return np.concatenate(parts)


def places(start: Array, limits: MotionLimits, options: MoveOptions) -> Array:
    """Places (P, 6), mm and rad, spread evenly about the start, within the arm's bounds."""
    spread = Halton(len(start), scramble=False).random(options.places + 1)[1:]  # even for any number; the first is 0
    half = np.array([options.reach, options.reach, (options.up + options.down) / 2, *[options.turn] * 3])
    middle = start + np.array([0, 0, (options.up - options.down) / 2, 0, 0, 0])
    out = middle + (2 * spread - 1) * half
    out[::UPRIGHT_EVERY, 3:] = start[3:]
    return np.asarray(np.clip(out, limits.low + AXIS_MARGIN, limits.high - AXIS_MARGIN))


def straight_move(start: Array, goal: Array, tick: float, options: MoveOptions) -> Iterator[Array]:
    """Set-points (K, 6) of a straight minimum-jerk move, if there is any way to go."""
    offset = goal - start
    length = max(float(np.linalg.norm(offset[:3])), 60.0 * float(np.linalg.norm(offset[3:])))  # 1 rad/s at 60 mm/s
    if length > 0:
        count = max(5, int(np.ceil(PEAK_SPEED_RATIO * length / (options.speed * tick))))
        s = np.linspace(0, 1, count + 1)[1:, None]
        yield start + (10 * s**3 - 15 * s**4 + 6 * s**5) * offset


def _swing(middle: Array, limits: MotionLimits, tick: float, options: MoveOptions) -> Array:
    """Three sines with a smooth envelope: their acceleration separates dead time from lag."""
    t = np.arange(1, round(options.swing / tick) + 1)[:, None] * tick
    size, rate = SWING_SINES
    omega = 2 * np.pi * rate
    limit = np.minimum(SWING_LOAD * limits.acceleration[:3] / omega**2, SWING_LOAD * limits.speed[:3] / omega)
    out = np.repeat(middle[None], len(t), axis=0)
    out[:, :3] += np.sin(np.pi * t / max(options.swing, tick)) ** 2 * np.minimum(size, limit) * np.sin(omega * t)
    return out


def still_surface(now: float) -> SurfacePose:
    """A surface that stands still at the base's origin, for the guard: a calibration has none."""
    return SurfacePose(now, np.eye(4), STILL_VARIANCE * np.eye(6), np.zeros(6), TrackState.TRACKING)


def guard_at(profile: ArmProfile, at: Array) -> Guard:
    """A guard for an arm that stands at `at` (6,)."""
    return Guard(profile.limits, replace(profile.arm, home=at), profile.tick, lag=profile.lag)


def check_moves(profile: ArmProfile, start: Array, targets: Array) -> None:
    """InputError with the guard's reason unless it accepts all set-points (K, 6), one per tick."""
    guard, at = guard_at(profile, start), start
    for number, target in enumerate(targets):
        if (target == at).all():
            continue
        now = (number + 1) * profile.tick
        answer = guard(Move(now, target, feed_for(at, target, profile.tick), 0, False), still_surface(now), now)
        if isinstance(answer, Refusal):
            allowed = "moves that the arm's limits and no-go zones allow: less --reach-mm, --turn-deg or --speed-mm-s"
            raise InputError("moves", f"{number * profile.tick:.1f} s after their begin", answer.reason, allowed)
        at = target


class CommandedFile:
    """Writes commanded.csv."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")
        self._file.write(COMMANDED_HEADER + "\n")
        self._last_knot = self._move_end = -np.inf  # s: instant of the last knot, end of the last move

    def note(self, arm: Arm, now: float) -> None:
        """Write the moves that have ended at `now`, s."""
        for way in arm.ways(self._move_end):
            if way.end <= now:
                self._add(way)
                self._move_end = way.end

    def _add(self, way: QueuedCommand) -> None:
        for instant, axes in ((way.start, way.source), (way.end, way.target)):
            if instant >= self._last_knot + STAMP_RESOLUTION:
                row = instant, *(np.array(axes) * DISPLAY_UNITS)
                self._file.write(",".join(f"{value:.6f}" for value in row) + "\n")
                self._last_knot = instant

    def __enter__(self) -> CommandedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_commanded(path: Path) -> SetPoint:
    """The set-point in a commanded.csv; InputError if it is invalid."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        allowed = f"a text file that begins with {COMMANDED_HEADER}"
        raise InputError(path, "file", "missing or not text", allowed) from None
    if not lines or lines[0].strip() != COMMANDED_HEADER:
        raise InputError(path, "line 1", lines[0][:60] if lines else "nothing", COMMANDED_HEADER)
    rows = [_row(path, number, line) for number, line in enumerate(lines[1:], 2) if line.strip()]
    if len(rows) < 2:
        raise InputError(path, "rows", len(rows), "two or more")
    table = np.array(rows)
    if (back := np.flatnonzero(np.diff(table[:, 0]) <= 0)).size:
        raise InputError(path, f"line {back[0] + 3}: stamp_s", table[back[0] + 1, 0], "stamps that rise")
    return SetPoint(np.ascontiguousarray(table[:, 0]), table[:, 1:] / DISPLAY_UNITS)


def _row(path: Path, number: int, line: str) -> Array:
    try:
        row = np.array([float(word) for word in line.split(",")])
    except ValueError:
        row = np.zeros(0)
    if row.shape != (7,) or not np.isfinite(row).all():
        raise InputError(path, f"line {number}", line[:60], "7 finite numbers: s, mm and degrees")
    return row


class ArmDrive:
    """Drives an arm and logs its set-points. beside: what else is polled with the arm, by the instant, s."""

    def __init__(
        self, arm: Arm, clock: Clock, log: CommandedFile, beside: Callable[[float], None] = lambda now: None
    ) -> None:
        self.arm, self._clock, self._log, self._background = arm, clock, log, beside

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Wait, while polling the arm."""
        end = self._clock.now() + seconds
        while (now := self._clock.now()) < end and not until():
            self._look(now)
            self._clock.wait_until(now + self.arm.settings.poll)

    def ready(self, stands: Array | None) -> Array:
        """Arm it; returns its position (6,). stands: position of an arm that does not report it, mm and rad."""
        if stands is not None:
            self.arm.stand(stands, self._clock.now())
        self.wait(LISTEN_TIME)
        reason = self.arm.arm(self._clock.now())
        if reason or self.arm.target is None:
            allowed = "an arm that answers from where it stands at rest, or --stands"
            raise InputError("arm", "ready", reason or "nobody knows where it stands", allowed)
        return self.arm.target

    def follow(self, targets: Array, report: ProgressReport = no_progress) -> None:
        """Send set-points (K, 6), one per tick; where the link asks to wait, the rest is delayed.

        The arm stays armed at the last one. InputError where the guard or the link refuses; then the arm is at rest.
        """
        assert self.arm.target is not None
        arm, at = self.arm, self.arm.target
        guard, next_tick, number = guard_at(arm.profile, at), self._clock.now(), 0
        try:
            while number < len(targets):
                now = self._clock.now()
                self._look(now)
                if arm.state is not ArmState.ARMED:
                    raise InputError("arm", "motion", arm.reason, "an arm that is left to move")
                if now >= next_tick and not arm.hold(now):
                    target = targets[number]
                    if (target != at).any():
                        move = Move(now, target, feed_for(at, target, arm.profile.tick), 0, False)
                        answer = guard(move, still_surface(now), now)
                        reason = answer.reason if isinstance(answer, Refusal) else arm.send(move, now)
                        if reason:
                            raise InputError("arm", "motion", reason, "moves that guard and link let pass")
                        at = target
                    tick_start = max(next_tick, now - arm.profile.tick)  # missed ticks are not made up
                    number, next_tick = number + 1, tick_start + arm.profile.tick * (1 + arm.settings.ease)
                    report(number, len(targets))
                self._clock.wait_until(now + arm.settings.poll)
            self.wait(SETTLE_TIME, lambda: arm.state is not ArmState.ARMED)
        except BaseException:
            self.halt("the calibration was ended")
            raise

    def halt(self, reason: str) -> None:
        """Stop the arm at once."""
        if self.arm.state is ArmState.ARMED:
            self.arm.stop(reason, self._clock.now())
        self.wait(SETTLE_TIME)

    def _look(self, now: float) -> None:
        self.arm.poll(now)
        self._background(now)
        self._log.note(self.arm, now)


class PictureWriter(threading.Thread):
    """Writes the pictures of live cameras into a session folder, without loss, until `end`.

    count: frame sets so far. keep: whether those that come are written. A failure is stored, and `check` raises it in
    the thread that moves the arm.
    """

    def __init__(self, live: LiveCameras, rig: Rig, clock: Clock, folder: Path, keep: bool) -> None:
        super().__init__(name="pictures", daemon=True)
        self._live, self._rig, self._clock, self._folder = live, rig, clock, folder
        self._ended = threading.Event()
        self._failed: Exception | None = None
        self.count, self.keep = 0, keep

    def run(self) -> None:
        """Until `end`, or until something fails."""
        try:
            with SessionFolderWriter(self._folder, self._rig, ()) as session:
                while not self._ended.is_set():
                    frames = self._live.next_set(self._clock.now() + 0.2)
                    for frame in frames.frames if frames is not None and self.keep else ():
                        stamp = frame.stamp - self._rig.cameras[frame.camera].clock_offset
                        # lossless: JPEG stores a thin needle's colour at half the resolution
                        session.picture(frame.camera, stamp, *encode(frame.image))
                    self.count += frames is not None
        except Exception as error:  # raised by `check`
            self._failed = error

    def check(self) -> None:
        """Raise the stored failure, if any."""
        if self._failed is not None:
            raise self._failed

    def end(self) -> None:
        """Finish the folder, and wait for it."""
        self._ended.set()
        self.join()


def move_arm(
    arm: Arm, clock: Clock, folder: Path, stands: Array | None, options: MoveOptions, report: ProgressReport
) -> Array:
    """Make the moves, after checking all of them, and write commanded.csv; returns the start (6,).

    However it ends, the arm is at rest and disarmed, and the moves so far are recorded.
    """
    with CommandedFile(folder / COMMANDED_FILE) as log:
        drive = ArmDrive(arm, clock, log)
        try:
            start = drive.ready(stands)
            targets = plan_moves(start, arm.profile.limits, arm.profile.tick, options)
            check_moves(arm.profile, start, targets)
            drive.follow(targets, report)
        finally:
            drive.halt("the calibration was ended") if arm.travels else arm.disarm(clock.now())
            log.note(arm, clock.now())
    return start


def record_live(
    live: LiveCameras,
    rig: Rig,
    driver: ArmDriver,
    profile: ArmProfile,
    clock: Clock,
    folder: Path,
    stands: Array | None,
    options: MoveOptions,
    report: ProgressReport,
    link: LinkSettings,
) -> None:
    """Move an arm before live cameras and record both in a session folder; Ctrl-C stops the arm, keeping the record."""
    write_arm(folder / ARM_FILE, profile, "the arm as it was taken to be while it was calibrated")
    with arm_before_cameras(live, rig, driver, profile, clock, folder, link) as (arm, writer):

        def progress(done: int, total: int) -> None:
            writer.check()
            report(done, total)

        move_arm(arm, clock, folder, stands, options, progress)


@contextmanager
def arm_before_cameras(
    live: LiveCameras,
    rig: Rig,
    driver: ArmDriver,
    profile: ArmProfile,
    clock: Clock,
    folder: Path,
    link: LinkSettings,
    keep: bool = True,
) -> Iterator[tuple[Arm, PictureWriter]]:
    """An arm to be moved in the block, once live cameras give pictures, and the writer of these into a session folder.

    keep: whether pictures are written from the start on. The cameras and the driver are let go at the end. InputError
    where no pictures come.
    """
    with ExitStack() as stack:
        stack.callback(driver.release)
        stack.enter_context(live)
        arm = Arm(driver, profile, clock.now(), link)
        stack.callback(arm.close)
        writer = PictureWriter(live, rig, clock, folder, keep)
        writer.start()
        stack.callback(writer.end)
        end = clock.now() + FIRST_PICTURES_TIMEOUT
        while writer.count < START_FRAME_SETS:
            writer.check()
            if clock.now() > end:
                allowed = "cameras that deliver: stillbed cameras RIG.toml shows what they do"
                raise InputError("cameras", "frame sets", writer.count, allowed)
            arm.poll(clock.now())
            clock.wait_until(clock.now() + 0.01)
        yield arm, writer
    writer.check()
