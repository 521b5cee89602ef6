"""Session folders: one error with file, key and value for everything wrong; videos that stop early."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.errors import InputError
from hardware.files.folder_tables import write_tum
from hardware.files.images import Video, count_by_decoding
from hardware.files.session import Session
from hardware.recording.session_reader import open_session
from tests.session_files import SIZE, change, image, make_folder, rig, stamps, trajectory, write_video


def images_of(session: Session) -> dict[tuple[int, float], np.ndarray]:
    return {(f.camera, f.stamp): f.image for s in session.frame_sets() for f in s.frames}


@pytest.mark.parametrize("pictures", [False, True])
def test_a_whole_folder_gives_every_image_at_its_stamp(tmp_path: Path, pictures: bool) -> None:
    session = open_session(make_folder(tmp_path / "s", count=12, cameras=3, pictures=pictures, offset=0.25 / 30))
    assert len(session) == 12 == len(list(session.frame_sets()))
    times = stamps(12)
    for number in range(12):
        frames = list(session.frame_sets())[number]
        assert [f.camera for f in frames.frames] == [0, 1, 2]
        expected = [times[number], times[number], times[number] + 0.25 / 30]
        assert [f.stamp for f in frames.frames] == expected
        assert frames.stamp == pytest.approx(np.mean(expected), abs=1e-12)
        for frame in frames.frames:
            assert np.array_equal(frame.image, image(frame.camera, number))
    assert session.truth is not None and session.truth.exact
    assert session.surface == tmp_path / "s" / "surface.ply"
    assert (session.roi[0].camera, session.roi[0].stamp) == (0, times[1])
    assert session.roi[0].polygon.tolist() == [[-3.5, 2.0], [40.25, 3.0], [20.0, 44.1]]
    assert session.damage == ""


def test_two_readings_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    session = open_session(make_folder(tmp_path / "s"))
    pairs = list(zip(session.frame_sets(), session.frame_sets(), strict=True))
    assert all(np.array_equal(a.frames[1].image, b.frames[1].image) for a, b in pairs)


def test_the_optional_files_may_be_absent(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    for name in ("roi.toml", "truth.tum", "surface.ply"):
        (folder / name).unlink()
    session = open_session(folder)
    assert (session.roi, session.truth, session.surface) == ((), None, None)


def test_truth_wins_over_reference(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    write_tum(folder / "reference.tum", trajectory(2, False))
    session = open_session(folder)
    assert session.truth is not None and session.truth.exact and len(session.truth) == 6
    (folder / "truth.tum").unlink()
    session = open_session(folder)
    assert session.truth is not None and not session.truth.exact and len(session.truth) == 2


def test_a_frame_a_camera_dropped_leaves_the_others_paired(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", count=6)
    write_video(folder / "top.avi", 1, 5)
    times = stamps(6)
    kept = [t for k, t in enumerate(times) if k != 2]
    rows = [f"left,{k},{t!r}" for k, t in enumerate(times)] + [f"top,{k},{t!r}" for k, t in enumerate(kept)]
    (folder / "frames.csv").write_text("camera,frame,stamp_s\n" + "\n".join(rows))
    sets = list(open_session(folder).frame_sets())
    assert [len(s.frames) for s in sets] == [2, 2, 1, 2, 2, 2]
    assert np.array_equal(sets[3].frames[1].image, image(1, 2))


def test_pictures_are_sorted_by_their_numbers(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", count=11, pictures=True)  # 0.png .. 10.png
    last = list(open_session(folder).frame_sets())[-1]
    assert np.array_equal(last.frames[0].image, image(0, 10))


def test_grey_pictures_stay_grey(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", pictures=True)
    grey = image(0, 0)[..., 0]
    assert cv2.imwrite(str(folder / "left" / "0.png"), grey)
    first = next(iter(open_session(folder).frame_sets()))
    assert np.array_equal(first.frames[0].image, grey)


def cut(name: str, keep: float) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(keep * len(data))])

    return act


def swap(name: str, old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: change(folder / name, old, new)


def in_rig(old: str, new: str) -> Callable[[Path], None]:
    return swap("rig.toml", old, new)


def in_frames(old: str, new: str) -> Callable[[Path], None]:
    return swap("frames.csv", old, new)


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def put(name: str, text: str) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        (folder / name).write_text(text)

    return act


def row(camera: str, frame: int, count: int = 6) -> str:
    return f"{camera},{frame},{stamps(count)[frame]!r}\n"


def scaled(by: float) -> Callable[[Path], None]:
    """The same rig with every length multiplied."""

    def act(folder: Path) -> None:
        from hardware.files.rig_file import ImageSource, write_rig

        other = rig(2)
        for c in other.cameras:
            c.base_from_camera[:3, 3] *= by
        write_rig(folder / "rig.toml", other, [ImageSource("video", f"{n}.avi") for n in ("left", "top")])

    return act


def other_clock(by: float, *cameras: str, shift: float = 0.0) -> Callable[[Path], None]:
    """The same stamps of these cameras in another unit, or from another zero."""

    def act(folder: Path) -> None:
        rows = [line.split(",") for line in (folder / "frames.csv").read_text().split()]
        lines = [[c, n, repr(by * float(s) + shift)] if c in cameras else [c, n, s] for c, n, s in rows]
        (folder / "frames.csv").write_text("\n".join(map(",".join, lines)))

    return act


def second_scan(folder: Path) -> None:
    (folder / "surface.stl").write_bytes(b"solid\n")


MATRIX = "[[70.1, 0.0, 31.7], [0.0, 70.3, 24.2], [0.0, 0.0, 1.0]]"

FAULTS: list[tuple[str, Callable[[Path], None], str, str, str]] = [
    # what is done, how, and the file, key and words that the error must hold
    ("video missing", remove("left.avi"), "left.avi", "video", "no such file"),
    ("video empty", cut("left.avi", 0.0), "left.avi", "video", "0 bytes"),
    ("video undecodable", put("left.avi", "no video at all" * 99), "left.avi", "video", "undecodable"),
    ("video cut short", cut("top.avi", 0.6), "frames.csv", "number of frames of camera 'top'", "6"),
    ("video shorter", lambda f: write_video(f / "top.avi", 1, 5), "frames.csv", "camera 'top'", "6, allowed 5"),
    ("video longer", lambda f: write_video(f / "top.avi", 1, 7), "frames.csv", "camera 'top'", "6, allowed 7"),
    ("frame not in video", in_frames(row("top", 5), row("top", 5) + "top,6,99\n"), "frames.csv", "'top'", "7"),
    ("frame left out", in_frames(row("left", 3), ""), "frames.csv", "camera 'left': frame", "4 after 2"),
    ("stamp back", in_frames(row("left", 3), "left,3,-5.0\n"), "frames.csv", "stamp_s of frame 3", "-5.0"),
    ("stamp equal", in_frames(row("left", 3), f"left,3,{stamps(6)[2]!r}\n"), "frames.csv", "of frame 3", "later than"),
    ("frame twice", in_frames(row("left", 3), row("left", 2)), "frames.csv", "line 5", "left,2"),
    ("stamps in ms", other_clock(1e3, "left", "top"), "frames.csv", "'left': stamp_s", "seconds, not ms or ns"),
    ("stamps in ns", other_clock(1e9, "left", "top"), "frames.csv", "'left': stamp_s", "seconds, not ms or ns"),
    ("two zeros", other_clock(1, "left", shift=1.7e9), "frames.csv", "'left': stamp_s", "one clock for all cameras"),
    ("stamp nan", in_frames(row("left", 3), "left,3,nan\n"), "frames.csv", "line 5: stamp_s", "nan"),
    ("stamp inf", in_frames(row("left", 3), "left,3,inf\n"), "frames.csv", "line 5: stamp_s", "inf"),
    ("stamp no number", in_frames(row("left", 3), "left,3,soon\n"), "frames.csv", "stamp_s", "soon"),
    ("row short", in_frames(row("left", 3), "left,3\n"), "frames.csv", "line 5: stamp_s", "''"),
    ("frame no number", in_frames(row("left", 3), "left,-3,1\n"), "frames.csv", "line 5: frame", "-3"),
    ("camera unknown", in_frames("left,0", "lefd,0"), "frames.csv", "line 2: camera", "did you mean 'left'"),
    ("header wrong", in_frames("stamp_s", "stamp"), "frames.csv", "header", "camera,frame,stamp_s"),
    ("frames.csv empty", put("frames.csv", ""), "frames.csv", "header", "empty"),
    ("frames.csv bare", put("frames.csv", "camera,frame,stamp_s\n"), "frames.csv", "frames", "none"),
    ("frames.csv missing", remove("frames.csv"), "frames.csv", "file", "no such file"),
    ("rig.toml missing", remove("rig.toml"), "rig.toml", "file", "no such file"),
    ("rig.toml empty", put("rig.toml", " \n"), "rig.toml", "file", "empty"),
    ("rig.toml no TOML", in_rig("[[camera]]", "[[camera]"), "rig.toml", "syntax", "line"),
    ("no camera", put("rig.toml", "camera = []"), "rig.toml", "camera", "[]"),
    ("key missing", in_rig("size = [64, 48]\n", ""), "rig.toml", "camera[0].size", "missing"),
    ("key misspelt", in_rig("distortion", "distorsion"), "rig.toml", "distorsion", "did you mean 'distort"),
    ("top key unknown", in_rig("[[camera]]", "sruface = 'a'\n[[camera]]"), "rig.toml", "sruface", "'surface'"),
    ("no images named", in_rig('video = "left.avi"\n', ""), "rig.toml", "camera 'left'", "neither"),
    ("both named", in_rig('video = "left.avi"', 'video = "a"\nimages = "b"'), "rig.toml", "'left'", "one of"),
    ("name twice", in_rig('name = "top"', 'name = "left"'), "rig.toml", "camera[1].name", "left"),
    ("name a path", in_rig('name = "top"', 'name = "../top"'), "rig.toml", "camera[1].name", "../top"),
    ("focal nan", in_rig("70.1", "nan"), "rig.toml", "camera 'left': matrix", "nan"),
    ("focal zero", in_rig("70.1", "0.0"), "rig.toml", "camera 'left': matrix fx", "0.0"),
    ("focal negative", in_rig("70.3", "-70.3"), "rig.toml", "camera 'left': matrix fy", "-70.3"),
    ("focal in mm", in_rig("70.1", "3.6"), "rig.toml", "camera 'left': matrix fx", "6.4 px"),
    ("skew", in_rig(MATRIX, MATRIX.replace("0.0", "0.5", 1)), "rig.toml", "camera 'left': matrix", "0.5"),
    ("matrix ragged", in_rig(MATRIX, "[[1, 2, 3], [4, 5]]"), "rig.toml", "camera 'left': matrix", "3 x 3"),
    ("matrix of text", in_rig("70.1", '"70.1"'), "rig.toml", "camera 'left': matrix", "3 x 3"),
    ("matrix of flags", in_rig("70.1", "true"), "rig.toml", "camera 'left': matrix", "3 x 3"),
    ("size of one", in_rig("[64, 48]", "[64]"), "rig.toml", "camera 'left': size", "width, height"),
    ("size not whole", in_rig("[64, 48]", "[64, 48.5]"), "rig.toml", "camera 'left': size", "48.5"),
    ("size other", in_rig("[64, 48]", "[48, 64]"), "left.avi", "size of frame 0", "64 x 48 px"),
    ("distortion of 4", in_rig("-0.0002, 0.0]", "-0.0002]"), "rig.toml", "distortion", "5 finite"),
    ("in metres", scaled(1e-3), "rig.toml", "base_from_camera of all cameras", "mm, not m"),
    ("in parsecs", scaled(1e200), "rig.toml", "base_from_camera of all cameras", "along each axis"),
    ("roi camera", swap("roi.toml", '"left"', '"lift"'), "roi.toml", "roi[0].camera", "did you mean 'left'"),
    ("roi frame", swap("roi.toml", "frame = 1", "frame = 6"), "roi.toml", "roi[0].frame", "0..5"),
    ("roi frame text", swap("roi.toml", "frame = 1", 'frame = "1"'), "roi.toml", "roi[0].frame", "whole number"),
    ("roi of 2", swap("roi.toml", ", [20.0, 44.1]", ""), "roi.toml", "roi[0].polygon", "2 points"),
    ("roi nan", swap("roi.toml", "44.1", "nan"), "roi.toml", "roi[0].polygon", "nan"),
    ("roi a line", swap("roi.toml", "[20.0, 44.1]", "[-3.5, 2]"), "roi.toml", "roi[0].polygon", "not a line"),
    (
        "roi outside",
        put("roi.toml", "[[roi]]\ncamera='top'\nframe=0\npolygon=[[-9,0],[-1,0],[-5,9]]"),
        "roi.toml",
        "poly",
        "64",
    ),
    ("roi key", swap("roi.toml", "polygon", "polygone"), "roi.toml", "roi[0].polygone", "did you mean 'polygon'"),
    (
        "roi twice",
        lambda f: put("roi.toml", (f / "roi.toml").read_text() * 2)(f),
        "roi.toml",
        "roi[1]",
        "left, frame 1",
    ),
    ("roi empty", put("roi.toml", ""), "roi.toml", "file", "empty"),
    ("truth nan", put("truth.tum", "0 1 2 3 0 0 nan 1"), "truth.tum", "line 1", "nan"),
    ("scan named, missing", in_rig("[[camera]]", "surface = 'a.stl'\n[[camera]]"), "rig.toml", "surface", "a.stl"),
    ("scan of no kind", in_rig("[[camera]]", "surface = 'a.txt'\n[[camera]]"), "rig.toml", "surface", ".ply"),
    ("two scans", second_scan, "s", "surface", "surface.ply, surface.stl"),
    ("scan empty", cut("surface.ply", 0.0), "surface.ply", "file", "empty"),
]


@pytest.mark.parametrize(("fault", "act", "file", "what", "words"), FAULTS, ids=[f[0] for f in FAULTS])
def test_one_error(tmp_path: Path, fault: str, act: Callable[[Path], None], file: str, what: str, words: str) -> None:
    folder = make_folder(tmp_path / "s")
    open_session(folder)
    act(folder)
    with pytest.raises(InputError) as caught:
        open_session(folder)
    assert Path(caught.value.where).name == file
    assert what in caught.value.what
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def cut_mp4(tmp_path: Path) -> tuple[Path, bytes]:
    """A session with an mp4 that has its index in front, and that video's bytes without the last frames."""
    folder = make_folder(tmp_path / "s", count=30)
    path = folder / "left.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, SIZE)
    for number in range(30):
        writer.write(image(0, number))
    writer.release()
    whole = index_in_front(path.read_bytes())
    path.write_bytes(whole)
    change(folder / "rig.toml", "left.avi", "left.mp4")
    return folder, whole[:-6000]


