"""The folder of a simulated run: written as the run goes on, and readable if the run ends early.

session.mcap, session/     the session, as `stillbed track` and `replay` take it: pictures, rig, region, head and truth
tracking/                  poses.csv, poses.tum and their report, as `stillbed track` writes them
commands.csv, frames.bin   the motion's commands, and the bytes sent to the arm
nozzle.csv                 the nozzle's place and its target, every millisecond
arm.toml, scenario.toml    the arm as the motion knew it, and the scenario
watch.html, report.html    the cameras' pictures while it runs, on a page that reloads itself; and the result
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from html import escape
from logging import INFO, WARNING
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState, Trajectory
from estimation.rig import Rig, pixels_from_points
from estimation.se3 import Array
from hardware.files.arm_file import write_arm
from hardware.files.folder_tables import SessionFolderWriter, rows_from_trajectory
from hardware.files.pose_file import PoseWriter
from hardware.files.session import row_from_head
from hardware.motion.loop import Tick
from hardware.offline.replay import CommandWriter
from hardware.process.clock import utc_now
from hardware.recording.loop_record import LoopKeeper
from hardware.recording.recorder import Recorder
from hardware.simulator.cameras import JITTER_LIMIT, Shot
from hardware.simulator.deposit import NozzleLog, PlannedLine
from hardware.simulator.nozzle_error import nozzle_errors
from hardware.simulator.scenario import Scenario
from hardware.simulator.world import WorldSink
from perception.frames import FrameSet, Image, PrintHead, Roi
from perception.tracking.step import STAGES, StepReport, TrackingStep
from planning.command import Move
from planning.laid_beads import Look
from planning.path import PrintProgress

WATCH_INTERVAL = 0.5  # s of the run between two pictures
MAIN_TILE, SIDE_TILE = (960, 540), (480, 270)  # px: the first camera's picture, and the others'
WATCH_JPEG_QUALITY = 85
CLOSE_UP_PX = 400  # px of the picture across a tile's width once the line's place is known
LINE_BGR = (255, 200, 90)  # BGR
STATE_BGR = {  # as the report's states
    TrackState.INITIALISING: (160, 160, 160),
    TrackState.TRACKING: (90, 190, 70),
    TrackState.DEGRADED: (40, 170, 240),
    TrackState.COASTING: (50, 110, 240),
    TrackState.LOST: (60, 60, 220),
}
WATCH_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>{refresh}
<style>body{{margin:0;padding:1.2rem;background:#14171a;color:#e6e9ec;font:16px/1.5 system-ui,sans-serif}}
h1{{font-size:1.15rem;font-weight:600;margin:0 0 .6rem}}img{{max-width:100%;border-radius:8px;display:block}}
dl{{display:flex;flex-wrap:wrap;gap:.3rem 2rem;margin:.9rem 0}}dt{{color:#9aa4ad;font-size:.8rem}}dd{{margin:0}}
a{{color:#7fc4ff}}</style><h1>{title}</h1>{picture}
<dl>{facts}</dl>{foot}</html>
"""


