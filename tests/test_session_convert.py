"""Folder to MCAP and back loses nothing; the real recordings opened, exported; rig.toml comes back bit by bit."""

from __future__ import annotations

import filecmp
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.rig import Camera, Rig
from estimation.se3 import Array
from hardware.files.folder_tables import SessionFolderWriter, write_tum
from hardware.files.images import encode
from hardware.files.rig_file import ImageSource, read_rig, rig_from_table, table_from_rig, write_rig
from hardware.files.session import Session
from hardware.offline.convert import export_recording, import_folder
from hardware.recording.messages import message_from_rig, rig_from_message
from hardware.recording.session_reader import open_session
from tests.session_files import NAMES, camera, change, image, make_folder, rig, trajectory


def assert_same(a: Session, b: Session) -> None:
    """Rig, stamps, polygons, truth, scan and pixels, bit by bit."""
    assert table_from_rig(a.rig) == table_from_rig(b.rig)
    sets = ([[(r.camera, r.camera_stamp, r.stamp) for r in refs] for refs in session.sets] for session in (a, b))
    assert next(sets) == next(sets)
    polygons = ([(r.camera, r.stamp, r.polygon.tolist()) for r in session.roi] for session in (a, b))
    assert next(polygons) == next(polygons)
    assert (a.truth is None) == (b.truth is None)
    if a.truth is not None and b.truth is not None:
        assert a.truth.exact == b.truth.exact and a.truth.stamps.tobytes() == b.truth.stamps.tobytes()
        assert a.truth.base_from_surface.tobytes() == b.truth.base_from_surface.tobytes()
    assert (a.surface and a.surface.read_bytes()) == (b.surface and b.surface.read_bytes())
    for x, y in zip(a.frame_sets(), b.frame_sets(), strict=True):
        assert x.stamp == y.stamp
        assert all(np.array_equal(f.image, g.image) for f, g in zip(x.frames, y.frames, strict=True))


def same_tree(a: Path, b: Path) -> bool:
    names = sorted(p.relative_to(a) for p in a.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(b) for p in b.rglob("*") if p.is_file())
    return all(filecmp.cmp(a / n, b / n, shallow=False) for n in names)


@pytest.mark.parametrize("pictures", [False, True])
@pytest.mark.parametrize("exact", [False, True])
def test_import_and_export_lose_nothing(tmp_path: Path, pictures: bool, exact: bool) -> None:
    folder = make_folder(tmp_path / "s", count=20, cameras=3, pictures=pictures, offset=0.1 / 30)
    if not exact:
        (folder / "truth.tum").unlink()
        write_tum(folder / "reference.tum", trajectory(20, False))
    told: list[tuple[int, int]] = []
    import_folder(folder, tmp_path / "a.mcap", lambda done, total: told.append((done, total)))
    assert told == [(i, 60) for i in range(1, 61)]
    assert_same(open_session(folder), open_session(tmp_path / "a.mcap"))
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert_same(open_session(folder), open_session(tmp_path / "out"))
    import_folder(tmp_path / "out", tmp_path / "b.mcap")
    export_recording(tmp_path / "b.mcap", tmp_path / "again")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert same_tree(tmp_path / "out", tmp_path / "again")


@settings(max_examples=15)
@given(
    steps=st.lists(st.floats(1e-3, 1.0), min_size=2, max_size=5),
    start=st.floats(-1e6, 1e6) | st.just(1.7e9),
    offset=st.floats(-0.5, 0.5),
    focal=st.floats(20, 1e4),
)
def test_any_numbers_come_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory, steps: list[float], start: float, offset: float, focal: float
) -> None:
    base = tmp_path_factory.mktemp("c")
    times = (start + np.cumsum(steps)).tolist()
    folder = make_folder(base / "s", count=len(times), pictures=True)
    change(folder / "rig.toml", "70.1", repr(focal))
    change(folder / "rig.toml", "size", f"clock_offset_s = {offset!r}\nsize")
    rows = [f"{name},{k},{t!r}" for name in NAMES[:2] for k, t in enumerate(times)]
    (folder / "frames.csv").write_text("camera,frame,stamp_s\n" + "\n".join(rows) + "\n")
    (folder / "truth.tum").unlink()
    import_folder(folder, base / "a.mcap")
    export_recording(base / "a.mcap", base / "out")
    assert_same(open_session(folder), open_session(base / "a.mcap"))
    assert_same(open_session(folder), open_session(base / "out"))
    written, given = ((each / "frames.csv").read_text().split() for each in (base / "out", folder))
    assert sorted(written) == sorted(given)


