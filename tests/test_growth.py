"""The map grows where new parts of the surface come into view, by what is proven to move with it."""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from estimation import se3
from estimation.mapping.bundle_adjustment import AdjustedMap
from estimation.mapping.refiner import MIN_DELAY_SETS, DelayedJob, Refiner
from estimation.observations import no_observations
from estimation.online.surface_state import StateSettings
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.surface_map import SurfaceMap, merge_maps
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.simulator.scene.scene import rois
from hardware.simulator.scene.shape import Wound
from perception.frames import Frame, FrameSet
from perception.lens import Lenses
from perception.mapping.features import MAX_DESCRIPTORS, Relocaliser, grey
from perception.mapping.first_map import FirstMap, build_first_map
from perception.mapping.growth import NewLandmarks, Probation, SurfaceSnapshot, between_known
from perception.mapping.patches import Pyramid
from perception.tracking.step import TrackingStep
from tests.rendered_sets import frame_sets, patch, pictures

RIG = arc_rig(size=(320, 240), focal=560.0)  # 0.7 mm a pixel, 228 mm wide
LONG = patch(1, (320.0, 60.0), np.inf, Wound((310.0, 56.0)))
STAMPS = np.arange(36) / 10
FIRST = StateSettings().averaged_poses  # the pose that is given out first
SMALL = patch(2, (80.0, 60.0), np.inf, Wound((70.0, 54.0)))


def passing(stamp: float) -> Array:
    """A long patch passes by: of what is in view at first, nothing is in the end."""
    return BASE_FROM_REST @ se3.exp([0.02 * np.sin(stamp), 0, 0, 85 - 58 * stamp, 0, 1.5 * np.sin(2 * stamp)])


@cache
def passing_sets() -> tuple[FrameSet, ...]:
    return tuple(frame_sets(LONG, RIG, passing, STAMPS, np.random.default_rng(0)))


@cache
def passed() -> tuple[list[SurfacePose], list[SurfaceMap], TrackingStep]:
    """Poses and the map after each frame set."""
    step = TrackingStep(RIG, rois(LONG, RIG, passing(0.0), 0.0))
    poses, maps = [], []
    for frames in passing_sets():
        poses.append(step(frames))
        step.idle()
        maps.append(step.map)
    return poses, [m for m in maps if m is not None], step


@pytest.mark.slow
def test_a_surface_of_which_all_that_was_known_has_gone_is_still_followed() -> None:
    poses, maps, _ = passed()
    late = [p for p in poses[FIRST:] if p.state is not TrackState.TRACKING]
    assert len(late) <= 1  # while new landmarks are proven
    estimated_from_true = se3.inverse(poses[FIRST].base_from_surface) @ passing(poses[FIRST].stamp)
    off = [se3.inverse(passing(p.stamp)) @ p.base_from_surface @ estimated_from_true for p in poses[FIRST:]]
    assert max(np.linalg.norm(o[:3, 3]) for o in off) < 0.15
    ideal = se3.transform_points(poses[-1].base_from_surface, maps[0].points)[:, 0] - BASE_FROM_REST[0, 3]
    assert np.median(ideal) < -60  # the first map is mostly out of view


def test_rows_are_only_added_and_keep_their_meaning() -> None:
    _, maps, _ = passed()
    counts = [len(m) for m in maps]
    assert counts == sorted(counts) and counts[-1] > counts[0] + 50
    for before, after in pairwise(maps):
        assert np.linalg.norm(after.points[: len(before)] - before.points, axis=1).max() < 2.0
    hidden = maps[-1].points[: counts[0]]  # kept, and hardly moved by what was learned since
    assert np.median(np.linalg.norm(hidden - maps[3].points[: counts[0]], axis=1)) < 0.2


def test_what_was_added_lies_on_the_true_surface_as_claimed() -> None:
    poses, maps, _ = passed()
    last, new = maps[-1], slice(len(maps[0]), None)
    true_from_estimated = se3.inverse(passing(poses[FIRST].stamp)) @ poses[FIRST].base_from_surface
    points = se3.transform_points(true_from_estimated, last.points[new])
    blocks = np.einsum("ninj->nij", last.covariance.reshape(len(last), 3, len(last), 3))[new]
    claimed = np.sqrt(np.einsum("i,nij,j->n", true_from_estimated[2, :3], blocks, true_from_estimated[2, :3]))
    assert np.median(np.abs(points[:, 2])) < 0.2 and np.median(np.abs(points[:, 2])) < 3 * np.median(claimed)
    assert np.linalg.eigvalsh(last.covariance).min() > -1e-9


WIDE_RIG = arc_rig(size=(640, 480), focal=560.0)
LENSES = Lenses(WIDE_RIG)
MOVED = BASE_FROM_REST @ se3.exp([0.02, 0.01, 0.0, 8.0, 3.0, 2.0])


@cache
def images(moved: bool) -> dict[int, Pyramid]:
    taken = pictures(SMALL, WIDE_RIG.cameras, MOVED if moved else BASE_FROM_REST, np.random.default_rng(int(moved)))
    return {c: Pyramid(grey(i)) for c, i in enumerate(taken)}


