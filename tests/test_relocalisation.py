"""Finding the surface again anywhere in the image, not where it is not; landmarks found beside the tracks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from estimation import se3, smooth
from estimation.batch.smoothed import Smoothed
from estimation.observations import Observations, no_observations
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.offline.smooth_tracks import ReobservedTracks, SessionTracks, with_looks
from hardware.report.evaluation import best_constant
from hardware.simulator.scene.scene import Scene, rois
from perception.frames import FrameSet, Image
from perception.lens import Lenses
from perception.mapping.features import Relocaliser, grey
from perception.mapping.first_map import FirstMap, build_first_map
from perception.mapping.matcher import Matcher
from perception.mapping.patches import Pyramid
from perception.tracking.reobservation import KnownMotion, ReferencePictures, Reobserver
from tests.rendered_sets import AWAY, WIDE, frame_sets, patch, pictures
from tests.slow_cases import slowly

RIG = arc_rig()
SCENE = patch(1, wound=WIDE)
FLAT = SCENE.shape.grid(6.0, 0.8)
MAP = SurfaceMap(SCENE.shape.points(FLAT), SCENE.shape.normals(FLAT), np.zeros((3 * len(FLAT),) * 2))


def look(pose: Array, scene: Scene = SCENE, seed: int = 0) -> dict[int, tuple[Image, Image]]:
    images = pictures(scene, RIG.cameras, pose, np.random.default_rng(seed))
    return {c: Pyramid(grey(image)) for c, image in enumerate(images)}


def learned(cameras: Rig = RIG) -> Relocaliser:
    search = Relocaliser(Lenses(cameras))
    for camera, images in look(BASE_FROM_REST).items():
        search.learn(camera, images[0], BASE_FROM_REST, MAP)
    return search


@pytest.fixture(scope="module")
def search() -> Relocaliser:
    return learned()


def off(found: Array, pose: Array) -> tuple[float, float]:
    """Error in mm and degrees."""
    change = se3.inverse(found) @ pose
    return float(np.linalg.norm(change[:3, 3])), float(np.degrees(se3.angle_of(change)))


@pytest.mark.parametrize(
    "motion",
    [
        np.zeros(6),
        np.array([0, 0, 0.5, 40.0, -25.0, 10.0]),
        np.array([0.3, -0.2, 0, -30.0, 20.0, -40.0]),
        np.array([0, 0, np.pi / 2, 0, 30.0, 20.0]),
    ],
)
def test_the_surface_is_found_wherever_it_went(search: Relocaliser, motion: Array) -> None:
    pose = BASE_FROM_REST @ se3.exp(motion)
    found = search.find(look(pose, seed=1))
    assert found is not None and found.matches > 30
    mm, degrees = off(found.base_from_surface, pose)
    assert mm < 1.0 and degrees < 1.5  # a start for the alignment, which reaches 5 px or 2 mm


@pytest.mark.parametrize("camera", [0, *slowly(1, 2)])
def test_one_camera_is_enough_for_a_start(search: Relocaliser, camera: int) -> None:
    pose = BASE_FROM_REST @ se3.exp(np.array([0, 0, 0.4, 20.0, -15.0, 5.0]))
    found = search.find({camera: look(pose, seed=2)[camera]})
    assert found is not None and set(found.single) <= {camera}
    mm, degrees = off(found.base_from_surface, pose)
    assert mm < 4.0 and degrees < 5.0


def test_each_camera_finds_its_own_instant(search: Relocaliser) -> None:
    """Camera 2 was exposed when the surface was 15 mm further on."""
    here, there = BASE_FROM_REST, BASE_FROM_REST @ se3.exp(np.array([0, 0, 0, 15.0, 0, 0]))
    found = search.find({**look(here, seed=3), 2: look(there, seed=3)[2]})
    assert found is not None and set(found.single) == {0, 1, 2}
    for camera, pose in [(0, here), (1, here), (2, there)]:
        assert off(found.single[camera], pose)[0] < 4.0


def test_neither_the_room_nor_another_surface_is_this_one(search: Relocaliser) -> None:
    assert search.find(look(AWAY)) is None and search.find(look(BASE_FROM_REST, patch(7, wound=WIDE))) is None


@pytest.mark.parametrize("level", [0, 128])
def test_nothing_is_found_in_even_images(search: Relocaliser, level: int) -> None:
    blank = Pyramid(np.full((720, 1280), level, np.uint8))
    assert search.find(dict.fromkeys(range(3), blank)) is None and search.find({}) is None


def test_a_blind_camera_does_not_hide_what_the_others_see(search: Relocaliser) -> None:
    images = {**look(BASE_FROM_REST, seed=4), 1: Pyramid(np.zeros((720, 1280), np.uint8))}
    found = search.find(images)
    assert found is not None and 1 not in found.single and off(found.base_from_surface, BASE_FROM_REST)[0] < 1.5


def test_before_anything_is_learned_nothing_is_found_and_a_surface_out_of_view_teaches_nothing() -> None:
    search, seen = Relocaliser(Lenses(RIG)), look(BASE_FROM_REST)
    assert search.find(seen) is None
    search.learn(0, seen[0][0], BASE_FROM_REST @ se3.exp(np.array([0, 0, 0, 2000.0, 0, 0])), MAP)
    assert search.find(seen) is None


def test_two_runs_give_the_same_bits(search: Relocaliser) -> None:
    pose = BASE_FROM_REST @ se3.exp(np.array([0, 0, 0.3, 10.0, 0, 0]))
    a, b = search.find(look(pose)), learned().find(look(pose))
    assert a is not None and b is not None and a.base_from_surface.tobytes() == b.base_from_surface.tobytes()


RELINKING_RIG = arc_rig(size=(320, 240), focal=560.0)
RELINKING_SCENE = patch(2, (80.0, 60.0), np.inf, WIDE)
STAMPS = np.arange(16) / 10
BEFORE, JOINED = 2, 8  # frame sets that nobody tracked at first, and from which on half of the landmarks are
LOST = (11, 12)  # frame sets in which nothing was seen


def moving(stamp: float) -> Array:
    return BASE_FROM_REST @ se3.exp([0.02 * np.sin(stamp), 0.03 * stamp, 0, 12 * stamp - 8, 0, 1.5 * np.sin(2 * stamp)])


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Frame sets, all looks at the landmarks of their map, and what a run might have had of them. before: smoothed."""

    sets: list[FrameSet]
    whole: list[Observations]
    tracks: SessionTracks
    before: Smoothed

    def relinked(self, sets: list[FrameSet]) -> ReobservedTracks:
        motion = KnownMotion(RELINKING_RIG, self.before, self.tracks.observations)
        references = ReferencePictures(motion)
        for frames in self.sets:
            if frames.stamp in references.stamps:
                references.cut(frames)
        cut = references.matcher()
        relinker = Reobserver(motion, *cut)
        found = [seen for frames in sets for seen in relinker(frames)]
        return with_looks(self.tracks, map(relinker.as_tracks, found))