def test_a_video_whose_index_tells_frames_that_are_cut_off_is_refused_at_once(tmp_path: Path) -> None:
    folder, rest = cut_mp4(tmp_path)
    assert len(open_session(folder)) == 30
    (folder / "left.mp4").write_bytes(rest)
    with pytest.raises(InputError, match=r"frames of camera 'left' = 30, allowed \d+, .* in left\.mp4"):
        open_session(folder)


def test_a_video_cut_while_it_is_read_ends_with_an_error_after_the_whole_sets(tmp_path: Path) -> None:
    folder, rest = cut_mp4(tmp_path)
    session = open_session(folder)
    (folder / "left.mp4").write_bytes(rest)
    given = []
    with pytest.raises(InputError, match=r"left\.mp4: frame \d+ = .*ends early") as caught:
        for frames in session.frame_sets():
            given.append(frames)
    assert 0 < len(given) < 30
    assert caught.value.what == f"frame {len(given)}"


def index_in_front(mp4: bytes) -> bytes:
    """The same mp4 with its moov box before its mdat box, chunk offsets moved to match."""
    boxes, at = [], 0
    while at < len(mp4):
        length = int.from_bytes(mp4[at : at + 4], "big")
        boxes.append((mp4[at + 4 : at + 8], mp4[at : at + length]))
        at += length
    moov = bytearray(next(box for kind, box in boxes if kind == b"moov"))
    table = moov.find(b"stco")
    count = int.from_bytes(moov[table + 8 : table + 12], "big")
    for i in range(count):
        spot = table + 12 + 4 * i
        moov[spot : spot + 4] = (int.from_bytes(moov[spot : spot + 4], "big") + len(moov)).to_bytes(4, "big")
    head = b"".join(box for kind, box in boxes if kind not in (b"moov", b"mdat"))
    return head + bytes(moov) + next(box for kind, box in boxes if kind == b"mdat")


