"""`stillbed smooth` from a recording with its tracks to the files, once and only once."""

from __future__ import annotations

import csv
import json
import re
import shutil
import tomllib
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from estimation import se3, smooth
from estimation.batch import smooth as solver
from estimation.errors import InputError
from estimation.synthetic.follow import follow_steps
from estimation.synthetic.movements import BreathingSpec, draw_breathing, draw_pulse, draw_walk
from estimation.synthetic.world import arc_rig, synthetic_world
from hardware.cli.main import main
from hardware.files.folder_tables import read_tum
from hardware.files.rig_file import read_rig
from hardware.files.session import FrameRef
from hardware.offline import smooth as run_module
from hardware.offline.smooth_tracks import (
    Rhythm,
    breathing_rhythm,
    pulse_rhythm,
    read_tracks,
    reobserve,
    source_hash,
    tracks_of,
)
from hardware.process.system import file_hash
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import open_session, read_observations, read_poses, read_smoothed
from hardware.report.evaluation import best_constant
from hardware.simulator.scenario import read_scenario
from perception.frames import Frame, Image
from tests.rendered_sets import write_session
from tests.slow_cases import slowly

ROOT = Path(__file__).parents[1]

BLANK = np.full((720, 1280), 90, np.uint8)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live run on a breathing surface, 3 s at 20 Hz, with its truth."""
    path = tmp_path_factory.mktemp("live") / "run.mcap"
    world = synthetic_world("breathing", seconds=3.0, rate=20.0, count=40, offsets=(0.004, 0.0, -0.004))
    with Recorder(path, world.rig) as recorder:
        recorder.truth(world.truth)
        for k, step in enumerate(follow_steps(world, "seen")):
            for camera in range(3 if k % 20 == 0 else 1):
                recorder.frame(Frame(camera, step.pose.stamp, BLANK))
            recorder.write(step.seen)
            recorder.write(step.pose)
    return path


@pytest.fixture(scope="module")
def out(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("smoothed") / "out"
    assert main(["smooth", str(recording), "-o", str(folder), "--rate", "100"]) == 0
    return folder


def test_the_poses_are_better_than_the_live_ones(recording: Path, out: Path) -> None:
    truth = open_session(recording).truth
    ours = read_tum(out / "smoothed.tum", exact=False)
    assert (ours.stamps == truth.stamps).all()
    live = np.stack([pose.base_from_surface for pose in read_poses(recording)])
    off = []
    for poses in (ours.base_from_surface, live):
        constant = best_constant(se3.inverse(truth.base_from_surface) @ poses)
        off.append(se3.log(se3.inverse(poses) @ truth.base_from_surface @ constant)[:, 3:])
    assert np.sqrt((off[0] ** 2).mean()) < 0.8 * np.sqrt((off[1] ** 2).mean())


def test_the_table_has_the_rate_that_was_asked_for(out: Path) -> None:
    with (out / "smoothed.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    stamps = np.array([float(row["stamp_s"]) for row in rows])
    assert np.allclose(np.diff(stamps), 0.01, atol=1e-5) and len(rows) == 295
    assert len(rows[0]) == 8 + 6 + 21 + 21
    assert all(float(row["cov_tz_tz"]) >= 0 and float(row["twist_cov_tz_tz"]) > 0 for row in rows)


def test_rig_map_and_copy_can_be_read_again(recording: Path, out: Path) -> None:
    offsets = [camera.clock_offset for camera in read_rig(out / "rig.toml").rig.cameras]
    assert offsets == pytest.approx([0.004, 0.0, -0.004], abs=0.003)
    header, *_ = (out / "map.ply").read_text(encoding="ascii").split("end_header")
    assert "element vertex 40" in header and "property uchar red" in header
    assert len(list(read_smoothed(out / "smoothed.mcap"))) == 60
    assert len(list(read_observations(out / "smoothed.mcap"))) == len(list(read_observations(recording)))
    assert len(open_session(out / "smoothed.mcap")) == len(open_session(recording))
    assert not list(read_smoothed(recording))


def test_the_report_says_what_was_found(out: Path) -> None:
    text = (out / "report.html").read_text(encoding="utf-8")
    for part in ("Trajectory", "Live minus smoothed", "Residuals", "Spectrum", "Error by delay", "Calibration drift"):
        assert f"<h2>{part}" in text
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["poses"] == 60 and summary["landmarks"] == 40 and 0 < summary["live_rms_mm"] < 0.2


def test_the_covariances_are_judged_in_the_frame_of_the_fixed_pose(
    recording: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", str(out / "smoothed.mcap"), str(recording)]) == 0
    texts = capsys.readouterr().out, json.loads((out / "summary.json").read_text(encoding="utf-8"))["text"]
    compared, summarised = (float(re.search(r"NEES/6: ([\d.]+)", text)[1]) for text in texts)
    assert compared == summarised and 0.4 < summarised < 2.5


@pytest.mark.parametrize(("steps", "converged"), [(40, True), (1, False)])
def test_a_solution_that_has_not_converged_says_so(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int, converged: bool
) -> None:
    monkeypatch.setattr(solver, "MAX_STEPS", steps)
    monkeypatch.setattr(solver, "GATE_WIDENINGS", (4.0,))
    assert main(["smooth", str(recording), "-o", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["converged"] is converged
    assert ("Not converged" in summary["text"]) is not converged
    assert ("Not converged" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")) is not converged


def test_what_is_done_is_not_done_again(
    recording: Path, out: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (out / "summary.json").stat().st_mtime_ns
    assert main(["smooth", str(recording), "-o", str(out), "--rate", "100"]) == 0
    assert "done already" in capsys.readouterr().out
    assert (out / "summary.json").stat().st_mtime_ns == before
    asked = [run_module.content_hash("a session's", run_module.SmoothOptions(rate)) for rate in (100.0, 50.0)]
    assert asked[0] != asked[1]


def test_what_an_earlier_run_left_is_not_taken_for_this_ones(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, folder = tmp_path / "out", tmp_path / "run"
    first = ["smooth", str(recording), "-o", str(out), "--no-relink"]
    assert main(first) == 0 and main(["export", str(recording), "-o", str(folder)]) == 0
    rows = (out / "smoothed.csv").read_text(encoding="utf-8")
    with monkeypatch.context() as patched:
        patched.setattr(run_module, "write_map", interrupted)  # behind smoothed.csv
        assert main([*first, "--rate", "50"]) == 130
    assert (out / "smoothed.csv").read_text(encoding="utf-8") != rows
    assert main(first) == 0 and "done already" not in capsys.readouterr().out
    assert (out / "smoothed.csv").read_text(encoding="utf-8") == rows
    (out / "report.html").unlink()
    assert main(first) == 0 and (out / "report.html").exists()

    monkeypatch.setattr(run_module, "tracks_of", lambda *_: read_tracks(recording))
    assert (out / "smoothed.mcap").exists()
    assert main(["smooth", str(folder), "-o", str(out), "--no-relink"]) == 0
    assert not (out / "smoothed.mcap").exists()  # the poses of another session


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_neither_a_session_nor_another_commands_report_is_overwritten(
    recording: Path, out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sessions = tmp_path / "sessions"
    assert main(["export", str(recording), "-o", str(sessions / "monday")]) == 0
    rig = (sessions / "monday/rig.toml").read_bytes()
    assert main(["smooth", str(sessions / "monday"), "-o", str(sessions / "monday")]) == 2
    assert main(["smooth", str(sessions), "-o", str(sessions)]) == 1
    assert (sessions / "monday/rig.toml").read_bytes() == rig
    assert "would be overwritten" in (sessions / "sessions.csv").read_text(encoding="utf-8")

    (tmp_path / "summary.json").write_text('{"poses": 60}')  # of `stillbed track`
    assert main(["smooth", str(recording), "-o", str(tmp_path)]) == 2
    assert (tmp_path / "summary.json").read_text() == '{"poses": 60}'
    report = (out / "report.html").read_bytes()
    assert main(["compare", str(out), "-o", str(out)]) == 2
    assert (out / "report.html").read_bytes() == report
    assert capsys.readouterr().err.count("another command's report") == 2


@pytest.mark.parametrize("share", [0.9, *slowly(0.5, 0.999)])
def test_damage_cuts_the_end(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], share: float) -> None:
    cut, out, data = tmp_path / "cut.mcap", tmp_path / "out", recording.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    assert main(["smooth", str(cut), "-o", str(out), "--no-relink"]) == 1
    damage = open_session(cut).damage
    assert damage and capsys.readouterr().out.startswith(f"The recording is damaged: {damage}. ")
    copied = open_session(out / "smoothed.mcap")
    assert copied.damage == "" and len(copied) == len(open_session(cut))
    assert len(list(read_smoothed(out / "smoothed.mcap"))) == len(list(read_poses(cut)))


def test_a_failed_session_stops_no_other(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["smooth", str(tmp_path / "no.mcap"), str(recording), "-o", str(tmp_path / "all")]) == 1
    text = capsys.readouterr().out
    assert "no.mcap: not smoothed" in text and "60 poses" in text
    assert (tmp_path / "all" / "run" / "smoothed.tum").exists()


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of a few pictures, without tracks."""
    folder = tmp_path_factory.mktemp("pictures") / "breathing"
    write_session(folder, seconds=0.6, rate=10.0, seed=2, cameras=arc_rig(size=(320, 240), focal=280.0))
    return folder


