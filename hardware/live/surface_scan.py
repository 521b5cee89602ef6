"""`stillbed scan`: the calibrated cameras as a scanner; a mesh with colour and standard deviation, and a report.

The surface is tracked while it breathes, and pictures of some instants are fused where the poses say that they were
taken (`perception.mapping.dense_surface`). The scan stands in the surface frame of that tracking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.mapping.bundle_adjustment import exposed_poses
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.scans.scan import Scan, face_areas, render_scan, triangulate_lattice
from estimation.se3 import Array
from hardware.files.mesh_file import write_scan
from hardware.files.region_table import ANY_REGION, RegionSettings, check_region
from hardware.live.frame_source import LiveCameraSource, SourceEnded
from hardware.live.settings import read_settings
from hardware.offline.track import region_search, tracker
from hardware.operator.shared_state import Polygons
from hardware.process.checks import read_toml
from hardware.process.clock import WallClock
from hardware.process.progress import Progress, cache_folder, cached, duration_text, write_atomically
from hardware.process.system import SharedLatest
from hardware.report.evaluation import percent
from hardware.report.page import captioned, data_url, document, figure_row, figures_table, row_of_tiles, section, tile
from perception.frames import FrameSet, Roi, region_polygons
from perception.lens import Lenses
from perception.mapping.dense_surface import DenseFit, DenseSurface, ScanView, camera_place
from perception.mapping.scan_map import GUESS_SIGMA_MM, LATTICE_MARGIN_MM, initial_heights, node_size

MAX_SETS = 40  # frame sets that are fused: more take longer and are hardly better
MAX_FIND_TIME = 20.0  # s in which the surface is found, of recorded or real time
MAX_NODES = 120_000  # of the lattice: a larger surface gets a coarser one
MIN_TRACKED_SETS = 2  # whose poses agree: fewer are no scan
PICTURE_WAIT = 0.5  # s of a wait for live pictures
NO_SURFACE = "the surface was not found"


@dataclass(frozen=True, slots=True)
class ScanOrder:
    """What is to be scanned, and into which file."""

    source: Path  # rig.toml, session.toml, scenario.toml, session folder or recording
    out: Path  # .ply; the report stands beside it
    sets: int = 6  # frame sets that are fused
    seconds: float = 4.0  # s in which they are taken: a breath
    region: RegionSettings = ANY_REGION
    force: bool = False

    @property
    def report(self) -> Path:
        """The report's file."""
        return self.out.with_suffix(".html")


@dataclass(frozen=True, slots=True, eq=False)
class ScanSource:
    """Pictures to scan from."""

    rig: Rig
    roi: tuple[Roi, ...]
    frame_sets: Iterator[FrameSet]


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceScan:
    """What was scanned."""

    surface: DenseSurface
    scan: Scan  # of its sure nodes
    nodes: NDArray[np.int64]  # (V,) of the lattice, row by row, that are vertices
    rig: Rig
    first: SurfacePose  # of the first of the fused frame sets
    sets: int
    seconds: float  # s that the fit took

    @property
    def area(self) -> float:
        """mm^2 of the mesh."""
        return float(face_areas(self.scan).sum())

    @property
    def coverage(self) -> float:
        """Share of the region that was seen."""
        return float(self.surface.sure.sum() / max(1, (self.surface.wanted | self.surface.sure).sum()))

    @property
    def words(self) -> str:
        """What was scanned and how well, in words."""
        share, (median, high) = percent(self.coverage, 0), np.percentile(self.sigma, [50, 95])
        return (
            f"{self.area / 100:.1f} cm² scanned from {self.sets} frame sets, {share} of the region; "
            f"standard deviation {median:.3f} mm (median), {high:.3f} mm (95 %); fused in {duration_text(self.seconds)}"
        )

    @property
    def sigma(self) -> Array:
        """Standard deviation (V,) mm of each vertex across the surface."""
        return np.asarray(self.surface.sigma.ravel()[self.nodes])

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Colours (V, 3), RGB."""
        return np.asarray(self.surface.colours.reshape(-1, 3)[self.nodes, ::-1])


def check_scan(order: ScanOrder) -> ScanOrder:
    """The order; InputError where it cannot be followed, or would overwrite a file and `force` is not set."""
    where = "command line"
    if order.out.suffix.lower() != ".ply":
        raise InputError(where, "--out", order.out, "a file that ends in .ply")
    for file in (order.out, order.report):
        if file.is_dir() or (file.exists() and not order.force):
            got = "a folder" if file.is_dir() else "a file that exists"
            raise InputError(file, "--out", got, "a new file, or --force")
    if not order.out.parent.is_dir():
        raise InputError(order.out, "--out", "no such folder", "a file in a folder that exists")
    if not MIN_TRACKED_SETS <= order.sets <= MAX_SETS:
        raise InputError(where, "--sets", order.sets, f"{MIN_TRACKED_SETS} to {MAX_SETS}")
    if order.region.drawn:
        raise InputError(where, "--region", "no corners", "a region with corners: no page is there to draw on")
    if not 0 < order.seconds < float("inf"):
        raise InputError(where, "--seconds", order.seconds, "above 0")
    return order


def run_scan(order: ScanOrder) -> str:
    """Scan into the order's file, with a report beside it; returns a summary. InputError, StillbedError."""
    order = check_scan(order)
    with open_source(order) as source:
        scanned = scan_surface(source, order.sets, order.seconds, order.region)
    write_atomically(order.out, lambda file: write_scan(
        file, scanned.scan.vertices, scanned.scan.triangles, scanned.colours, scanned.sigma
    ))  # fmt: skip
    write_atomically(order.report, scan_page(scanned, order.source.name))
    return f"{scanned.words}\n{camera_advice(scanned)}\nscan: {order.out}\nreport: {order.report}"


