"""Landmarks are found again where the tracks do not have them: right, before they joined, and where all were lost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from estimation import se3, smooth
from estimation.batch.smoothed import Smoothed
from estimation.observations import Observations, no_observations
from estimation.se3 import Array
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.offline.smooth_tracks import Relinked, with_looks
from hardware.report.evaluation import best_constant
from hardware.simulator.scene.scene import rois
from hardware.smoothing.tracks import Tracks
from perception.features import grey
from perception.frames import FrameSet
from perception.known_motion import KnownMotion
from perception.lens import Lenses
from perception.mapping.first_map import FirstMap, build_first_map
from perception.matching.matcher import Matcher
from perception.matching.patches import pyramid
from perception.tracking.reobservation import References, Relinker
from tests.synthetic import WIDE, frame_sets, patch

RIG = arc_rig(size=(320, 240), focal=560.0)
SCENE = patch(2, (80.0, 60.0), np.inf, WIDE)
STAMPS = np.arange(16) / 10
BEFORE, JOINED = 2, 8  # frame sets that nobody tracked at first, and from which on half of the landmarks are
LOST = (11, 12)  # frame sets in which nothing was seen


def moving(stamp: float) -> Array:
    return REST @ se3.exp([0.02 * np.sin(stamp), 0.03 * stamp, 0, 12 * stamp - 8, 0, 1.5 * np.sin(2 * stamp)])


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Frame sets, all looks at the landmarks of their map, and what a run might have had of them. before: smoothed."""

    sets: list[FrameSet]
    whole: list[Observations]
    tracks: Tracks
    before: Smoothed

    def relinked(self, sets: list[FrameSet]) -> Relinked:
        motion = KnownMotion(RIG, self.before, self.tracks.observations)
        references = References(motion)
        for frames in self.sets:
            if frames.stamp in references.stamps:
                references.cut(frames)
        cut = references.matcher()
        assert cut is not None
        relinker = Relinker(motion, *cut)
        found = [seen for frames in sets for seen in relinker(frames)]
        return with_looks(self.tracks, map(relinker.told, found))


@pytest.fixture(scope="module")
def case() -> Case:
    sets = list(frame_sets(SCENE, RIG, moving, STAMPS, np.random.default_rng(0)))
    lenses = Lenses(RIG)
    pyramids = [{f.camera: pyramid(grey(f.image)) for f in frames.frames} for frames in sets]
    polygons = {roi.camera: roi.polygon for roi in rois(SCENE, RIG, moving(0.0), 0.0)}
    first = build_first_map(lenses, pyramids[0], polygons)
    assert isinstance(first, FirstMap)
    matcher = Matcher(lenses, first.map, first.templates)
    whole = []
    for frames, images in zip(sets, pyramids, strict=True):
        moved = moving(frames.stamp) @ se3.inverse(moving(0.0)) @ first.base_from_surface
        whole.append(matcher.align(frames.stamp, images, dict.fromkeys(images, moved), coarse=True))
    tracks = Tracks(tuple(had(seen, k) for k, seen in enumerate(whole) if k >= BEFORE), ())
    return Case(sets, whole, tracks, smooth(RIG, tracks.observations))


def had(seen: Observations, k: int) -> Observations:
    """What was tracked of a frame set."""
    return no_observations(seen.stamp) if k in LOST else seen.only((seen.track % 2 == 0) | (k >= JOINED))


@pytest.fixture(scope="module")
def found(case: Case) -> Relinked:
    return case.relinked(case.sets)


def looks(observations: Iterable[Observations]) -> dict[tuple[float, int, int], Array]:
    """Pixels by stamp, camera and track."""
    return {
        (seen.stamp, int(c), int(t)): pixel
        for seen in observations
        for c, t, pixel in zip(seen.camera, seen.track, seen.pixels, strict=True)
    }


def test_what_was_not_tracked_is_found_and_where_it_is(case: Case, found: Relinked) -> None:
    known, there, all_ = (looks(o) for o in (case.tracks.observations, found.tracks.observations, case.whole))
    missing = all_.keys() - known.keys()
    assert found.looks == len(there) - len(known) and found.sets == BEFORE + len(LOST)
    again = [key for key in missing if key in there]
    assert len(again) > 0.95 * len(missing)
    off = [np.linalg.norm(there[key] - all_[key]) for key in again]
    assert np.median(off) < 0.1 and np.percentile(off, 99) < 1.0  # px


def test_late_landmarks_have_early_looks(case: Case, found: Relinked) -> None:
    late = [key for key in looks(found.tracks.observations) if key[2] % 2 and key[0] < STAMPS[JOINED]]
    assert found.early >= len(late) > 0.95 * sum(key[2] % 2 and key[0] < STAMPS[JOINED] for key in looks(case.whole))


def test_what_was_seen_stays_as_it_is(case: Case, found: Relinked) -> None:
    known, there = looks(case.tracks.observations), looks(found.tracks.observations)
    assert all((there[key] == pixel).all() for key, pixel in known.items())


def test_the_error_does_not_grow(case: Case, found: Relinked) -> None:
    after = smooth(RIG, found.tracks.observations)
    assert len(after) == len(STAMPS) > len(case.before)
    before, now, all_ = errors(case.before), errors(after), np.abs(STAMPS[:, None] - case.before.stamps).min(1) < 1e-6
    assert np.sqrt((now[all_] ** 2).mean()) < np.sqrt((before**2).mean())
    assert now.max() < 0.1  # mm, of the frame sets that nobody tracked, too


def errors(smoothed: Smoothed) -> Array:
    """Distances (K,) from the truth, mm, after the constant that fits best."""
    truth, poses = np.stack([moving(t) for t in smoothed.stamps]), smoothed.states.poses
    constant = best_constant(se3.inverse(truth) @ poses)
    return np.asarray(np.linalg.norm(poses[:, :3, 3] - (truth @ constant)[:, :3, 3], axis=1))


def test_another_surface_in_the_pictures_is_not_taken_for_this_one(case: Case) -> None:
    other, blank = patch(3, (80.0, 60.0), np.inf, WIDE), (*range(BEFORE), *LOST)
    others = frame_sets(other, RIG, moving, STAMPS[list(blank)], np.random.default_rng(1))
    sets = dict(enumerate(case.sets)) | dict(zip(blank, others, strict=True))
    found = case.relinked([sets[k] for k in sorted(sets)])
    assert found.sets == 0 < found.looks


def test_a_picture_that_is_repeated_tells_nothing(case: Case) -> None:
    frozen = case.sets[3].frames
    sets = [case.sets[3], *(replace(frames, frames=frozen) for frames in case.sets[4:8])]
    once = case.relinked(sets[:1])
    assert case.relinked(sets).looks == once.looks > 0


def test_pictures_that_a_live_run_paired_otherwise_are_left_alone(case: Case) -> None:
    moved = [replace(frames, stamp=frames.stamp + 0.003) for frames in case.sets[3:6]]
    assert case.relinked(moved).looks == 0