class WatchPage:
    """Writes watch.jpg and watch.html into a folder, at most every WATCH_INTERVAL s of the run."""

    def __init__(self, folder: Path, rig: Rig, title: str) -> None:
        self.page, self._folder, self._rig, self._title = folder / "watch.html", folder, rig, title
        self._number, self._next = 0, -np.inf
        self._facts: list[tuple[str, str]] = []

    def show(self, frames: FrameSet, pose: SurfacePose, line: Array | None, facts: Sequence[tuple[str, str]]) -> None:
        """The newest frames, pose and printed line (N, 3), mm, surface frame of the pose; facts: name and value."""
        if pose.stamp < self._next:
            return
        self._next = pose.stamp + WATCH_INTERVAL
        self._number += 1
        self._facts = [("state", pose.state.value + (f": {pose.reason}" if pose.reason else "")), *facts]
        picture = self._montage(frames, pose, line)
        cv2.imwrite(str(self._folder / "watch.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, WATCH_JPEG_QUALITY])
        self._write('<meta http-equiv="refresh" content="1">', "<p>This page renews itself while the run goes on.</p>")

    def begin(self) -> None:
        """Write a page before the first picture."""
        self._write('<meta http-equiv="refresh" content="1">', "<p>The first pictures are being rendered.</p>")

    def finish(self, verdict: str) -> None:
        """The run is over: the page no longer reloads itself, and links to the report."""
        self._write("", f'<p>{escape(verdict)} <a href="report.html">The report</a></p>')

    def _write(self, refresh: str, foot: str) -> None:
        facts = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in self._facts)
        title = escape(self._title)
        picture = f'<img src="watch.jpg?{self._number}" alt="what the cameras see">' if self._number else ""
        text = WATCH_PAGE.format(title=title, refresh=refresh, picture=picture, facts=facts, foot=foot)
        self.page.write_text(text, encoding="utf-8")

    def _montage(self, frames: FrameSet, pose: SurfacePose, line: Array | None) -> Image:
        others = max(len(self._rig) - 1, 1)
        height = max(MAIN_TILE[1], others * SIDE_TILE[1])
        canvas = np.full((height, MAIN_TILE[0] + SIDE_TILE[0], 3), 24, np.uint8)
        for camera in range(len(self._rig)):
            (w, h), x, y = (MAIN_TILE, 0, 0) if camera == 0 else (SIDE_TILE, MAIN_TILE[0], (camera - 1) * SIDE_TILE[1])
            tile = canvas[y : y + h, x : x + w]
            images = [f.image for f in frames.frames if f.camera == camera]
            if images:
                self._draw(tile, images[0], camera, pose, line)
            label = self._rig.cameras[camera].name if images else "no picture"
            for colour, width in (((20, 20, 20), 4), ((240, 240, 240), 1)):
                cv2.putText(tile, label, (16, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA)
        cv2.rectangle(canvas, (0, 0), (canvas.shape[1] - 1, height - 1), STATE_BGR[pose.state], 6)
        return canvas

    def _draw(self, tile: Image, image: Image, camera: int, pose: SurfacePose, line: Array | None) -> None:
        """The picture on its tile, zoomed to the line by the pose, and the line on it."""
        width, (h, w) = image.shape[1], tile.shape[:2]
        pixels: Array | None = None
        if line is not None and pose.state.measured:
            points = se3.transform_points(pose.base_from_surface, line)
            projected, depth = pixels_from_points(self._rig.cameras[camera], points)
            pixels = projected if (depth > 1).all() else None
        zoom, corner = w / width, np.zeros(2)
        if pixels is not None:
            zoom, corner = w / CLOSE_UP_PX, pixels.mean(0) - [CLOSE_UP_PX / 2, CLOSE_UP_PX * h / w / 2]
        tile_from_picture = np.array([[zoom, 0, -zoom * corner[0]], [0, zoom, -zoom * corner[1]]])
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        cv2.warpAffine(colour, tile_from_picture, (w, h), dst=tile, flags=cv2.INTER_LINEAR)
        if pixels is not None:
            corners = [np.rint(16 * zoom * (pixels - corner)).astype(np.int32).reshape(-1, 1, 2)]
            cv2.polylines(tile, corners, False, LINE_BGR, 1, cv2.LINE_AA, 4)


NOZZLE_HEADER = (
    *("stamp_s", "extrude", "flow_mm3_s", "x_mm", "y_mm", "z_mm", "target_x_mm", "target_y_mm", "target_z_mm"),
    *("error_mm", "error_x_mm", "error_y_mm", "error_z_mm", "angle_deg", "path_error_mm"),
    *("place_mm", "checkpoint", "reason"),
)
_ROW = "%.6f,%d" + ",%.6f" * 14 + ",%d,"


class NozzleWriter:
    """Writes nozzle.csv, some rows at a time; closes it as a context manager."""

    def __init__(self, file: Path, line: PlannedLine) -> None:
        self._file = file.open("w", newline="", encoding="utf-8")
        self._file.write(",".join(NOZZLE_HEADER) + "\n")
        self._line = line

    def write(self, log: NozzleLog) -> None:
        """The rows since the last call."""
        nozzle, target, errors = log.base_from_nozzle, log.base_from_target, nozzle_errors(log, self._line)
        error = errors.distance, errors.vector, np.degrees(errors.angle), errors.path
        places = nozzle[:, :3, 3], target[:, :3, 3]
        rows = np.column_stack([log.stamps, log.extrude, log.flow, *places, *error, log.place, log.checkpoint])
        reasons = {reason: _quoted(reason) for reason in np.unique(log.reason).tolist()}
        for row, reason in zip(rows.tolist(), log.reason.tolist(), strict=True):
            self._file.write((_ROW % tuple(row)).replace("nan", "") + reasons[reason])
        self._file.flush()

    def __enter__(self) -> NozzleWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._file.close()


def _quoted(reason: str) -> str:
    """A last cell and its end of line, as csv.writer writes them; a line break becomes a blank."""
    text = reason.replace("\n", " ")
    return ('"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\r') else text) + "\n"


ROW_STRIDE = 20  # of the nozzle's log for viewers: 50 rows a second
LANDMARKS_PERIOD = 2.0  # s between two clouds of the landmarks
STAMP_DIGITS = 9  # of a stamp: a row and an exposure at one instant become one
TRUTH_DELAY = 0.5  # s beyond the transport by which any picture has arrived; truth is written in order of stamp

RUN_FILES = (
    *("session.mcap", "commands.csv", "frames.bin", "nozzle.csv", "arm.toml", "scenario.toml"),
    *("watch.html", "watch.jpg", "report.html", "summary.json"),
)

PosesAt = Callable[[Array], Array]  # times (N,), s -> base_from_surface (N, 4, 4)


def clear_run(out: Path) -> None:
    """Remove an earlier run from the folder `out`: two runs make no session."""
    for name in ("session", "tracking"):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in RUN_FILES:
        (out / name).unlink(missing_ok=True)


class RunFolder(WorldSink):
    """Writes a run; a context manager that leaves all files readable on any end."""

    def __init__(
        self, out: Path, scenario: Scenario, line: PlannedLine, rois: Sequence[Roi], truth: PosesAt, scan: Path | None
    ) -> None:
        """out: an existing folder. line: the planned line. scan: the scan's file in out/session, if any."""
        self.out, self._truth, self._line, self._seconds = out, truth, line, scenario.seconds
        self.logs: list[NozzleLog] = []
        self.looks: list[Look] = []
        self.pictures: dict[int, bytes] = {}  # per camera, the newest while printing, else the newest
        self.watch = WatchPage(out, scenario.known_rig, scenario.title)
        self._line_points: Array | None = None  # (N, 3) mm, of the line in the tracker's own surface frame
        self._activity, self._printing, self._printed = "waiting for a surface to follow", False, False
        self._state: TrackState | None = None
        self._reason = ""
        self._pending: list[Array] = []  # s, instants without a written truth
        self._truth_stamps: list[Array] = []  # s, rising
        self._until = -np.inf  # s, the last of them
        self._last_head = -np.inf  # s, the last frame set with a written print head
        self._last_pose = 0.0  # s, stamp of the last pose
        self._tracker: TrackingStep | None = None
        self._last_map = -np.inf  # s, of the last landmarks for viewers
        cameras = scenario.cameras
        self._truth_delay = cameras.transport + JITTER_LIMIT * cameras.transport_jitter + TRUTH_DELAY
        shutil.copyfile(scenario.file, out / "scenario.toml")
        write_arm(out / "arm.toml", scenario.profile, "what the motion knew of the arm")
        (out / "tracking").mkdir(exist_ok=True)
        with ExitStack() as stack:  # open files are closed if the next cannot be opened
            names = [camera.name for camera in scenario.known_rig.cameras]
            self._poses = stack.enter_context(PoseWriter(out / "tracking", names, STAGES))
            self._commands = stack.enter_context(CommandWriter(out))
            self._nozzle = stack.enter_context(NozzleWriter(out / "nozzle.csv", line))
            self._session: tuple[SessionFolderWriter, Recorder] | None = None
            start_ns = round(utc_now() * 1e9)  # the time of day at which virtual time begins
            if scenario.tracking.pictures:
                self._session = (
                    stack.enter_context(SessionFolderWriter(out / "session", scenario.known_rig, rois, start_ns)),
                    stack.enter_context(
                        Recorder(out / "session.mcap", scenario.known_rig, overwrite=True, began=start_ns)
                    ),
                )
                if scan is not None:
                    self._session[1].surface(scan)
                for roi in rois:
                    self._session[1].write(roi)
            self._files = stack.pop_all()

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
        """The print head at the stamp of a frame set, tracked or not; a repeated stamp is ignored."""
        if self._session is not None and stamp > self._last_head:
            self._last_head = stamp
            for container in self._session:
                container.head_row(row_from_head(stamp, head), head.extruding)

    def show_tracker(self, tracker: TrackingStep) -> None:
        """Show this tracker's landmarks to viewers."""
        self._tracker = tracker

    def pose(self, frames: FrameSet, pose: SurfacePose, report: StepReport, spent: float) -> None:
        """The pose of a frame set, computed in `spent` s of real time."""
        self._poses.write(pose, len(frames.frames), report, spent)
        self._last_pose = pose.stamp
        if pose.state is not self._state:
            self.event(pose.stamp, f"{pose.state.value}: {pose.reason}", INFO if pose.state.measured else WARNING)
            self._state = pose.state
        if self._session is not None:
            self._session[1].write(report.observations)
            self._session[1].write(pose)
            surface_map = None if self._tracker is None else self._tracker.map
            if surface_map is not None and pose.stamp >= self._last_map + LANDMARKS_PERIOD:
                self._last_map = pose.stamp
                self._session[1].show_surface(pose.stamp, surface_map.points)
            error, log = "not printing", self.logs[-1] if self.logs else None
            if log is not None and log.extrude.any():
                errors = (log.base_from_nozzle - log.base_from_target)[log.extrude, :3, 3]
                error = f"{np.linalg.norm(errors, axis=1).mean():.3f} mm"
            time = f"{pose.stamp:.1f} of {self._seconds:g} s"
            facts = [("time", time), ("arm", self._activity), ("error at the nozzle", error)]
            self.watch.show(frames, pose, self._line_points, facts)

    def look(self, look: Look) -> None:
        """The result of a look at what was printed."""
        self.looks.append(look)
        if self._session is not None:
            self._session[1].write(look)

    def registration(self, truth_from_estimate: Array) -> None:
        """The path's registration: truth_surface_from_estimated_surface (4, 4)."""
        self._line_points = se3.transform_points(se3.inverse(truth_from_estimate), self._line.points)
        if self._session is not None:
            self._session[1].show_path(self._last_pose, self._line_points, self._line.knots)

    @property
    def keeper(self) -> LoopKeeper | None:
        """Records the inputs of the motion's loop in session.mcap; None without."""
        return None if self._session is None else LoopKeeper(self._session[1].attach, self._session[1].write)

    def wire(self, stamp: float, data: bytes, sent: bool) -> None:
        """Bytes at the arm's port: sent to the arm, or received."""
        if sent:
            self._commands.send(data)
        if self._session is not None:
            (self._session[1].sent if sent else self._session[1].received)(stamp, data)

    def tick(self, tick: Tick, progress: PrintProgress | None) -> None:
        """A tick, and the progress of the print by it; None before the path was placed."""
        if progress is None:
            return
        command = tick.command
        self._commands.write(command)
        if self._session is not None:
            recorder = self._session[1]
            recorder.write(command)
            recorder.progress(command.stamp, progress.place)
        reason = command.reason
        if reason and reason != self._reason:
            self.event(command.stamp, f"hold: {reason}", WARNING)
        self._reason = reason
        self._printing = isinstance(command, Move) and command.extrude
        share = f"{progress.place:.0f} of {progress.length:.0f} mm"
        self._activity = f"holds: {reason}" if reason else f"{progress.phase.value}, {share}"

    def rows(self, log: NozzleLog) -> None:
        """The next rows of the truth at the nozzle."""
        self.logs.append(log)
        self._nozzle.write(log)
        if self._session is not None and log.extrude.any():
            errors = (log.base_from_nozzle - log.base_from_target)[:, :3, 3]
            for k in np.flatnonzero(log.extrude)[::ROW_STRIDE]:
                self._session[1].error(float(log.stamps[k]), "nozzle", float(np.linalg.norm(errors[k])))
        self._pending.append(log.stamps)
        self._write_truth(float(log.stamps[-1]) - self._truth_delay)

    def event(self, stamp: float, text: str, level: int = WARNING) -> None:
        """An event for a person."""
        if self._session is not None:
            self._session[1].event(stamp, text, level, "simulation")

    def _write_truth(self, until: float) -> None:
        """Truth in the middle of each exposure and at each row, in order, up to `until`, s."""
        if self._session is None or not self._pending:
            return
        stamps: Array = np.unique(np.round(np.concatenate(self._pending), STAMP_DIGITS))
        self._pending = [stamps[stamps > until]]
        due = stamps[(stamps <= until) & (stamps > self._until)]
        if len(due):
            self._until = float(due[-1])
            self._truth_stamps.append(due)
            for row in rows_from_trajectory(self._trajectory(due)):
                self._session[1].truth_row(row, exact=True)

    def _trajectory(self, stamps: Array) -> Trajectory:
        return Trajectory(stamps, self._truth(stamps), exact=True)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        with self._files:
            self._write_truth(np.inf)
            if self._session is not None and self._truth_stamps:
                self._session[0].truth(self._trajectory(np.concatenate(self._truth_stamps)))
