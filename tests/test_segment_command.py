"""`stillbed segment`: masks, a table, bad input; the network that comes along finds wounds, not skin."""

from __future__ import annotations

import argparse
import csv
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from estimation.observations import no_observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from hardware.bench.pictures import new_to, run_segmentation
from hardware.bench.subjects import SUBJECTS
from hardware.cli.main import main
from hardware.files.images import encode
from hardware.files.path_file import write_path
from hardware.files.pose_file import WOUND_FILE_NAME, WoundFile
from hardware.live.prepared import prepare
from hardware.live.settings import LiveSettings
from hardware.offline.segment import OVERLAY_FOLDER, WOUND_TABLE, SegmentOptions, input_files, run_segment
from hardware.simulator.scene.render import WoundView, mask_from_outlines, wound_view
from perception.frames import Frame, FrameSet
from perception.tracking.step import report_without_offsets
from perception.training.dataset import Labelled, read_dataset
from perception.wound.network import SHIPPED_MODEL, WoundNetwork, hash_of, read_settings, shipped_model
from perception.wound.segmentation import NetworkSegmenter, Segmentation, centroid, dice
from tests.moving_surfaces import raster
from tests.session_files import make_folder
from tests.test_segmentation import SETTINGS, disc, picture, red_is_wound

SEGMENTER = NetworkSegmenter(red_is_wound, SETTINGS)


def write_video(file: Path, frames: int) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10, (160, 120))
    for number in range(frames):
        writer.write(picture((60 + number, 60), 20, (120, 160))[0])
    writer.release()


