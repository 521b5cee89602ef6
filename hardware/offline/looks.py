"""Looks at what was laid: gathers the views while the needle stands aside, measures, judges, and draws the result.

The first look, before anything is laid, measures the surface; each of the others what has come since. The last frame
set of a look takes some two seconds of a core.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial, reduce
from html import escape
from pathlib import Path as File

import numpy as np

from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceHeights
from hardware.offline.track import FrameSetStep
from hardware.process.system import step_back
from hardware.recording import messages
from hardware.recording.session_reader import read_channels
from hardware.report import page
from hardware.report.evaluation import percent
from perception.frames import FrameSet
from perception.lens import Lenses
from perception.mapping.scan_map import node_size
from perception.mapping.surface_heights import (
    BeadShares,
    SurfaceView,
    dense_heights,
    first_heights,
    heights_with_beads,
    sweep_beads,
    view_of,
)
from planning.command import LOOKS, Command, Hold
from planning.laid_beads import (
    SURE,
    BeadPieces,
    LaidBeads,
    Look,
    Stations,
    adapted_flow,
    bead_heights,
    judge_beads,
    nearest_station,
    pieces_between,
    stations_of,
)
from planning.material import AS_PLANNED, FlowShares
from planning.path import LOOK, Path, PrintProgress, way_lengths

VIEWS = 4  # frame sets of a look: each at another place of the breath, so that pixels fall elsewhere
VIEW_SPACING = 0.25  # s between them
SETTLED = 0.3  # s after the needle came to rest aside: it may swing, and pictures are late
LOOK_TIMEOUT = 15.0  # s aside, after which a look goes without the views that did not come
MARGIN = 10.0  # mm of surface beside the path that is measured as well: matching begins with what is coarse
MIN_STEP = 0.2  # mm between nodes: ten across a bead, and a look in two seconds
WIDTHS = (1.0, 1.12, 1.25, 1.4)  # by the planned: gel spreads
GROUND_DOUBT = 0.3  # share by which a piece must differ from the others, and surely so, before it is believed
NOTHING_JUDGED = "looked at: the surface was measured, and nothing was judged yet"
LOOK_TOPIC = "/look"
STATION_POINTS = 6  # of a piece's drawn line
PLOT_SCALE = 14.0  # px a mm of the drawing
SHARE_COLOURS = ((0.6, "#c0392b"), (0.8, "#e67e22"), (1.25, "#27ae60"), (1.6, "#e67e22"), (math.inf, "#8e44ad"))
FLOW_COLOURS = ((0.8, "#1f618d"), (0.99, "#7fb3d5"), (1.01, "#bbb"), (1.25, "#f5b041"), (math.inf, "#d35400"))


class SurfaceLooks:
    """The looks of one print. surface: last measured, None before the first. last: result of the last look."""

    def __init__(
        self, rig: Rig, path: Path, start: float = 0.0, adapt: bool = False, flows: Sequence[FlowShares] = ()
    ) -> None:
        """path: in the surface frame of the poses. start: where it begins, in checkpoints. adapt: whether to adapt it.

        flows: that were asked for before.

        InputError where the path says no amounts.
        """
        self._lenses, self._path = Lenses(rig), path
        self._adaptive, self._commanded_flow = adapt, reduce(FlowShares.then, flows, AS_PLANNED)
        self._layer: list[Look] = []  # those at the layer that is laid
        pieces_between(path, 0, len(path) - 1)
        self._views: list[SurfaceView] = []
        self._last_view = -math.inf  # s, of the last view
        self._widths: tuple[float, ...] = WIDTHS
        self._start_fraction = start  # checkpoints, up to where was looked at
        self._aside_at, self._stamp, self._complete = math.nan, math.nan, False  # s, needle aside since, newest set
        self.last: Look | None = None
        self.surface: SurfaceHeights | None = None

    def at(
        self, progress: PrintProgress, command: Command, frames: FrameSet, pose: SurfacePose, step: FrameSetStep
    ) -> bool:
        """Whether this frame set completes a look, True once a look; its result is then in `last`.

        command: the last one. step: the tracker, whose map says about where the surface lies.
        """
        surface_map = getattr(step, "map", None)
        if surface_map is None or not self.gather(progress, command, frames, pose):
            return False
        self.finish(progress.fraction, surface_map.points)
        return True

    def adapted(self) -> FlowShares | None:
        """The flows of the next layer by the last look, which later looks then expect; None where they stay."""
        if not self._adaptive or self.last is None:
            return None
        layer = self.last.laid.stations.layer[-1:]
        self._layer = [look for look in self._layer if look.laid.stations.layer[-1:] == layer] + [self.last]
        shares = adapted_flow(self._path, self._layer, self._commanded_flow)
        if shares is not None:
            self._commanded_flow, self._layer = self._commanded_flow.then(shares), []
            self.last = replace(self.last, flow=shares)
        return shares

    def gather(self, progress: PrintProgress, command: Command, frames: FrameSet, pose: SurfacePose) -> bool:
        """Keep the views of a look; whether this frame set completes them, True once a look."""
        if progress.wanted != LOOK:
            self._aside_at, self._complete = math.nan, False
            return False
        if self._complete or not (isinstance(command, Hold) and command.reason == LOOKS):
            return False
        self._aside_at = pose.stamp if math.isnan(self._aside_at) else self._aside_at
        complete = self._keep_view(frames, pose, self._aside_at)
        self._complete = complete or pose.stamp > self._aside_at + LOOK_TIMEOUT
        self._stamp = pose.stamp
        return self._complete

    def begin(self, views: Sequence[SurfaceView], landmarks: Array) -> None:
        """Measure the surface in views from before anything is laid, near landmarks (N, 3) mm, surface frame."""
        self._views = list(views)
        self._measure(landmarks)

    def finish(self, fraction: float, landmarks: Array) -> None:
        """Judge the printed beads up to `fraction` checkpoints; or measure the surface where nothing is printed yet."""
        self.last = None
        if self.surface is None or not len(pieces_between(self._path, self._start_fraction, fraction)):
            self._start_fraction = fraction
            self._measure(landmarks)
        elif self._views:
            self.last = self._judge(fraction, self._stamp)

    def _measure(self, landmarks: Array) -> None:
        views, self._views = self._views, []
        if not views:
            return
        low, high = self._path.zone[:, :2] + np.array([[-MARGIN], [MARGIN]])
        node = node_size(self._lenses, sorted(views[0].images), views[0].base_from_surface[:3, 3])
        self.surface = dense_heights(self._lenses, views, first_heights(landmarks, low, high, max(node, MIN_STEP)))

    def _keep_view(self, frames: FrameSet, pose: SurfacePose, since: float = -math.inf) -> bool:
        """Keep a frame set if it is of use; whether there are enough. since: s, when the needle came to rest aside."""
        is_due = pose.stamp >= self._last_view + VIEW_SPACING and pose.stamp >= since + SETTLED
        if is_due and pose.state is TrackState.TRACKING and len(frames.frames) > 1:
            self._last_view = pose.stamp
            self._views.append(view_of(frames, pose.base_from_surface))
        return len(self._views) >= VIEWS

    def _judge(self, fraction: float, now: float) -> Look:
        """Judge the printed beads up to `fraction` checkpoints."""
        assert self.surface is not None
        views, self._views = self._views, []
        pieces = pieces_between(self._path, self._start_fraction, fraction, told=self._commanded_flow)
        laid, self.surface, width = look_at(self._lenses, views, self.surface, pieces, self._widths)
        self._widths = (width,)  # a property of the gel, seen best on the bare surface
        start, self._start_fraction = self._start_fraction, fraction
        return Look(now, start, fraction, now - self._aside_at, width, laid)


class LiveLooks:
    """The looks of a live run, judged in a thread while tracking goes on.

    count: done so far. text: of the last one. busy: the running job.

    The bare surface is measured in views from just before the print begins, when the arm stands at its home.
    A look that fails says so, and the print goes on as planned.
    """

    def __init__(
        self,
        rig: Rig,
        path: Path,
        stack: ExitStack,
        adapt: Callable[[FlowShares], None] | None = None,
        flows: Sequence[FlowShares] = (),
    ) -> None:
        """path: in its own frame. stack: at whose end what is still judged is left. adapt: is told the next flows.

        flows: that looks of the run before asked for.
        """
        self._adapt, self._flows = adapt, flows
        self._rig, self._path = rig, path
        self._looks: SurfaceLooks | None = None
        self._bare_views = deque[SurfaceView](maxlen=VIEWS)
        self._last_view = -math.inf  # s, of the last of these
        self._worker = ThreadPoolExecutor(1, "looks", step_back)  # not at the priority of the tracking
        stack.callback(self._worker.shutdown, wait=False, cancel_futures=True)
        self.busy: Future[None] | None = None
        self._job_is_look = False  # whether the job is a look, rather than the bare surface
        self.count, self.text = 0, ""
        self.placed: Path | None = None  # the path, in the surface frame

    def __call__(
        self,
        progress: PrintProgress | None,
        command: Command | None,
        frames: FrameSet,
        pose: SurfacePose,
        landmarks: Array | None,
        lies: Array | None,
    ) -> Look | None:
        """A look that is complete by now, else None; None also for a look without a result, which `count` includes.

        progress, command: of the motion, the last ones. landmarks: (N, 3) mm of the map. lies: (4, 4) mm
        surface_from_path, None before the print begins.
        """
        if self.busy is not None:
            return self._finished(pose.stamp) if self.busy.done() else None
        if lies is None or landmarks is None or progress is None or command is None:
            spaced = pose.stamp > self._last_view + VIEW_SPACING
            if pose.state is TrackState.TRACKING and len(frames.frames) > 1 and spaced:
                self._last_view = pose.stamp
                self._bare_views.append(view_of(frames, pose.base_from_surface))
            return None
        if self._looks is None:
            self.placed = replace(self._path, surface_from_nozzle=lies @ self._path.surface_from_nozzle)
            how = progress.fraction, self._adapt is not None, self._flows
            self._looks = SurfaceLooks(self._rig, self.placed, *how)
            self._job_is_look = False
            self.busy = self._worker.submit(self._looks.begin, list(self._bare_views), landmarks)
            self._bare_views.clear()
        elif self._looks.gather(progress, command, frames, pose):
            self._job_is_look = True
            self.busy = self._worker.submit(self._looks.finish, progress.fraction, landmarks)
        return None

    def _finished(self, now: float) -> Look | None:
        assert self.busy is not None and self._looks is not None
        error, self.busy = self.busy.exception(), None
        if not self._job_is_look:
            return None
        text = f"looked at: nothing could be judged, and the path goes on as planned ({type(error).__name__}: {error})"
        self.text = NOTHING_JUDGED if error is None else text
        self.count += 1
        if self._adapt is not None and (shares := self._looks.adapted()) is not None:
            self._adapt(shares)
        if (look := self._looks.last) is None:
            return None
        self.text = f"looked at: {look.text}"
        return replace(look, stamp=now, seconds=look.seconds + now - look.stamp)


def look_at(
    lenses: Lenses,
    views: Sequence[SurfaceView],
    before: SurfaceHeights,
    pieces: BeadPieces,
    widths: Sequence[float] = WIDTHS,
) -> tuple[LaidBeads, SurfaceHeights, float]:
    """The printed share of planned beads, the surface after, and the beads' relative width out of `widths`."""
    nodes = before.nodes
    stations = stations_of(pieces)
    station, _ = nearest_station(pieces, stations, nodes)

    def due_at(width: float) -> Array:
        return bead_heights(replace(pieces, width=pieces.width * width), nodes)

    bead_shares = sweep_beads(lenses, views, before, due_at, widths, station, np.diff(stations.bead) == 0)
    planned = due_at(bead_shares.width)
    after = heights_with_beads(before, planned, station, bead_shares)
    exact_before = replace(before, sigma=0.0 * before.sigma)  # a share's sigma holds what the ground is off by
    laid = judge_beads(exact_before, after, replace(pieces, width=pieces.width * bead_shares.width))
    ground = heights_with_beads(before, planned, station, replace(bead_shares, share=ground_shares(bead_shares)))
    return laid, replace(after, heights=ground.heights), bead_shares.width


