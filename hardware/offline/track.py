"""`stillbed track`: a recorded session tracked frame set by frame set; and the trackers that can be chosen by name.

The command line needs only the names, so GTSAM, OpenCV and onnxruntime are imported where they are used.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

from hardware.process.progress import Progress, ProgressReport, check_apart, prepare_out
from hardware.process.system import SPAWN, blocked_sigint, exit_with_parent, step_back
from perception.tracking import MAP_METHOD, THESIS_METHOD

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from estimation.pose import SurfacePose
    from estimation.rig import Rig
    from estimation.scans.scan import Scan
    from estimation.se3 import Array
    from hardware.files.pose_file import PoseWriter
    from hardware.files.region_table import RegionSettings
    from hardware.files.session import Session
    from hardware.operator.shared_state import Polygons
    from hardware.process.system import SharedLatest
    from perception.frames import FrameSet, Roi
    from perception.tracking.step import StepReport, TrackingStep
    from perception.tracking.wound_step import FindRegion, RegionTrackingStep
    from perception.wound.segmentation import NetworkSegmenter

    PoseSink = Callable[[FrameSet, SurfacePose, StepReport], None]  # takes each pose once it is written

SETTLING_TIME = 1.0  # s of an earlier run, beyond where its path was placed, that make the map anew
MAP_PROCESS_NICE = 10  # added to the niceness of the map's process


class FrameSetStep(Protocol):
    """A tracker: TrackingStep, or anything that is called like it."""

    last: StepReport

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp`."""

    def idle(self) -> None:
        """Do the work that no pose waits for; there is none by default."""
        return


@contextmanager
def step_by(
    method: str,
    rig: Rig,
    roi: Sequence[Roi],
    surface: Path | None = None,
    now: Callable[[], float] = lambda: 0.0,
    tool: Array | None = None,
    prefilter: str = "none",
    model: Path | None = None,
) -> Iterator[FrameSetStep]:
    """The tracker of a method, a key of TRACKING_METHODS, for these cameras; other arguments as `tracker` takes them.

    The thesis's methods make no use of scan and tool, and always apply the bilateral filter.
    """
    if method == MAP_METHOD:
        with tracker(rig, roi, surface, now, tool, prefilter, model) as step:
            yield step
        return
    from concurrent.futures import ThreadPoolExecutor

    from perception.thesis.camera import Corners, KeyPoints
    from perception.thesis.step import ThesisStep

    with ThreadPoolExecutor(len(rig)) as threads:
        yield ThesisStep(rig, roi, now, threads, KeyPoints if method == THESIS_METHOD else Corners)


@contextmanager
def tracker(
    rig: Rig,
    roi: Sequence[Roi],
    surface: Path | Scan | None = None,
    now: Callable[[], float] = lambda: 0.0,
    tool: Array | None = None,
    prefilter: str = "none",
    model: Path | None = None,
    find: Callable[[Executor], FindRegion] | None = None,
    waits: bool = True,
) -> Iterator[TrackingStep | RegionTrackingStep]:
    """TrackingStep for these cameras; the map is refined in a process of its own, as GTSAM holds the interpreter lock.

    roi: where the surface is at the start; without one `find`, given one thread, makes what finds it, by default the
    search of the wound by a network. model: the network, an ONNX file; None: the one that comes along. surface: the
    scan, or its file, mm. now: s, by which the stages are timed. tool: (K, 2) mm, profile of the tool on the arm as
    `ArmProfile.tool`. prefilter: a key of perception.lens.PREFILTERS.

    waits: whether a map that is not ready when it is due is waited for, so that a recording gives the same poses again.

    InputError for a scan that cannot be read, and for a rig of one camera.
    """
    from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

    from estimation.errors import InputError
    from hardware.files.mesh_file import read_mesh
    from perception.lens import PREFILTERS
    from perception.mapping.masks import Tool
    from perception.tracking.step import TrackingStep
    from perception.tracking.wound_step import RegionTrackingStep

    scan = read_mesh(surface) if isinstance(surface, Path) else surface
    if len(rig) < 2:
        raise InputError("rig", "cameras", len(rig), "2 or more: one camera sees no depth")
    with ProcessPoolExecutor(1, SPAWN, _start_map_process) as executor:
        with blocked_sigint():
            first = executor.submit(int)
        first.result()  # the process has started before the first frame set

        def make_step(regions: Sequence[Roi]) -> TrackingStep:
            masked = None if tool is None else Tool(tool)
            return TrackingStep(rig, regions, now, executor, scan, masked, PREFILTERS[prefilter], waits)

        if roi:
            yield make_step(roi)
            return
        search = partial(network_search, rig, model) if find is None else find
        with ThreadPoolExecutor(1, initializer=step_back) as thread:
            yield RegionTrackingStep(rig, make_step, search(thread))


