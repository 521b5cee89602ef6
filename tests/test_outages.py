"""Cameras fail in every way before a moving wound: the tracker says so, is never wrong in silence, and comes back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.pose import TrackState
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.bench.campaigns.outages import judge
from hardware.bench.outage_run import FPS, Stretch, Watched, make_pictures
from hardware.bench.outages import figures, kinds_text, shares
from hardware.simulator.outage import Kind, Outage, Spoiler, draw_outage
from perception.frames import Image
from tests.slowly import slowly

RIG = arc_rig(size=(320, 180), focal=280.0)
EXTENT = np.array([[x, y, 0.0] for x in (-24.0, 24.0) for y in (-17.0, 17.0)])
TRACKING, DEGRADED, COASTING = TrackState.TRACKING, TrackState.DEGRADED, TrackState.COASTING
LIKE = (Kind.HAND, Kind.GLARE, Kind.EXPOSURE)  # much like those beside them: in part hidden, or too bright


# -- the judge


def watched(kind: Kind = Kind.DEAD, start: int = 10, end: int = 20, count: int = 40) -> Watched:
    """A tracker that says at once what is wrong and is back at once."""
    outage = Outage(kind, (0,), start / FPS, end / FPS, 0.5, np.eye(4), 0)
    struck = [start <= k < end for k in range(count)]
    used = np.array([[0 if s else 90, 90, 90] for s in struck])
    states = tuple(DEGRADED if s else TRACKING for s in struck)
    reasons = tuple("cam_0" if s else "" for s in struck)
    return Watched(
        outage, np.arange(count) / FPS, np.full(count, 0.02), np.full(count, 0.05), states, reasons, used, False
    )


def test_what_is_said_at_once_is_no_loss() -> None:
    verdict = judge(watched())
    assert (verdict.silent, verdict.beyond, verdict.flagged, verdict.back) == (False, False, 0.0, 0.0)
    assert verdict.after == verdict.worst == 0.02


@pytest.mark.parametrize(("error", "radius", "silent"), [(0.51, 0.1, True), (0.49, 0.1, False), (0.51, 0.18, False)])
def test_a_loss_is_silent_when_it_is_off_by_more_than_harmless_and_claimed(
    error: float, radius: float, silent: bool
) -> None:
    seen = watched()
    off = np.where(np.arange(40) == 15, error, 0.02)
    said = replace(seen, error=off, radius=np.full(40, radius))
    assert not judge(said).silent and judge(said).beyond == silent
    hushed = replace(said, states=(TRACKING,) * 40)
    assert judge(hushed).silent == silent


def test_what_was_wrong_before_the_outage_does_not_count() -> None:
    early = np.where(np.arange(40) == 5, 3.0, 0.02)
    assert not judge(replace(watched(), error=early)).beyond


@pytest.mark.parametrize("late", [1, 4])
def test_the_flag_is_timed_from_the_first_blind_frame(late: int) -> None:
    seen = watched()
    quiet = range(10, 10 + late)
    states = tuple(TRACKING if k in quiet else s for k, s in enumerate(seen.states))
    reasons = tuple("" if k in quiet else r for k, r in enumerate(seen.reasons))
    assert judge(replace(seen, states=states, reasons=reasons)).flagged == pytest.approx(late / FPS)


def test_an_outage_that_nobody_mentions_is_never_flagged() -> None:
    seen = watched()
    assert judge(replace(seen, states=(TRACKING,) * 40, reasons=("",) * 40)).flagged == np.inf
    short = watched(end=12)
    assert np.isnan(judge(replace(short, states=(TRACKING,) * 40, reasons=("",) * 40)).flagged)


def test_a_fault_that_costs_nothing_need_not_be_mentioned() -> None:
    seen = replace(watched(Kind.EXPOSURE), states=(TRACKING,) * 40, reasons=("",) * 40, used=np.full((40, 3), 80))
    assert np.isnan(judge(seen).flagged)
    off = np.where(np.arange(40) >= 12, 0.3, 0.02)
    assert judge(replace(seen, error=off)).flagged == np.inf


def test_back_is_the_first_pose_without_a_reservation_and_its_error_the_worst_from_then_on() -> None:
    seen = watched()
    states = tuple(COASTING if 10 <= k < 23 else s for k, s in enumerate(seen.states))
    error = np.where(np.arange(40) == 25, 0.4, 0.02)
    verdict = judge(replace(seen, states=states, error=error))
    assert verdict.back == pytest.approx(3 / FPS) and verdict.after == 0.4
    assert judge(replace(seen, states=(*seen.states[:10], *(COASTING,) * 30))).back == np.inf


def test_the_table_has_a_line_for_each_kind_and_the_figures_count_what_is_late() -> None:
    good = judge(watched())
    bad = replace(good, flagged=0.15, back=np.inf, after=np.inf, silent=True)
    lines = kinds_text([(Kind.DEAD, good), (Kind.BLUR, bad)]).splitlines()
    assert [line.split()[0] for line in lines] == ["kind", "dead", "blur", "all"]
    values = {f.what: f.value for f in figures([good, bad])}
    assert (
        values["silent losses"]
        == values["flagged after more than 100 ms"]
        == values["back after more than 200 ms"]
        == 1
    )


def test_every_outage_falls_to_one_scene_and_seeds_differ() -> None:
    jobs = shares(200, 2, 3)
    assert sum(len(kinds) for _, kinds in jobs) == 200 and len({seed for seed, _ in jobs}) == len(jobs) == 4
    counts = [sum(kinds.count(k) for _, kinds in jobs) for k in Kind]
    assert max(counts) - min(counts) <= 1


# -- the faults


def picture(seed: int) -> Image:
    return np.asarray(np.random.default_rng(seed).integers(20, 200, (180, 320)), np.uint8)


def spoilt(kind: Kind, cameras: tuple[int, ...] = (1,), bump: np.ndarray | None = None) -> list[Image | None]:
    outage = Outage(kind, cameras, 1.0, 3.0, 0.7, np.eye(4) if bump is None else bump, 5)
    images, last = [picture(c) for c in range(3)], [picture(10 + c) for c in range(3)]
    return Spoiler(RIG, EXTENT)(outage, 2.0, images, last, REST)


@pytest.mark.parametrize("kind", list(Kind))
def test_only_the_cameras_struck_change(kind: Kind) -> None:
    cameras = (0, 2) if kind is Kind.SWAPPED else (1,)
    bump = se3.exp(np.array([0.01, 0, 0, 0, 0, 0]))
    for c, image in enumerate(spoilt(kind, cameras, bump)):
        same = image is not None and np.array_equal(image, picture(c))
        assert same == (c not in cameras)


def test_frozen_swapped_and_dead_cameras_deliver_what_their_names_say() -> None:
    frozen, dead, swapped = spoilt(Kind.FROZEN)[1], spoilt(Kind.DEAD)[1], spoilt(Kind.SWAPPED, (0, 1))
    assert dead is None and frozen is not None and np.array_equal(frozen, picture(11))
    assert all(i is not None and np.array_equal(i, picture(c)) for i, c in zip(swapped, (1, 0, 2), strict=True))


def test_a_camera_that_was_not_bumped_sees_the_same() -> None:
    image = spoilt(Kind.BUMPED)[1]
    assert image is not None and np.abs(image.astype(int) - picture(1)).max() <= 2


def test_a_turned_camera_sees_all_shifted_by_focal_length_times_angle() -> None:
    images = [np.zeros((180, 320), np.uint8) for _ in range(3)]
    images[1][88:93, 158:163] = 200
    outage = Outage(Kind.BUMPED, (1,), 1.0, 3.0, 0.7, se3.exp(np.array([0, 0.05, 0, 0, 0, 0])), 5)
    moved = Spoiler(RIG, EXTENT)(outage, 2.0, images, images, REST)[1]
    assert moved is not None
    columns = np.arange(320) @ moved.sum(0) / moved.sum()
    assert columns - 160 == pytest.approx(-0.05 * 280 * 1.01, abs=0.3)


def test_draws_are_the_same_again_and_within_their_limits() -> None:
    for kind in Kind:
        for seed in range(20):
            a, b = (draw_outage(kind, RIG, 1.0, np.random.default_rng(seed)) for _ in range(2))
            assert (a.cameras, a.end, a.strength, a.seed) == (b.cameras, b.end, b.strength, b.seed)
            assert 0 < a.end - a.start <= 5 and 1 <= len(a.cameras) <= 3 and set(a.cameras) <= {0, 1, 2}


# -- the tracker


@pytest.fixture(scope="module")
def stretch() -> Stretch:
    begun = Stretch(make_pictures(3, period=24, size=(480, 270), focal=420.0), 3)
    assert begun.begin()
    return begun


@pytest.mark.parametrize("kind", [*(kind for kind in Kind if kind not in LIKE), *slowly(*LIKE)])
def test_the_tracker_is_never_lost_in_silence_and_comes_back(stretch: Stretch, kind: Kind) -> None:
    seen = stretch.outage(kind, longest=0.6)
    verdict = judge(seen)
    assert not verdict.silent and not verdict.beyond
    assert np.isnan(verdict.flagged) or verdict.flagged <= 0.1
    assert verdict.back <= 0.2 and verdict.after < 0.2
    if kind.blinds:
        named = " ".join(seen.reasons)
        assert any(f"cam_{c}" in named for c in seen.outage.cameras)
