"""`stillbed segment`: masks of the inputs' own names and sizes, a table, and what it says of bad input."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from hardware.cli.main import main
from hardware.offline.segment import OVERLAYS, TABLE, Options, listed, run_segment
from perception.wound.segmentation import NetworkSegmenter, Segmentation
from tests.test_segmentation import SETTINGS, disc, picture, red_is_wound

SEGMENTER = NetworkSegmenter(red_is_wound, SETTINGS)


def write_video(file: Path, frames: int) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10, (160, 120))
    for number in range(frames):
        writer.write(picture((60 + number, 60), 20, (120, 160))[0])
    writer.release()


def rows(out: Path) -> list[dict[str, str]]:
    with (out / TABLE).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_masks_have_the_pictures_names_and_sizes_and_are_black_and_white(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, size in (("one.jpg", (120, 160)), ("two.PNG", (90, 70)), ("none.png", (64, 64))):
        image = np.full((*size, 3), 150, np.uint8) if name == "none.png" else picture((30, 40), 15, size)[0]
        cv2.imwrite(str(photos / name), image)
    said = run_segment([photos], tmp_path / "masks", SEGMENTER, Options(overlay=True, mm_per_px=0.5))
    assert said.startswith("2 of 3 pictures show a wound")
    for name, size in (("one", (120, 160)), ("two", (90, 70)), ("none", (64, 64))):
        mask = cv2.imread(str(tmp_path / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == size
        assert set(np.unique(mask)) <= {0, 255}
        assert (tmp_path / "masks" / OVERLAYS / f"{name}.jpg").is_file()
    table = {row["name"]: row for row in rows(tmp_path / "masks")}
    area = int(table["one"]["area_px"])
    assert area == pytest.approx(disc((120, 160), (30, 40), 15).sum(), rel=0.1)
    assert float(table["one"]["area_mm2"]) == pytest.approx(area / 4)
    assert float(table["one"]["centroid_x_px"]) == pytest.approx(30, abs=1)
    assert table["none"]["wound"] == "0" and table["none"]["centroid_x_px"] == table["none"]["x0_px"] == ""
    assert all(float(row["ms"]) > 0 for row in table.values())


def test_a_video_gives_a_mask_a_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "ward.avi", 5)
    run_segment([tmp_path / "ward.avi"], tmp_path / "masks", SEGMENTER, Options())
    assert [row["name"] for row in rows(tmp_path / "masks")] == [f"ward_{k:06d}" for k in range(5)]
    middles = [float(row["centroid_x_px"]) for row in rows(tmp_path / "masks")]
    assert np.allclose(np.diff(middles), 1, atol=0.5)


def test_a_video_cut_short_keeps_what_decodes_and_says_so(tmp_path: Path) -> None:
    file = tmp_path / "cut.avi"
    write_video(file, 20)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cut\.avi"):
        run_segment([file], tmp_path / "masks", SEGMENTER, Options())
    assert len(rows(tmp_path / "masks")) == len(list((tmp_path / "masks").glob("*.png"))) < 20


def test_an_unreadable_picture_is_told_after_the_others_are_done(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    cv2.imwrite(str(tmp_path / "b.png"), picture((30, 30), 9, (60, 60))[0])
    with pytest.raises(InputError, match=r"a\.jpg: picture"):
        run_segment([tmp_path / "a.jpg", tmp_path / "b.png"], tmp_path / "masks", SEGMENTER, Options())
    assert [row["name"] for row in rows(tmp_path / "masks")] == ["b"]


def test_ctrl_c_keeps_what_is_done(tmp_path: Path) -> None:
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture((30, 30), 9, (60, 60))[0])
    left = [1, 1]

    def segmenter(image: np.ndarray) -> Segmentation:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return SEGMENTER(image)

    with pytest.raises(KeyboardInterrupt):
        run_segment([tmp_path], tmp_path / "masks", segmenter, Options())
    assert [row["name"] for row in rows(tmp_path / "masks")] == ["0", "1"]


def test_inputs_that_make_no_sense_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "x.jpg").touch()
    (tmp_path / "x.png").touch()
    (tmp_path / "x.txt").touch()
    for inputs, match in (
        ([tmp_path / "empty"], "pictures"),
        ([tmp_path / "gone"], "no such file"),
        ([tmp_path / "x.txt"], "kind"),
        ([tmp_path / "x.jpg", tmp_path / "x.png"], "masks are named for it"),
    ):
        with pytest.raises(InputError, match=match):
            listed(inputs)


def test_the_command_line_refuses_options_that_do_not_go_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "b.png"), picture((30, 30), 9, (60, 60))[0])
    for extra in (
        ["--mm-per-px", "0"],
        ["--threads", "0"],
        ["--method", "shape", "--model", "x.onnx"],
        ["--scan", "x.ply"],
        ["--model", str(tmp_path / "gone.onnx")],
    ):
        assert main(["segment", str(tmp_path / "b.png"), "-o", str(tmp_path / "out"), *extra]) == 2
        assert capsys.readouterr().err.startswith("stillbed: ")
    assert not (tmp_path / "out").exists()