def _start_map_process() -> None:
    """Set up the map's process: the parent ends it, also after Ctrl-C, and frames have priority over the map."""
    from estimation.runtime import load_scipy

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    step_back(MAP_PROCESS_NICE)
    exit_with_parent()
    load_scipy()


DRAW_TEXT = "draw on the page where the surface is"


def region_search(
    rig: Rig, region: RegionSettings, drawn: SharedLatest[Polygons], model: Path | None = None
) -> Callable[[Executor], FindRegion] | None:
    """What finds a region that is not known before the first picture, to be given one thread; None: nobody asks."""
    from hardware.files.region_table import RegionBy  # loads numpy

    if region.drawn:
        return lambda thread: partial(_drawn_region, rig, drawn)
    if region.by is RegionBy.COLOUR:
        return partial(colour_search, rig, region.colour)
    return partial(network_search, rig, model) if region.by is RegionBy.NETWORK else None


def _drawn_region(rig: Rig, drawn: SharedLatest[Polygons], frames: FrameSet) -> Sequence[Roi] | str:
    """The region that somebody has drawn on the page; InputError where it is of other cameras."""
    from hardware.files.region_table import RegionBy, RegionSettings, check_region

    polygons = drawn.get()
    if polygons is None:
        return DRAW_TEXT
    settings = RegionSettings(RegionBy.POLYGON, polygons)
    check_region("the operator's page", settings, rig)
    return settings.rois(rig, frames.stamp)


def network_search(rig: Rig, model: Path | None, thread: Executor) -> FindRegion:
    """Looks for the wound by a network, in one thread. model: an ONNX file; None: the one that comes along."""
    from perception.tracking.wound_step import RegionSearch

    return RegionSearch(rig, _network_segmenter(model), thread)


def colour_search(rig: Rig, colour: str, thread: Executor) -> FindRegion:
    """Looks for a printed frame or patch of a colour, "#rrggbb", in one thread."""
    from perception.tracking.wound_step import RegionSearch
    from perception.wound.segmentation import ColourSegmenter

    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return RegionSearch(rig, ColourSegmenter((red, green, blue)), thread, patch=True)


def _network_segmenter(model: Path | None) -> NetworkSegmenter:
    from perception.wound.network import WoundNetwork, shipped_model
    from perception.wound.segmentation import NetworkSegmenter

    network = WoundNetwork(shipped_model() if model is None else model, threads=1)  # the other core is the tracker's
    return NetworkSegmenter(network, network.settings)


def restore_map(step: FrameSetStep, record: Path, since: float, until: float, session: Session, shift: float) -> Array:
    """Show a new tracker the first pictures of an earlier run, to map the same surface; new_from_old (4, 4) mm.

    record, since, until: of the earlier run, s. shift: s, added to their stamps.

    Pictures recorded without loss give the same map; from others its frame may lie elsewhere, by the difference of both
    runs' poses at the last of them. InputError where the surface is not found in its own pictures.
    """
    from estimation import se3
    from estimation.errors import InputError
    from hardware.recording.session_reader import read_poses
    from perception.frames import FrameSet

    poses = {pose.stamp: pose for pose in read_poses(record) if pose.stamp <= until + SETTLING_TIME}
    later = dropwhile(lambda frames: frames.stamp < since, session.frame_sets())
    sets = takewhile(lambda frames: frames.stamp <= until + SETTLING_TIME, later)
    new_from_old: Array | None = None
    for frames in sets:
        shifted = tuple(replace(frame, stamp=frame.stamp + shift) for frame in frames.frames)
        pose, old = step(FrameSet(frames.stamp + shift, shifted, frames.head)), poses.get(frames.stamp)
        step.idle()
        if old is not None and old.state.measured and pose.state.measured and old.state is pose.state:
            new_from_old = se3.inverse(pose.base_from_surface) @ old.base_from_surface
    if new_from_old is None:
        raise InputError(record, "recording", "no surface", "pictures in which it is found again")
    return new_from_old


