"""Folder to MCAP and back: nothing is lost, nothing half done is left, nothing is overwritten."""

from __future__ import annotations

import filecmp
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from session_files import NAMES, change, make_folder, rig, trajectory

from estimation.errors import InputError, StillbedError
from hardware.files.rig_file import table_from_rig
from hardware.files.session import Session, open_session
from hardware.offline.convert import export_recording, import_folder
from hardware.tum import write_tum


def assert_same(a: Session, b: Session) -> None:
    """Rig, stamps, polygons, truth, scan and pixels, bit by bit."""
    assert table_from_rig(a.rig) == table_from_rig(b.rig)
    assert [[(r.camera, r.camera_stamp, r.stamp) for r in s] for s in a.sets] == [
        [(r.camera, r.camera_stamp, r.stamp) for r in s] for s in b.sets
    ]
    assert [(r.camera, r.stamp, r.polygon.tolist()) for r in a.roi] == [
        (r.camera, r.stamp, r.polygon.tolist()) for r in b.roi
    ]
    assert (a.truth is None) == (b.truth is None)
    if a.truth is not None and b.truth is not None:
        assert a.truth.exact == b.truth.exact
        assert a.truth.stamps.tobytes() == b.truth.stamps.tobytes()
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
    assert sorted((base / "out" / "frames.csv").read_text().split()) == sorted(
        (folder / "frames.csv").read_text().split()
    )


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
    folder = make_folder(tmp_path / "s")
    import_folder(folder, tmp_path / "a.mcap", jpeg_quality=90)
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


def test_an_interrupted_import_leaves_nothing(tmp_path: Path) -> None:
    make_folder(tmp_path / "s")
    with pytest.raises(Stop):
        import_folder(tmp_path / "s", tmp_path / "a.mcap", stop_at(5))  # type: ignore[arg-type]
    assert leftovers(tmp_path, "s") == []


def test_an_interrupted_export_leaves_nothing(tmp_path: Path) -> None:
    import_folder(make_folder(tmp_path / "s"), tmp_path / "a.mcap")
    with pytest.raises(Stop):
        export_recording(tmp_path / "a.mcap", tmp_path / "out", stop_at(5))  # type: ignore[arg-type]
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
    with pytest.raises(InputError, match="no such folder"):
        import_folder(tmp_path / "a.mcap", tmp_path / "b.mcap")
    with pytest.raises(InputError, match=r"allowed an \.mcap file"):
        export_recording(folder, tmp_path / "out")
    with pytest.raises(InputError, match=r"0 \.\. 100"):
        import_folder(folder, tmp_path / "b.mcap", jpeg_quality=101)


def test_a_rig_written_is_the_rig_read(tmp_path: Path) -> None:
    assert table_from_rig(open_session(make_folder(tmp_path / "s", cameras=3, offset=1 / 3)).rig) == table_from_rig(
        rig(3, 1 / 3)
    )
