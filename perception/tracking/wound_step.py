"""The wound over time in each camera, segmented in parallel to the tracker; a tracking step for its region."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from estimation.mapping.refiner import DelayedJob
from estimation.pose import SurfacePose, identity_pose
from estimation.rig import Rig
from estimation.scans.registration import Registration
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from perception.frames import FrameSet, Image, Roi, of_whole_pictures, whole_pictures
from perception.tracking.step import STAGES, StepReport, TrackingStep, empty_report
from perception.wound.segmentation import (
    Box,
    Segmentation,
    Segmenter,
    WoundMask,
    box_of,
    centroid,
    hull_of,
    largest_part,
    polygon,
    region,
)

SAME_WOUND_OVERLAP = 0.3  # intersection over union of two boxes: a wound moves little between looks
MAX_MISSED_LOOKS = 3  # looks without it, after which a wound is dropped


@dataclass(frozen=True, slots=True, eq=False)
class WoundEstimate:
    """One camera's wound, filtered over time."""

    mask: WoundMask  # (H, W) of its largest part, when last detected
    box: Box | None  # of the mask; None: no wound
    roi: Box  # search region of the next look
    centroid: Array  # (2,) px
    confidence: float  # of the last look
    missed: int  # looks since the last detection


class WoundFilter:
    """Filters one camera's detections of the wound over time."""

    def __init__(self, size: tuple[int, int]) -> None:
        """size: (W, H) px of the camera's images."""
        self._size = size
        self._mask: WoundMask = np.zeros(size[::-1], bool)
        self._box: Box | None = None
        self._other_box: Box | None = None  # of the last look's detection
        self._missed_looks = 0

    def take(self, look: Segmentation) -> WoundEstimate:
        """Add one look. A jump is accepted when the second look confirms it; a missed wound is kept for
        MAX_MISSED_LOOKS; the region contains the current and the last box (thesis Fig. 3.4)."""
        last_box = self._box
        mask = largest_part(look.mask)
        box = box_of(mask)
        places = [place for place in (last_box, self._other_box) if place is not None]
        if box is None or (last_box is not None and all(overlap(box, place) <= SAME_WOUND_OVERLAP for place in places)):
            self._missed_looks += 1
            if self._missed_looks > MAX_MISSED_LOOKS:
                self._box, self._mask = None, np.zeros_like(self._mask)
        else:
            self._box, self._mask, self._missed_looks = box, mask, 0
        self._other_box = box
        roi = region(None if self._missed_looks else self._box, last_box, self._size)
        return WoundEstimate(self._mask, self._box, roi, centroid(self._mask), look.confidence, self._missed_looks)


def overlap(a: Box, b: Box) -> float:
    """Area of two boxes' intersection over that of their union."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    intersection = max(0, width) * max(0, height)
    return intersection / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - intersection)


SEGMENTATION_DELAY_SETS = 3  # until a result is used: three cameras take 60 ms of one core, a frame set 33 ms


class AsyncSegmentation:
    """Segments pictures in parallel to the tracker.

    A result is used a fixed number of frame sets after its pictures, even if it was ready before: replays are
    deterministic. Pictures that arrive during a job are skipped; the next job takes the newest.
    """

    def __init__(
        self, rig: Rig, segmenter: Segmenter, executor: Executor | None = None, delay: int = SEGMENTATION_DELAY_SETS
    ) -> None:
        """executor: one thread (onnxruntime releases the GIL); without one the work is done when due."""
        self._segmenter = segmenter
        self._filters = [WoundFilter(camera.size) for camera in rig.cameras]
        self._job: DelayedJob[dict[int, Segmentation]] = DelayedJob(executor, delay)
        self.job_frames: FrameSet | None = None  # pictures of the last job

    def __call__(self, frames: FrameSet) -> tuple[float, dict[int, WoundEstimate]] | None:
        """Once a frame set: the due result, as the pictures' stamp, s, and each camera's wound; None: none is due."""
        looks, result = self._job.poll(), None
        if looks is not None and self.job_frames is not None:
            result = self.job_frames.stamp, {camera: self._filters[camera].take(look) for camera, look in looks.items()}
        if not self._job.busy and frames.frames:
            self.job_frames = frames
            self._job.submit(segment_all, self._segmenter, {f.camera: f.image for f in frames.frames})
        return result


def segment_all(segmenter: Segmenter, images: Mapping[int, Image]) -> dict[int, Segmentation]:
    """Each camera's picture, segmented one after another."""
    return {camera: segmenter(image) for camera, image in images.items()}


MAX_EMPTY_LOOKS = 2  # without a wound in two cameras, after which whole pictures are the region
MAX_PARTIAL_LOOKS = 5  # at a frame or patch not seen by all cameras: some may lack in the first frame sets
SKIN_MARGIN_SHARE = 0.6  # of the wound's box, on every side: the skin there moves with it and has more texture
EDGE_SHARE = 0.1  # by which a patch's outline is drawn in: what lies under it begins there, and does not move with it
WHOLE_PICTURES = "no region and no wound: whole pictures are tracked as one surface; better draw a region"
WOUND_SEARCH_TEXT, PATCH_SEARCH_TEXT = "the wound is being looked for", "the coloured frame is being looked for"


@dataclass(frozen=True, slots=True, eq=False)
class WoundSight:
    """The pictures from which the region was derived, and the wound's masks in them."""

    frames: FrameSet
    masks: Mapping[int, WoundMask]  # (H, W) by camera; cameras without a wound are left out


