"""Where the print head was: kept with the session in both containers, and given to the frame sets it belongs to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation import se3
from estimation.errors import InputError
from hardware.files.folder_tables import HEAD_COLUMNS, read_heads, write_heads
from hardware.files.session import HEAD_STAMP_TOLERANCE, NO_PRINT_HEADS, PrintHeadLog, head_from_row, row_from_head
from hardware.offline.convert import TrackRecorder, export_recording, import_folder
from hardware.recording.recorder import MAX_CHUNK_SECONDS, Recorder
from hardware.recording.session_reader import open_session
from hardware.recording.session_reader import read_heads as recorded_heads
from perception.frames import PrintHead
from tests.recording_samples import write_frames
from tests.session_files import make_folder, rig, stamps
from tests.tracking_runs import Replayed

HEADER = ",".join(HEAD_COLUMNS)


def made_up(times: list[float], seed: int = 0) -> PrintHeadLog:
    """Heads anywhere at these stamps, s."""
    draw = np.random.default_rng(seed)
    nozzle = se3.exp(draw.normal(size=(len(times), 6)) * [1, 1, 1, 100, 100, 1e3])
    rows = [row_from_head(stamp, PrintHead(place, False)) for stamp, place in zip(times, nozzle, strict=True)]
    return PrintHeadLog(np.array(rows).reshape(-1, 8), draw.integers(0, 2, len(times)).astype(bool))


def same(a: PrintHeadLog, b: PrintHeadLog) -> bool:
    return a.rows.tobytes() == b.rows.tobytes() and np.array_equal(a.extruding, b.extruding)


@given(st.lists(st.floats(-4, 4), min_size=6, max_size=6), st.floats(-1e6, 2e9), st.booleans())
def test_a_row_holds_a_head(xi: list[float], stamp: float, extruding: bool) -> None:
    head = PrintHead(se3.exp(np.array(xi) * [1, 1, 1, 200, 200, 200]), extruding)
    row = row_from_head(stamp, head)
    back = head_from_row(row, extruding)
    assert row[0] == stamp and back.extruding == extruding
    assert np.array_equal(back.base_from_nozzle[:3, 3], head.base_from_nozzle[:3, 3])
    assert np.abs(back.base_from_nozzle - head.base_from_nozzle).max() < 1e-13 * 200


@given(
    st.lists(st.floats(1e-4, 0.2), min_size=1, max_size=8),
    st.floats(-1e3, 1e3),
    st.floats(-0.1, 1.2),
    st.integers(0, 99),
)
def test_a_frame_set_gets_the_nearest_head_or_none(steps: list[float], start: float, share: float, seed: int) -> None:
    times = start + np.cumsum(steps)
    stamp = times[0] + share * (times[-1] - times[0])
    heads = made_up(times.tolist(), seed)
    found, away = heads.at(stamp), np.abs(times - stamp)
    if found is None:
        assert away.min() > HEAD_STAMP_TOLERANCE
    else:
        assert away.min() <= HEAD_STAMP_TOLERANCE
        places = heads.rows[away == away.min(), 1:4]
        assert (found.base_from_nozzle[:3, 3] == places).all(1).any()


def test_without_rows_there_is_no_head() -> None:
    assert len(NO_PRINT_HEADS) == 0 and NO_PRINT_HEADS.at(0.0) is None


@given(steps=st.lists(st.floats(1e-6, 1e3), max_size=6), start=st.floats(-1e6, 2e9), seed=st.integers(0, 9999))
def test_rows_come_back(tmp_path_factory: pytest.TempPathFactory, steps: list[float], start: float, seed: int) -> None:
    folder = tmp_path_factory.mktemp("h")
    heads = made_up((start + np.cumsum(steps)).tolist(), seed)
    write_heads(folder / "head.csv", heads)
    assert same(read_heads(folder / "head.csv"), heads)
    with Recorder(folder / "x.mcap", rig(2)) as recorder:
        write_frames(recorder, 1, 2, start)
        for row, extruding in zip(heads.rows, heads.extruding, strict=True):
            recorder.head_row(row, bool(extruding))
    assert same(open_session(folder / "x.mcap").heads, heads)
    found = [(stamp, head.extruding) for stamp, head in recorded_heads(folder / "x.mcap")]
    assert found == list(zip(heads.rows[:, 0], heads.extruding, strict=True))


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session folder of 20 frame sets of two cameras, 0.4 ms apart, all but the first four with a head."""
    folder = make_folder(tmp_path / "s", count=20, pictures=True, offset=0.0004)
    write_heads(folder / "head.csv", made_up([stamp + 0.0002 for stamp in stamps(20)[4:]]))
    return folder


def test_each_frame_set_has_its_own_head_and_the_rest_none(session: Path) -> None:
    heads = [frames.head for frames in open_session(session).frame_sets()]
    rows = read_heads(session / "head.csv")
    assert heads[:4] == [None] * 4
    for head, row, extruding in zip(heads[4:], rows.rows, rows.extruding, strict=True):
        assert head is not None and head.extruding == extruding
        assert np.array_equal(head.base_from_nozzle, head_from_row(row, True).base_from_nozzle)


