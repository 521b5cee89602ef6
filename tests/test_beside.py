"""`stillbed bench beside`: what the wound network costs the poses beside which it runs."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np
import pytest

from estimation.pose import SurfacePose, TrackState
from hardware.bench.figures import Figure
from hardware.bench.recordings import MADE_RECORDINGS, WARM_UP_STEPS, beside_figures, pose_bytes
from hardware.bench.subjects import SUBJECTS

COUNT = WARM_UP_STEPS + 40


def pose(number: int) -> SurfacePose:
    return SurfacePose(number / 30, np.eye(4), np.eye(6), np.zeros(6), TrackState.TRACKING)


def told(without: list[SurfacePose], along: list[SurfacePose], spent: np.ndarray) -> dict[str, Figure]:
    return {figure.what.removeprefix("x: "): figure for figure in beside_figures("x", without, along, spent)}


def test_medians_and_late_poses_are_compared_after_the_first_sets() -> None:
    poses = [pose(number) for number in range(COUNT)]
    spent = np.full((3, COUNT), [[0.01], [0.012], [0.001]])
    spent[:, :WARM_UP_STEPS] = 5.0
    spent[1, -1] = 0.04
    figures = told(poses, poses, spent)
    assert figures["pose after, without the network, median"].value == pytest.approx(10)
    assert figures["with / without, median"].value == pytest.approx(1.2)
    assert figures["pictures handed over, after the pose, 99 %"].value == pytest.approx(1)
    assert figures["poses later than the next pictures"].value == 1
    assert figures["poses lost with the network alone"].value == figures["poses that differ in a bit"].value == 0


def test_a_pose_that_is_lost_or_differs_by_one_bit_is_counted() -> None:
    poses, spent = [pose(number) for number in range(COUNT)], np.full((3, COUNT), 0.01)
    lost = [*poses[:-1], replace(poses[-1], state=TrackState.LOST)]
    figures = told(poses, lost, spent)
    assert figures["poses lost with the network alone"].verdict == "MISSED"
    assert figures["poses that differ in a bit"].value == 1
    assert told(lost, poses, spent)["poses lost with the network alone"].value == 0  # lost without it
    for field in ("base_from_surface", "covariance", "twist"):
        values = getattr(poses[0], field).copy()
        values.flat[0] = np.nextafter(values.flat[0], 2.0)
        assert pose_bytes(replace(poses[0], **{field: values})) != pose_bytes(poses[0])
    assert pose_bytes(replace(poses[0], reason="x")) != pose_bytes(poses[0]) == pose_bytes(pose(0))


def test_without_a_surface_that_is_followed_there_is_no_figure() -> None:
    nothing = [replace(pose(number), state=TrackState.INITIALISING) for number in range(COUNT)]
    (figure,) = beside_figures("x", nothing, nothing, np.zeros((3, COUNT)))
    assert math.isnan(figure.value) and figure.note


@pytest.mark.slow
def test_the_network_beside_the_tracker_changes_no_pose() -> None:
    subject, parser = SUBJECTS["beside"], argparse.ArgumentParser()
    subject.add_options(parser)
    scene = next(iter(MADE_RECORDINGS))
    figures = {figure.what: figure for figure in subject.run(parser.parse_args(["--seconds", "1.5", "--scene", scene]))}
    assert figures[f"{scene}: poses lost with the network alone"].value == 0
    assert figures[f"{scene}: poses that differ in a bit"].value == 0
    share, pace = figures[f"{scene}: network's share of a core"].value, figures[f"{scene}: pace"].value
    assert 0 < share <= 110 and 0 < pace < 100.001  # what is left of the last pictures ends after a block
