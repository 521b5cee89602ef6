"""Small bumps and turned lenses are found, told apart and named; what all cameras see alike is the surface's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation import se3
from estimation.observations import Observations
from estimation.online.bump_detector import BumpDetector, reduced_alone, reduced_together
from estimation.online.fit import camera_equations
from estimation.pose import TrackState
from estimation.pose_solver import project
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.synthetic.world import observations
from tests.rendered_sets import breathing
from tests.slow_cases import slowly
from tests.test_estimator import LANDMARKS, RATE, RIG, begun

CALM, AFTER = 3.6, 1.2  # s


def exact(seed: int, at: Array) -> tuple[Observations, Array, Array, Array]:
    """What all cameras see of a resting surface, exactly; its points, the pose of each camera, and slopes of pixels."""
    seen = observations(RIG, LANDMARKS, at, 0.0, np.random.default_rng(seed), 0.0)
    points = LANDMARKS[seen.track]
    return seen, points, np.broadcast_to(at, (3, 4, 4)), project(RIG, seen.camera, at, points)[2]


def knocked(camera: int, change: Array, scale: float = 1.0) -> Rig:
    cameras, own = list(RIG.cameras), RIG.cameras[camera]
    matrix = own.matrix * np.array([[scale, 1, 1], [1, scale, 1], [1, 1, 1]])
    cameras[camera] = replace(own, base_from_camera=own.base_from_camera @ change, matrix=matrix)
    return Rig(tuple(cameras))


def watched(rig: Rig, back: bool = False) -> tuple[list[TrackState], list[str]]:
    """States and reasons from the knock on; back: the camera is put back after AFTER, and watched twice as long."""
    estimator, draw = begun(breathing), np.random.default_rng(4)
    states, reasons = [], []
    for number in range(1, round((CALM + AFTER * (1 + 2 * back)) * RATE)):
        stamp = number / RATE
        struck = CALM <= stamp < CALM + AFTER
        seen = observations(rig if struck else RIG, LANDMARKS, breathing(stamp), stamp, draw, 0.3)
        fit = estimator.fit(seen, estimator.predict(stamp))
        pose = estimator.accept(fit, seen)
        if stamp < CALM:
            assert not estimator.health.bumps.bumped
        else:
            states.append(pose.state)
            reasons.append(pose.reason)
    return states, reasons


@pytest.mark.parametrize("camera", [0, *slowly(2)])
def test_half_a_millimetre_is_named(camera: int) -> None:
    states, reasons = watched(knocked(camera, se3.exp([0, 0, 0, 0.5, 0, 0])))
    assert states[-1] is TrackState.DEGRADED
    assert reasons[-1].startswith(f"{RIG.cameras[camera].name} was bumped: its picture stands 1.")


@pytest.mark.parametrize("turned", [(0, 1.01, "larger"), *slowly((2, 0.99, "smaller"))])
def test_a_lens_that_was_turned_is_told_from_a_bump(turned: tuple[int, float, str]) -> None:
    camera, scale, words = turned
    states, reasons = watched(knocked(camera, np.eye(4), scale))
    assert states[-1] is TrackState.DEGRADED
    assert RIG.cameras[camera].name in reasons[-1] and f"% {words}: its lens was turned" in reasons[-1]
    assert any(f"{share} %" in reasons[-1] for share in ("0.8", "0.9", "1.0", "1.1"))


@pytest.mark.slow
def test_a_camera_that_is_put_back_is_trusted_again() -> None:
    states, reasons = watched(knocked(1, se3.exp([0, 0, 0, 0.7, 0, 0])), back=True)
    assert "bumped" in reasons[round(AFTER * RATE) - 2] and states[-1] is TrackState.TRACKING and not reasons[-1]


def test_a_camera_that_nobody_saw_at_first_is_not_taken_for_bumped_once_it_is_seen() -> None:
    """Its calibration is off, by 1.6 px here, and nobody has seen it stand elsewhere."""
    rig, estimator, draw = knocked(2, se3.exp([0, 0, 0, 0.6, 0, 0])), begun(breathing), np.random.default_rng(5)
    for stamp in np.arange(1, round((CALM + 2) * RATE)) / RATE:
        seen = observations(rig, LANDMARKS, breathing(stamp), stamp, draw, 0.3)
        seen = seen.select(seen.camera != 2) if stamp < CALM else seen
        estimator.accept(estimator.fit(seen, estimator.predict(stamp)), seen)
        assert not estimator.health.bumps.bumped


@pytest.mark.parametrize("unrest", [0.2, *slowly(0.5, 1.0)])
@pytest.mark.parametrize("rate", [6.0, *slowly(30.0)])
def test_a_picture_that_never_stood_still_is_not_taken_for_bumped_but_its_jump_is(unrest: float, rate: float) -> None:
    """A camera that exposes late before a waving surface: its picture is off to and fro, px, from the first on."""
    draw, at, detector = np.random.default_rng(6), breathing(0.0), BumpDetector([c.name for c in RIG.cameras])
    exposed = np.broadcast_to(at, (3, 4, 4))
    for stamp in np.arange(round(20 * rate)) / rate:
        seen = observations(RIG, LANDMARKS, at, stamp, draw, 0.3)
        off = unrest * np.sin(4.4 * stamp) + 16 * unrest * (stamp > 16)
        seen = replace(seen, pixels=seen.pixels + np.outer(seen.camera == 1, [off, 0]))
        points = LANDMARKS[seen.track]
        _, _, jacobians = project(RIG, seen.camera, at, points)
        detector.update(RIG, seen, points, exposed, jacobians, frozenset())
        assert stamp > 16 or not detector.bumped
    assert list(detector.bumped) == [1]


def test_a_moved_surface_is_no_change_of_a_camera() -> None:
    """Law: what a pose explains to first order is in no camera's numbers."""
    draw, at, stamp = np.random.default_rng(1), breathing(0.0), 0.0
    seen = observations(RIG, LANDMARKS, at, stamp, draw, 0.0)
    moved = at @ se3.exp(np.array([2e-5, -1e-5, 3e-5, 2e-3, 1e-3, -2e-3]))
    points = LANDMARKS[seen.track]
    _, _, jacobians = project(RIG, seen.camera, moved, points)
    for pose in (moved, at):
        parts = camera_equations(RIG, seen, points, np.broadcast_to(pose, (3, 4, 4)), jacobians)
        for told in (*(reduced_alone(parts, c, parts) for c in parts), reduced_together(parts, 3)):
            assert np.abs(told.pull / np.sqrt(np.diag(told.fixed))).max() < 2e-3


