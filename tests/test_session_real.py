"""The real recordings that lie beside the project: opened, imported, exported; skipped where they are absent."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from hardware.files.session import open_session
from hardware.offline.convert import export_recording, import_folder

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
    for camera, frame in zip(session.rig.cameras, first.frames, strict=True):
        assert frame.image.shape == (camera.size[1], camera.size[0], 3)


@needs_data
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
        assert folder.truth is not None and back.truth is not None
        assert folder.truth.base_from_surface.tobytes() == back.truth.base_from_surface.tobytes()
