"""The page that is watched while a run goes on."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from estimation import se3
from estimation.pose import SurfacePose, TrackState
from estimation.rig import pixels_from_points
from estimation.synthetic.arc_rig import REST, arc_rig
from hardware.simulator.watch import EVERY, NARROW, WIDE, Watch
from perception.frames import Frame, FrameSet, Image

RIG = arc_rig()
DOTTED = np.array([[x, y, 0.0] for x in (-8.0, 8.0) for y in (-5.0, 5.0)])
POSE = SurfacePose(1.0, REST, np.eye(6), np.zeros(6), TrackState.TRACKING)


def frames(stamp: float = 1.0, cameras: tuple[int, ...] = (0, 1, 2), gray: bool = False) -> FrameSet:
    shape = (720, 1280) if gray else (720, 1280, 3)
    return FrameSet(stamp, tuple(Frame(camera, stamp, np.full(shape, 60, np.uint8)) for camera in cameras))


def shown(folder: Path, pose: SurfacePose = POSE, line: np.ndarray | None = DOTTED, **more: object) -> Image:
    Watch(folder, RIG, "A <title>").show(frames(**more), pose, line, [("arm", "prints & waits")])  # type: ignore[arg-type]
    picture = cv2.imread(str(folder / "watch.jpg"))
    assert picture is not None
    return np.asarray(picture, np.uint8)


def drawn(picture: Image) -> np.ndarray:
    """Where (540, 960) something bright stands in the first camera's tile, its label and the frame left out."""
    bright = picture[: WIDE[1], : WIDE[0]].max(axis=2) > 130
    bright[:50] = bright[:, :20] = bright[-20:] = bright[:, -20:] = False
    return np.asarray(bright)


def test_the_page_says_what_is_told_and_renews_itself_until_the_run_is_over(tmp_path: Path) -> None:
    watch = Watch(tmp_path, RIG, "A <title>")
    watch.show(frames(), POSE, None, [("arm", "prints & waits")])
    text = watch.page.read_text()
    assert 'http-equiv="refresh"' in text
    assert "A &lt;title&gt;" in text and "prints &amp; waits" in text and POSE.state.value in text
    watch.finish("It was <good>.")
    text = watch.page.read_text()
    assert "refresh" not in text
    assert "It was &lt;good&gt;." in text and 'href="report.html"' in text


def test_there_is_one_picture_for_each_half_second_of_the_run(tmp_path: Path) -> None:
    watch = Watch(tmp_path, RIG, "x")
    written = set()
    for i in range(31):
        stamp = i * EVERY / 10
        watch.show(frames(stamp, cameras=()), SurfacePose(stamp, *_rest()), None, [])
        written.add(watch.page.read_text().split("watch.jpg?")[1].split('"')[0])
    assert written == {"1", "2", "3", "4"}


def _rest() -> tuple[np.ndarray, np.ndarray, np.ndarray, TrackState]:
    return REST, np.eye(6), np.zeros(6), TrackState.TRACKING


def test_the_line_is_drawn_where_the_pose_says_and_only_while_it_is_measured(tmp_path: Path) -> None:
    rows, columns = np.nonzero(drawn(shown(tmp_path)))
    assert len(rows) > 300
    assert abs(rows.mean() - WIDE[1] / 2) < 15 and abs(columns.mean() - WIDE[0] / 2) < 15  # close to the line
    lost = SurfacePose(1.0, REST, np.eye(6), np.zeros(6), TrackState.LOST, reason="blind")
    assert not drawn(shown(tmp_path, lost)).any()
    assert not drawn(shown(tmp_path, line=None)).any()


def test_a_line_behind_a_camera_is_not_drawn(tmp_path: Path) -> None:
    camera = RIG.cameras[0]
    behind = SurfacePose(1.0, camera.base_from_camera @ se3.make(np.eye(3), [0, 0, -300]), *_rest()[1:])
    assert (pixels_from_points(camera, se3.transform_points(behind.base_from_surface, DOTTED))[1] < 0).all()
    assert not drawn(shown(tmp_path, behind)).any()


def test_a_missing_camera_is_a_dark_tile_and_gray_pictures_are_shown(tmp_path: Path) -> None:
    both = shown(tmp_path, line=None, cameras=(0, 2), gray=True)
    assert both.shape == (max(WIDE[1], 2 * NARROW[1]), WIDE[0] + NARROW[0], 3)
    first, missing, third = both[300, 300], both[150, WIDE[0] + 200], both[NARROW[1] + 150, WIDE[0] + 200]
    assert abs(int(first[0]) - 60) < 8 and abs(int(third[0]) - 60) < 8
    assert missing.max() < 40


def test_rigs_of_one_camera_and_of_five_have_a_page(tmp_path: Path) -> None:
    for count in (1, 5):
        rig = arc_rig(tuple(20.0 * i for i in range(count)))
        watch = Watch(tmp_path, rig, "x")
        watch.show(frames(cameras=tuple(range(count))), POSE, DOTTED, [])
        assert (tmp_path / "watch.jpg").stat().st_size > 1000