@cache
def first() -> FirstMap:
    polygons = {roi.camera: roi.polygon for roi in rois(SMALL, WIDE_RIG, BASE_FROM_REST, 0.0)}
    found = build_first_map(LENSES, images(False), polygons)
    assert not isinstance(found, str)
    return found


def waiting(amid_others: bool = False) -> Probation:
    start = first().base_from_surface
    look = SurfaceSnapshot({}, start, dict.fromkeys(range(3), start), np.zeros((6, 6)), no_observations(0.0), {})
    count = len(first().map)
    level = np.full(count, np.inf)
    return Probation(NewLandmarks(look, first().map, first().templates, level, {}), np.full(count, amid_others))


def at(pose: Array) -> dict[int, Array]:
    """Where the surface is said to be when it is at `pose` in the scene's own terms, by camera."""
    return dict.fromkeys(range(3), pose @ se3.inverse(BASE_FROM_REST) @ first().base_from_surface)


def test_what_moves_with_the_surface_is_proven_at_once() -> None:
    new = waiting()
    new.look(LENSES, 1.0, images(True), at(MOVED))
    assert new.proven.mean() > 0.8


def test_what_stands_still_while_the_surface_moves_is_never_proven() -> None:
    new = waiting()
    for _ in range(4):
        new.look(LENSES, 1.0, images(False), at(MOVED))
    assert new.proven.mean() < 0.05 and new.finished


@pytest.mark.parametrize("amid_others", [False, True])
def test_where_nothing_moves_only_what_lies_amid_known_landmarks_is_taken(amid_others: bool) -> None:
    new = waiting(amid_others)
    new.look(LENSES, 1.0, images(False), at(BASE_FROM_REST))
    assert new.proven.mean() > 0.9 if amid_others else not new.proven.any()


def test_amid_others_means_between_them_and_level_with_them() -> None:
    flat = np.stack(np.meshgrid(np.arange(-30, 30, 5.0), np.arange(-30, 30, 5.0)), -1).reshape(-1, 2)
    known = SurfaceMap(np.c_[flat, np.zeros(len(flat))], np.tile([0.0, 0, 1], (len(flat), 1)), np.zeros((0, 0)))
    points = np.array([[2.0, 3, 0.3], [2, 3, 8], [70, 0, 0], [-28, 14, -0.5]])
    new = SurfaceMap(points, np.tile([0.0, 0, 1], (4, 1)), np.zeros((12, 12)))
    found = NewLandmarks(waiting().new.snapshot, new, first().templates, np.full(4, np.inf), {})
    assert between_known(found, known, 400.0).tolist() == [True, False, False, True]
    put_there = replace(found, level=np.array([0.1, np.inf, 0.1, np.inf]))
    assert between_known(put_there, known, 400.0).tolist() == [False, False, False, True]


def square(x: int) -> int | None:
    return x * x