def run_track(
    path: Path,
    out: Path,
    record: Path | None = None,
    force: bool = False,
    method: str = MAP_METHOD,
    tool: Array | None = None,
    prefilter: str = "none",
    wound: bool = False,
    model: Path | None = None,
    graph: Path | None = None,
) -> tuple[str, str]:
    """Track the session at `path` into the folder `out`; returns the summary, and what was lost of the file, as texts.

    method, tool, prefilter, model: as `step_by` takes them. wound: whether it is segmented as well,
    into wound.csv. graph: the file that the factor graph is written into as it is at the end, by `MAP_METHOD` only.
    An early end, by an error of the input or Ctrl-C, leaves poses and a report of all frame sets until then.
    """
    from hardware.files.pose_file import WOUND_FILE_NAME, PoseWriter, WoundFile
    from hardware.offline.convert import TrackRecorder
    from hardware.process.clock import WallClock
    from hardware.recording.session_reader import open_session
    from perception.tracking.step import STAGES

    session = open_session(path)
    if model is not None:
        _network_segmenter(model)  # what is wrong with it is told before anything is written
    for option, file in (("--record", record), ("--graph", graph)):
        if file is not None:
            check_apart(option, file, path)
            _check_file(option, file, force)
    prepare_out(out, force)
    for stale in ("report.html", "summary.json", WOUND_FILE_NAME):  # an earlier run's
        (out / stale).unlink(missing_ok=True)
    clock = WallClock()
    complete = False
    with ExitStack() as stack:
        chosen = step_by(method, session.rig, session.roi, session.surface, clock.now, tool, prefilter, model)
        step = stack.enter_context(chosen)
        sinks = [] if record is None else [stack.enter_context(TrackRecorder(record, session, force)).write]
        if wound:
            sinks.append(stack.enter_context(WoundFile(out, session.rig, _network_segmenter(model))).write)
        writer = stack.enter_context(PoseWriter(out, [camera.name for camera in session.rig.cameras], STAGES))
        progress = stack.enter_context(Progress("track", "frame sets", clock.now))
        try:
            follow(session.frame_sets(), step, writer, clock.now, progress, len(session), sinks)
            complete = True
        finally:
            if graph is not None:
                graph.write_text(cast("TrackingStep", step).window_graph, encoding="utf-8")
            text = _write_report(out, session, complete, method)
    return f"{text}\nreport: {out / 'report.html'}", session.damage


def _check_file(option: str, file: Path, force: bool) -> None:
    """InputError where the option's file cannot be written, before a tracker is started."""
    from estimation.errors import InputError

    if file.is_dir() or (file.exists() and not force):
        got = "a folder" if file.is_dir() else "a file that exists"
        raise InputError(file, option, got, "a new file, or --force")
    if not file.parent.is_dir():
        raise InputError(file, option, "no such folder", "a file in a folder that exists")


def follow(
    frame_sets: Iterable[FrameSet],
    step: FrameSetStep,
    writer: PoseWriter,
    now: Callable[[], float],
    progress: ProgressReport,
    total: int,
    sinks: Sequence[PoseSink] = (),
) -> int:
    """Run `step` over the frame sets, each pose written before the next frame set is taken; returns their number.

    now: s, by which the step alone is timed, not the writing. total: frame sets, for the progress only.
    """
    done = 0
    for done, frames in enumerate(frame_sets, 1):
        start = now()
        pose = step(frames)
        spent = now() - start
        writer.write(pose, len(frames.frames), step.last, spent)
        for sink in sinks:
            sink(frames, pose, step.last)
        step.idle()
        progress(done, total)
    return done


def _write_report(out: Path, session: Session, complete: bool, method: str) -> str:
    """Evaluate the poses.csv in `out` into report.html and summary.json there; returns the summary as text."""
    from hardware.files.pose_file import read_poses
    from hardware.report.evaluation import as_dict, evaluate, summary_text, write_summary
    from hardware.report.report import write_report

    since = min((roi.stamp for roi in session.roi), default=float("-inf"))
    table = read_poses(out / "poses.csv")
    result = evaluate(table, session.truth, session.path.name, since, complete, session.damage, method)
    write_summary(out / "summary.json", as_dict(result))
    write_report(out / "report.html", result)
    return summary_text(result)
