"""The dry run over a printed picture on a table: live cameras of another program, a virtual arm, and a region."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hardware.operator.view import MoveRequest
from hardware.recording.session_reader import open_session, read_poses
from perception.frames import region_polygons
from tests.live_runs import PATH, Running, asks_to_move, messages
from tests.outside_cameras import outside
from tests.printed_sheet import corners_at, rig
from tests.test_operator_windows import window
from tests.test_record import sheet_error

LIFT = 20.0  # mm


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("sheet")
    (folder / "path.csv").write_text("\n".join(PATH.splitlines()[:4]) + "\n")
    with outside(folder):
        yield folder


def corners() -> dict[str, list[list[float]]]:
    """The sheet wherever it is pushed to: as large as it is, in the middle of its way."""
    return {camera.name: corners_at(0.0, camera, 8.0).round(1).tolist() for camera in rig().cameras}


async def draw(address: str) -> str:
    """Draw the region on the page once it is asked for; what is said to that."""
    async with window(address) as socket:
        while not (said := await socket.next())["view"]["draws"]:
            pass
        await socket.socket.send_str(json.dumps({"region": corners(), "turn": said["view"]["turn"], "tag": 3}))
        return str((await socket.next("asked"))["words"])


@pytest.mark.slow
@pytest.mark.parametrize("by", ["polygon", "colour", "drawn"])
def test_a_dry_run_over_a_printed_picture_follows_the_picture(place: Path, by: str) -> None:
    tables = {
        "polygon": "".join(f"{name} = {each}\n" for name, each in corners().items()),
        "colour": 'by = "colour"\n',
        "drawn": 'by = "polygon"\n',
    }
    record = place / f"{by}_run.mcap"
    (place / f"{by}.toml").write_text(
        f'[cameras]\nrig = "rig.toml"\npatience_s = 120\n[print]\npath = "path.csv"\ndry_run = true\n'
        f'lift_mm = {LIFT}\n[arm]\ndevice = "virtual"\n[record]\nfile = "{record.name}"\n'
        f"[region]\n{tables[by]}"
    )
    run = Running(str(place / f"{by}.toml"), cache=place)
    try:
        if by == "drawn":
            run.wait_for(r"open (\S+) to see")
            address = run.said.split("open ")[1].split(" ")[0]
            assert asyncio.run(draw(address)) == ""
        run.wait_for(r"now: move the path on the page")  # where it lies by the region alone is a guess
        asks_to_move(run, MoveRequest(0.0, 0.0, -90.0))  # along the sheet's long side the arm does not reach
        run.wait_for("moved by hand")
        run.press("y")
        run.wait_for("ready")
        run.press("s")
        assert run.end() == 0, run.said
    finally:
        run.close()
    poses = [pose for pose in read_poses(record) if pose.state.measured]
    off = sheet_error(np.stack([pose.base_from_surface for pose in poses]))
    assert np.median(off) < 0.1 and np.ptp([pose.base_from_surface[0, 3] for pose in poses]) > 5.0  # mm
    session = open_session(record)
    assert len(session.roi) == 3
    begun = min(pose.stamp for pose in poses)
    before = [frames for frames in session.frame_sets() if frames.stamp <= begun]  # of the first measured pose
    assert not isinstance(region_polygons(session.roi, before[-1], []), str)  # a tracker of the file has begun by then
    assert not any(message["extrude"] for message in messages(record, "/move"))