def rows(out: Path) -> list[dict[str, str]]:
    with (out / WOUND_TABLE).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_masks_have_the_pictures_names_and_sizes_and_are_black_and_white(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, size in (("one.jpg", (120, 160)), ("two.PNG", (90, 70)), ("none.png", (64, 64))):
        image = np.full((*size, 3), 150, np.uint8) if name == "none.png" else picture((30, 40), 15, size)[0]
        cv2.imwrite(str(photos / name), image)
    said, _ = run_segment([photos], tmp_path / "masks", SEGMENTER, SegmentOptions(overlay=True, mm_per_px=0.5))
    assert said.startswith("2 of 3 pictures show a wound")
    for name, size in (("one", (120, 160)), ("two", (90, 70)), ("none", (64, 64))):
        mask = cv2.imread(str(tmp_path / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == size and set(np.unique(mask)) <= {0, 255}
        assert (tmp_path / "masks" / OVERLAY_FOLDER / f"{name}.jpg").is_file()
    table = {row["name"]: row for row in rows(tmp_path / "masks")}
    area = int(table["one"]["area_px"])
    assert area == pytest.approx(disc((120, 160), (30, 40), 15).sum(), rel=0.1)
    assert float(table["one"]["area_mm2"]) == pytest.approx(area / 4)
    assert float(table["one"]["centroid_x_px"]) == pytest.approx(30, abs=1)
    assert table["none"]["wound"] == "0" and table["none"]["centroid_x_px"] == table["none"]["x0_px"] == ""
    assert all(float(row["ms"]) > 0 for row in table.values())


def test_with_force_nothing_of_an_earlier_run_stays_but_what_is_read(tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "out" / "other.txt"
    for name in ("first.png", "second.png"):
        cv2.imwrite(str(tmp_path / name), picture((30, 40), 15, (120, 160))[0])
    run_segment([tmp_path / "first.png"], out, SEGMENTER, SegmentOptions(overlay=True))
    other.touch()
    run_segment([tmp_path / "second.png"], out, SEGMENTER, SegmentOptions(force=True))
    assert {file.name for file in out.rglob("*") if file.is_file()} == {"second.png", "wounds.csv", "other.txt"}
    run_segment([out / "second.png"], out / "masks", SEGMENTER, SegmentOptions())
    (out / "masks" / "wounds.csv").replace(out / "wounds.csv")
    with pytest.raises(InputError, match="would be overwritten"):
        run_segment([out / "second.png"], out, SEGMENTER, SegmentOptions(force=True))
    assert (out / "second.png").exists()


def test_pictures_that_a_table_of_somebody_else_names_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for file in (tmp_path / "first.png", out / "own.png"):
        cv2.imwrite(str(file), picture((30, 40), 15, (120, 160))[0])
    (out / WOUND_TABLE).write_text("name,patient\nown,7\n")
    run_segment([tmp_path / "first.png"], out, SEGMENTER, SegmentOptions(force=True))
    assert (out / "own.png").exists() and [row["name"] for row in rows(out)] == ["first"]


def test_a_video_gives_a_mask_a_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "ward.avi", 5)
    run_segment([tmp_path / "ward.avi"], tmp_path / "masks", SEGMENTER, SegmentOptions())
    assert [row["name"] for row in rows(tmp_path / "masks")] == [f"ward_{k:06d}" for k in range(5)]
    middles = [float(row["centroid_x_px"]) for row in rows(tmp_path / "masks")]
    assert np.allclose(np.diff(middles), 1, atol=0.5)


def test_a_video_cut_short_keeps_what_decodes_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "cut.avi"
    write_video(file, 20)
    assert main(["segment", str(file), "-o", str(tmp_path / "whole"), "--method", "shape"]) == 0
    assert "damaged" not in capsys.readouterr().out
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert main(["segment", str(file), "-o", str(tmp_path / "masks"), "--method", "shape"]) == 1
    kept = len(rows(tmp_path / "masks"))
    assert kept == len(list((tmp_path / "masks").glob("*.png"))) < 20
    assert f"The recording is damaged: {file}: {kept} of 20 frames decode, " in capsys.readouterr().out


def test_an_unreadable_picture_is_told_after_the_others_are_done(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    cv2.imwrite(str(tmp_path / "b.png"), picture((30, 30), 9, (60, 60))[0])
    with pytest.raises(InputError, match=r"a\.jpg: picture .*masks of 1 other picture are in .*masks"):
        run_segment([tmp_path / "a.jpg", tmp_path / "b.png"], tmp_path / "masks", SEGMENTER, SegmentOptions())
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
        run_segment([tmp_path], tmp_path / "masks", segmenter, SegmentOptions())
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
            input_files(inputs)


DATA = Path(__file__).parent.parent.parent / "shared" / "data" / "fuseg"


@pytest.fixture(scope="module")
def segmenter() -> NetworkSegmenter:
    network = WoundNetwork(shipped_model(), 1)
    return NetworkSegmenter(network, network.settings)


@pytest.fixture(scope="module")
def views() -> list[WoundView]:
    return [wound_view(seed) for seed in range(2)]


def test_rendered_wounds_are_found_with_exact_masks(segmenter: NetworkSegmenter, views: list[WoundView]) -> None:
    for view in views:
        found = segmenter(view.image)
        assert dice(found.mask, view.wound) > 0.7
        assert np.linalg.norm(centroid(found.mask) - centroid(view.wound)) < 8
    redness = [float(v.image[v.wound][:, 2].mean() - v.image[v.wound][:, 1].mean()) for v in views]
    assert min(redness) > 20


def test_rendered_healthy_skin_shows_no_wound(segmenter: NetworkSegmenter) -> None:
    for seed in range(2):
        view = wound_view(seed, wounded=False)
        assert not view.wound.any() and view.area == 0
        assert not segmenter(view.image).found


def test_the_network_answers_the_same_on_one_thread_and_on_two(views: list[WoundView]) -> None:
    one, two = (WoundNetwork(shipped_model(), threads) for threads in (1, 2))
    first, second = (NetworkSegmenter(each, each.settings)(views[0].image) for each in (one, two))
    assert np.array_equal(first.mask, second.mask)


def test_a_network_of_other_bytes_than_its_settings_say_is_refused(tmp_path: Path) -> None:
    for suffix in (".onnx", ".toml"):
        shutil.copy(shipped_model(suffix=suffix), tmp_path / f"x{suffix}")
    WoundNetwork(tmp_path / "x.onnx", 1)
    with (tmp_path / "x.onnx").open("ab") as stream:
        stream.write(b"\0")
    with pytest.raises(InputError, match="sha256"):
        WoundNetwork(tmp_path / "x.onnx", 1)


def test_what_is_wrong_with_a_network_is_told_by_its_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        WoundNetwork(tmp_path / "gone.onnx")
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"no network")
    with pytest.raises(InputError, match="settings"):
        WoundNetwork(bad)
    wrong = [("", "network"), ("edge = true", "edge"), ("colour = 3", "colour"), ("[looks]\nx = 1", "x")]
    wrong += [(f"edge = {value}", "finite") for value in ("nan", "-inf", "9" * 400)]
    wrong += [(f"[looks]\nwindow = {'9' * 400}", "finite")]
    for extra, match in wrong:
        bad.with_suffix(".toml").write_text(f'sha256 = "{hash_of(bad)}"\n{extra}\n', encoding="utf-8")
        with pytest.raises(InputError, match=match):
            WoundNetwork(bad)


def test_settings_without_a_word_are_the_usual_ones(tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text('sha256 = "abc"\n[looks]\nwindow = 0\n', encoding="utf-8")
    settings = read_settings(tmp_path / "x.toml", "abc")
    assert settings.looks.window == 0 and settings.edge == 0.5


def test_the_true_mask_of_a_disc_has_the_discs_area() -> None:
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    rim = np.column_stack([50 + 20.3 * np.cos(angle), 40 + 20.3 * np.sin(angle)])
    assert mask_from_outlines([rim], (100, 80)).sum() == pytest.approx(np.pi * 20.3**2, rel=0.02)
    assert not mask_from_outlines([], (100, 80)).any()


def red(image: np.ndarray) -> Segmentation:
    """Finds what is red."""
    return Segmentation(image[..., 2].astype(int) - image[..., 1] > 60, 0.9, 0.7)


def test_the_file_of_a_run_holds_each_cameras_wound_and_its_area_once_the_surface_is_tracked(tmp_path: Path) -> None:
    view = wound_view(0)
    rig = Rig((view.camera,))
    image = np.zeros_like(view.image)
    image[view.wound] = (20, 20, 200)
    pose = SurfacePose(0.0, view.base_from_surface, np.eye(6), np.zeros(6), TrackState.TRACKING)
    unseen = report_without_offsets(no_observations(0.0), np.zeros(1, np.int64), np.zeros(5))
    with WoundFile(tmp_path, rig, red) as file:
        for number in range(8):
            stamp = number / 30
            file.write(FrameSet(stamp, (Frame(0, stamp, image),)), replace(pose, stamp=stamp), unseen)
    with (tmp_path / WOUND_FILE_NAME).open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["stamp_s"]) for row in rows] == pytest.approx([0, 0.1], abs=1e-5)
    # A plane stands for a bed some mm deep, and for a body that is curved
    assert float(rows[0]["area_mm2"]) == pytest.approx(view.area, rel=0.12)
    assert rows[0]["camera"] == view.camera.name and rows[0]["wound"] == "1"


def test_the_bench_judges_by_no_picture_that_a_network_has_learned_from(tmp_path: Path) -> None:
    empty = np.zeros((4, 4), bool)
    names = shipped_model(f"{SHIPPED_MODEL}_trained", ".txt").read_text(encoding="utf-8").split()
    own = [Labelled(name, np.zeros((4, 4, 3), np.uint8), empty) for name in (*names, "clinic/1.jpg")]
    assert len(names) == len(set(names)) == 786 + 152 + 140
    assert [each.name for each in new_to(own, shipped_model())] == ["clinic/1.jpg"]
    assert new_to(own, tmp_path / "others.onnx") == own  # a network that comes without its list
    assert 0 < len(new_to(own, shipped_model("shape", ".toml"))) < len(own)


@pytest.mark.slow
def test_the_bench_runs_without_data_and_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    SUBJECTS["segmentation"].add_options(parser)
    figures = {
        figure.what: figure for figure in run_segmentation(parser.parse_args(["--rendered", "2", "--areas", "1"]))
    }
    assert "segmentation" in SUBJECTS
    assert "Dice of each picture, mean" not in figures and "no DATASET is named" in capsys.readouterr().err
    assert figures["Dice on rendered wounds, mean"].value > 0.7
    assert figures["network, a picture: median"].value > 0
    for kind in ("network", "true outlines"):
        assert figures[f"area by three cameras, {kind}: inside the 95 % interval"].value == 1
    assert abs(figures["area by three cameras, true outlines: error, mean"].value) < 3


@pytest.mark.skipif(not DATA.is_dir(), reason="labelled pictures of wounds are not beside the project")
def test_real_wounds_are_found(segmenter: NetworkSegmenter, tmp_path: Path) -> None:
    """Learned from, so no figure: a file that is damaged or read wrongly fails here."""
    for part in ("images", "labels"):
        (tmp_path / part).mkdir()
        for file in sorted((DATA / part).iterdir())[::60]:
            (tmp_path / part / file.name).symlink_to(file)
    some = read_dataset(tmp_path)
    reached = [dice(segmenter(np.ascontiguousarray(p.picture[..., ::-1])).mask, p.wound) for p in some]
    assert float(np.mean(reached)) > 0.85


def test_the_network_says_its_name_licence_and_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["segment", "--version"])
    told = capsys.readouterr().out
    assert ended.value.code == 0
    assert "wound; licence: CC BY-NC" in told and "not commercial" in told and "Foot Ulcer" in told
    assert "LicenseRef-CC-BY-NC" in shipped_model("LICENSE-wound", ".txt").read_text(encoding="utf-8")
    own = tmp_path / "own.onnx"
    shutil.copy(shipped_model(), own)
    own.with_suffix(".toml").write_text(f'sha256 = "{hash_of(own)}"\nlicence = "mine"\n', encoding="utf-8")
    with pytest.raises(SystemExit):
        main(["segment", "--model", str(own), "--version"])
    assert capsys.readouterr().out == "own; licence: mine; source: not stated\n"


def test_own_weights_are_taken_by_segment_track_and_live_alike_and_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone, session = str(tmp_path / "gone.onnx"), make_folder(tmp_path / "session")
    (session / "surface.ply").unlink()
    (tmp_path / "x.png").write_bytes(encode(np.zeros((64, 64, 3), np.uint8))[1])
    write_path(tmp_path / "p.csv", raster())
    live = [
        "live",
        "--rig",
        str(session),
        "--arm",
        "virtual",
        "--path",
        str(tmp_path / "p.csv"),
        "--record",
        str(tmp_path / "run.mcap"),
        "--arm",
        "virtual",
    ]
    out = ["-o", str(tmp_path / "out")]
    for words in (["segment", str(tmp_path / "x.png"), *out], ["track", str(session), *out], live):
        assert main([*words, "--model", gone]) == 2
        assert "gone.onnx" in capsys.readouterr().err and not (tmp_path / "out").exists()
    own = tmp_path / "own.onnx"
    for suffix in (".onnx", ".toml"):
        shutil.copy(shipped_model(suffix=suffix), own.with_suffix(suffix))
    assert main(["segment", str(tmp_path / "x.png"), *out, "--model", str(own)]) == 0
    assert main(["track", str(session), "-o", str(tmp_path / "tracked"), "--wound", "--model", str(own)]) == 0
    settings = LiveSettings(
        rig=session, path=tmp_path / "p.csv", record=tmp_path / "run.mcap", arm="virtual", model=own
    )
    prepared = prepare(settings, "here", False)
    assert prepared.settings.model == own
