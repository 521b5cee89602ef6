"""The thesis's estimator from pictures to poses, as a method of `stillbed track`, in a scenario and on the bench."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.pose import SurfacePose, TrackState
from estimation.se3 import Array
from estimation.synthetic.world import BASE_FROM_REST, arc_rig
from hardware.bench import recordings as thesis
from hardware.bench import recordings as thesis_scenes
from hardware.bench.subjects import MADE
from hardware.cli.main import main
from hardware.files.pose_file import read_poses
from hardware.simulator.scenario import read_scenario
from hardware.simulator.scene.scene import rois
from perception.frames import Frame, FrameSet, Roi
from perception.thesis.camera import Corners, KeyPoints
from perception.thesis.step import ThesisStep
from perception.tracking import TRACKING_METHODS
from tests.rendered_sets import WIDE, Motion, frame_sets, patch, write_session
from tests.simulated_worlds import SMALL, write_scenario
from tests.slow_cases import slowly

RIG = arc_rig(focal=550.0, size=(640, 360))
PATCH = patch(radius=np.inf, wound=WIDE)
ROIS = rois(PATCH, RIG, BASE_FROM_REST, 0.0)
RATE = 20.0


def moving(xi: Sequence[float]) -> Motion:
    """A motion at constant speed: [rx ry rz tx ty tz] rad/s and mm/s in base axes, about the surface's middle."""

    def motion(stamp: float) -> Array:
        w, v = stamp * np.array(xi[:3]), stamp * np.array(xi[3:])
        return se3.make(se3.exp_rotation(w) @ BASE_FROM_REST[:3, :3], BASE_FROM_REST[:3, 3] + v)

    return motion


def filmed(motion: Motion, count: int = 9) -> list[FrameSet]:
    stamps = np.arange(count) / RATE
    return list(frame_sets(PATCH, RIG, motion, stamps, np.random.default_rng(7)))


def followed(sets: Iterable[FrameSet], step: ThesisStep | None = None) -> list[SurfacePose]:
    step = step or ThesisStep(RIG, ROIS)
    return [step(frames) for frames in sets]


def change(poses: Sequence[SurfacePose]) -> Array:
    """What the last pose is beyond the first: rotation vector, rad, and shift, mm, in base axes (6,)."""
    first, last = poses[0].base_from_surface, poses[-1].base_from_surface
    return np.append(se3.log_rotation(last[:3, :3] @ first[:3, :3].T), last[:3, 3] - first[:3, 3])


SLIDE = (0.0, 0.0, 0.0, 8.0, -5.0, 6.0)


@pytest.fixture(scope="module")
def slide() -> list[FrameSet]:
    """Nine frame sets, 0.4 s, of a patch that slides by 3.2, -2 and 2.4 mm."""
    return filmed(moving(SLIDE))


@pytest.mark.parametrize("finder", [KeyPoints, Corners])
def test_a_slide_is_followed_within_the_84_degrees_taken_for_90(slide: list[FrameSet], finder: type[KeyPoints]) -> None:
    poses = followed(slide, ThesisStep(RIG, ROIS, finder=finder))
    assert all(pose.state is TrackState.TRACKING for pose in poses)
    true = 0.4 * np.array(SLIDE[3:])
    seen = change(poses)[3:]
    assert np.abs(seen[:2] - true[:2]).max() < 0.3
    crosstalk = np.cos(np.deg2rad(84)) * true[1]  # what the bottom camera sees of y it takes for z
    assert abs(seen[2] - true[2]) < abs(crosstalk) + 0.3
    assert np.linalg.norm(seen - true) > 0.01  # it is no better than its approximations


def test_a_turn_about_the_top_cameras_axis_is_measured() -> None:
    turned = change(followed(filmed(moving((0, 0, 0.25, 0, 0, 0)))))
    assert np.rad2deg(turned[2]) == pytest.approx(np.rad2deg(0.1), abs=1.5)


def test_the_twist_is_the_velocity(slide: list[FrameSet]) -> None:
    pose = followed(slide)[-1]
    velocity = pose.base_from_surface[:3, :3] @ pose.twist[3:]
    assert np.linalg.norm(velocity - SLIDE[3:]) < 3.0 and (np.linalg.eigvalsh(pose.covariance) > 0).all()


