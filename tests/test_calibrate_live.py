"""`stillbed calibrate cameras` before live cameras: it guides, keeps what it found, goes on, and calibrates."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation import se3
from estimation.calibration.lens_fit import MIN_PLANE_CORNERS, focal_from_terms, focal_terms, homography, poses
from estimation.rig import pixels_from_points
from hardware.calibration.corners import (
    COVERAGE_GRID,
    MIN_COMMON_SETS,
    CoverageGuide,
    board_orientations,
    coverage_from_parts,
    missing_coverage,
    parts_of,
)
from hardware.calibration.live import WavingRecorder, devices_named, watch
from hardware.calibration.run import CalibrationOptions, finish
from hardware.cameras.feed import CameraPhase, CameraState, LiveHealth
from hardware.cli.main import main
from hardware.files.rig_file import read_rig, write_board
from hardware.process.progress import Progress
from perception.frames import Frame, FrameSet, Image, StampedBy
from tests.board_session import BOARD, LENSES, rendered, small_rig
from tests.boards import motion
from tests.camera_streams import CLOCK, HttpCamera, served
from tests.command_processes import spoken, started

SIZE, RATE = (640, 480), 8.0
INSTANTS = 14
SOON = 60.0  # s, by which even a busy machine has looked at a dozen pictures


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[list[Image]]:
    """What each of three cameras sees, there and back again."""
    folder = rendered(tmp_path_factory.mktemp("live") / "session", INSTANTS)
    ways = [[cv2.imread(str(p)) for p in sorted((folder / name).glob("*.png"))] for name in "abc"]
    return [[np.asarray(p, np.uint8) for p in [*way, *way[-2:0:-1]] if p is not None] for way in ways]


@pytest.fixture
def cameras(pictures: list[list[Image]]) -> Iterator[list[HttpCamera]]:
    begin = CLOCK.now()

    def shown(way: list[Image]) -> HttpCamera:
        return HttpCamera(fps=RATE, picture_of=lambda n: way[int((CLOCK.now() - begin) * RATE) % len(way)])

    three = [shown(way) for way in pictures]
    with served(*three):
        yield three


def board_file(folder: Path) -> Path:
    write_board(folder / "board.toml", BOARD)
    return folder / "board.toml"


class ListedCameras:
    """Three cameras that show a list of pictures, a set each time they are asked, and then end."""

    def __init__(self, ways: list[list[Image]]) -> None:
        self._ways, self._shown = ways, 0

    def next_set(self, until: float) -> FrameSet | None:
        self._shown += 1
        return None if self._over else self._set(self._shown - 1)

    def health(self) -> LiveHealth:
        phase = CameraPhase.ENDED if self._over else CameraPhase.OPEN
        newest = [None if self._shown == 0 else way[0] for way in self._ways]
        return LiveHealth(tuple(state(name, phase, one) for name, one in zip("abc", newest, strict=True)), 0, 0, 0, 0)

    @property
    def _over(self) -> bool:
        return self._shown > len(self._ways[0])

    def _set(self, k: int) -> FrameSet:
        stamp = k / RATE
        return FrameSet(stamp, tuple(Frame(c, stamp, way[k]) for c, way in enumerate(self._ways)))


def state(name: str, phase: CameraPhase, newest: Image | None) -> CameraState:
    by: StampedBy = "driver"
    return CameraState(name, "a list", phase, *[0.0] * 5, by, 0, 0, 0, {}, None, 0, (), newest)


@pytest.mark.slow
def test_live_cameras_are_calibrated_from_what_they_showed(pictures: list[list[Image]], tmp_path: Path) -> None:
    file, out, store = board_file(tmp_path), tmp_path / "rig.toml", tmp_path / "rig.corners.npz"
    devices = devices_named(["http://h/0", "http://h/1", "http://h/2"])
    progress = Progress("corners", "frame sets", CLOCK.now, StringIO())
    once = [way[:INSTANTS] for way in pictures]
    material, table = watch(ListedCameras(once), devices, BOARD, store, None, CLOCK, progress)
    assert table.done == INSTANTS and "camera" in progress.note and "the board" in progress.note
    outcome = finish(material, table, BOARD, file, out, CalibrationOptions(limit=1.0))
    assert outcome.verdict.passed and "camera 2: focal length" in outcome.text
    written = read_rig(out)
    for camera, lens in zip(written.rig.cameras, LENSES, strict=True):
        assert camera.matrix[0, 0] == pytest.approx(lens[0], rel=0.03)
    assert [f'source = "http://h/{c}"' in out.read_text() for c in range(3)] == [True] * 3
    assert (tmp_path / "rig.report.html").exists()


@pytest.fixture
def still(pictures: list[list[Image]]) -> Iterator[list[HttpCamera]]:
    """Cameras before a board that nobody moves: enough never comes."""

    def shown(way: list[Image]) -> HttpCamera:
        return HttpCamera(fps=RATE, picture_of=lambda _: way[0])

    three = [shown(way) for way in pictures]
    with served(*three):
        yield three


@pytest.mark.slow
def test_what_was_found_is_kept_after_ctrl_c_and_the_next_run_goes_on(still: list[HttpCamera], tmp_path: Path) -> None:
    out, store = tmp_path / "rig.toml", tmp_path / "rig.corners.npz"
    urls, file = [camera.url for camera in still], board_file(tmp_path)
    command = ["calibrate", "cameras", *urls, "--board", str(file), "-o", str(out), "--no-page"]
    run = started(command)
    assert "the board" in spoken(run)  # where to hold it, or how to tilt it
    run.send_signal(signal.SIGINT)
    told = run.stderr.read()
    assert run.wait(SOON) == 130
    assert f"the corners so far are in {store}; the same command goes on from there" in told and not out.exists()
    names = ("camera 1", "camera 2", "camera 3")
    before = WavingRecorder(names, (SIZE,) * 3, BOARD, store)
    assert before.search.done > 0 and max(before.guide.coverage(c).parts.sum() for c in range(3)) > 0
    assert main([*command, "--seconds", "0"]) == 2  # a board that stands still tells no lens
    after = WavingRecorder(names, (SIZE,) * 3, BOARD, store)
    assert after.search.done > before.search.done
    assert all(after.guide.coverage(c).parts.sum() >= before.guide.coverage(c).parts.sum() for c in range(3))
    assert WavingRecorder(names, (SIZE,) * 3, replace(BOARD, square=50.0), store).search.done == 0


def test_a_camera_that_shows_nothing_is_named(
    cameras: list[HttpCamera], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("hardware.calibration.live.OPENING_TIMEOUT", 1.0)
    cameras[1].online = False
    urls = [camera.url for camera in cameras]
    files = ["--board", str(board_file(tmp_path)), "-o", str(tmp_path / "rig.toml")]
    command = ["calibrate", "cameras", *urls, *files, "--no-page"]
    assert main(command) == 2
    assert "camera camera 2: pictures = 'none', allowed one within 1 s: camera 2 cannot" in capsys.readouterr().err


def test_offsets_of_a_rig_are_found_anew(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    entry = '[[camera]]\nname = "{}"\nsource = "http://h/{}"\nsize = [640, 480]\nclock_offset_s = 0.5\n'
    numbers = "matrix = [[430, 0, 320], [0, 430, 240], [0, 0, 1]]\ndistortion = [0, 0, 0, 0, 0]\n"
    place = "base_from_camera = [[1, 0, 0, {}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    rig.write_text("".join(entry.format(n, n) + numbers + place.format(100 * n) for n in range(2)))
    devices = devices_named([str(rig)])
    assert devices.rig is not None and [place.offset for place in devices.places] == [0.0, 0.0]


def seen_by(camera: int, poses: np.ndarray) -> list[np.ndarray]:
    """Corners (P, 2) of each pose, nan outside of the picture."""
    out = []
    for pose in poses:
        pixels = pixels_from_points(small_rig().cameras[camera], se3.transform_points(pose, BOARD.corners))[0]
        pixels[((pixels < 0) | (pixels > np.array(SIZE) - 1)).any(-1)] = np.nan
        out.append(pixels)
    return out


def test_the_guide_asks_for_what_is_missing_and_ends_once_it_was_seen() -> None:
    guide = CoverageGuide(("a",), (SIZE,), BOARD)
    assert "a: hold the board in its picture's top left" in guide.missing()[0]
    still = motion(np.zeros(1), np.random.default_rng(0), BOARD.corners.mean(0))
    for pixels in seen_by(0, np.repeat(still, 3, 0)):
        guide.add({0: pixels})
    first = guide.missing()
    assert any("tilt the board by 30 degrees" in words for words in first)
    assert any("nearer to it, and farther away" in words for words in first)
    assert any(f"{MIN_COMMON_SETS - 3} frame sets more" in words for words in first)
    rng = np.random.default_rng(1)
    everywhere = []
    for _ in range(300):
        turn = se3.exp(np.concatenate([rng.uniform(-0.6, 0.6, 3), np.zeros(3)]))
        depth = rng.uniform(450, 800)
        at = np.array([*(rng.uniform(-0.75, 0.75, 2) * [0.75 * depth, 0.56 * depth]), depth])
        everywhere.append(se3.make(np.eye(3), at) @ turn @ se3.make(np.eye(3), -BOARD.corners.mean(0)))
    for pixels in seen_by(0, np.stack(everywhere)):
        guide.add({0: pixels})
    assert guide.missing() == () and guide.coverage(0).depth == pytest.approx(1.5, abs=0.3)


def test_cameras_that_never_see_it_together_are_asked_to() -> None:
    guide = CoverageGuide(("a", "b"), (SIZE,) * 2, BOARD)
    still = motion(np.zeros(1), np.random.default_rng(0), BOARD.corners.mean(0))
    for camera in (0, 1):
        guide.add({camera: seen_by(camera, still)[0]})
    assert f"hold the board where two cameras see it, {MIN_COMMON_SETS} frame sets more" in guide.missing()
    guide.add({c: seen_by(c, still)[0] for c in (0, 1)})
    assert f"hold the board where two cameras see it, {MIN_COMMON_SETS - 1} frame sets more" in guide.missing()


def test_the_sum_is_what_all_views_tell_and_old_ones_are_seldom_seen_again(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = list[int]()

    def counted(planes: np.ndarray, f: np.ndarray) -> np.ndarray:
        looked.append(len(planes))
        return poses(planes, f)

    monkeypatch.setattr("hardware.calibration.corners.poses", counted)
    rng = np.random.default_rng(3)
    views = seen_by(0, motion(np.linspace(0, 20, 120), rng, BOARD.corners.mean(0)))
    views = [pixels + rng.normal(0, 0.2, pixels.shape) for pixels in views]
    views = [pixels for pixels in views if np.isfinite(pixels[:, 0]).sum() >= MIN_PLANE_CORNERS]
    guide, middle = CoverageGuide(("a",), (SIZE,), BOARD), (np.array(SIZE) - 1) / 2
    for pixels in views:
        guide.add({0: pixels})
        guide.missing()
    seen = [np.isfinite(pixels[:, 0]) for pixels in views]
    planes = np.stack([homography(BOARD.corners[s, :2], p[s] - middle) for s, p in zip(seen, views, strict=True)])
    found = poses(planes, np.full(len(planes), focal_from_terms(focal_terms(planes))))
    whole = coverage_from_parts(parts_of(np.stack(views), SIZE), board_orientations(found))
    held = guide.coverage(0)
    assert np.array_equal(held.parts, whole.parts)
    assert held.tilts == pytest.approx(whole.tilts, abs=0.05) and held.depth == pytest.approx(whole.depth, rel=0.03)
    assert len(views) > 60 and sum(looked) < 6 * len(views)


def test_nothing_seen_lacks_everything() -> None:
    held = coverage_from_parts(parts_of(np.zeros((0, 12, 2)), SIZE), board_orientations(np.zeros((0, 4, 4))))
    assert held.parts.shape == COVERAGE_GRID[::-1]
    assert [share for share, _ in missing_coverage("a", held)] == [1.0, 1.0, 1.0]
