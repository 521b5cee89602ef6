"""The wound's outline corrected during a live run before rendered pictures: recorded, and followed inside it."""

from __future__ import annotations

import asyncio
import json
from itertools import islice
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from hardware.live.prerender import prerender
from hardware.offline.track import tracker
from hardware.operator.view import Wish
from hardware.recording.session_reader import corrected_pictures, open_session, read_poses
from perception.frames import region_polygons
from perception.mapping.features import polygon_mask
from perception.wound.segmentation import rgb
from tests.live_runs import Running, messages
from tests.test_live_scan import PATH, SCENARIO

RETRACKED = 6  # frame sets
Outline = dict[str, list[list[float]]]


def head_of(data: bytes) -> dict[str, Any]:
    """The head of a message of pictures."""
    return dict(json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")]))


async def correct(address: str, share: float) -> tuple[Outline, Outline]:
    """Draw the outline smaller once the run would take it; what it was on the pictures, and what was sent."""
    origin = address.rsplit("/", 2)[0]
    found, smaller = Outline(), Outline()
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(address + "socket", headers={"Origin": origin}, max_msg_size=0) as socket,
    ):
        async for message in socket:
            if message.type is aiohttp.WSMsgType.BINARY:
                if (head := head_of(message.data))["kind"] == "sheet":
                    flat = {each["camera"]: each["outline"] for each in head["pictures"]}
                    found = {name: np.reshape(each[0], (-1, 2)).tolist() for name, each in flat.items() if each}
                continue
            said = json.loads(message.data)
            if "bundle" in said:
                await socket.send_str(json.dumps({"shown": said["bundle"]}))
            if said["kind"] == "asked":
                assert said["words"] == ""
                return found, smaller
            if said.get("view") and Wish.OUTLINE in said["view"]["offers"] and found:
                middles = {name: np.mean(corners, axis=0) for name, corners in found.items()}
                smaller = {
                    name: np.round(middles[name] + share * (np.array(each) - middles[name]), 1).tolist()
                    for name, each in found.items()
                }
                asked = {"ask": Wish.OUTLINE, "turn": said["view"]["turn"], "tag": 3, "outline": smaller}
                await socket.send_str(json.dumps(asked))
    raise AssertionError("the page has ended")


@pytest.mark.slow
def test_a_corrected_outline_is_recorded_with_its_pictures_and_the_surface_is_followed_inside_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "wound.toml").write_text(SCENARIO)
    (tmp_path / "path.csv").write_text(PATH)
    prerender(tmp_path / "wound.toml", tmp_path / "stillbed", threads=1)
    record = tmp_path / "run.mcap"
    (tmp_path / "region.toml").write_text('[region]\nby = "network"\n')
    given = ["--simulated", tmp_path / "wound.toml", "--region", tmp_path / "region.toml", "--record", record]
    run = Running(*map(str, given), cache=tmp_path)
    try:
        run.wait_for(r"open (\S+) to see")
        address = run.said.split("open ")[1].split(" ")[0]
        at = run.wait_for("confirm")
        found, sent = asyncio.run(correct(address, 0.85))
        at = run.wait_for("inside the outline that the operator corrected", at)
        at = run.wait_for("confirm", at)
        again, more = asyncio.run(correct(address, 0.97))  # what is followed now is shown, and can be corrected again
        at = run.wait_for("inside the outline that the operator corrected", at)
        at = run.wait_for("confirm", at)
        run.press("a")  # as at first: by the network
        at = run.wait_for("confirm", at)
        run.press("q")
        assert run.end() == 1, run.said  # ended before it was printed
    finally:
        run.close()
    session, outlines = open_session(record), messages(record, "/wound_outline")
    names = [camera.name for camera in session.rig.cameras]
    assert len(found) >= 2 and found.keys() == sent.keys() == again.keys() == more.keys()
    assert [outline["by"] for outline in outlines] == ["operator"] * (len(sent) + len(more))

    # the pictures are those of the recording, and the masks what was drawn
    labelled = {each.name.split("/")[1]: each for each in corrected_pictures(record)}
    assert len(labelled) == len(outlines)
    images = {(f.camera, f.stamp): f.image for frames in session.frame_sets() for f in frames.frames}
    for outline, corners in zip(outlines, [*sent.values(), *more.values()], strict=True):
        camera, taken = outline["camera"], outline["taken"]
        each = labelled[f"{names[camera]}_{taken:.6f}"]
        assert np.array_equal(each.picture, rgb(images[camera, taken]))
        assert np.array_equal(each.wound, polygon_mask(session.rig.cameras[camera].size, np.array(corners)) > 0)

    # each look has its region: found, drawn inside the outline, again, and found
    rois = messages(record, "/roi")
    stamps = sorted({roi["stamp"] for roi in rois})
    looks = [[roi for roi in rois if roi["stamp"] == stamp] for stamp in stamps]
    assert [look[0]["found"] for look in looks] == [True, False, False, True]
    for look, drawn in ((looks[1], sent), (looks[2], more)):
        assert {names[roi["camera"]] for roi in look} == drawn.keys()
        for roi in look:
            carried, said = np.reshape(roi["polygon"], (-1, 2)), np.array(drawn[names[roi["camera"]]])
            assert carried.shape == said.shape
            assert np.abs(carried - carried.mean(0) - said + said.mean(0)).max() < 4.0  # px: it breathes 2 mm
    assert [(roi.stamp, roi.found) for roi in session.roi] == [(stamps[-1], True)] * len(names)
    poses = {pose.stamp: pose for pose in read_poses(record)}
    measured = [stamp for stamp, pose in poses.items() if pose.state.measured]
    assert all(any(a < stamp < b for stamp in measured) for a, b in zip(stamps, [*stamps[1:], np.inf], strict=True))

    # a tracker of the recording begins with the last look, and does what the run did
    counted = (f for f in session.frame_sets() if not isinstance(region_polygons(session.roi, f, []), str))
    with tracker(session.rig, session.roi) as step:
        for frames in islice(counted, RETRACKED):
            pose = step(frames)
            step.idle()
            assert np.array_equal(pose.base_from_surface, poses[frames.stamp].base_from_surface)
            assert pose.state is poses[frames.stamp].state
