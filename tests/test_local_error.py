"""The claim of a place follows from the landmarks around it: a bump there is claimed soon, and elsewhere nothing is."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.observations import MissedLandmarks, Observations
from estimation.online.estimator import Estimator
from estimation.online.fit import FrameFit
from estimation.online.parted_texture import MAX_PARTED_SHARE, MIN_APART_MM, PartedTexture
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array, Mask
from estimation.surface_map import LocalError, SurfaceMap
from estimation.synthetic.world import arc_rig, observations, project_landmarks, undistorting
from hardware.recording.messages import message_from_pose, pose_from_message
from hardware.simulator.scene.shape import Deformation
from planning.motion import guard
from tests.rendered_sets import breathing, still
from tests.slow_cases import slowly

RIG = arc_rig()
REACH_PX = 2.5  # of the alignment, as TrackingStep's FINE_REACH_PX
LIMIT_MM = 0.5  # sigma from which the guard refuses
MIDDLE = np.zeros((1, 3))
BEGINS_S = 2.0
BUMP_MM = 10.0  # one sigma
Motion = Callable[[float], Array]


def field(size: tuple[float, float], count: int, seed: int = 1) -> Array:
    """Landmarks (N, 3) mm of a flat surface about the needle's place."""
    across = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2)) * size
    return np.column_stack([across, np.zeros(count)])


DENSE, SPARSE = field((100.0, 70.0), 250), field((200.0, 140.0), 250)


class Followed:
    """An estimator on a surface of which only what lies within the alignment's reach is found."""

    def __init__(self, points: Array, rate: float, motion: Motion, seed: int = 0, region: bool = True) -> None:
        self.points, self.rate, self.motion, self.seed = points, rate, motion, seed
        count = len(points)
        self.estimator, self.number = Estimator(RIG, region="drawn" if region else "none"), 0
        surface = SurfaceMap(points, np.tile([0.0, 0.0, 1.0], (count, 1)), 0.02**2 * np.eye(3 * count))
        self.estimator.begin(0.0, motion(0.0), surface)

    def __call__(self, displaced: Array, hidden: Mask | None = None, masked: Mask | None = None) -> SurfacePose:
        """One frame set in which the landmarks are displaced (N, 3) mm; hidden, masked: (C, N) of the cameras.

        What is hidden is missed; what is masked is not looked for.
        """
        self.number += 1
        stamp, shape = self.number / self.rate, (len(RIG), len(self.points))
        draw, pose = np.random.default_rng([self.seed, self.number]), self.motion(stamp)
        hidden = np.zeros(shape, bool) if hidden is None else hidden
        sought = np.ones(shape, bool) if masked is None else ~masked
        poses = np.tile(pose, (len(RIG), 1, 1))
        guess = self.estimator.predict(stamp) if self.number > 1 else pose
        expected, seen = project_landmarks(undistorting(RIG), self.points, np.tile(guess, (len(RIG), 1, 1)))
        there = project_landmarks(undistorting(RIG), self.points + displaced, poses)[0]
        within = np.linalg.norm(there - expected, axis=2) < REACH_PX
        found = within & ~hidden & (draw.random(shape) > 0.02)
        tracks = observations(RIG, self.points + displaced, pose, stamp, draw, 0.15, 0.02, found & sought)
        missed = MissedLandmarks(*np.nonzero(seen & sought & ~found))
        tracks = replace(tracks, missed=missed)
        fit = self.estimator.fit(tracks, guess)
        return self.estimator.accept(fit, tracks, self._elsewhere(fit, tracks, there, hidden))

    def _elsewhere(self, fit: FrameFit, tracks: Observations, there: Array, hidden: Mask) -> Observations | None:
        """What the second look finds of landmarks that stand at pixels (C, N, 2)."""
        asked = self.estimator.elsewhere(fit, tracks)
        if asked is None:
            return None
        poses = np.tile(fit.solution.base_from_surface, (len(RIG), 1, 1))
        expected = project_landmarks(undistorting(RIG), asked.points, poses)[0]
        near = np.linalg.norm(there[:, asked.rows] - expected, axis=2) < 2 * REACH_PX
        camera, at = np.nonzero(near & ~hidden[:, asked.rows])
        row = asked.rows[at]
        return Observations(fit.stamp, camera, row, there[camera, row], np.full(len(row), 0.15))