# -- pictures


@contextmanager
def open_source(order: ScanOrder) -> Iterator[ScanSource]:
    """The pictures of live cameras, of a recorded session or of a scenario, which is rendered first."""
    from hardware.recording.session_reader import open_session

    path, region = order.source, order.region
    if path.suffix == ".toml" and not path.is_dir():
        table = read_toml(path)
        if "camera" not in table and "scene" not in table:
            settings = read_settings(path)
            named = settings.simulated or settings.rig
            if named is None:
                raise InputError(path, "cameras", "neither", "one of rig and simulated")
            with open_source(replace(order, source=named, region=region if region.by else settings.region)) as source:
                yield source
            return
        if "camera" in table:
            cameras = LiveCameraSource(path)
            try:
                yield ScanSource(cameras.rig, region.rois(cameras.rig, -np.inf), _live_sets(cameras))
            finally:
                cameras.close()
            return
        path = _rendered(path, order.seconds)
    session = open_session(path)
    check_region("command line", region, session.rig)
    roi = session.roi if region.by is None else region.rois(session.rig, -np.inf)
    yield ScanSource(session.rig, roi, session.frame_sets())


def _live_sets(cameras: LiveCameraSource) -> Iterator[FrameSet]:
    while True:
        try:
            timed_set = cameras.take(PICTURE_WAIT)
        except SourceEnded:
            return
        if timed_set is not None:
            yield timed_set.frames


def _rendered(scenario: Path, seconds: float) -> Path:
    """The session of a scenario, rendered as far as it is needed unless all of it is there."""
    from hardware.live.prerender import prerender  # loads all of the simulator

    entry = cached(scenario, cache_folder())
    return (entry if entry.session.exists() else prerender(scenario, cache_folder(), seconds=seconds + 2)).session


# -- scanning


def scan_surface(source: ScanSource, sets: int, seconds: float, region: RegionSettings = ANY_REGION) -> SurfaceScan:
    """Track the surface for `seconds`, and fuse the pictures of `sets` instants. StillbedError where it is not found.

    Ctrl-C while it is tracked ends that: what was seen until then is fused.
    """
    clock = WallClock()
    selection, find = _FrameSelection(sets, seconds), region_search(source.rig, region, SharedLatest[Polygons]())
    with tracker(source.rig, source.roi, find=find) as step:
        with Progress("scan", "frame sets", clock.now) as progress:
            progress.note = "the surface is being looked for"
            progress(0, 0)
            try:
                for number, frames in enumerate(source.frame_sets, 1):
                    pose = step(frames)
                    progress.note = pose.reason or f"{len(selection)} of {sets} instants"
                    progress(number, 0)
                    if not selection.add(
                        frames,
                        pose,
                        partial(exposed_poses, source.rig, step.map, step.last.observations, pose.base_from_surface),
                    ):
                        break
                    step.idle()
            except KeyboardInterrupt:
                if len(selection) < MIN_TRACKED_SETS:
                    raise
        if len(selection) < MIN_TRACKED_SETS or step.map is None:
            raise StillbedError(f"{NO_SURFACE}: {selection.reason or 'no pictures came'}")
        roi, landmarks = step.roi, step.map.points
    selected = selection.selected()
    with Progress("fuse", "%", clock.now) as progress:
        progress(0, 100)
        return fuse(source.rig, roi, landmarks, selected, lambda share: progress(round(100 * share), 100))


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrames:
    """A frame set whose pose is known."""

    frames: FrameSet
    pose: SurfacePose
    exposed: Mapping[int, Array]  # (4, 4) base_from_surface at each camera's own exposure