def test_threads_change_nothing_and_the_same_pictures_give_the_same_poses(slide: list[FrameSet]) -> None:
    with ThreadPoolExecutor(3) as threads:
        runs = [followed(slide, ThesisStep(RIG, ROIS, executor=e)) for e in (None, threads, threads)]
    for poses in runs[1:]:
        for a, b in zip(poses, runs[0], strict=True):
            assert np.array_equal(a.base_from_surface, b.base_from_surface)
            assert np.array_equal(a.covariance, b.covariance)


def covered(frames: FrameSet, cameras: Iterable[int]) -> FrameSet:
    """The frame set with black pictures of some cameras."""
    dark = set(cameras)
    changed = (replace(f, image=0 * f.image) if f.camera in dark else f for f in frames.frames)
    return replace(frames, frames=tuple(changed))


def test_what_is_hidden_for_a_moment_is_coasted_over_and_then_measured_from_before(slide: list[FrameSet]) -> None:
    hidden = [covered(f, (0, 1, 2)) if 5 <= i <= 6 else f for i, f in enumerate(slide)]
    open_run, poses = followed(slide), followed(hidden)
    assert [p.state for p in poses[5:7]] == [TrackState.COASTING] * 2
    assert poses[7].state is TrackState.TRACKING
    assert np.linalg.norm(change(poses[:7])[3:] - change(open_run[:7])[3:]) < 0.5  # carried on by its velocity
    assert np.linalg.norm(change(poses)[3:] - change(open_run)[3:]) < 0.2
    assert np.trace(poses[6].covariance) > np.trace(poses[4].covariance)


def test_one_camera_alone_is_degraded_and_named(slide: list[FrameSet]) -> None:
    poses = followed([*slide[:4], covered(slide[4], [2]), covered(slide[5], [0, 1])])
    assert [p.state for p in poses[4:]] == [TrackState.DEGRADED] * 2
    assert "cam_2 not measured" in poses[4].reason
    assert "cam_0 not measured" in poses[5].reason


def test_after_half_a_second_of_nothing_it_is_lost(slide: list[FrameSet]) -> None:
    nothing = [FrameSet(0.1 + i / RATE, ()) for i in range(12)]
    states = [p.state for p in followed([*slide[:3], *nothing[1:]])]
    assert states[3] is TrackState.COASTING and states[-1] is TrackState.LOST


def test_before_the_region_is_known_it_waits(slide: list[FrameSet]) -> None:
    late = [Roi(r.camera, 0.3, r.polygon) for r in ROIS]
    poses = followed(slide, ThesisStep(RIG, late))
    assert poses[0].state is TrackState.INITIALISING and "0.300 s" in poses[0].reason
    assert poses[-1].state is TrackState.TRACKING


def test_one_camera_alone_cannot_begin(slide: list[FrameSet]) -> None:
    alone = [replace(f, frames=f.frames[:1]) for f in slide[:2]]
    assert [p.state for p in followed(alone)] == [TrackState.INITIALISING] * 2


def test_the_same_instant_again_is_the_same_pose(slide: list[FrameSet]) -> None:
    step = ThesisStep(RIG, ROIS)
    poses = followed([slide[0], slide[1], slide[1]], step)
    assert poses[2] is poses[1]
    assert not step.last.used.any()


def test_observations_are_the_features_where_the_cameras_see_them(slide: list[FrameSet]) -> None:
    step = ThesisStep(RIG, ROIS)
    followed(slide[:2], step)
    seen = step.last.observations
    assert sorted(set(seen.camera.tolist())) == [0, 2]
    assert step.last.used.tolist() == np.bincount(seen.camera, minlength=3).tolist()
    for roi in ROIS:
        pixels = seen.pixels[seen.camera == roi.camera]
        assert ((pixels > roi.polygon.min(0) - 20) & (pixels < roi.polygon.max(0) + 20)).all()


def test_a_picture_of_another_size_is_refused(slide: list[FrameSet]) -> None:
    with pytest.raises(InputError, match="image size"):
        followed([FrameSet(0.0, tuple(Frame(c, 0.0, np.zeros((90, 160), np.uint8)) for c in range(3)))])