def ground_shares(bead_shares: BeadShares) -> Array:
    """Shares (S,) of pieces for the ground of the next look: the median, except where a piece surely differs.

    An error of the ground is the next layer's with opposite sign. Unknown pieces count as printed.
    """
    share, doubt = bead_shares.share, np.maximum(GROUND_DOUBT, SURE * bead_shares.sigma)
    usual = float(np.median(share[np.isfinite(share)])) if np.isfinite(share).any() else 1.0
    return np.where(np.abs(share - usual) < doubt, usual, np.where(np.isfinite(share), share, 1.0))


def read_looks(recording: File) -> list[Look]:
    """The looks of a recording, in order of stamp; none of a folder. InputError where it cannot be read."""
    if not recording.is_file():
        return []
    return sorted(read_channels(recording, {LOOK_TOPIC: partial(_look, recording)}), key=lambda look: look.stamp)


def _look(recording: File, message: messages.Message) -> Look:
    try:
        return messages.look_from_message(message)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(recording, LOOK_TOPIC, str(error), "a look, as stillbed writes it") from None


def looks_section(looks: Sequence[Look], path: Path) -> str:
    """The looks as a section of a report: a table, and a drawing of the beads by what lies there; "" of none."""
    if not looks:
        return ""
    rows = []
    for look in looks:
        volume, planned, _ = look.laid.total
        laid, crest = look.laid, look.laid.stations.crest
        off = laid.height[np.isfinite(laid.height)] - crest[np.isfinite(laid.height)]
        middle, uneven = (np.median(off), np.std(off)) if len(off) else (math.nan, math.nan)
        heights = np.median(crest) + middle, np.median(crest), uneven
        clogs = "; ".join(f"{a:.0f} to {b:.0f} mm" for a, b in laid.clogs) or "none"
        values = (f"{value:.2f}" if math.isfinite(value) else "–" for value in (volume, planned, *heights))
        counts = str(int(laid.gap.sum())), str(int(laid.blob.sum()))
        rows.append([f"{look.last:.0f}", f"{look.seconds:.1f}", *values, *counts, clogs])
    head = ("after checkpoint", "aside, s", "laid, mm³", "planned, mm³", "height, mm", "as planned, mm", "uneven, mm")
    table = page.figures_table((*head, "gaps", "blobs", "clogs"), rows)
    figures = "".join(
        f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"
        for look in looks
        for picture, caption in _captioned_pictures(look, path)
    )
    text = (
        "What lies there of the planned beads, by the cameras while the needle stood aside. Green: as planned to a "
        "quarter; orange: less than 0.8 or more than 1.25; red: a gap; violet: a blob; grey: not seen. What is planned "
        "of a layer that took its flow from the one below is what it was told to lay."
    )
    return page.section("Looks at what was laid", text, table + f'<div class="pictures">{figures}</div>')


