"""A stretch of tracking with one outage after the other, and what the tracker said and did in each frame set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.bodies import Wound, with_wound
from hardware.simulator.look import Look
from hardware.simulator.outage import LONGEST, Kind, Outage, Spoiler, draw_outage
from hardware.simulator.picture_loop import PictureLoop, closed_motion
from hardware.simulator.scene.scene import Scene, rois
from hardware.simulator.scene.shape import cylinder
from perception.frames import Frame, FrameSet, Image
from perception.tracking.step import TrackingStep

FPS = 30.0
PERIOD = 96  # frame sets of the motion's loop: a breath of 3.2 s
WOUND = Wound((40.0, 28.0))
EXTENT = np.array([[x, y, 0.0] for x in (-24.0, 0.0, 24.0) for y in (-17.0, 0.0, 17.0)])  # mm, around the wound
JUDGED = np.array([[0, 0, 0], [15.0, 0, 0], [-15.0, 0, 0], [0, 10.0, 0], [0, -10.0, 0]])  # mm: where prints are laid
WITHIN = 2.8  # 95 % of a normal error in space lie within so many standard deviations
START, CALM, REST_AFTER = 1.5, 0.5, 0.7  # s before the first outage, before each, and watched after each
JUMPS = 0.3  # of the outages in which nobody sees the surface it goes elsewhere meanwhile
ELSEWHERE = se3.exp(np.array([0.08, -0.06, 0.2, 12.0, -9.0, 6.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """What all stretches of one scene look at. near, far: loops of the motion at two places; rest: (4, 4)."""

    rig: Rig
    scene: Scene
    near: PictureLoop
    far: PictureLoop


def make_pictures(
    seed: int, period: int = PERIOD, size: tuple[int, int] = (640, 360), focal: float = 560.0
) -> Pictures:
    """Render the loops of one scene, some 20 s for the default."""
    rig, scene, near = looped(seed, period, size, focal)
    return Pictures(rig, scene, near, PictureLoop(scene, rig, near.poses @ ELSEWHERE, seed + 1))


def looped(
    seed: int, period: int = PERIOD, size: tuple[int, int] = (640, 360), focal: float = 560.0
) -> tuple[Rig, Scene, PictureLoop]:
    """Cameras, a scene, and the loop of its pictures at the nearer place: `period` frame sets."""
    rng = np.random.default_rng([seed, 61])
    rig = arc_rig(size=size, focal=focal)
    shape = with_wound(cylinder((80.0, 60.0), float(rng.uniform(50, 120))), WOUND, seed)
    scene = Scene(shape, Look(texel=0.2, wetness=0.3, drape=False), seed=seed)
    poses = closed_motion(period, REST, rng, lively=period / PERIOD)  # at one speed, however short the loop
    return rig, scene, PictureLoop(scene, rig, poses, seed)


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """Frame sets of one outage, from the calm before it to the rest after it.

    stamps: (K,) s. error: (K,) mm, the largest of the judged points. radius: (K,) mm, within which 95 % of the errors
    there are claimed to lie. states, reasons: K each. used: (K, C) tracks that carry the pose. jumped: whether the
    surface came back elsewhere.
    """

    outage: Outage
    stamps: Array
    error: Array
    radius: Array
    states: tuple[TrackState, ...]
    reasons: tuple[str, ...]
    used: NDArray[np.int64]
    jumped: bool


class Stretch:
    """One tracker, driven over the loop of pictures."""

    def __init__(self, pictures: Pictures, seed: int, step: Callable[[Pictures], TrackingStep] | None = None) -> None:
        self._rng = np.random.default_rng([seed, 67])
        self._pictures = pictures
        self._loop, self._at = pictures.near, int(self._rng.integers(len(pictures.near)))
        self._count = 0
        self._spoiler = Spoiler(pictures.rig, EXTENT)
        self._last: list[Image] = []
        roi = rois(pictures.scene, pictures.rig, self._loop.poses[self._at % len(self._loop)], 0.0)
        self._step = TrackingStep(pictures.rig, roi) if step is None else step(pictures)
        self._constant: Array | None = None
        self._rows: list[tuple[float, float, float, TrackState, str, NDArray[np.int64]]] = []

    def begin(self) -> bool:
        """Start up; whether the tracker then tracks. What stands between the two surface frames is taken here."""
        offsets = []
        for _ in range(round(START * FPS)):
            truth, pose = self._frame(None)
            if pose.state is TrackState.TRACKING:
                offsets.append(se3.inverse(truth) @ pose.base_from_surface)
        if len(offsets) < START * FPS / 2:
            return False
        middle = offsets[len(offsets) // 2]
        self._constant = middle @ se3.exp(se3.log(se3.inverse(middle) @ np.stack(offsets)).mean(0))
        self._rows.clear()
        return True

    def outage(self, kind: Kind, longest: float = LONGEST) -> Watched:
        """Calm, one outage of `longest` s at most, and the rest after it."""
        self._rows.clear()
        for _ in range(round(CALM * FPS)):
            self._frame(None)
        outage = draw_outage(kind, self._pictures.rig, self._count / FPS, self._rng, longest)
        hidden = len(outage.cameras) == len(self._pictures.rig) and kind in (Kind.OCCLUDED, Kind.DEAD, Kind.BLACK)
        before, jumps = self._loop, hidden and outage.end - outage.start > 1.0 and self._rng.random() < JUMPS
        while self._count / FPS < outage.end - 1e-9:
            if jumps and self._count / FPS > outage.start + 0.5:
                jumps, self._loop = False, self._other()
            self._frame(outage)
        for _ in range(round(REST_AFTER * FPS)):
            self._frame(None)
        stamps, error, radius, states, reasons, used = zip(*self._rows, strict=True)
        return Watched(
            outage,
            np.array(stamps),
            np.array(error),
            np.array(radius),
            states,
            reasons,
            np.stack(used),
            self._loop is not before,
        )

    def _other(self) -> PictureLoop:
        return self._pictures.far if self._loop is self._pictures.near else self._pictures.near

    def _frame(self, outage: Outage | None) -> tuple[Array, SurfacePose]:
        """One frame set through the tracker; the true pose and the tracker's."""
        stamp, truth = self._count / FPS, self._loop.poses[self._at % len(self._loop)]
        images: list[Image | None] = list(self._loop.images(self._at))
        kept = list(self._last)
        if outage is not None:
            images = self._spoiler(outage, stamp, self._loop.images(self._at), kept, truth)
        frames = []
        for c, image in enumerate(images):
            if image is not None:
                same = bool(kept) and image is kept[c]
                noisy = image if same else self._loop.noisy(image)
                frames.append(Frame(c, stamp, noisy))
                if outage is None:
                    self._last = [*self._last[:c], noisy, *self._last[c + 1 :]]
        pose = self._step(FrameSet(stamp, tuple(frames)))
        self._step.idle()
        self._note(truth, pose)
        self._count, self._at = self._count + 1, self._at + 1
        return truth, pose

    def _note(self, truth: Array, pose: SurfacePose) -> None:
        error = radius = np.nan
        if self._constant is not None:
            expected = truth @ self._constant
            points = se3.transform_points(se3.inverse(self._constant), JUDGED)
            gap = se3.transform_points(pose.base_from_surface, points) - se3.transform_points(expected, points)
            error = float(np.linalg.norm(gap, axis=1).max())
            radius = WITHIN * float(pose.error_at(points).max())
        self._rows.append((pose.stamp, error, radius, pose.state, pose.reason, self._step.last.used.copy()))


def calm(watched: Watched, good: float) -> bool:
    """Whether the stretch may go on: the last frame sets are TRACKING and within `good` mm."""
    last = slice(-5, None)
    return all(s is TrackState.TRACKING for s in watched.states[last]) and float(watched.error[last].max()) < good


def run_stretch(pictures: Pictures, kinds: Sequence[Kind], seed: int, good: float) -> list[Watched]:
    """Outages of these kinds in this order; where one is not recovered from, the tracker starts anew for the next."""
    done: list[Watched] = []
    stretch: Stretch | None = None
    for k, kind in enumerate(kinds):
        if stretch is None:
            stretch = Stretch(pictures, seed + 1000 * k)
            if not stretch.begin():
                raise RuntimeError(f"no start in scene of seed {seed}")
        done.append(stretch.outage(kind))
        if not calm(done[-1], good):
            stretch = None
    return done