def test_camera_names_that_a_glob_would_misread(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    change(folder / "rig.toml", '"left"', '"[a] é*"')
    for name in ("frames.csv", "roi.toml"):
        (folder / name).write_text((folder / name).read_text().replace("left", "[a] é*"))
    import_folder(folder, tmp_path / "a.mcap")
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert_same(open_session(folder), open_session(tmp_path / "out"))


def test_a_camera_that_gave_nothing_stays_in_the_rig(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", pictures=True)
    for path in (folder / "top").iterdir():
        path.unlink()
    rows = [line for line in (folder / "frames.csv").read_text().split() if not line.startswith("top")]
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    import_folder(folder, tmp_path / "a.mcap")
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    session = open_session(tmp_path / "out")
    assert len(session.rig) == 2 and [len(s.frames) for s in session.frame_sets()] == [1] * 6


def test_jpeg_pictures_keep_their_bytes(tmp_path: Path) -> None:
    import_folder(make_folder(tmp_path / "s"), tmp_path / "a.mcap", jpeg_quality=90)
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert (tmp_path / "out" / "left" / "000003.jpg").is_file()
    import_folder(tmp_path / "out", tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_damaged_recording_exports_what_is_left(tmp_path: Path) -> None:
    import_folder(make_folder(tmp_path / "s", count=60), tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: 2 * len(data) // 3])
    damaged = open_session(tmp_path / "a.mcap")
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert damaged.damage and 10 < len(damaged) < 60
    assert len(open_session(tmp_path / "out")) == len(damaged)


def leftovers(folder: Path, *known: str) -> list[str]:
    return sorted({p.name for p in folder.iterdir()} - set(known))


class Stop(BaseException):
    """Ctrl-C, at a place of our choosing."""


def stop_at(count: int) -> object:
    def progress(done: int, total: int) -> None:
        if done == count:
            raise Stop

    return progress


def test_an_interrupted_import_or_export_leaves_nothing(tmp_path: Path) -> None:
    folder, recording = make_folder(tmp_path / "s"), tmp_path / "a.mcap"
    with pytest.raises(Stop):
        import_folder(folder, recording, stop_at(5))
    assert leftovers(tmp_path, "s") == []
    import_folder(folder, recording)
    with pytest.raises(Stop):
        export_recording(recording, tmp_path / "out", stop_at(5))
    assert leftovers(tmp_path, "s", "a.mcap") == []


def test_import_overwrites_only_when_told(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(InputError, match="exists already"):
        import_folder(folder, tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    import_folder(folder, tmp_path / "a.mcap", overwrite=True)
    assert len(open_session(tmp_path / "a.mcap")) == 6


def test_export_wants_a_new_or_empty_folder(tmp_path: Path) -> None:
    import_folder(make_folder(tmp_path / "s"), tmp_path / "a.mcap")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="not empty"):
        export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert leftovers(tmp_path / "out", "mine.txt") == []
    (tmp_path / "out" / "mine.txt").unlink()
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert len(open_session(tmp_path / "out")) == 6


def test_a_place_that_cannot_be_written_is_one_error(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    with pytest.raises(StillbedError, match="cannot write"):
        import_folder(folder, folder / "rig.toml" / "a.mcap")
    import_folder(folder, tmp_path / "a.mcap")
    with pytest.raises(StillbedError, match="cannot write"):
        export_recording(tmp_path / "a.mcap", folder / "rig.toml" / "out")


def test_the_wrong_kind_of_thing_is_one_error(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s")
    import_folder(folder, tmp_path / "a.mcap")
    with pytest.raises(InputError, match="session = 'a file', allowed a session folder"):
        import_folder(tmp_path / "a.mcap", tmp_path / "b.mcap")
    with pytest.raises(InputError, match="no such folder"):
        import_folder(tmp_path / "nowhere", tmp_path / "b.mcap")
    with pytest.raises(InputError, match=r"allowed an \.mcap file"):
        export_recording(folder, tmp_path / "out")
    with pytest.raises(InputError, match=r"0 \.\. 100"):
        import_folder(folder, tmp_path / "b.mcap", jpeg_quality=101)


DATA = Path(__file__).parent.parent.parent / "shared" / "data"

needs_data = pytest.mark.skipif(not (DATA / "webcams_a").is_dir(), reason=f"no recordings in {DATA}")


@needs_data
@pytest.mark.parametrize(
    ("name", "cameras", "sets", "roi_frame"),
    [("webcams_a", 3, 48, 0), ("webcams_b", 3, 111, 66), ("teabox", 2, 121, 0)],
)
def test_a_real_folder_gives_every_frame_set_whole(name: str, cameras: int, sets: int, roi_frame: int) -> None:
    session = open_session(DATA / name)
    assert len(session) == sets and {len(s) for s in session.sets} == {cameras}
    assert session.truth is not None and not session.truth.exact and session.surface is None
    assert {roi.stamp for roi in session.roi} <= {ref.stamp for ref in session.sets[roi_frame]}
    first = next(iter(session.frame_sets()))
    for seen_by, frame in zip(session.rig.cameras, first.frames, strict=True):
        assert frame.image.shape == (seen_by.size[1], seen_by.size[0], 3)


@needs_data
@pytest.mark.slow  # made-up folders do here, and real ones are read in test_recordings
def test_a_real_folder_survives_the_way_there_and_back(tmp_path: Path) -> None:
    folder = open_session(DATA / "teabox")
    import_folder(DATA / "teabox", tmp_path / "a.mcap")
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    for path in (tmp_path / "a.mcap", tmp_path / "out"):
        back = open_session(path)
        assert back.sets == folder.sets
        for a, b in islice(zip(folder.frame_sets(), back.frame_sets(), strict=True), 20):
            assert a.stamp == b.stamp
            assert all(np.array_equal(f.image, g.image) for f, g in zip(a.frames, b.frames, strict=True))
        assert folder.truth.base_from_surface.tobytes() == back.truth.base_from_surface.tobytes()


NOWHERE = ImageSource("images", "*")


def written(path: Path, cameras: list[Camera]) -> Path:
    write_rig(path, Rig(tuple(cameras)), [NOWHERE] * len(cameras))
    return path


finite = st.floats(-1e4, 1e4)


@given(
    xi=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    t=st.lists(finite, min_size=3, max_size=3),
    focal=st.floats(1e3, 1e5),
    lens=st.lists(st.floats(-1, 1), min_size=5, max_size=5),
    offset=finite,
    name=st.text(st.characters(categories=["L", "N", "P", "S", "Zs"], exclude_characters='/\\,"'), min_size=1).filter(
        lambda n: not n.startswith(".") and len(n) < 60
    ),
)
def test_a_rig_comes_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory,
    xi: list[float],
    t: list[float],
    focal: float,
    lens: list[float],
    offset: float,
    name: str,
) -> None:
    matrix = np.array([[focal, 0, 1 / 3], [0, focal * 1.1, 17.0], [0, 0, 1]])
    base_from_camera = se3.make(se3.exp_rotation(xi), t)
    one = Camera(name if name.isprintable() else "a", (1280, 720), matrix, np.array(lens), base_from_camera, offset)
    first = read_rig(written(tmp_path_factory.mktemp("rig") / "rig.toml", [one])).rig
    assert table_from_rig(first) == table_from_rig(Rig((one,)))
    assert table_from_rig(rig_from_message("file", message_from_rig(first))) == table_from_rig(first)


def test_four_digits_become_an_exact_rotation_and_stay_it(tmp_path: Path) -> None:
    rough = replace(camera("a", 1), base_from_camera=np.round(camera("a", 1).base_from_camera, 4))
    first = read_rig(written(tmp_path / "rig.toml", [rough])).rig
    exact = first.cameras[0].base_from_camera
    assert se3.is_transform(exact, 1e-14) and not se3.is_transform(rough.base_from_camera, 1e-6)
    assert np.abs(exact - rough.base_from_camera).max() < 2e-4
    second = read_rig(written(tmp_path / "again.toml", list(first.cameras))).rig
    assert second.cameras[0].base_from_camera.tobytes() == exact.tobytes()


def mirrored(m: Array) -> Array:
    return m @ np.diag([1.0, 1.0, -1.0, 1.0])


def scaled(m: Array) -> Array:
    return np.block([[1.002 * m[:3, :3], m[:3, 3:]], [m[3:]]])


def sheared(m: Array) -> Array:
    out = m.copy()
    out[0, 1] += 0.01
    return out


@pytest.mark.parametrize("spoil", [mirrored, scaled, sheared, np.transpose])
def test_a_matrix_that_is_no_rotation_is_refused(tmp_path: Path, spoil: Callable[[Array], Array]) -> None:
    wrong = replace(camera("a", 1), base_from_camera=spoil(camera("a", 1).base_from_camera))
    with pytest.raises(InputError, match=r"camera 'a': base_from_camera = .*allowed a rotation"):
        read_rig(written(tmp_path / "rig.toml", [camera("b", 0), wrong]))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", [(0, 0), (1, 3)])
def test_a_matrix_with_a_hole_is_refused(tmp_path: Path, value: float, place: tuple[int, int]) -> None:
    table = table_from_rig(rig(2))
    table["camera"][1]["base_from_camera"][place[0]][place[1]] = value
    with pytest.raises(InputError, match=r"camera 'top': base_from_camera .* 4 x 4 finite numbers"):
        rig_from_table("here", table)


def baseline(distance: float) -> Rig:
    shifted = camera("b", 0).base_from_camera.copy()
    shifted[0, 3] += distance
    return Rig((camera("a", 0), replace(camera("b", 0), base_from_camera=shifted)))


def test_the_shortest_baseline_is_ten_millimetres(tmp_path: Path) -> None:
    assert len(rig_from_table("here", table_from_rig(baseline(10.001)))) == 2
    with pytest.raises(InputError, match="not m"):
        rig_from_table("here", table_from_rig(baseline(9.999)))


def test_a_rig_in_micrometres_is_refused() -> None:
    table = table_from_rig(rig(3))
    for entry in table["camera"]:
        for i in range(3):
            entry["base_from_camera"][i][3] *= 1e3
    with pytest.raises(InputError, match="mm"):
        rig_from_table("here", table)


def test_one_near_pair_in_a_wide_rig_and_a_single_camera_are_taken() -> None:
    near = baseline(0.0).cameras
    assert len(rig_from_table("here", table_from_rig(Rig((*near, camera("c", 5)))))) == 3
    assert len(rig_from_table("here", table_from_rig(Rig((camera("a", 0),))))) == 1


def test_a_calibration_without_images_can_be_read(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", rig(2), [None, None])
    assert read_rig(tmp_path / "rig.toml").sources == (None, None)


def test_a_blank_line_does_not_shift_the_lines_that_errors_name(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    text = (folder / "frames.csv").read_text().splitlines()
    (folder / "frames.csv").write_text("\n".join([*text[:2], "", "", "nobody,1,0.5", *text[2:]]) + "\n")
    with pytest.raises(InputError, match="line 5: camera = 'nobody'"):
        open_session(folder)


def test_cameras_whose_names_look_like_patterns_come_back(tmp_path: Path) -> None:
    """[a] is a pattern for a, and ? for any letter."""
    named = replace(
        rig(2), cameras=tuple(replace(c, name=n) for c, n in zip(rig(2).cameras, ("[ab]", "a?"), strict=True))
    )
    with SessionFolderWriter(tmp_path / "x", named, ()) as writer:
        for number, stamp in enumerate((0.1, 0.2)):
            for camera in range(2):
                writer.picture(camera, stamp, *encode(image(camera, number)))
    assert [len(one.frames) for one in open_session(tmp_path / "x").frame_sets()] == [2, 2]
