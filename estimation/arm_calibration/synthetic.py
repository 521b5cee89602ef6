"""Sightings of a made-up arm's tip with known noise: what a calibration is held against."""

from __future__ import annotations

import numpy as np

from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_model import ArmState, Kinematics, Sightings, predict
from estimation.rig import Rig
from estimation.se3 import Array

SETTLE = 0.25  # s after which an arm rests


def set_point_of(targets: Array, tick: float, begin: float = 0.0) -> SetPoint:
    """Where targets (K, 6), a tick apart, send an arm that stands at the first of them at `begin`, s."""
    return SetPoint(begin + tick * np.arange(len(targets), dtype=np.float64), np.ascontiguousarray(targets, float))


def sightings_of(
    state: ArmState,
    set_point: SetPoint,
    kinematics: Kinematics,
    rig: Rig,
    period: float,
    noise: float,
    outliers: float,
    rng: np.random.Generator,
) -> Sightings:
    """The tip in every camera each `period` s. noise: px, one sigma. outliers: share that is anywhere near it."""
    stamps = np.arange(set_point.instants[0] + period, set_point.instants[-1], period)
    camera = np.repeat(np.arange(len(rig)), len(stamps))
    stamp = np.tile(stamps, len(rig)) + 0.003 * camera
    pixels = predict(state, set_point, kinematics, rig, stamp, camera).pixels
    pixels = pixels + noise * rng.normal(size=pixels.shape)
    astray = rng.random(len(stamp)) < outliers
    pixels[astray] += 40 * rng.normal(size=(int(astray.sum()), 2))
    sigma = np.full(len(stamp), max(noise, 1e-3))
    return Sightings(stamp, camera, pixels, sigma, set_point.places(stamp, SETTLE))