def test_a_picture_that_cannot_be_decoded_is_named_when_its_turn_comes(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", pictures=True)
    (folder / "top" / "3.png").write_bytes(b"no picture")
    frames = open_session(folder).frame_sets()
    for _ in range(3):
        next(frames)
    with pytest.raises(InputError, match=r"3\.png: picture"):
        next(frames)


@pytest.mark.parametrize("name", ["rig.toml", "top.avi"])
def test_a_file_of_a_folder_is_refused_with_the_folder(name: str, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    with pytest.raises(InputError) as caught:
        open_session(folder / name)
    assert str(caught.value).endswith(f"the folder: {folder}")


def test_a_path_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        open_session(tmp_path / "none")


WHOLE = 5  # frames


class Stumbling:
    """A decoder that raises, as OpenCV's own reader of AVI files does at some damage, from a frame on; -1: at once."""

    def __init__(self, at: int) -> None:
        self._at, self._next = at, 0

    def open(self, name: str) -> bool:
        self._step(-1)
        return True

    def isOpened(self) -> bool:
        return self._at >= 0

    def get(self, what: int) -> float:
        return WHOLE

    def set(self, what: int, value: float) -> bool:
        self._next = int(value)
        return True

    def grab(self) -> bool:
        self._step(self._next)
        self._next += 1
        return self._next <= WHOLE

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, np.zeros((4, 4, 3), np.uint8)) if self.grab() else (False, None)

    def release(self) -> None:
        """Nothing is held."""

    def _step(self, frame: int) -> None:
        if frame >= self._at:
            raise cv2.error("Assertion failed")


@pytest.mark.parametrize("at", [-1, 0, 3, WHOLE])
def test_a_decoder_that_raises_ends_the_video_there(at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file := tmp_path / "a.avi").write_bytes(b"RIFF")
    monkeypatch.setattr(cv2, "VideoCapture", lambda: Stumbling(at))
    if at < 0:
        with pytest.raises(InputError, match=r"a\.avi.*undecodable"):
            Video(file)
        return
    assert count_by_decoding(file) == at
    assert Video(file).reaches(WHOLE) == (at == WHOLE)
    video, read = Video(file), 0
    while video.read() is not None:
        read += 1
    assert read == video.next == at