def station_places(look: Look, path: Path, count: int = STATION_POINTS) -> Array:
    """Places (S, count, 3) mm along each piece of bead that was looked at, on the path."""
    knots = np.concatenate([[0.0], np.cumsum(way_lengths(path.surface_from_nozzle))])
    lengths = np.linspace(look.laid.stations.begin, look.laid.stations.end, count, axis=1)
    return np.stack([np.interp(lengths, knots, path.surface_from_nozzle[:, k, 3]) for k in range(3)], axis=-1)


def _captioned_pictures(look: Look, path: Path) -> list[tuple[str, str]]:
    """The pictures of a look with their captions: what lies there, and the next layer's flow where it has its own."""
    pictures = [(look_picture(look, path), f"after {look.last:.0f} checkpoints: {look.text}")]
    if look.flow is not None:
        caption = f"{look.flow.text}; grey: as planned, blue: less, orange: more"
        pictures.append((flow_picture(look.flow, look.laid.stations, path), caption))
    return pictures


def look_picture(look: Look, path: Path) -> str:
    """The stations of a look from above, each in the colour of its share, as SVG."""
    places, widths = station_places(look, path)[..., :2], look.laid.stations.width / look.width
    colours, titles = [], []
    for share in look.laid.share.tolist():
        measured = not math.isnan(share)
        colours.append(next(c for limit, c in SHARE_COLOURS if share < limit) if measured else "#999")
        titles.append(f"{percent(share, 0)} of the planned" if measured else "not seen")
    return _beads_picture(places, widths, colours, titles, path, "beads by how much lies there")