def test_a_change_of_one_picture_comes_back_in_its_numbers() -> None:
    true = np.array([0.3, -0.2, 1e-3, 2e-3])
    seen, points, exposed, jacobians = exact(2, breathing(0.0))
    mine = seen.camera == 1
    slopes = camera_equations(RIG, seen, points, exposed, jacobians)[1].jacobian
    pixels = seen.pixels.copy()
    pixels[mine] += slopes @ true
    parts = camera_equations(RIG, replace(seen, pixels=pixels), points, exposed, jacobians)
    told = reduced_alone(parts, 1, parts)
    assert np.linalg.solve(told.information, told.pull) == pytest.approx(true, rel=0.02, abs=1e-4)
    without = reduced_alone({**parts, 1: parts[1].without(true)}, 1, parts)
    assert np.abs(without.pull).max() < 0.02 * np.abs(told.pull).max()


@pytest.mark.parametrize("hidden", [0, 1, 2])
def test_what_is_usual_of_three_cameras_is_usual_of_any_two(hidden: int) -> None:
    """Law: pictures that stand as they always did are off by nothing, whichever of them are seen."""
    seen, points, exposed, jacobians = exact(3, breathing(0.0))
    true = np.random.default_rng(4).normal(size=(3, 4)) * [0.3, 0.3, 1e-3, 1e-3]
    slopes = camera_equations(RIG, seen, points, exposed, jacobians)
    pixels = seen.pixels.copy()
    for c in range(3):
        pixels[seen.camera == c] += slopes[c].jacobian @ true[c]
    parts = camera_equations(RIG, replace(seen, pixels=pixels), points, exposed, jacobians)
    told = reduced_together(parts, 3)
    usual = np.linalg.lstsq(told.information, told.pull, rcond=1e-9)[0].reshape(3, 4)
    left = {c: parts[c].without(usual[c]) for c in range(3) if c != hidden}
    for c in left:
        before, after = reduced_alone(parts, c, left), reduced_alone(left, c, left)
        assert np.abs(after.pull).max() < 1e-3 * np.abs(before.pull).max() + 1e-6