def rise(height: float, seconds: float) -> Callable[[float], float]:
    """Height, mm, over time, s, of what rises from BEGINS_S on for so many seconds."""
    return lambda stamp: height * float(np.clip((stamp - BEGINS_S + 1e-9) / max(seconds, 1e-9), 0.0, 1.0))


CASES = [
    (DENSE, 13.0, 2.0, 1.0, breathing),
    (SPARSE, 13.0, 2.0, 0.0, breathing),
    *slowly(
        (DENSE, 30.0, 2.0, 0.0, still),
        (DENSE, 13.0, 2.0, 8.0, still),
        (DENSE, 30.0, 3.0, 6.0, breathing),
        (SPARSE, 30.0, 6.0, 2.3, breathing),
        (SPARSE, 13.0, 3.0, 12.0, still),
    ),
]


@pytest.mark.parametrize("case", CASES)
def test_a_bump_under_the_needle_is_claimed_before_it_is_two_frame_sets_old(
    case: tuple[Array, float, float, float, Motion],
) -> None:
    """Of 2 mm and more, at once or slowly, on a surface with dense landmarks and on whole pictures."""
    points, rate, height, seconds, motion = case
    follow, bump, lifts = Followed(points, rate, motion), Deformation(bulge=1.0, radius=BUMP_MM), rise(height, seconds)
    high = np.array([lifts(k / rate) for k in range(1, int((BEGINS_S + seconds + 1.0) * rate))])
    poses = [follow(bump.displacement(points, h)) for h in high.tolist()]
    claims = np.array([pose.error_at(MIDDLE)[0] for pose in poses])
    rim = np.array([pose.error_at(0.45 * np.ptp(points, axis=0)[None])[0] for pose in poses])
    assert claims[high == 0].max() < LIMIT_MM / 2
    two = int(np.flatnonzero(high >= 2.0 - 1e-9)[0])
    assert claims[two + 2 :].min() > LIMIT_MM, claims[two - 3 :].round(2).tolist()
    lifted = np.linalg.norm(bump.displacement(points, height), axis=1) > MIN_APART_MM / 2
    assert rim.max() < LIMIT_MM or lifted.mean() > MAX_PARTED_SHARE  # of so many nobody knows that they are a part


RISES = [(13.0, 0.0), (30.0, 1.0), (13.0, 2.4), *slowly((30.0, 0.0), (13.0, 1.0), (30.0, 2.4))]


@pytest.mark.parametrize("case", RISES)
def test_a_bump_of_three_landmarks_is_never_off_by_a_millimetre_in_silence(case: tuple[float, float]) -> None:
    """4 mm wide, one sigma: smaller than the bells under which displacements are averaged."""
    rate, seconds = case
    top = DENSE[np.linalg.norm(DENSE, axis=1).argmin()]
    shape = np.exp(-((DENSE - top) ** 2).sum(1) / (2 * 4.0**2))[:, None] * [0.0, 0.0, 1.0]
    follow, lifts = Followed(DENSE, rate, breathing), rise(3.0, seconds)
    high = np.array([lifts(k / rate) for k in range(1, int((BEGINS_S + seconds + 1.0) * rate))])
    radius = np.array([follow(h * shape).radius_at(top[None], 0.95)[0] for h in high.tolist()])
    late = np.flatnonzero(high > 1.0)[2 if seconds == 0 else 0 :]  # at once: two frame sets are allowed
    assert (high[late] < 3 * radius[late]).all(), np.stack([high, radius])[:, late[0] - 3 :].round(2).tolist()
    assert radius[high == 0].max() < LIMIT_MM


