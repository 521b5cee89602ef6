"""The judge: a session is given to the tracker as `stillbed track` does it, and each pose is held against the truth.

Silently wrong is a frame set whose pose may be printed on (TRACKING, or DEGRADED within the guard's limit) and where at
some place of the wound the error is above 1 mm and above three times the radius that the pose claims to hold it in 95
of 100 cases. The first pose given as TRACKING places the path, so errors are relative to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields

import cv2
import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from hardware.offline.track import FrameSetStep, _network_segmenter
from hardware.process.clock import WallClock
from perception.frames import FrameSet
from perception.tracking.step import TrackingStep
from perception.tracking.wound_step import RegionSearch, RegionTrackingStep
from planning.command import MotionLimits
from tests.campaigns.deceit.kinds import make_session
from tests.campaigns.deceit.scenes import Session
from tests.campaigns.deceit.world import Renderer

WRONG_MM, WRONG_RATIO, SHARE = 1.0, 3.0, 0.95  # issue's words: off by > 1 mm and > 3 times the claimed 95 % radius
RISEN_MM = 2.0  # of the wound alone, from which it has to be told
GUARD_MM = next(f.default for f in fields(MotionLimits) if f.name == "pose_error")  # one sigma: above it nothing moves
LETTERS = {"INITIALISING": "i", "TRACKING": "T", "DEGRADED": "d", "COASTING": "c", "LOST": "L"}


@dataclass(frozen=True, slots=True, eq=False)
class SetVerdict:
    """What one frame set's pose claims, and what is true, at the place where it is worst."""

    state: str
    printed: bool  # whether the guard would let the needle move on it
    error: float  # mm; inf where the mapped tissue is gone
    claim: float  # mm, radius at SHARE
    wrong: bool
    covered: bool  # whether the claim holds the error everywhere, or nothing is printed
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What came of one session."""

    kind: str
    index: int
    seed: int
    what: str  # the session's parameters, in words
    decidable: bool
    honest: bool
    sets: tuple[SetVerdict, ...]
    first: int  # number of the first set that is TRACKING; the sessions' length where there is none
    again: int  # sets after the trick's end until one is TRACKING and right; -1: none is; -2: no such end
    told: int  # sets from a rise of 2 mm until the claim covers it or nothing is printed; -1: never; -2: no rise

    @property
    def wrong(self) -> int:
        """Silently wrong frame sets."""
        return sum(s.wrong for s in self.sets)

    @property
    def worst(self) -> SetVerdict | None:
        """The frame set that is most wrong; else, of those printed on, the one with the largest error."""
        printed = [s for s in self.sets if s.wrong] or [s for s in self.sets if s.printed]
        return max(printed, key=lambda s: s.error, default=None)

    @property
    def tracking(self) -> float:
        """Share of the frame sets from the first TRACKING one on that are TRACKING."""
        after = self.sets[self.first :]
        return sum(s.state == "TRACKING" for s in after) / len(after) if after else 0.0

    @property
    def followed(self) -> float:
        """Share of the frame sets from the first TRACKING one on that are measured."""
        after = self.sets[self.first :]
        return sum(s.state in ("TRACKING", "DEGRADED") for s in after) / len(after) if after else 0.0

    @property
    def states(self) -> str:
        """A letter a set, upper case W or D where it is silently wrong."""
        return "".join(
            ("W" if s.state == "TRACKING" else "D") if s.wrong else LETTERS.get(s.state, s.state[0].lower())
            for s in self.sets
        )

    @property
    def reasons(self) -> str:
        """The reasons given, the most frequent first."""
        seen = Counter(s.reason for s in self.sets if s.reason)
        return "; ".join(f"{text} ({count})" for text, count in seen.most_common(6))


def claims(pose: SurfacePose, points_surface: Array) -> tuple[Array, Array]:
    """What a pose claims of points (N, 3), surface frame: radius at SHARE (N,), and the guard's one sigma (N,), mm."""
    return pose.radius_at(points_surface, SHARE), pose.error_at(points_surface)