@pytest.mark.slow
def test_changed_pictures_are_tracked_anew(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"

    def times() -> list[int]:
        return [(out / name).stat().st_mtime_ns for name in ("tracks.mcap", "relinked.mcap")]

    assert main(["smooth", str(pictures), "-o", str(out)]) == 0
    assert "looks at landmarks were found" in capsys.readouterr().out
    summary, first = json.loads((out / "summary.json").read_text(encoding="utf-8")), times()
    looks = sum(map(len, read_observations(out / "relinked.mcap")))
    assert summary["looks_found"] == looks > 0 and summary["error_mm"] < 0.1
    assert main(["smooth", str(pictures), "-o", str(out), "--no-relink"]) == 0
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["looks_found"] == 0 and times() == first

    changed, kept = tmp_path / "breathing", source_hash(out / "tracks.mcap")
    shutil.copytree(pictures, changed)
    picture, other = sorted((changed / "cam_0").iterdir())[3:5]
    shutil.copyfile(other, picture)
    tracks_of(open_session(changed), out, file_hash(changed))
    assert times()[0] > first[0] and source_hash(out / "tracks.mcap") not in ("", kept)


def test_a_picture_that_cannot_be_read_leaves_the_tracks_to_be_smoothed(recording: Path, tmp_path: Path) -> None:
    session = open_session(recording)
    tracks = tracks_of(session, tmp_path, "")
    result = smooth(session.rig, tracks.observations, start=tracks.start)
    broken = replace(session, open_reader=Unreadable)
    found = reobserve(broken, tracks, result, tmp_path, "of these", StringIO())
    assert found.looks == 0 and "no picture" in found.text
    assert source_hash(tmp_path / "relinked.mcap") == ""


class Unreadable:
    """Holds no picture."""

    def read(self, ref: FrameRef) -> Image:
        raise InputError("x.avi", "picture", "no picture", "a whole one")

    def encoded(self, ref: FrameRef) -> None:
        return None

    def close(self) -> None:
        """Nothing is open."""


def chest(seed: int, seconds: float, pulse: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Times (N,), s, positions (N, 3), mm, of a breathing chest with a pulse of some mm, and the pulse's rate, Hz."""
    rng, times = np.random.default_rng(seed), np.arange(0, seconds, 1 / 30)
    spec = BreathingSpec(rng.uniform(3, 5.5), period_spread=float(rng.choice([0.03, 0.1])), depth_spread=0.1)
    waves = draw_breathing(spec, rng), draw_walk(rng), draw_pulse(rng.uniform(0.9, 1.9), 0.03, 0.1, rng)
    axes = np.array([[0.8, 1.6, 7.8], [0.15, 0.15, 0.2], pulse * rng.normal(size=3) / 3**0.5])
    noise = gaussian_filter1d(rng.normal(size=(len(times), 3)), 1.0, axis=0)
    positions = sum(wave(times)[:, None] * axis for wave, axis in zip(waves, axes, strict=True)) + 0.01 * noise
    beats = int(np.searchsorted(waves[2].starts, seconds))
    return times, positions, beats / float(waves[2].starts[beats])


def rhythms_of(times: np.ndarray, positions: np.ndarray) -> tuple[Rhythm, Rhythm]:
    centred = positions - positions.mean(0)
    breathing = breathing_rhythm(times, centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1])
    return breathing, pulse_rhythm(times, positions, breathing)


@pytest.mark.slow
def test_a_pulse_is_found_where_there_is_one_within_its_claim_and_none_where_there_is_none() -> None:
    found = []
    for seed in range(8):
        times, positions, rate = chest(seed, 60.0, 0.15 if seed % 2 else 0.0)
        pulse = rhythms_of(times, positions)[1]
        if seed % 2 == 0:
            assert pulse.why and np.isnan(pulse.rate) and pulse.words("pulse") == f"No pulse found: {pulse.why}."
        elif not pulse.why:
            found.append(abs(pulse.rate - rate) <= pulse.claim)
            assert pulse.claim < 0.05 * rate
    assert len(found) >= 3 and sum(found) >= len(found) - 1


@pytest.mark.parametrize("rate", [0.25, 0.4])
def test_the_harmonics_of_an_even_breath_are_no_pulse(rate: float) -> None:
    times = np.arange(0, 60, 1 / 30)
    breath = 8 * np.abs(np.sin(np.pi * rate * times)) ** 3  # a ventilator: each like the other, with a kink
    noise = 0.005 * np.random.default_rng(1).normal(size=(len(times), 3))
    breathing, pulse = rhythms_of(times, breath[:, None] * [0.1, 0.2, 0.97] + noise)
    assert breathing.rate == pytest.approx(rate, abs=breathing.claim) and pulse.why


@pytest.mark.parametrize("kind", ["noise", "walk"])
def test_chance_has_no_rhythm(kind: str) -> None:
    for seed in range(6):
        rng, times = np.random.default_rng(seed), np.arange(0, 60, 1 / 30)
        steps = rng.normal(size=(len(times), 3))
        positions = np.cumsum(steps, axis=0) if kind == "walk" else steps
        assert all(rhythm.why for rhythm in rhythms_of(times, 0.05 * positions))


UNLIKE = ("breathing_calm", "breathing_irregular", "shaking_table_0_5_hz", "steps_300um", "still")  # in their motion
ALIKE = [file.stem for file in sorted((ROOT / "data" / "scenarios").glob("*.toml")) if file.stem not in UNLIKE]


@pytest.mark.parametrize("name", [*UNLIKE, *slowly(*ALIKE)])
def test_no_scenario_gets_a_rate_that_is_off_by_more_than_its_claim(name: str) -> None:
    """By its exact surface, for as long as it lasts and for a minute, with a smoothed session's noise."""
    file = ROOT / "data" / "scenarios" / f"{name}.toml"
    scenario, table = read_scenario(file), tomllib.loads(file.read_text(encoding="utf-8"))
    rates = {part["kind"]: part.get("rate_hz", 1.15) for part in table.get("motion", [])}
    rng = np.random.default_rng(7)
    for seconds in (scenario.seconds, 60.0):
        times = np.arange(0, seconds, 1 / 30)
        noise = gaussian_filter1d(rng.normal(size=(len(times), 3)), 1.0, axis=0)
        positions = (scenario.rest @ scenario.motion(times))[:, :3, 3]
        breathing, pulse = rhythms_of(times, positions + 0.01 * noise)
        if not pulse.why:
            assert "pulse" in rates and abs(pulse.rate - rates["pulse"]) <= pulse.claim + 0.02 * rates["pulse"], pulse
        if not breathing.why and "breathing" in rates:
            assert abs(breathing.rate - rates["breathing"]) <= breathing.claim + 0.1 * rates["breathing"], breathing
        elif not breathing.why:  # of a table or of steps: then it comes back after that time
            again = scenario.motion(times + 1 / breathing.rate)[:, :3, 3] - scenario.motion(times)[:, :3, 3]
            assert again.std() < 0.4 * positions.std(axis=0).max(), breathing
