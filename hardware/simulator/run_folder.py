"""The folder of a simulated run: all that passes is written to it as it comes, and can be read if it is cut short.

session.mcap, session/     the session, as `stillbed track` and `replay` take it: pictures, rig, region, head and truth
tracking/                  poses.csv, poses.tum and their report, as `stillbed track` writes them
commands.csv, frames.bin   what the motion decided, and the bytes that went to the arm
nozzle.csv                 where the nozzle was and should have been, every millisecond
arm.toml, scenario.toml    what was assumed of the arm, and what was simulated
watch.html, report.html    what the cameras see while it runs, and what came of it
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.trajectory import Trajectory
from hardware.files.arm_file import write_arm
from hardware.files.pose_file import PoseWriter
from hardware.heads import row_from_head
from hardware.offline.replay import CommandWriter
from hardware.recording.recorder import Recorder
from hardware.recording.schemas import INFO, WARNING
from hardware.session_folder import SessionFolder
from hardware.simulator.cameras import JITTER_LIMIT, Shot
from hardware.simulator.nozzle_file import NozzleWriter
from hardware.simulator.nozzle_log import NozzleLog
from hardware.simulator.planned_line import PlannedLine
from hardware.simulator.scenario import Scenario
from hardware.simulator.watch import Watch
from hardware.tum import rows_from_trajectory
from perception.frames import FrameSet, PrintHead, Roi
from perception.tracking.step import STAGES, StepReport
from planning.command import Command, Move
from planning.progress import Progress

DIGITS = 9  # of a stamp: a row and an exposure of one instant are one
PATIENCE = 0.5  # s beyond the transport until a picture has surely arrived; truth is written in order of stamp

FILES = (
    *("session.mcap", "commands.csv", "frames.bin", "nozzle.csv", "arm.toml", "scenario.toml"),
    *("watch.html", "watch.jpg", "report.html", "summary.json"),
)

TruthAt = Callable[[Array], Array]  # times (N,), s -> base_from_surface (N, 4, 4)


def clear(out: Path) -> None:
    """Remove from the folder `out` what an earlier run left there: of two runs no session could be made."""
    for name in ("session", "tracking"):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in FILES:
        (out / name).unlink(missing_ok=True)


class RunFolder:
    """Writes a run; a context manager that leaves all files readable however it ends."""

    def __init__(
        self, out: Path, scenario: Scenario, line: PlannedLine, rois: Sequence[Roi], truth: TruthAt, scan: Path | None
    ) -> None:
        """out: a folder that is there. line: the planned line. scan: the scan's file in out/session, if any."""
        self.out, self._truth, self._line, self._seconds = out, truth, line, scenario.seconds
        self.logs: list[NozzleLog] = []
        self.pictures: dict[int, bytes] = {}  # per camera, the newest, if there is one the newest of the printing
        self.watch = Watch(out, scenario.told_rig, scenario.title)
        self._shown: Array | None = None  # (N, 3) the line in the tracker's own surface frame
        self._doing, self._printing, self._printed = "waiting for a surface to follow", False, False
        self._state: TrackState | None = None
        self._reason = ""
        self._pending: list[Array] = []  # s, instants whose truth is still to be written
        self._written: list[Array] = []  # s, rising
        self._until = -np.inf  # s, the last of them
        self._headed = -np.inf  # s, the last frame set whose print head was written
        cameras = scenario.cameras
        self._latest = cameras.transport + JITTER_LIMIT * cameras.transport_jitter + PATIENCE
        shutil.copyfile(scenario.file, out / "scenario.toml")
        write_arm(out / "arm.toml", scenario.profile, "what the motion knew of the arm")
        (out / "tracking").mkdir(exist_ok=True)
        with ExitStack() as opening:  # what is open is closed if the next cannot be opened
            names = [camera.name for camera in scenario.told_rig.cameras]
            self._poses = opening.enter_context(PoseWriter(out / "tracking", names, STAGES))
            self._commands = opening.enter_context(CommandWriter(out))
            self._nozzle = opening.enter_context(NozzleWriter(out / "nozzle.csv", line))
            self._session: tuple[SessionFolder, Recorder] | None = None
            if scenario.tracking.pictures:
                self._session = (
                    opening.enter_context(SessionFolder(out / "session", scenario.told_rig, rois)),
                    opening.enter_context(Recorder(out / "session.mcap", scenario.told_rig, overwrite=True)),
                )
                self._record_start(rois, scan)
            self._files = opening.pop_all()

    def _record_start(self, rois: Sequence[Roi], scan: Path | None) -> None:
        assert self._session is not None
        if scan is not None:
            self._session[1].surface(scan)
        for roi in rois:
            self._session[1].write(roi)

    def picture(self, shot: Shot, kind: str, data: bytes) -> None:
        """A picture has arrived, as encoded by its camera."""
        assert self._session is not None
        folder, recorder = self._session
        folder.picture(shot.camera, shot.stamp, kind, data)
        recorder.encoded_frame(shot.camera, shot.stamp, kind, data)
        self._pending.append(np.array([shot.exposed]))
        if self._printing or not self._printed:
            self.pictures[shot.camera] = data
            self._printed |= self._printing

    def head(self, stamp: float, head: PrintHead) -> None:
        """Where the print head was at the stamp of a frame set, tracked or not; an instant told again is one."""
        if self._session is not None and stamp > self._headed:
            self._headed = stamp
            for container in self._session:
                container.head_row(row_from_head(stamp, head), head.extruding)

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        """A pose was made of a frame set in `spent` s of real time."""
        self._poses.write(pose, len(frames.frames), report, spent)
        if pose.state is not self._state:
            self.event(pose.stamp, f"{pose.state.value}: {pose.reason}", INFO if pose.state.measured else WARNING)
            self._state = pose.state
        if self._session is not None:
            self._session[1].write(report.observations)
            self._session[1].write(pose)
            time = f"{pose.stamp:.1f} of {self._seconds:g} s"
            facts = [("time", time), ("arm", self._doing), ("error at the nozzle", self._error())]
            self.watch.show(frames, pose, self._shown, facts)

    def registered(self, truth_from_estimate: Array) -> None:
        """The path was registered: truth_surface_from_estimated_surface (4, 4)."""
        self._shown = se3.transform_points(se3.inverse(truth_from_estimate), self._line.points)

    def command(self, command: Command, progress: Progress, frame: bytes, received: bytes) -> None:
        """A command was sent, how far the print is by it, and what came from the arm since the last."""
        self._commands.write(command, frame)
        if self._session is not None:
            recorder = self._session[1]
            recorder.write(command)
            recorder.sent(command.stamp, frame)
            if received:
                recorder.received(command.stamp, received)
        reason = command.reason
        if reason and reason != self._reason:
            self.event(command.stamp, f"hold: {reason}", WARNING)
        self._reason = reason
        self._printing = isinstance(command, Move) and command.extrude
        share = f"{progress.place:.0f} of {progress.length:.0f} mm"
        self._doing = f"holds: {reason}" if reason else f"{progress.phase.value}, {share}"

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""
        self.logs.append(log)
        self._nozzle.write(log)
        self._pending.append(log.stamps)
        self._write_truth(float(log.stamps[-1]) - self._latest)

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        """Something that a person should know."""
        if self._session is not None:
            self._session[1].event(stamp, text, level, "simulation")

    def _error(self) -> str:
        """The mean error of the last rows while they were printed, in words."""
        log = self.logs[-1] if self.logs else None
        if log is None or not log.extrude.any():
            return "not printing"
        off = (log.base_from_nozzle - log.base_from_target)[log.extrude, :3, 3]
        return f"{np.linalg.norm(off, axis=1).mean():.3f} mm"

    def _write_truth(self, until: float) -> None:
        """Truth in the middle of each exposure and at each row, in order, up to `until`, s."""
        if self._session is None or not self._pending:
            return
        stamps: Array = np.unique(np.round(np.concatenate(self._pending), DIGITS))
        self._pending = [stamps[stamps > until]]
        due = stamps[(stamps <= until) & (stamps > self._until)]
        if len(due):
            self._until = float(due[-1])
            self._written.append(due)
            for row in rows_from_trajectory(self._trajectory(due)):
                self._session[1].truth_row(row, exact=True)

    def _trajectory(self, stamps: Array) -> Trajectory:
        return Trajectory(stamps, self._truth(stamps), exact=True)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        with self._files:
            self._write_truth(np.inf)
            if self._session is not None and self._written:
                self._session[0].truth(self._trajectory(np.concatenate(self._written)))