def test_landmarks_that_part_together_are_told_at_their_places() -> None:
    parted = PartedTexture(RIG, len(DENSE), True)
    known = LocalError(np.zeros((0, 3)), *np.zeros((3, 0)), DENSE, 25.0, 100.0)
    rows = np.linalg.norm(DENSE - DENSE[0], axis=1) < 12.0
    parted._members, parted._size = rows, 1.5
    told = parted.local_error(known, DENSE)
    assert told is not None and (told.variance_at(DENSE[rows]) >= 0.75 * 1.5**2).all()
    far = np.linalg.norm(DENSE[:, None] - DENSE[rows], axis=2).min(1) > 8.0
    assert not told.variance_at(DENSE[far]).any()
    alone = np.zeros(len(DENSE), bool)
    alone[0] = True
    parted._members = alone  # a motion fits one landmark by chance
    assert parted.local_error(known, DENSE) is known


def test_a_hand_over_a_part_is_doubted_there_and_nowhere_else_and_forgotten_when_it_is_gone() -> None:
    follow = Followed(DENSE, 30.0, breathing)
    hand = np.tile(np.linalg.norm(DENSE[:, :2] - [35.0, 0.0], axis=1) < 20.0, (len(RIG), 1))
    poses = [follow(0 * DENSE, hand & (60 <= k < 120)) for k in range(150)]
    under, far = np.array([35.0, 0.0, 0.0]), np.array([-30.0, 0.0, 0.0])
    claims = np.stack([pose.error_at(np.stack([under, far])) for pose in poses])
    assert claims[62:120, 0].min() > LIMIT_MM and np.diff(claims[63:100, 0]).min() >= -0.1
    assert claims[:, 1].max() < LIMIT_MM / 2 and claims[122:, 0].max() < LIMIT_MM / 2
    assert all(pose.state is TrackState.TRACKING for pose in poses[10:])


def test_what_is_not_looked_for_is_no_evidence() -> None:
    follow = Followed(DENSE, 30.0, breathing)
    head = np.tile(np.linalg.norm(DENSE[:, :2], axis=1) < 15.0, (len(RIG), 1))
    poses = [follow(0 * DENSE, masked=head if k >= 40 else None) for k in range(90)]
    assert max(pose.error_at(MIDDLE)[0] for pose in poses[5:]) < LIMIT_MM / 2


@given(st.integers(0, 999), st.floats(0.0, 0.4))
@settings(max_examples=20)
def test_a_place_is_known_as_pose_guard_and_a_recording_tell_alike(seed: int, ahead: float) -> None:
    draw = np.random.default_rng(seed)
    root = draw.normal(scale=0.01, size=(6, 6))
    centres, sizes = draw.uniform(-20, 20, (5, 3)), draw.uniform(0, 4, (3, 5))
    support = draw.uniform(-20, 20, (4, 3))
    local = LocalError(centres, sizes[0], sizes[1], 5 + sizes[2], support, 10.0, 9.0)
    plain = SurfacePose(1.0, still(0.0), root @ root.T, np.zeros(6), TrackState.TRACKING)
    pose = replace(plain, local=local)
    place = draw.uniform(-25, 25, 3)
    then, alone = pose.predict(1.0 + ahead), plain.predict(1.0 + ahead)
    best = max(
        (sizes[0][k] + ahead * sizes[1][k])
        * max(0.0, 1 - ((place - centres[k]) ** 2).sum() / (10 + 2 * sizes[2][k]) ** 2)
        for k in range(5)
    )
    best = max(best, 9.0 * np.clip(np.linalg.norm(support - place, axis=1).min() / 10.0 - 1.0, 0.0, 1.0))
    variance = then.error_at(place[None])[0] ** 2
    assert variance == pytest.approx(alone.error_at(place[None])[0] ** 2 + best)
    assert pose.predicted_error(1.0 + ahead, place[None])[0] ** 2 == pytest.approx(variance)
    assert guard._error(pose, place, ahead) ** 2 == pytest.approx(variance)
    assert (then.radius_at(place[None]) >= alone.radius_at(place[None])).all()
    told = pose_from_message(json.loads(json.dumps(message_from_pose(pose))))
    assert told.local is not None and (told.local.variance == sizes[0]).all() and (told.local.centres == centres).all()
    assert (told.local.support == support).all() and (told.local.span, told.local.unsupported) == (10.0, 9.0)
    assert (told.local.growth == sizes[1]).all() and (told.local.reach == 5 + sizes[2]).all()
    assert pickle.loads(pickle.dumps(pose)).error_at(place[None]) == pose.error_at(place[None])
    old = message_from_pose(plain)
    del old["local"]
    assert pose_from_message(old).local is None