class _FrameSelection:
    """Frame sets to choose from, spread over the time."""

    def __init__(self, sets: int, seconds: float) -> None:
        self._sets, self._seconds = sets, seconds
        self._first_stamp: float | None = None
        self._tracking_start: float | None = None
        self._bins: dict[int, TrackedFrames] = {}
        self.reason = ""

    def __len__(self) -> int:
        return len(self._bins)

    def add(self, frames: FrameSet, pose: SurfacePose, exposed: Callable[[], Mapping[int, Array]]) -> bool:
        """Take a frame set where its pose is good; whether more are wanted."""
        self._first_stamp = frames.stamp if self._first_stamp is None else self._first_stamp
        self.reason = pose.reason or self.reason
        if pose.state is not TrackState.TRACKING or len(frames.frames) < 2:
            start = self._first_stamp if self._tracking_start is None else self._tracking_start + self._seconds
            return frames.stamp < start + MAX_FIND_TIME
        self._tracking_start = frames.stamp if self._tracking_start is None else self._tracking_start
        bin_number = int((frames.stamp - self._tracking_start) / self._seconds * self._sets)
        if bin_number >= self._sets and len(self) >= MIN_TRACKED_SETS:
            return False
        if bin_number >= self._sets:  # of live cameras one set alone, as the first take long: once more
            self._bins, self._tracking_start, bin_number = {-1: next(iter(self._bins.values()))}, frames.stamp, 0
        current = self._bins.get(bin_number)
        if current is None or self._quality(frames, pose) > self._quality(current.frames, current.pose):
            self._bins[bin_number] = TrackedFrames(frames, pose, exposed())
        return True

    @staticmethod
    def _quality(frames: FrameSet, pose: SurfacePose) -> tuple[int, float]:
        """The more cameras and the slower the surface, the better."""
        return len(frames.frames), -float(np.linalg.norm(pose.twist[3:]))

    def selected(self) -> list[TrackedFrames]:
        """One frame set of each part of the time."""
        return [self._bins[number] for number in sorted(self._bins)]


def fuse(
    rig: Rig,
    roi: Sequence[Roi],
    landmarks: Array,
    selected: Sequence[TrackedFrames],
    progress: Callable[[float], None] = lambda share: None,
) -> SurfaceScan:
    """The surface in pictures whose poses are known. landmarks: (N, 3) mm, surface frame."""
    clock = WallClock()
    start = clock.now()
    views = [
        ScanView(c, instant, frame.image, se3.inverse(tracked.exposed[c]) @ rig.cameras[c].base_from_camera)
        for instant, tracked in enumerate(selected)
        for c, frame in ((frame.camera, frame) for frame in tracked.frames.frames)
    ]
    lenses, cameras = Lenses(rig), sorted({view.camera for view in views})
    low, high = np.percentile(landmarks[:, :2], [1, 99], axis=0) + LATTICE_MARGIN_MM * np.array([[-1.0], [1.0]])
    base_from_surface = selected[0].pose.base_from_surface
    step = node_size(lenses, cameras, se3.transform_points(base_from_surface, landmarks.mean(0)[None])[0])
    step = max(step, float(np.sqrt(np.prod(high - low) / MAX_NODES)))
    coarse = initial_heights(landmarks, low, high)
    lines = [at + GUESS_SIGMA_MM / 2 * np.arange(n) for at, n in zip(low[::-1], coarse.shape, strict=True)]
    heights = RegularGridInterpolator(lines, coarse.astype(float), bounds_error=False, fill_value=None)
    rois = tuple(replace(each, stamp=-np.inf) for each in roi)
    regions = region_polygons(rois, selected[0].frames, [camera.size for camera in rig.cameras])
    surface = DenseFit(lenses, views, progress)(
        low, high, step, lambda flat: heights(flat[:, ::-1]), regions if isinstance(regions, dict) else {}
    )
    used, triangles = triangulate_lattice(surface.sure)
    if not len(triangles):
        raise StillbedError("no part of the surface was seen alike by two cameras")
    scan = Scan(surface.points.reshape(-1, 3)[used], triangles, surface.normals.reshape(-1, 3)[used])
    return SurfaceScan(surface, scan, used, rig, selected[0].pose, len(selected), clock.now() - start)