@pytest.fixture(scope="module")
def case() -> Case:
    sets = list(frame_sets(RELINKING_SCENE, RELINKING_RIG, moving, STAMPS, np.random.default_rng(0)))
    lenses = Lenses(RELINKING_RIG)
    pyramids = [{f.camera: Pyramid(grey(f.image)) for f in frames.frames} for frames in sets]
    polygons = {roi.camera: roi.polygon for roi in rois(RELINKING_SCENE, RELINKING_RIG, moving(0.0), 0.0)}
    first = build_first_map(lenses, pyramids[0], polygons)
    assert isinstance(first, FirstMap)
    matcher = Matcher(lenses, first.map, first.templates)
    whole = []
    for frames, images in zip(sets, pyramids, strict=True):
        moved = moving(frames.stamp) @ se3.inverse(moving(0.0)) @ first.base_from_surface
        whole.append(matcher.align(frames.stamp, images, dict.fromkeys(images, moved), coarse=True))
    tracks = SessionTracks(tuple(had(seen, k) for k, seen in enumerate(whole) if k >= BEFORE), ())
    return Case(sets, whole, tracks, smooth(RELINKING_RIG, tracks.observations))


def had(seen: Observations, k: int) -> Observations:
    """What was tracked of a frame set."""
    return no_observations(seen.stamp) if k in LOST else seen.select((seen.track % 2 == 0) | (k >= JOINED))


@pytest.fixture(scope="module")
def found(case: Case) -> ReobservedTracks:
    return case.relinked(case.sets)


def looks(observations: Iterable[Observations]) -> dict[tuple[float, int, int], Array]:
    """Pixels by stamp, camera and track."""
    return {
        (seen.stamp, int(c), int(t)): pixel
        for seen in observations
        for c, t, pixel in zip(seen.camera, seen.track, seen.pixels, strict=True)
    }


def test_what_was_not_tracked_is_found_and_where_it_is(case: Case, found: ReobservedTracks) -> None:
    known, there, all_ = (looks(o) for o in (case.tracks.observations, found.tracks.observations, case.whole))
    missing = all_.keys() - known.keys()
    assert found.looks == len(there) - len(known) and found.sets == BEFORE + len(LOST)
    again = [key for key in missing if key in there]
    assert len(again) > 0.95 * len(missing)
    off = [np.linalg.norm(there[key] - all_[key]) for key in again]
    assert np.median(off) < 0.1 and np.percentile(off, 99) < 1.0  # px


def test_late_landmarks_have_early_looks(case: Case, found: ReobservedTracks) -> None:
    late = [key for key in looks(found.tracks.observations) if key[2] % 2 and key[0] < STAMPS[JOINED]]
    assert found.early >= len(late) > 0.95 * sum(key[2] % 2 and key[0] < STAMPS[JOINED] for key in looks(case.whole))


def test_what_was_seen_stays_as_it_is(case: Case, found: ReobservedTracks) -> None:
    known, there = looks(case.tracks.observations), looks(found.tracks.observations)
    assert all((there[key] == pixel).all() for key, pixel in known.items())


def test_the_error_does_not_grow(case: Case, found: ReobservedTracks) -> None:
    after = smooth(RELINKING_RIG, found.tracks.observations)
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
    others = frame_sets(other, RELINKING_RIG, moving, STAMPS[list(blank)], np.random.default_rng(1))
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
