"""What the first pose is off by is claimed by what is known of cameras and tracks now."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.first_pose import FirstPose
from estimation.fit import Fit
from estimation.online.camera_errors import CameraErrors
from estimation.online.pose_solver import PoseFit, SharedFit
from estimation.se3 import Array
from estimation.track_noise import TrackNoise

CAMERAS = 3


def spread(seed: int, columns: int = 12) -> Array:
    root = np.random.default_rng(seed).normal(size=(6, columns))
    return root @ root.T / columns


def first(window: float, cameras: CameraErrors) -> tuple[FirstPose, Fit]:
    """A first pose whose window knows a part of what its last fit does, and that fit."""
    rng = np.random.default_rng(2)
    bias, late, tracks = rng.normal(size=(6, 2 * CAMERAS)), 20 * rng.normal(size=(6, CAMERAS)), 1e-3 * spread(3)
    noise = tracks + cameras.unrest * bias @ bias.T
    solution = PoseFit(np.eye(4), np.eye(6), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 6)), 1.0)
    zero, none = np.zeros((6, 6)), np.zeros(CAMERAS)
    counts, kept = np.zeros(CAMERAS, np.int64), np.zeros(0, bool)
    sizes = zero, zero, np.zeros(6), np.zeros(6), 1.0, tracks, late, bias
    fit = Fit(0.0, solution, noise, *sizes, kept, counts, "", none, none)
    return FirstPose(window * noise, fit, cameras), fit


def rested(quiet: float) -> CameraErrors:
    """Cameras that were seen to shift by `quiet` px from frame set to frame set, and to be late by nothing."""
    cameras, rng = CameraErrors(CAMERAS), np.random.default_rng(7)
    information = np.diag(np.repeat([1 / 1e-4**2, 1 / 1e-3**2], [CAMERAS, 2 * CAMERAS]))
    for _ in range(300):
        seen = np.r_[np.zeros(CAMERAS), quiet * rng.normal(size=2 * CAMERAS)]
        cameras.learn(SharedFit(information, information @ seen), 1 / 30)
    return cameras


@pytest.mark.parametrize("window", [0.3, 1.0])
def test_at_once_it_is_what_the_window_said_and_what_late_cameras_make_of_it(window: float) -> None:
    cameras = CameraErrors(CAMERAS)
    pose, fit = first(window, cameras)
    late = fit.late @ cameras.delays.covariance @ fit.late.T
    assert pose.covariance(cameras, TrackNoise(CAMERAS)) == pytest.approx(window * fit.noise + late, rel=1e-6)


def test_once_the_images_are_known_to_rest_it_is_what_the_tracks_make_of_it() -> None:
    pose, fit = first(0.5, CameraErrors(CAMERAS))
    cameras = rested(0.005)
    late = fit.late @ cameras.delays.covariance @ fit.late.T
    expected = 0.5 * (fit.tracks + cameras.unrest * fit.bias @ fit.bias.T) + late
    assert pose.covariance(cameras, TrackNoise(CAMERAS)) == pytest.approx(expected, rel=1e-6)
    assert cameras.unrest < 0.1 * CameraErrors(CAMERAS).unrest


def test_images_found_less_at_rest_than_was_believed_make_it_larger() -> None:
    pose, _ = first(0.5, CameraErrors(CAMERAS))
    noise = TrackNoise(CAMERAS)
    restless, believed = pose.covariance(rested(0.3), noise), pose.covariance(rested(0.05), noise)
    assert np.linalg.eigvalsh(restless - believed)[0] > -1e-12 and np.trace(restless) > 2 * np.trace(believed)


def test_an_offset_that_was_not_corrected_then_is_claimed_when_it_is_known() -> None:
    cameras = CameraErrors(CAMERAS)
    pose, fit = first(0.5, cameras)
    information = np.diag(np.repeat([1 / 1e-3**2, 1e-9], [CAMERAS, 2 * CAMERAS]))
    true = np.array([0.016, 0.0, -0.016])
    for _ in range(200):
        found = np.r_[true - cameras.offset, np.zeros(2 * CAMERAS)]
        cameras.learn(SharedFit(information, information @ found), 1 / 30)
    claimed = pose.covariance(cameras, TrackNoise(CAMERAS))
    off = fit.late @ true
    assert off @ np.linalg.solve(claimed, off) < 2.0