@given(st.floats(1.0, 15.0), st.floats(1e-6, 1e6), st.floats(1.0, 3.0).filter(lambda away: abs(away - 2) > 1e-9))
def test_however_far_a_place_may_have_gone_nothing_is_said_of_one_beyond_twice_its_reach(
    reach: float, variance: float, away: float
) -> None:
    local = LocalError(np.zeros((1, 3)), np.array([variance]), np.zeros(1), np.array([reach]), DENSE, 25.0, 9.0)
    place = np.array([[away * reach, 0.0, 0.0]])
    assert (local.variance_at(place)[0] > 0) == (away < 2)
    assert local.variance_at(place / away)[0] == pytest.approx(0.75 * variance)


def test_the_guard_refuses_a_pose_whose_local_error_is_not_finite() -> None:
    local = LocalError(np.zeros((1, 3)), np.array([np.nan]), np.zeros(1), np.ones(1), np.zeros((1, 3)), 10.0, 9.0)
    pose = SurfacePose(1.0, still(0.0), 1e-6 * np.eye(6), np.zeros(6), TrackState.TRACKING, local=local)
    assert not np.isfinite(np.concatenate([np.ravel(a) for a in guard._numbers(pose)])).all() and not pose.finite


@pytest.mark.parametrize(("region", "span"), [(True, 25.0), (False, 10.0)])
def test_a_place_without_a_landmark_around_it_is_not_known(region: bool, span: float) -> None:
    hole = DENSE[np.linalg.norm(DENSE[:, :2], axis=1) > 1.5 * span]
    follow = Followed(hole, 30.0, breathing, region=region)
    pose = [follow(0 * hole) for _ in range(30)][-1]
    assert pose.state is TrackState.TRACKING and pose.error_at(MIDDLE)[0] > LIMIT_MM
    rim = hole[np.linalg.norm(hole, axis=1).argmin()]
    beside = np.stack([rim * (1 - 0.6 * span / np.linalg.norm(rim)), rim, hole[0]])
    assert pose.error_at(beside).max() < LIMIT_MM


# -- texture that parts


def parted(
    share: float, region: bool, slides: Motion, seconds: float = 3.0, motion: Motion = breathing, periodic: bool = False
) -> tuple[list[SurfacePose], Array, Followed]:
    """Poses, and errors (T,) mm at the middle, where the landmarks left of a line move by `slides` on their own."""
    follow, rate = Followed(SPARSE, 30.0, motion, region=region), 30.0
    follow.estimator.periodic = periodic
    across = np.sort(SPARSE[:, 0])[int(share * len(SPARSE))]
    left = SPARSE[:, 0] < across
    poses, off = [], []
    for number in range(1, int((BEGINS_S + seconds) * rate)):
        stamp = number / rate
        base = se3.transform_points(slides(stamp), SPARSE)
        there = se3.transform_points(se3.inverse(motion(stamp)), base)
        pose = follow(np.where(left[:, None], there - SPARSE, 0.0))
        poses.append(pose)
        off.append(np.linalg.norm((pose.base_from_surface @ [0, 0, 0, 1] - motion(stamp) @ [0, 0, 0, 1])[:3]))
    return poses, np.array(off), follow


def slipping(stamp: float) -> Array:
    """As `breathing`, and from BEGINS_S on 20 mm/s along x on top."""
    return breathing(stamp) @ se3.make(np.eye(3), [20.0 * max(stamp - BEGINS_S, 0.0), 0.0, 0.0])