def flow_picture(flow: FlowShares, below: Stations, path: Path) -> str:
    """Stretches of the next layer from above, by the flow that each gets, as SVG; as wide as the beads below them."""
    places_on_path = np.linspace(flow.begin, flow.end, STATION_POINTS, axis=1)
    places = [np.interp(places_on_path, np.arange(len(path)), path.surface_from_nozzle[:, k, 3]) for k in range(2)]
    colours = [next(c for limit, c in FLOW_COLOURS if share < limit) for share in flow.share.tolist()]
    titles = [f"{percent(share, 0)} of the planned flow" for share in flow.share.tolist()]
    width = np.full(len(titles), np.median(below.width))
    return _beads_picture(np.stack(places, axis=-1), width, colours, titles, path, "the next layer by its flow")


def _beads_picture(
    places: Array, widths: Array, colours: Sequence[str], titles: Sequence[str], path: Path, label: str
) -> str:
    """Lines through places (S, K, 2) mm, `widths` (S,) mm wide."""
    low, high = path.zone[:, :2] + np.array([[-2.0], [2.0]])
    size, lines = (high - low) * PLOT_SCALE, []
    for place, width, colour, title in zip(places, widths * 0.85 * PLOT_SCALE, colours, titles, strict=True):
        x, y = ((place - low) * PLOT_SCALE).T
        line = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, size[1] - y, strict=True))
        lines.append(
            f'<path d="M{line}" stroke="{colour}" stroke-width="{width:.1f}" fill="none"><title>{title}</title></path>'
        )
    box = f'viewBox="0 0 {size[0]:.0f} {size[1]:.0f}" width="{min(size[0], 520):.0f}"'
    return f'<svg {box} role="img" aria-label="{label}">{"".join(lines)}</svg>'
