"""An arm that moves before live cameras, recorded: its pictures in a session folder, and where it was sent."""

from __future__ import annotations

import threading
from pathlib import Path

from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.arm.link import Arm
from hardware.arm.port import Opener
from hardware.arm.profile import ArmProfile
from hardware.arm_calibration.commanded import NAME, CommandedFile
from hardware.arm_calibration.moves import MoveWishes, check_moves, planned
from hardware.calibration.arm_record import Drive
from hardware.calibration.arm_solve import ARM
from hardware.cameras.live import LiveCameras
from hardware.files.arm_file import write_arm
from hardware.files.images import encode
from hardware.link_settings import LinkSettings
from hardware.process.clock import Clock
from hardware.process.progress import Report
from hardware.session_folder import SessionFolder

FIRST = 20.0  # s that the cameras may take for their first pictures; one on a network takes five to open
FEWEST_SETS = 5  # frame sets before the arm begins to move


class PictureKeeper(threading.Thread):
    """Writes the pictures of live cameras into a session folder, exactly, until it is ended.

    count: frame sets so far. A failure is kept for whoever moves the arm: `check` raises it there.
    """

    def __init__(self, live: LiveCameras, rig: Rig, clock: Clock, folder: Path) -> None:
        super().__init__(name="pictures", daemon=True)
        self._live, self._rig, self._clock, self._folder = live, rig, clock, folder
        self._ended = threading.Event()
        self._failed: Exception | None = None
        self.count = 0

    def run(self) -> None:
        """Until `end`, or until something fails."""
        try:
            with SessionFolder(self._folder, self._rig, ()) as session:
                while not self._ended.is_set():
                    self._keep(session)
        except Exception as error:  # told where the arm is moved
            self._failed = error

    def _keep(self, session: SessionFolder) -> None:
        frames = self._live.next_set(self._clock.now() + 0.2)
        for frame in frames.frames if frames is not None else ():
            stamp = frame.stamp - self._rig.cameras[frame.camera].clock_offset
            # exactly: JPEG stores a thin needle's colour at half the resolution
            session.picture(frame.camera, stamp, *encode(frame.image))
        self.count += frames is not None

    def check(self) -> None:
        """Raise what failed, if anything did."""
        if self._failed is not None:
            raise self._failed

    def end(self) -> None:
        """Finish the folder, and wait until that is done."""
        self._ended.set()
        self.join()


def move_arm(arm: Arm, clock: Clock, folder: Path, stands: Array | None, wishes: MoveWishes, report: Report) -> Array:
    """Make the moves; writes commanded.csv. All are checked before the first; where it begins, (6,), and comes back.

    However it ends, the arm is at rest and disarmed, and what was done stays recorded.
    """
    with CommandedFile(folder / NAME) as log:
        drive = Drive(arm, clock, log)
        try:
            start = drive.ready(stands)
            targets = planned(start, arm.profile.limits, arm.profile.tick, wishes)
            check_moves(arm.profile, start, targets)
            drive.follow(targets, report)
        finally:
            drive.halt("the calibration was ended") if arm.travels else arm.disarm(clock.now())
            log.note(arm, clock.now())
    return start


def record_live(
    live: LiveCameras,
    rig: Rig,
    opener: Opener,
    profile: ArmProfile,
    clock: Clock,
    folder: Path,
    stands: Array | None,
    wishes: MoveWishes,
    report: Report,
    link: LinkSettings,
) -> None:
    """Move an arm before live cameras and record both in a session folder; Ctrl-C stops the arm and keeps what is."""
    write_arm(folder / ARM, profile, "the arm as it was taken to be while it was calibrated")
    with live:
        arm = Arm(opener, profile, clock.now(), link)
        keeper = PictureKeeper(live, rig, clock, folder)
        keeper.start()

        def told(done: int, total: int) -> None:
            keeper.check()
            report(done, total)

        try:
            _await_pictures(keeper, arm, clock)
            move_arm(arm, clock, folder, stands, wishes, told)
        finally:
            keeper.end()
            arm.close()
    keeper.check()


def _await_pictures(keeper: PictureKeeper, arm: Arm, clock: Clock) -> None:
    """Until the cameras have given some; InputError where they do not."""
    end = clock.now() + FIRST
    while keeper.count < FEWEST_SETS:
        keeper.check()
        if clock.now() > end:
            allowed = "cameras that deliver: stillbed cameras RIG.toml shows what they do"
            raise InputError("cameras", "frame sets", keeper.count, allowed)
        arm.poll(clock.now())
        clock.wait_until(clock.now() + 0.01)
