"""`stillbed view` shows what was recorded, in a real browser too; `stillbed compare` has evo's own numbers."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from estimation.pose import Trajectory
from estimation.se3 import Array
from estimation.synthetic.follow import follow_steps
from estimation.synthetic.world import synthetic_world
from hardware.cli.main import WRONG_INPUT, main
from hardware.files.folder_tables import write_tum
from hardware.files.path_file import write_path
from hardware.offline.compare import ALIGNMENTS, compare, error_statistics
from hardware.offline.trajectory_files import PoseSeries, read_pose_series
from hardware.offline.viewer import PictureReader, Playback, instant_text, open_playback, serve, session_text
from hardware.operator.settings import OperatorSettings
from hardware.recording.recorder import Recorder
from hardware.report.evaluation import consistency_text
from perception.frames import Frame
from planning.command import Hold, Move
from tests.browser import Browser, axe_findings
from tests.moving_surfaces import raster
from tests.recording_samples import pose, whole_recording
from tests.session_files import image, make_folder, rig
from tests.tracking_runs import breathing

COUNT = 24


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live run on a swaying surface, its pictures brighter from one frame set to the next."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    world = synthetic_world("lively", seconds=COUNT / 20, rate=20.0, count=40)
    with Recorder(path, world.rig) as recorder:
        recorder.truth(world.truth)
        for k, step in enumerate(follow_steps(world, "seen")):
            for camera in range(3):
                recorder.frame(Frame(camera, step.pose.stamp, np.full((720, 1280), 40 + 8 * k, np.uint8)))
            recorder.write(step.seen)
            recorder.write(step.pose)
    return path


@pytest.fixture(scope="module")
def playback(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Playback:
    way = tmp_path_factory.mktemp("path") / "path.csv"
    write_path(way, raster())
    return open_playback(recording, toolpath=way)


@pytest.fixture(scope="module")
def address(playback: Playback) -> Iterator[str]:
    """Where it is served, by a thread of this process."""
    settings, loop = OperatorSettings(), asyncio.new_event_loop()
    with socket.create_server((settings.host, 0)) as listener:
        thread = threading.Thread(target=loop.run_forever, daemon=True)
        thread.start()
        task = asyncio.run_coroutine_threadsafe(serve(playback, settings, listener), loop)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/{settings.token}/"
        task.cancel()
        loop.call_soon_threadsafe(loop.stop)
        thread.join(5)


def test_holds_stages_and_the_log_of_a_run_are_shown_at_their_instants(recording: Path, tmp_path: Path) -> None:
    """A recording with commands and a log, whose stamps begin far from zero."""
    path = tmp_path / "told.mcap"
    stamps = 5000.0 + np.arange(10) / 10
    with Recorder(path, rig(2)) as recorder:
        for number, stamp in enumerate(stamps):
            for camera in range(2):
                recorder.write(Frame(camera, float(stamp), image(camera, number)))
            if number == 3:
                recorder.event(float(stamp), "print")
            if number == 5:
                recorder.write(Hold(float(stamp), 0.02, "pose is 0.4 s old"))
            if number == 8:
                recorder.write(Move(float(stamp), np.zeros(6), 5.0, 3, False))
                recorder.event(float(stamp), "stopped: by the operator")
    shown = open_playback(path)
    assert [bool(why) for why in shown.held] == [False] * 5 + [True] * 3 + [False] * 2
    told = json.loads(session_text(shown))
    assert told["stages"] == [[0.3, "print"], [0.8, "stopped"]]
    assert told["events"][1] == [0.8, "stopped: by the operator"] and told["held"][6] == "pose is 0.4 s old"


def got(address: str, **headers: str) -> bytes:
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=20) as answer:
        return bytes(answer.read())


def test_each_instant_has_its_own_pose_tracks_and_pictures(playback: Playback) -> None:
    assert playback.source == "live" and len(playback) == COUNT
    book = PictureReader(playback)
    for k in (5, 20, 6):  # back as well
        pose, seen = playback.poses[k], playback.tracks[k]
        assert pose is not None and seen is not None and pose.stamp == seen.stamp == playback.stamps[k]
        said = json.loads(instant_text(playback, k))
        assert np.allclose(said["tracking"]["base_from_surface"], pose.base_from_surface, atol=1e-4)
        pictures = book(k)
        assert len(pictures.pictures) == 3 and pictures.stamp == playback.stamps[k]
        assert sum(len(p.tracks) for p in pictures.pictures) == len(seen)
    assert 0 < np.nanmax(playback.off) < 0.3
    book.close()


def test_the_surface_lies_where_its_landmarks_are(playback: Playback) -> None:
    world = synthetic_world("lively", seconds=COUNT / 20, rate=20.0, count=40)
    pose = playback.poses[3]
    assert pose is not None and len(playback.scene.surface) > 30
    shown = se3.transform_points(pose.base_from_surface, playback.scene.surface)
    true = se3.transform_points(world.truth.base_from_surface[3], world.landmarks.points)
    nearest = np.linalg.norm(shown[:, None] - true[None], axis=2).min(1)
    assert np.median(nearest) < 0.5


def test_a_folder_shows_its_truth_or_other_poses(tmp_path: Path, recording: Path) -> None:
    shown = open_playback(make_folder(tmp_path / "s", pictures=True))
    assert shown.source in ("truth", "reference") and not any(shown.tracks)
    assert json.loads(session_text(shown))["states"].count("TRACKING") == sum(p is not None for p in shown.poses)
    assert open_playback(recording, poses=f"{recording}:truth").source.endswith(":truth")


def test_only_who_has_the_address_is_let_in(address: str) -> None:
    assert b"stillbed view" in got(address)
    whole = json.loads(got(f"{address}session"))
    assert len(whole["stamps"]) == COUNT and len(whole["scene"]["cameras"]) == 3
    wrong = address.rsplit("/", 2)[0] + "/wrong-token/session"
    for where, headers in ((wrong, {}), (f"{address}session", {"Origin": "http://elsewhere.example"})):
        with pytest.raises(urllib.error.HTTPError) as refused:
            got(where, **headers)
        assert refused.value.code == 403
    for nowhere in (f"at/{COUNT}", "pictures/99999", "secret.txt"):
        with pytest.raises(urllib.error.HTTPError) as missing:
            got(address + nowhere)
        assert missing.value.code == 404


def test_a_picture_that_cannot_be_read_is_said(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", pictures=True)
    shown = open_playback(folder)
    pictures = sorted(p for p in folder.rglob("*.png"))
    pictures[-1].write_bytes(b"no picture")
    book, failed = PictureReader(shown), 0
    for k in range(len(shown)):
        try:
            book(k)
        except Exception as error:
            failed += 1
            assert pictures[-1].name in str(error)
    assert failed == 1


def test_the_slider_moves_the_scene(address: str, browser: Browser) -> None:
    page = browser.page(address, (1280, 860))
    page.until("document.body.dataset.shown !== undefined && document.querySelectorAll('.camera').length === 3")
    scene = "document.querySelector('#scene canvas').toDataURL()"
    bright = (
        "(() => { const c = document.querySelector('.camera canvas');"
        " return c.getContext('2d').getImageData(c.width / 2, 20, 1, 1).data[0]; })()"
    )
    before, dark = page.js(scene), page.js(bright)
    page.js(f"(() => {{ const t = document.getElementById('time'); t.value = {COUNT - 4};"
            " t.dispatchEvent(new Event('input')); })()")  # fmt: skip
    page.until(f"document.body.dataset.shown === '{COUNT - 4}'")
    page.until(f"{scene} !== {json.dumps(before)}")
    assert page.until(f"{bright} > {dark + 60}")
    assert f"{COUNT - 3} of {COUNT}" in page.text("#now") and page.js("document.getElementById('alarm').hidden")
    page.key("Home", "Home")
    page.until("document.body.dataset.shown === '0'")
    page.key("Space", " ")
    page.until(f"document.body.dataset.playing === 'no' && document.body.dataset.shown === '{COUNT - 1}'")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing_serious_in_the_viewer(address: str, browser: Browser, theme: str) -> None:
    page = browser.page(address)
    page.until('document.body.dataset.shown === "0"')
    page.js(f"localStorage.setItem('stillbed.theme', '{theme}')")
    page.reload()
    page.until(f"document.body.dataset.shown === '0' && document.documentElement.dataset.theme === '{theme}'")
    assert axe_findings(page) == []
    page.js("localStorage.clear()")
    page.close()


def test_a_recording_without_tracks_has_no_surface(tmp_path: Path) -> None:
    shown = open_playback(whole_recording(tmp_path))
    assert shown.source == "live" and len(shown.scene.surface) == 0


STAMPS = np.arange(90) / 30


def posed(poses: Array, covariance: Array | None = None, stamps: Array = STAMPS) -> PoseSeries:
    unknown = np.full((len(poses), 6, 6), np.nan)
    return PoseSeries("made.tum", Trajectory(stamps, poses, exact=True), unknown if covariance is None else covariance)


def moved(seed: int, sigma: float = 0.02) -> tuple[Array, Array]:
    """Truth, and what a run in another base and on another surface frame makes of it."""
    draw = np.random.default_rng(seed)
    truth = breathing(STAMPS)
    noise = se3.exp(draw.normal(size=(len(STAMPS), 6)) * sigma * np.repeat([0.01, 1.0], 3))
    base, surface = (se3.exp(draw.normal(size=6) * np.repeat([0.1, 5.0], 3)) for _ in range(2))
    return truth, base @ truth @ noise @ surface


@pytest.mark.parametrize("aligned", [False, True])
@pytest.mark.parametrize("delta", [1, 4])
def test_the_figures_are_evos(aligned: bool, delta: int) -> None:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    truth, found = moved(delta)
    theirs, reference = (PoseTrajectory3D(poses_se3=list(p), timestamps=STAMPS) for p in (found, truth))
    if aligned:
        theirs.align(reference, correct_scale=False)
    ours = compare(posed(found), posed(truth), delta).of(ALIGNMENTS[int(aligned)])
    parts = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    for part, absolute, relative in zip(
        parts,
        (ours.absolute.translation, ours.absolute.rotation),
        (ours.relative.translation, ours.relative.rotation),
        strict=True,
    ):
        for metric, values in (
            (metrics.APE(part), absolute),
            (metrics.RPE(part, delta, metrics.Unit.frames, all_pairs=False), relative),
        ):
            metric.process_data((reference, theirs))
            for name, value in metric.get_all_statistics().items():
                assert getattr(error_statistics(values), name) == pytest.approx(value, rel=1e-6, abs=1e-9), (name, part)


@settings(max_examples=25)
@given(seed=st.integers(0, 1000))
def test_moving_the_base_or_the_surface_frame_changes_only_what_it_may(seed: int) -> None:
    truth, found = moved(seed)
    shift = se3.exp(np.random.default_rng(seed + 1).normal(size=6) * np.repeat([0.3, 20.0], 3))
    plain, base, surface = (compare(posed(p), posed(truth)) for p in (found, shift @ found, found @ shift))

    def rmse(result: object, name: str, relative: bool = False) -> float:
        judged = result.of(name)
        part = judged.relative if relative else judged.absolute
        return error_statistics(part.translation).rmse

    assert rmse(base, ALIGNMENTS[1]) == pytest.approx(rmse(plain, ALIGNMENTS[1]), rel=1e-6)
    shifted = rmse(base, ALIGNMENTS[0], relative=True)
    assert shifted == pytest.approx(rmse(plain, ALIGNMENTS[0], relative=True), rel=1e-6)
    judged, expected = (r.of(ALIGNMENTS[2]) for r in (surface, plain))
    assert judged.absolute.rotation == pytest.approx(expected.absolute.rotation, abs=1e-3)
    assert rmse(plain, ALIGNMENTS[1]) <= rmse(plain, ALIGNMENTS[0]) + 1e-9


def test_honest_covariances_have_a_nees_of_six() -> None:
    draw, truth = np.random.default_rng(4), breathing(np.arange(600) / 30)
    sigma = np.array([1e-3, 2e-3, 1e-3, 0.02, 0.01, 0.05])
    found = truth @ se3.exp(draw.normal(size=(600, 6)) * sigma)
    covariance = np.broadcast_to(np.diag(sigma**2), (600, 6, 6))
    stamps = np.arange(600) / 30
    judged = compare(posed(found, covariance, stamps), posed(truth, stamps=stamps)).alignments
    assert judged[0].absolute.mean_nees / 6 == pytest.approx(1.0, abs=0.05)
    assert 0.93 < judged[0].absolute.nees_inside < 0.97
    bold = compare(posed(found, covariance / 4, stamps), posed(truth, stamps=stamps)).alignments[0]
    assert bold.absolute.mean_nees == pytest.approx(4 * judged[0].absolute.mean_nees)


@pytest.mark.parametrize("held", [0, 17])
def test_covariances_relative_to_a_pose_that_is_held_are_judged_in_its_frame(held: int) -> None:
    draw, truth = np.random.default_rng(4), breathing(np.arange(600) / 30)
    sigma = np.array([1e-3, 2e-3, 1e-3, 0.02, 0.01, 0.05])
    off = draw.normal(size=(600, 6)) * sigma
    off[held] = 0.0
    covariance = np.tile(np.diag(sigma**2), (600, 1, 1))
    covariance[held] *= 1e-6
    frame = se3.exp(np.array([0.1, -0.2, 0.3, 5.0, -3.0, 2.0]))  # the truth's surface frame is another
    stamps = np.arange(600) / 30
    judged = compare(posed(truth @ se3.exp(off), covariance, stamps), posed(truth @ frame, stamps=stamps)).at_one_pose
    assert judged.absolute.mean_nees / 6 == pytest.approx(1.0, abs=0.05)


def test_positions_on_a_line_determine_no_alignment() -> None:
    truth = np.tile(np.eye(4), (30, 1, 1))
    truth[:, 2, 3] = np.arange(30)
    result = compare(posed(truth, stamps=STAMPS[:30]), posed(truth, stamps=STAMPS[:30]))
    assert [judged.name for judged in result.alignments] == [name for name in ALIGNMENTS if name != ALIGNMENTS[1]]


def test_a_denser_trajectory_gives_each_instant_once() -> None:
    truth, dense = breathing(STAMPS), np.arange(2900) / 1000
    result = compare(posed(breathing(dense), stamps=dense), posed(truth))
    assert len(result.stamps) == np.sum(dense[-1] + 5e-4 >= STAMPS) and result.gap <= 5e-4


def test_a_recording_gives_its_poses_by_channel(tmp_path: Path) -> None:
    recording = whole_recording(tmp_path)
    found = read_pose_series(str(recording))
    assert found.name.endswith("x.mcap:pose") and len(found) == 24
    assert np.isfinite(found.covariance).all()
    assert len(read_pose_series(f"{recording}:pose")) == 24
    for words, what in ((f"{recording}:smoothed", "poses"), (f"{recording}:wrong", "channel")):
        with pytest.raises(InputError) as told:
            read_pose_series(words)
        assert told.value.what == what


def test_the_command_writes_page_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, found = moved(3)
    write_tum(tmp_path / "found.tum", Trajectory(STAMPS, found, exact=False))
    write_tum(tmp_path / "truth.tum", Trajectory(STAMPS, truth, exact=True))
    out = tmp_path / "out"
    assert main(["compare", str(tmp_path / "found.tum"), str(tmp_path), "-o", str(out)]) == 0
    told = capsys.readouterr().out
    figures = json.loads((out / "compare.json").read_text())
    assert figures["pairs"] == 90 and figures["reference_is_exact"]
    plain, aligned = (figures[name]["ape"]["translation_mm"]["rmse"] for name in ALIGNMENTS[:2])
    assert aligned < plain and f"{plain:#.3g} mm" in told
    assert f"over 90 of 90 poses, in a common surface frame, against {tmp_path / 'truth.tum'}." in told
    page = (out / "report.html").read_text()
    assert "Absolute pose error" in page and "NEES" not in page and "http" not in page.replace("http://www.w3.org", "")


def test_the_truth_in_a_recording_is_found_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        poses = [pose(float(stamp), k) for k, stamp in enumerate(STAMPS[:9])]
        placed = np.stack([each.base_from_surface for each in poses])
        recorder.truth(Trajectory(STAMPS[:9], placed, exact=True))
        for each in poses:
            recorder.frame(Frame(0, each.stamp, image(0, 0)))
            recorder.write(each)
    for words in (["x.mcap"], ["x.mcap:pose", "x.mcap"]):  # of a reference the truth comes first
        assert main(["compare", *(str(tmp_path / word) for word in words)]) == 0
        told = capsys.readouterr().out
        assert "9 of 9 poses" in told and "x.mcap:truth." in told


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "poses = 'none'"),
        ("1 2 3\n", "line 1"),
        ("9 0 0 0 0 0 0 1\n10 0 0 0 0 0 0 1\n11 0 0 0 0 0 0 1\n", "same clock"),
    ],
)
def test_errors_are_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str) -> None:
    write_tum(tmp_path / "truth.tum", Trajectory(STAMPS, breathing(STAMPS), exact=True))
    (tmp_path / "a.tum").write_text(text)
    assert main(["compare", str(tmp_path / "a.tum"), str(tmp_path / "truth.tum")]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


@pytest.mark.parametrize(
    ("nees", "fixed", "honest"),
    [(0.79, True, False), (0.81, True, True), (1.24, True, True), (1.81, True, False)]
    + [(0.19, False, False), (0.3, False, True), (1.81, False, True), (2.5, False, False)],
)
def test_covariances_that_are_not_calibrated_are_said_not_to_be(nees: float, fixed: bool, honest: bool) -> None:
    words = consistency_text(nees, fixed)
    assert ("inconsistent" in words) is not honest
    assert honest or f"{nees**0.5:.2g} times" in words
