"""`stillbed calibrate`: boards drawn and found again, a rendered recording calibrated, wrong inputs by name."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation import se3
from estimation.errors import InputError
from estimation.rig import pixels_from_points
from hardware.calibration.corners import collect_corners, content_key, read_corners, write_corners
from hardware.calibration.inputs import open_source
from hardware.calibration.run import (
    CalibrationOptions,
    CalibrationResult,
    PrintOptions,
    board_of,
    drawing,
    pdf,
    run_calibration,
    svg,
    write_print,
)
from hardware.cli.main import main
from hardware.files.rig_file import read_board, read_rig, write_board
from hardware.process.progress import no_progress
from hardware.simulator.scene.render import BoardView
from perception.boards.board import (
    Board,
    CornerFinder,
    charuco_board,
    ink_cells,
    thin_instants,
    undistort,
    usable_views,
    whole_view,
)
from perception.frames import Image
from tests.board_session import BOARD, LENSES, OFFSETS, rendered, small_rig

POSE = se3.exp(np.array([0.3, -0.25, 0.2, 0.0, 0.0, 0.0])) @ se3.make(np.eye(3), [-108.0, -135.0, 0.0])
POSE = se3.make(np.eye(3), [0.0, 0.0, 620.0]) @ POSE
CHESS = Board("chessboard", (7, 10), 25.0)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(tmp_path_factory.mktemp("board") / "session")


@pytest.fixture(scope="module")
def board_file(session: Path) -> Path:
    write_board(session.parent / "board.toml", BOARD)
    return session.parent / "board.toml"


@pytest.fixture(scope="module")
def outcome(session: Path, board_file: Path) -> CalibrationResult:
    return run_calibration(session, board_file, session.parent / "rig.toml", CalibrationOptions(), no_progress)


def seen(board: Board, as_board: Board | None = None, change: Callable[[Image], Image] = lambda image: image) -> int:
    picture = BoardView(small_rig().cameras[0], board).picture(POSE, 0.6, 1.5, np.random.default_rng(0))
    return CornerFinder(as_board or board)(np.ascontiguousarray(change(picture))).count


@pytest.mark.parametrize(
    "board", [BOARD, replace(BOARD, legacy=True), replace(BOARD, squares=(5, 4)), Board()], ids=str
)
def test_what_is_drawn_is_what_opencv_draws(board: Board) -> None:
    ink, _ = ink_cells(board)
    drawn = charuco_board(board).generateImage((ink.shape[1] * 8, ink.shape[0] * 8))
    assert np.array_equal(np.kron(ink, np.ones((8, 8))) > 0, drawn < 128)


@pytest.mark.parametrize("board", [BOARD, replace(BOARD, inverted=True), CHESS, replace(CHESS, inverted=True)], ids=str)
def test_corners_are_found_where_they_are(board: Board) -> None:
    camera = small_rig().cameras[0]
    middle = POSE @ se3.make(np.eye(3), BOARD.corners.mean(0) - board.corners.mean(0))
    picture = BoardView(camera, board).picture(middle, 0.6, 1.5, np.random.default_rng(0))
    found = CornerFinder(board)(picture)
    true = pixels_from_points(camera, se3.transform_points(middle, board.corners))[0]
    assert found.count == len(board.corners) and np.sqrt(np.mean((found.pixels - true) ** 2)) < 0.15
    assert 0.4 < found.blur < 1.5


def test_a_board_is_not_taken_for_another_nor_seen_in_a_mirror() -> None:
    assert seen(BOARD) == 12 and seen(BOARD, replace(BOARD, inverted=True)) == 0
    assert seen(BOARD, replace(BOARD, dictionary="5X5_50")) == 0
    assert seen(BOARD, change=lambda image: image[:, ::-1]) == 0
    assert seen(BOARD, change=lambda image: np.rot90(image)) == 12


def test_a_blurred_picture_is_told_to_be_so() -> None:
    view, rng = BoardView(small_rig().cameras[0], BOARD), np.random.default_rng(0)
    blur = [CornerFinder(BOARD)(view.picture(POSE, sigma, 1.5, rng)).blur for sigma in (0.6, 1.0, 1.5)]
    assert blur[0] < blur[1] < blur[2]


def test_board_files_come_back_and_wrong_ones_are_named(tmp_path: Path) -> None:
    path = tmp_path / "board.toml"
    for board in (BOARD, CHESS, replace(BOARD, inverted=True, legacy=True)):
        write_board(path, board)
        assert read_board(path) == board
    for text, named in (
        ('kind = "dots"', "kind"),
        ('kind = "charuco"\nsquares = [4.5, 5]', "squares"),
        ('kind = "charuco"\nsquares = [4, 5]\nsquare_mm = 0', "square_mm"),
        ('kind = "charuco"\nsquares = [4, 5]\nsquare_mm = 54\ndictionary = "4X4_51"', "dictionary"),
        ('kind = "charuco"\nsquares = [30, 30]\nsquare_mm = 5', "dictionary"),
        ('kind = "chessboard"\nsquares = [8, 8]\nsquare_mm = 5', "squares"),
    ):
        lines = text if "squares" in text else text + "\nsquares = [4, 5]"
        lines = lines if "square_mm" in text else lines + "\nsquare_mm = 5"
        path.write_text(lines)
        with pytest.raises(InputError, match=named):
            read_board(path)


@pytest.mark.parametrize(
    "wish", [PrintOptions(), PrintOptions(inverted=True), PrintOptions("chessboard", page="A3", square=30)], ids=str
)
def test_a_print_has_the_boards_true_size_and_a_ruler(wish: PrintOptions) -> None:
    board = board_of(wish)
    made = drawing(board, (297.0, 420.0))
    area = float((made.ink[:, 2] * made.ink[:, 3]).sum())
    ink, cell = ink_cells(board)
    rim = 0.2 * board.square * 2 * (sum(board.size) + 0.4 * board.square) if board.inverted else 0.0
    assert area == pytest.approx(ink.sum() * cell**2 + rim + 30.0 + 11 * 1.2 + 10 * 0.6, rel=1e-6)
    assert 'width="297mm" height="420mm"' in svg(made)
    text = pdf(made).decode("latin-1")
    assert re.search(r"/MediaBox \[0 0 841\.88\d+ 1190\.5\d+\]", text)
    start = int(text.rsplit("startxref\n", 1)[1].split()[0])
    assert text[start:].startswith("xref")


def test_a_printed_svg_shows_the_board_that_its_file_describes(tmp_path: Path) -> None:
    write_print(tmp_path / "b.svg", PrintOptions(squares=(4, 5), square=30.0))
    board = read_board(tmp_path / "b.toml")
    picture = np.full((297 * 4, 210 * 4), 255, np.uint8)
    for x, y, w, h in drawing(board, (210.0, 297.0)).ink * 4:
        picture[round(y) : round(y + h), round(x) : round(x + w)] = 0
    assert CornerFinder(board)(picture).count == 12


def test_a_board_file_that_was_edited_is_kept_unless_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command, file = ["calibrate", "board", "-o", str(tmp_path / "b.pdf")], tmp_path / "b.toml"
    assert main(command) == 0
    file.write_text(file.read_text().replace("square_mm = 25.0", "square_mm = 24.9"))
    (tmp_path / "b.pdf").unlink()
    assert main(command) == 2
    assert "b.toml: --out = 'a file that exists', allowed a new one, or --force" in capsys.readouterr().err
    assert read_board(file).square == 24.9 and not (tmp_path / "b.pdf").exists()
    assert main([*command, "--force"]) == 0 and read_board(file).square == 25
    assert main(command) == 2 and "b.pdf: --out" in capsys.readouterr().err


def test_a_board_that_does_not_fit_its_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"3 x 3 to 7 x 10 squares on A4"):
        write_print(tmp_path / "b.pdf", PrintOptions(squares=(9, 12)))


def test_a_recording_gives_its_rig_back(outcome: CalibrationResult) -> None:
    found, rig = outcome.calibration, small_rig()
    for camera, lens, offset in zip(found.rig.cameras, LENSES, OFFSETS, strict=True):
        assert camera.matrix[0, 0] == pytest.approx(lens[0], rel=0.01)
        assert camera.clock_offset == pytest.approx(offset, abs=1e-3)
    for camera, true in zip(found.rig.cameras, rig.cameras, strict=True):
        off = se3.log(se3.inverse(true.base_from_camera) @ camera.base_from_camera)
        assert np.degrees(np.linalg.norm(off[:3])) < 1.0 and np.linalg.norm(off[3:]) < 12


def test_the_files_that_are_written_can_be_read(outcome: CalibrationResult, session: Path) -> None:
    written = read_rig(session.parent / "rig.toml")
    for a, b in zip(written.rig.cameras, outcome.calibration.rig.cameras, strict=True):
        assert np.array_equal(a.matrix, b.matrix) and a.clock_offset == b.clock_offset
    figures = json.loads((session.parent / "rig.json").read_text())
    assert np.shape(figures["covariance"]) == (48, 48) and figures["cameras"][0]["sigma"]["fx"] > 0
    report = (session.parent / "rig.report.html").read_text()
    for words in ("Verdict", "Predicted error", "mm per pixel at the board", "data:image/jpeg", "Calibration passed"):
        assert words in report
    assert outcome.text.startswith("PASS")


def test_the_command_ends_with_the_verdict(session: Path, board_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["calibrate", "cameras", str(session), "--board", str(board_file), "-o", str(session.parent / "rig.toml")]
    written = (session.parent / "rig.toml").read_bytes()
    assert main(command) == 2 and "--force" in capsys.readouterr().err
    assert (session.parent / "rig.toml").read_bytes() == written
    assert main([*command, "--limit-mm", "0.001", "--force"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"away from where the rig.toml had it: b \d\.\d mm, 0\.\d\d degrees; c \d\.\d mm, 0\.", said)
    assert said.startswith("FAIL") and "hold the board in its picture's" in said


def test_corners_are_searched_once_and_damage_again(session: Path, outcome: CalibrationResult, tmp_path: Path) -> None:
    (recording, _), store = open_source(session), tmp_path / "x.npz"
    key = content_key(recording, BOARD)
    table = read_corners(session.parent / "rig.corners.npz", key)
    assert table is not None and table.done == len(recording)
    write_corners(store, key, replace(table, done=0))
    assert read_corners(store, "another") is None
    whole = store.read_bytes()
    store.write_bytes(whole[: len(whole) // 2])
    assert read_corners(store, key) is None
    store.write_bytes(b"")
    assert read_corners(store, key) is None
    asked: list[int] = []
    write_corners(store, key, replace(table, done=len(recording) - 1))
    again = collect_corners(recording, BOARD, store, lambda done, total: asked.append(done))
    assert asked == [len(recording)] and again.done == len(recording)


def test_long_recordings_are_thinned_in_runs() -> None:
    instant = np.repeat(np.arange(1000), 2)
    kept = thin_instants(instant, np.ones(2000, bool))
    chosen = np.unique(instant[kept])
    assert len(chosen) <= 250 and (np.diff(chosen) == 1).mean() > 0.8


def test_undistorted_pictures_keep_every_pixel() -> None:
    camera = small_rig().cameras[0]
    assert undistort(camera, np.zeros((480, 640, 3), np.uint8)).shape == (480, 640, 3)
    assert whole_view(camera)[0, 0] < camera.matrix[0, 0]


def test_a_rig_without_lenses_is_enough_to_begin(session: Path, tmp_path: Path, outcome: CalibrationResult) -> None:
    shutil.copytree(session, tmp_path / "s")
    lines = [f'[[camera]]\nname = "{n}"\nimages = "{n}/*"\nsize = [640, 480]\n' for n in "abc"]
    (tmp_path / "s" / "rig.toml").write_text("\n".join(lines))
    bare, material = open_source(tmp_path / "s")
    assert not material.calibrated and [c.name for c in bare.rig.cameras] == ["a", "b", "c"]
    table = collect_corners(open_source(session)[0], BOARD, None, no_progress)
    views, _ = usable_views(table, BOARD, ("a", "b", "c"), ((640, 480),) * 3)
    assert len(views) == len(outcome.calibration.views)


@pytest.mark.slow
def test_a_chessboard_calibrates_as_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    board = Board("chessboard", (6, 7), 40.0)
    folder, out = rendered(tmp_path / "session", instants=12, board=board), tmp_path / "rig.toml"
    write_board(tmp_path / "board.toml", board)
    command = ["calibrate", "cameras", str(folder), "--board", str(tmp_path / "board.toml"), "-o", str(out)]
    assert main(command) == 0 and capsys.readouterr().out.startswith("PASS")
    for camera, lens, true in zip(read_rig(out).rig.cameras, LENSES, small_rig().cameras, strict=True):
        assert camera.matrix[0, 0] == pytest.approx(lens[0], rel=0.005)
        off = se3.log(se3.inverse(true.base_from_camera) @ camera.base_from_camera)
        assert np.linalg.norm(off[3:]) < 3 and np.degrees(np.linalg.norm(off[:3])) < 0.3