class Dead(Executor):
    """An executor whose process has died."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_exception(BrokenExecutor())
        return future


@pytest.mark.parametrize("kind", ["here", "thread", "dead"])
def test_a_result_comes_into_force_a_fixed_number_of_frame_sets_later(kind: str) -> None:
    with ThreadPoolExecutor(1) as pool:
        work: DelayedJob[int] = DelayedJob({"here": None, "thread": pool, "dead": Dead()}[kind])
        assert work.poll() is None and not work.busy
        work.submit(square, 7)
        assert [work.poll() for _ in range(MIN_DELAY_SETS + 1)] == [None] * (MIN_DELAY_SETS - 1) + [49, None]
        work.submit(square, 3)
        assert work.busy
        work.cancel()
        assert [work.poll() for _ in range(MIN_DELAY_SETS)] == [None] * MIN_DELAY_SETS and not work.busy


def test_a_result_that_is_not_waited_for_counts_once_it_is_there() -> None:
    class Slow(Executor):
        future: Future[Any]

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            self.future = Future()
            return self.future

    slow = Slow()
    work: DelayedJob[int] = DelayedJob(slow, waits=False)
    work.submit(square, 7)
    assert [work.poll() for _ in range(MIN_DELAY_SETS + 4)] == [None] * (MIN_DELAY_SETS + 4)
    assert work.busy and work.late == 1
    slow.future.set_result(49)
    assert work.poll() == 49 and not work.busy and work.late == 1


def small_map(count: int, seed: int) -> SurfaceMap:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3 * count, 3 * count))
    return SurfaceMap(rng.normal(size=(count, 3)), np.tile([0.0, 0, 1], (count, 1)), root @ root.T)


def test_maps_are_joined_one_after_the_other_with_errors_of_their_own() -> None:
    a, b = small_map(4, 1), small_map(3, 2)
    both = merge_maps(a, b)
    assert len(both) == 7 and np.array_equal(both.points[4:], b.points) and np.array_equal(both.points[:4], a.points)
    assert np.array_equal(both.covariance[:12, :12], a.covariance)
    assert np.array_equal(both.covariance[12:, 12:], b.covariance) and not both.covariance[:12, 12:].any()


def test_a_map_that_grew_while_it_was_refined_keeps_its_new_rows() -> None:
    a, b = small_map(4, 1), small_map(3, 2)
    refiner = Refiner(RIG)
    refiner.extend(merge_maps(a, b))
    better = SurfaceMap(a.points + 0.1, a.normals, 2 * a.covariance)
    whole = refiner.append_new_rows(AdjustedMap(better, np.array([True, False, True, True])))
    assert np.array_equal(whole.map.points, np.concatenate([better.points, b.points]))
    assert whole.agrees.tolist() == [True, False, True, True, True, True, True]
    assert np.array_equal(whole.map.covariance[:12, :12], better.covariance)
    assert np.array_equal(whole.map.covariance[12:, 12:], b.covariance)


def test_no_new_view_drives_an_old_one_out_of_the_search() -> None:
    rng = np.random.default_rng(5)
    search = Relocaliser(LENSES)
    for view in range(4):
        features = rng.uniform(200, 400, (4000, 2)), np.full((4000, 128), float(view), np.float32)
        search.add(1, features, first().base_from_surface, first().map)
    held = np.unique(search.descriptors[:, 0], return_counts=True)
    assert held[0].tolist() == [0, 1, 2, 3] and held[1].sum() <= MAX_DESCRIPTORS and np.ptp(held[1]) <= 1


RADIUS, COVERED = 46.0, 0.8  # mm; s, from when two cameras see nothing
ALONE_RIG = arc_rig(size=(480, 360), focal=450.0)  # 0.9 mm a pixel
LIMB = patch(1, (80.0, 74.0), RADIUS, Wound((78.0, 72.0)))
ALONE_STAMPS = np.arange(34) / 10
AXIS = se3.make(np.eye(3), [0.0, 0.0, -RADIUS])


def turning(stamp: float) -> Array:
    """A limb that turns about its own axis until most of what was in view of the steep camera is not."""
    turn = 0.6 * 0.5 * (1 - np.cos(np.pi * np.clip((stamp - COVERED) / 2.5, 0, 1)))
    sway = [0.02 * np.sin(stamp), 0, 0, 1.5 * np.sin(stamp), np.sin(2 * stamp), 1.5 * np.sin(1.7 * stamp)]
    return np.asarray(BASE_FROM_REST @ AXIS @ se3.exp([turn, 0, 0, 0, 0, 0]) @ se3.inverse(AXIS) @ se3.exp(sway))


@cache
def alone_followed() -> tuple[list[SurfacePose], SurfaceMap, slice]:
    """Poses while camera 2 alone sees the limb, the map at the end, and which of it camera 2 alone has seen."""
    step = TrackingStep(ALONE_RIG, rois(LIMB, ALONE_RIG, turning(0.0), 0.0))
    poses, rng, before = [], np.random.default_rng(7), 0
    for frames in frame_sets(LIMB, ALONE_RIG, turning, ALONE_STAMPS, np.random.default_rng(0)):
        shown = [
            f
            if f.camera == 2 or frames.stamp < COVERED
            else Frame(f.camera, f.stamp, rng.integers(90, 110, f.image.shape).astype(np.uint8))
            for f in frames.frames
        ]
        poses.append(step(FrameSet(frames.stamp, tuple(shown))))
        step.idle()
        if frames.stamp < COVERED and step.map is not None:
            before = len(step.map)
    assert step.map is not None
    return poses, step.map, slice(before, None)


def true_from_estimated() -> Array:
    first = next(p for p in alone_followed()[0] if p.state.measured)
    return np.asarray(se3.inverse(turning(first.stamp)) @ first.base_from_surface)


@pytest.mark.slow  # test_tracking follows by one camera for a while
def test_a_limb_that_one_camera_sees_is_followed_around() -> None:
    poses, _, _ = alone_followed()
    change = se3.inverse(true_from_estimated())
    off = [np.linalg.norm((se3.inverse(turning(p.stamp)) @ p.base_from_surface @ change)[:3, 3]) for p in poses]
    assert all(p.state.measured for p in poses[FIRST:])
    assert np.mean(off[-6:]) < 0.75  # mm, and 0.95 without those that it alone sees


@pytest.mark.slow
def test_what_one_camera_alone_has_seen_lies_on_the_surface_as_claimed() -> None:
    _, surface_map, alone = alone_followed()
    points = se3.transform_points(true_from_estimated(), surface_map.points[alone])
    assert len(points) >= 8
    place = LIMB.shape.material(points)
    normals = LIMB.shape.normals(place)
    off = np.einsum("ni,ni->n", points - LIMB.shape.points(place), normals)
    inner, count = normals @ true_from_estimated()[:3, :3], len(surface_map)
    blocks = np.einsum("ninj->nij", surface_map.covariance.reshape(count, 3, count, 3))[alone]
    claimed = np.sqrt(np.einsum("ni,nij,nj->n", inner, blocks, inner))
    assert np.median(np.abs(off)) < 0.5 and np.mean((off / claimed) ** 2) < 2.5
    assert np.linalg.eigvalsh(surface_map.covariance).min() > -1e-9