def test_a_session_without_the_file_has_no_head(session: Path) -> None:
    (session / "head.csv").unlink()
    assert all(frames.head is None for frames in open_session(session).frame_sets())
    import_folder(session, session.parent / "a.mcap")
    export_recording(session.parent / "a.mcap", session.parent / "out")
    assert not (session.parent / "out" / "head.csv").exists()


def test_import_and_export_keep_every_row(session: Path, tmp_path: Path) -> None:
    import_folder(session, tmp_path / "a.mcap")
    export_recording(tmp_path / "a.mcap", tmp_path / "out")
    assert (tmp_path / "out" / "head.csv").read_bytes() == (session / "head.csv").read_bytes()
    import_folder(tmp_path / "out", tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    before, after = open_session(session), open_session(tmp_path / "a.mcap")
    for one, other in zip(before.frame_sets(), after.frame_sets(), strict=True):
        assert (one.head is None) == (other.head is None)
        if one.head is not None and other.head is not None:
            assert one.head.base_from_nozzle.tobytes() == other.head.base_from_nozzle.tobytes()


@pytest.mark.parametrize("tracked", [20, 9])
def test_the_recording_of_a_run_has_the_rows_of_its_session(session: Path, tmp_path: Path, tracked: int) -> None:
    original, step = open_session(session), Replayed([])
    try:
        with TrackRecorder(tmp_path / "run.mcap", original, overwrite=False) as recorder:
            for number, frames in enumerate(original.frame_sets()):
                if number == tracked:
                    raise KeyboardInterrupt
                recorder.write(frames, step(frames), step.last)
    except KeyboardInterrupt:
        pass
    count = tracked - 4
    first = PrintHeadLog(original.heads.rows[:count], original.heads.extruding[:count])
    assert same(open_session(tmp_path / "run.mcap").heads, first)


def test_a_damaged_recording_has_its_heads_up_to_the_damage(tmp_path: Path) -> None:
    times = stamps(90)
    heads = made_up(times)
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        for number in range(90):
            write_frames(recorder, 1, 2, times[number] + 1e-3)
            recorder.head_row(heads.rows[number], bool(heads.extruding[number]))
    data = (tmp_path / "x.mcap").read_bytes()
    (tmp_path / "x.mcap").write_bytes(data[: len(data) // 2])
    session = open_session(tmp_path / "x.mcap")
    count = len(session.heads)
    assert session.damage and 90 * 0.5 - 30 * MAX_CHUNK_SECONDS - 1 <= count < 60
    assert same(session.heads, PrintHeadLog(heads.rows[:count], heads.extruding[:count]))
    assert all(frames.head is not None for frames in session.frame_sets())


def test_what_could_not_be_read_back_is_refused_when_it_is_written(tmp_path: Path) -> None:
    heads = made_up([0.0, 0.0])
    with Recorder(tmp_path / "x.mcap", rig(2)) as recorder:
        recorder.head_row(heads.rows[0], True)
        with pytest.raises(InputError, match=r"print head = 0\.0, allowed later"):
            recorder.head_row(heads.rows[1], True)
        with pytest.raises(InputError, match="/head"):
            recorder.head_row(np.array([1.0, np.nan, 2, 3, 0, 0, 0, 1]), False)


def test_a_file_of_nothing_but_its_header_is_no_head(session: Path) -> None:
    (session / "head.csv").write_text(HEADER + "\n")
    assert all(frames.head is None for frames in open_session(session).frame_sets())


GOOD = "0.5,1,2,3,0,0,0,1,0"


@pytest.mark.parametrize(
    ("text", "what", "words"),
    [
        ("", "header", "empty"),
        (f"{HEADER.replace('extruding', 'ink')}\n{GOOD}", "header", "allowed stamp_s,x_mm"),
        (f"{HEADER}\n{GOOD}\n0.6,1,nan,3,0,0,0,1,0", "line 3", "allowed finite numbers"),
        (f"{HEADER}\ninf,1,2,3,0,0,0,1,0", "line 2", "allowed finite numbers"),
        (f"{HEADER}\n0.6,1,far,3,0,0,0,1,0", "line 2", "far"),
        (f"{HEADER}\n0.6,1,2,3,0,0,0", "line 2", "allowed 8 numbers"),
        (f"{HEADER}\n0.6,1,2,3,0,0,0,1.02,0", "line 2: length of qx qy qz qw", "1.02"),
        (f"{HEADER}\n{GOOD}\n{GOOD}", "line 3: stamp", "0.5, allowed later than the one before"),
        (f"{HEADER}\n{GOOD}\n\n0.4,1,2,3,0,0,0,1,0", "line 4: stamp", "0.4"),
        (f"{HEADER}\n0.6,1,2,3,0,0,0,1,2", "line 2: extruding", "'2', allowed 0 or 1"),
        (f"{HEADER}\n0.6,1,2,3,0,0,0,1,", "line 2: extruding", "'', allowed 0 or 1"),
        (f"{HEADER}\n0.6,1,2,3,0,0,0,1,true", "line 2: extruding", "'true', allowed 0 or 1"),
    ],
)
def test_a_wrong_row_is_named(session: Path, text: str, what: str, words: str) -> None:
    (session / "head.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        open_session(session)
    assert (Path(caught.value.where).name, caught.value.what) == ("head.csv", what) and words in str(caught.value)


def test_a_file_that_cannot_be_read_is_named(session: Path) -> None:
    (session / "head.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"head\.csv: file"):
        open_session(session)