def test_help_names_every_method(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["track", "--help"])
    words = " ".join(capsys.readouterr().out.split()).replace("- ", "-")  # argparse breaks lines at hyphens
    for name, what in TRACKING_METHODS.items():
        assert f"{name}: {what}" in words


def test_a_method_that_there_is_not_is_refused_with_those_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["track", "x", "-o", "y", "--method", "theses"])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "theses" in said and any(f"did you mean {name}?" in said for name in TRACKING_METHODS)


@pytest.mark.parametrize("method", ["thesis", *slowly("thesis-flow")])
def test_a_run_by_the_thesis_leaves_the_same_files_and_says_by_what(method: str, tmp_path: Path) -> None:
    write_session(tmp_path / "session", seconds=0.4, rate=10.0, cameras=RIG)
    out = tmp_path / "out"
    arguments = ["track", str(tmp_path / "session"), "-o", str(out), "--method", method]
    assert main([*arguments, "--record", str(tmp_path / "run.mcap")]) == 0
    assert sorted(f.name for f in out.iterdir()) == ["poses.csv", "poses.tum", "report.html", "summary.json"]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["method"] == method and summary["measured_share"] == 1.0
    assert summary["errors"]["start"]["translation_mm"]["max"] < 1.0
    table = read_poses(out / "poses.csv")
    assert not table.offsets.any() and np.isnan(table.offset_sigmas).all()
    assert f"method {method}" in (out / "report.html").read_text()


def test_a_scenario_chooses_the_thesis(tmp_path: Path) -> None:
    chosen = write_scenario(tmp_path, SMALL, tracking={"by": "thesis"}, name="by.toml")
    tracking = read_scenario(chosen).tracking
    assert (tracking.pictures, tracking.method) == (True, "thesis")
    wrong = write_scenario(tmp_path, SMALL, tracking={"by": "theses"}, name="wrong.toml")
    with pytest.raises(InputError, match=r"tracking.by = 'theses'.*did you mean 'thesis'"):
        read_scenario(wrong)


def test_the_thesis_registers_to_no_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = write_scenario(tmp_path, SMALL, tracking={"by": "thesis", "register": "scan"})
    assert main(["simulate", str(scenario), "-o", str(tmp_path / "out")]) == 2
    assert "tracking.register" in capsys.readouterr().err


@pytest.mark.slow  # a run by the thesis is tracked below
def test_the_loop_closes_with_the_thesis(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, SMALL, tracking={"by": "thesis"}, seconds=0.7)
    assert main(["simulate", str(scenario), "-o", str(tmp_path / "out")]) in (0, 1)
    summary = json.loads((tmp_path / "out" / "tracking" / "summary.json").read_text())
    assert summary["method"] == "thesis" and summary["measured_share"] > 0.9


@pytest.mark.slow
def test_the_bench_shows_both_on_the_same_frame_sets(tmp_path: Path) -> None:
    write_session(tmp_path / "session", seconds=0.6, rate=10.0, cameras=RIG)
    options = Namespace(sessions=[tmp_path / "session"], seconds=1.0, method="thesis")
    figures = {f.what.removeprefix("session: "): f for f in thesis.run_thesis(options)}
    ours, theirs = figures["error, ours"], figures["error, thesis"]
    assert 0 < ours.value < theirs.value < 2.0
    ratio = figures["error, thesis / ours"]
    assert ratio.value == pytest.approx(theirs.value / ours.value)
    assert str(ratio.target) == ">= 10"
    assert str(figures["pose after, thesis / ours"].target) == ">= 5"


def test_the_recordings_that_can_be_asked_for_are_those_that_can_be_made() -> None:
    assert tuple(thesis_scenes.MADE_RECORDINGS) == MADE


@pytest.mark.parametrize("name", [name for name, (body, _) in thesis_scenes.MADE_RECORDINGS.items() if body is None])
def test_a_made_recording_is_the_same_each_time_and_moves(name: str) -> None:
    shown = thesis_scenes.rendered_recording(name, 2.0)
    first = [next(iter(shown.frame_sets())) for _ in range(2)]
    for a, b in zip(first[0].frames, first[1].frames, strict=True):
        assert np.array_equal(a.image, b.image)
    assert len(shown.roi) == 3 and shown.truth is not None
    assert np.linalg.norm(np.ptp(shown.truth.base_from_surface[:, :3, 3], axis=0)) > 2.0