def places(pose: SurfacePose, points_surface: Array) -> Array:
    """Where a pose says that points (N, 3), surface frame, are: (N, 3) mm, base frame."""
    points = points_surface if pose.warp is None else pose.warp.apply(points_surface)
    return np.asarray(se3.transform_points(pose.base_from_surface, points))


class Judge:
    """Holds poses, in order, against a session's truth; the first TRACKING pose places the path."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._path: Array | None = None  # (N, 3) the judged places, in the tracker's surface frame

    def __call__(self, pose: SurfacePose) -> SetVerdict:
        """The verdict on the pose of the next frame set."""
        state = pose.state
        if self._path is None and state is TrackState.TRACKING:
            self._path = se3.transform_points(se3.inverse(pose.base_from_surface), self.session.truth(pose.stamp))
            if pose.warp is not None:
                self._path = pose.warp.undo(self._path)
        if self._path is None or not state.measured:
            return SetVerdict(state.name, False, np.nan, np.nan, False, True, pose.reason)
        radii, sigmas = claims(pose, self._path)
        printed = (sigmas <= GUARD_MM) | (state is TrackState.TRACKING)
        error = np.full(len(radii), np.inf)
        if pose.stamp < self.session.gone:
            error = np.linalg.norm(places(pose, self._path) - self.session.truth(pose.stamp), axis=-1)
        wrong = printed & (error > WRONG_MM) & (error > WRONG_RATIO * radii)
        held = sigmas > GUARD_MM
        at = int(np.argmax(np.where(wrong, 1e6 + np.minimum(error, 1e5), np.minimum(error, 1e5))))
        covered = bool((held | (error <= np.maximum(radii, 0.0))).all())
        name = state.name
        return SetVerdict(name, bool(printed.any()), error[at], radii[at], bool(wrong.any()), covered, pose.reason)


def tracker(session: Session) -> FrameSetStep:
    """The tracker as `stillbed track` makes it, its map refined in `idle`."""
    if session.roi:
        return TrackingStep(session.told, session.roi)
    search = RegionSearch(session.told, _network_segmenter(None))
    return RegionTrackingStep(session.told, lambda roi: TrackingStep(session.told, roi), search)


def frame_sets(session: Session) -> Iterator[FrameSet]:
    """The session's pictures, made one set after another."""
    renderer = Renderer(session.world)
    for number, stamp in enumerate(session.stamps):
        yield renderer.frame_set(number, stamp)


def run(session: Session) -> Verdict:
    """Track and judge a session."""
    step, judge, sets = tracker(session), Judge(session), list[SetVerdict]()
    for frames in frame_sets(session):
        sets.append(judge(step(frames)))
        step.idle()
    return _verdict(session, sets)


def run_one(seed: int, size: tuple[int, int], index: int) -> tuple[Verdict, float]:
    """One session of a campaign, and the seconds that it took."""
    cv2.setNumThreads(1)  # sessions run beside each other
    clock = WallClock()
    start = clock.now()
    verdict = run(make_session(seed, index, size))
    return verdict, clock.now() - start


def _verdict(session: Session, sets: list[SetVerdict]) -> Verdict:
    first = next((i for i, s in enumerate(sets) if s.state == "TRACKING"), len(sets))
    settled = int(np.searchsorted(session.stamps, session.settled))
    fine = [i for i, s in enumerate(sets) if i >= max(first, settled) and s.state == "TRACKING" and not s.wrong]
    again = -2 if session.settled < 0 else fine[0] - settled if fine else -1
    risen = [i for i, t in enumerate(session.stamps) if session.world.relief.rise(t) >= RISEN_MM]
    told = -2
    if risen and first < risen[0]:
        told = next((i - risen[0] for i in risen if sets[i].covered), -1)
    known = session.kind, session.index, session.seed, session.what, session.decidable == "", session.honest
    return Verdict(*known, tuple(sets), first, again, told)