def resting(stamp: float) -> Array:
    """At rest from BEGINS_S on."""
    return breathing(min(stamp, BEGINS_S))


@pytest.mark.parametrize("slides", [slipping, *slowly(resting)])
@pytest.mark.parametrize("share", [0.2, *slowly(0.5, 0.7)])
def test_without_a_region_the_claim_covers_both_groups(slides: Motion, share: float) -> None:
    poses, off, _ = parted(share, False, slides)
    apart = np.array([np.linalg.norm((slides(p.stamp) - breathing(p.stamp))[:3, 3]) for p in poses])
    radius = np.array([p.radius_at(MIDDLE, 0.95)[0] for p in poses])
    measured = np.array([p.state.measured for p in poses])
    late = measured & (apart > 2.0)
    assert late.any() and (radius[late] > np.maximum(apart, off)[late] / 3).all()
    assert not any(p.state is TrackState.TRACKING for p in poses[-20:])
    assert any("no region says which is the surface" in p.reason for p in poses) or share >= 0.5
    assert not any("texture" in p.reason for p in poses[: int(BEGINS_S * 30) - 1])


def test_what_slips_beside_the_surface_that_a_region_tells_is_told_and_left_out() -> None:
    poses, off, _ = parted(0.15, True, slipping)
    assert off.max() < 0.2 and max(p.error_at(np.array([[40.0, 0.0, 0.0]]))[0] for p in poses) < LIMIT_MM
    assert any("texture on the left moves by itself" in p.reason for p in poses)
    assert not any("draw" in p.reason for p in poses)


@pytest.mark.parametrize("share", [0.25, *slowly(0.5)])
def test_a_region_that_holds_two_groups_is_sure_of_neither(share: float) -> None:
    poses, _, _ = parted(share, True, slipping, 1.0)
    last = poses[-1]
    assert not last.state.measured or last.error_at(MIDDLE)[0] > LIMIT_MM


def test_where_the_texture_repeats_as_cloth_does_even_a_small_group_may_be_the_surface() -> None:
    poses, off, _ = parted(0.15, True, slipping, 0.5, periodic=True)
    apart = np.array([np.linalg.norm((slipping(p.stamp) - breathing(p.stamp))[:3, 3]) for p in poses])
    far = np.array([p.radius_at(np.array([[40.0, 0.0, 0.0]]), 0.95)[0] for p in poses])
    assert off.max() < 0.2 and (far[apart > 0.7] > apart[apart > 0.7] / 3).all() and (apart > 0.7).sum() > 10
    assert far[apart < 0.1].max() < LIMIT_MM
    assert any("so that may be the surface" in p.reason for p in poses)


@pytest.mark.parametrize("periodic", [False, True])
def test_a_bump_is_a_matter_of_its_place_and_in_cloth_of_all_of_it(periodic: bool) -> None:
    follow, bump, lifts = Followed(DENSE, 30.0, breathing), Deformation(bulge=1.0, radius=BUMP_MM), rise(1.0, 0.5)
    follow.estimator.periodic, rim = periodic, 0.45 * np.ptp(DENSE, axis=0)[None]
    high = np.array([lifts(k / 30.0) for k in range(1, int((BEGINS_S + 1.0) * 30.0))])
    poses = [follow(bump.displacement(DENSE, h)) for h in high.tolist()]
    claims = np.array([pose.error_at(rim)[0] for pose in poses])
    assert claims[high == 0].max() < LIMIT_MM / 2
    risen = claims[high > LIMIT_MM]
    assert (risen > LIMIT_MM / 2).all() if periodic else (risen < LIMIT_MM / 4).all()


def test_texture_that_moves_as_one_is_never_told_apart() -> None:
    poses, off, _ = parted(0.5, False, breathing)
    assert all(p.state is TrackState.TRACKING and not p.reason for p in poses[5:]) and off.max() < 0.2