# -- report

VIEWS = (  # title, and where it is seen from, surface frame
    ("from above", (0.0, 0.0, 1.0)),
    ("from the side", (1.0, 0.0, 0.6)),
    ("from below the wound", (0.0, -1.0, 0.6)),
)
VIEW_PIXELS = 460  # width and height of a picture
WEAK_SIGMA_MM = 0.1  # beyond, another camera is worth its place
SHADED_PERCENT = 98.0  # of standard deviations that the colours tell apart
WEAK_SHARE = 0.02  # of the region, below which no camera is missed
MIN_APART_DEG = 20.0  # between two cameras: nearer ones tell little about depth
TILTS_DEG, TURNS = (0.0, 20.0, 40.0, 60.0), 12  # camera places that are tried, off the surface's normal, round it


def scan_page(scanned: SurfaceScan, name: str) -> str:
    """The report as one HTML page."""
    sigma, surface, area = scanned.sigma, scanned.surface, f"{scanned.area / 100:.1f}"
    pictures = figure_row(
        _figure(title, render_scan(scanned.scan, scanned.colours, np.array(direction), VIEW_PIXELS)[..., ::-1])
        for title, direction in VIEWS
    )
    limits = np.percentile(sigma, [50, 95])
    masks = {camera.name: surface.seen[c] for c, camera in enumerate(scanned.rig.cameras)}
    masks["two cameras or more"], wanted = surface.seen.sum(0) >= 2, surface.wanted
    rows = [(name, percent((mask & wanted).sum() / max(1, wanted.sum()), 0)) for name, mask in masks.items()]
    rows.append(("scanned", percent(scanned.coverage, 0)))
    largest = max(2 * WEAK_SIGMA_MM, float(np.percentile(sigma, SHADED_PERCENT)))
    colours = np.where(surface.sure[::-1, :, None], _shaded(surface.sigma[::-1] / largest), 255)
    scale = _figure(f"0 to {largest:.2g} mm", np.asarray(_shaded(np.tile(np.linspace(0, 1, 256), (10, 1))), np.uint8))
    caption = "Standard deviation across the surface, blue to red. White lies outside, or no two cameras saw it alike."
    from_above = _figure("from above", np.asarray(colours, np.uint8))
    sigmas = [(f"{v:.3f}", "mm", f"standard deviation, {w}") for v, w in zip(limits, ("median", "95 %"), strict=True)]
    tiles = (area, "cm²", "scanned"), (f"{100 * scanned.coverage:.0f}", "%", "of the region"), *sigmas
    body = [
        row_of_tiles([tile(*item) for item in tiles]),
        section("The scan", "In plain light, from three sides.", pictures),
        section("How well it is known", caption, figure_row([from_above, scale])),
        section("Who saw it", "Share of the region that each camera shows.", figures_table(("camera", "share"), rows)),
        section("Where to put a camera", camera_advice(scanned), ""),
    ]
    return document("scan", name, scanned.words + ".", body, name)


def _figure(title: str, image: NDArray[np.uint8]) -> str:
    from hardware.files.images import encode

    return captioned(f'<img alt="the scan: {title}" src="{data_url(encode(image)[1])}">', title)


def _shaded(share: Array) -> Array:
    """Colours (..., 3), BGR, of shares (...) from 0 to 1: from blue by pale yellow to red."""
    stops = np.array([[150.0, 110, 60], [150, 225, 245], [40, 60, 200]])
    return np.stack([np.interp(share, [0, 0.5, 1], stops[:, k]) for k in range(3)], -1)


def camera_advice(scanned: SurfaceScan) -> str:
    """Where another camera would show most of what is open or known badly, in words; base frame."""
    surface, cameras = scanned.surface, scanned.rig.cameras
    weak = surface.wanted & (~surface.sure | (surface.sigma > WEAK_SIGMA_MM))
    share = weak.sum() / max(1, surface.wanted.sum())
    if share < WEAK_SHARE:
        return "No further camera is needed: nearly all of the region is known well."
    (x, y, z), near, apart = camera_place(surface, weak, scanned.first.base_from_surface, scanned.rig)
    return (
        f"{percent(share, 0)} of the region is open or known to no better than {WEAK_SIGMA_MM:g} mm. A camera at "
        f"({x:.0f}, {y:.0f}, {z:.0f}) mm in the base frame, {apart:.0f} degrees from {cameras[near].name} as seen from "
        f"there, would show it best."
    )