FindRegion = Callable[[FrameSet], Sequence[Roi] | str]  # the region, known since its stamp, or why there is none


class RegionSearch:
    """Searches for the region by a segmenter, once a frame set.

    sight: source of the region; None before, and for a frame or patch. source: its pictures; None before, and for whole
    pictures.
    """

    def __init__(self, rig: Rig, segmenter: Segmenter, executor: Executor | None = None, patch: bool = False) -> None:
        """executor: one thread, as `AsyncSegmentation` takes it.

        patch: the segmenter detects a printed frame or patch, whose outline is the region; the search waits for it.
        Else it detects a wound; the region includes skin around it, or whole pictures where there is no wound.
        """
        self._rig, self._patch = rig, patch
        self._segmentation = AsyncSegmentation(rig, segmenter, executor)
        self._looks = 0
        self.sight: WoundSight | None = None
        self.source: FrameSet | None = None

    def __call__(self, frames: FrameSet) -> Sequence[Roi] | str:
        """Each camera's region, since the pictures that show it, once two cameras or more do; else the reason."""
        source = self._segmentation.job_frames  # pictures of the next result
        result = self._segmentation(frames)
        if result is None:
            return self._search_text
        self._looks += 1
        stamp, wounds = result
        count = sum(wound.box is not None for wound in wounds.values())
        enough = count == len(self._rig) or (count >= 2 and not (self._patch and self._looks < MAX_PARTIAL_LOOKS))
        if not enough and (self._patch or self._looks < MAX_EMPTY_LOOKS):
            return self._search_text
        if source is not None and not self._patch:
            self.sight = WoundSight(source, {c: wound.mask for c, wound in wounds.items() if wound.box is not None})
        if enough:
            self.source = source
            return self._rois(stamp, wounds)
        return whole_pictures([camera.size for camera in self._rig.cameras], frames.stamp)

    @property
    def _search_text(self) -> str:
        return PATCH_SEARCH_TEXT if self._patch else WOUND_SEARCH_TEXT

    def _rois(self, stamp: float, wounds: dict[int, WoundEstimate]) -> Sequence[Roi]:
        """Regions around each camera's wound, or whole pictures without one; or the patch's outlines."""
        if self._patch:
            hulls = {c: hull_of(wound.mask) for c, wound in wounds.items() if wound.box is not None}
            return [Roi(c, stamp, (1 - EDGE_SHARE) * hull + EDGE_SHARE * hull.mean(0)) for c, hull in hulls.items()]
        rois = []
        for camera, wound in wounds.items():
            size = self._rig.cameras[camera].size
            side = 0 if wound.box is None else max(wound.box[2] - wound.box[0], wound.box[3] - wound.box[1])
            shape = polygon(region(wound.box, None, size, SKIN_MARGIN_SHARE * side))
            rois.append(Roi(camera, stamp, shape, found=True))
        return rois


class RegionTrackingStep:
    """TrackingStep that begins once the region is known."""

    last: StepReport

    def __init__(self, rig: Rig, make_step: Callable[[Sequence[Roi]], TrackingStep], find: FindRegion) -> None:
        """make_step: the step for a region. find: called with each frame set until it returns the region."""
        self._rig, self._make_step, self._find = rig, make_step, find
        self._step: TrackingStep | None = None
        self._caveat = ""  # reason of poses without another one

    def __call__(self, frames: FrameSet) -> SurfacePose:
        """The pose at `frames.stamp`; INITIALISING until there is a region."""
        if self._step is None:
            regions = self._find(frames)
            if isinstance(regions, str):
                self.last = empty_report(frames.stamp, len(self._rig), np.zeros(len(STAGES)))
                return identity_pose(frames.stamp, regions)
            self._step = self._make_step(regions)
            whole = of_whole_pictures(regions, [camera.size for camera in self._rig.cameras])
            self._caveat = WHOLE_PICTURES if whole else ""
            source = self._find.source if isinstance(self._find, RegionSearch) else None
            if source is not None:  # there the region is known; the surface may have left it since
                self._step(source)
        pose = self._step(frames)
        self.last = self._step.last
        return pose if pose.reason else replace(pose, reason=self._caveat)

    @property
    def map(self) -> SurfaceMap | None:
        """The map as it is now, in the surface frame; None before there is one."""
        return None if self._step is None else self._step.map

    @property
    def late(self) -> int:
        """As `TrackingStep.late`."""
        return 0 if self._step is None else self._step.late

    @property
    def window_graph(self) -> str:
        """The factor graph of the last poses in Graphviz's language; '' before the region is known."""
        return "" if self._step is None else self._step.window_graph

    @property
    def registration(self) -> Registration | None:
        """Pose of the scan by the pictures that confirmed the first map; None before, and without a scan."""
        return None if self._step is None else self._step.registration

    @property
    def roi(self) -> tuple[Roi, ...]:
        """The region of the surface at the start; empty before there is one."""
        return () if self._step is None else self._step.roi

    @property
    def sight(self) -> WoundSight | None:
        """The network's result from which the region was derived; None before, and without a network."""
        return self._find.sight if isinstance(self._find, RegionSearch) else None

    def idle(self) -> None:
        """As `TrackingStep.idle`."""
        if self._step is not None:
            self._step.idle()
