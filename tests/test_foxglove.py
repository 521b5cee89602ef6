"""The recording's messages served to Foxglove: what a client sees, and that none can disturb or command anything."""

from __future__ import annotations

import asyncio
import json
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial import cKDTree

from estimation.errors import InputError
from hardware.live.prepared import RunFiles
from hardware.live.settings import LiveSettings, check_settings
from hardware.operator.process import FOXGLOVE_BACKLOG, FoxgloveServer
from hardware.process.clock import WallClock, utc_now
from hardware.process.system import file_hash
from hardware.recording import ros_messages
from hardware.recording.mcap_file import FileMetadata, walk
from hardware.recording.recorder import PublishedMessage, Recorder
from hardware.recording.session_reader import open_session
from tests.live_runs import light_runs, messages
from tests.session_files import rig
from tests.test_viewers import placed, read, surface_at

CLOCK = WallClock()
PROTOCOL = "foxglove.sdk.v1"
PATIENCE = 20.0  # s
DATA = 1  # kind of a binary message that holds another, behind it its subscription and time


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def nozzle_from_path(record: Path) -> np.ndarray:
    """(N,) mm from the path to the nozzle while material is laid, all as viewers are shown them."""
    frames: dict[str, list[tuple[int, np.ndarray]]] = {"surface": [], "nozzle": []}
    for each in (each for message in read(record, "/tf") for each in message.transforms):
        stamp = each.header.stamp.sec * 1_000_000_000 + each.header.stamp.nanosec
        frames[each.child_frame_id].append((stamp, placed(each.transform)))
    rows = np.frombuffer(read(record, "/path")[-1].data.tobytes(), [("at", "<f4", 3), ("colour", "<u4")])
    at = np.linspace(0, len(rows) - 1, 100 * len(rows))
    line = np.stack([np.interp(at, np.arange(len(rows)), 1000 * axis) for axis in rows["at"].T], axis=1)
    path = cKDTree(line)
    began = open_session(record).began
    laid = [began + round(1e9 * float(str(m["stamp"]))) for m in messages(record, "/move") if m["extrude"]]
    times, poses = zip(*frames["surface"], strict=True)
    off = []
    for stamp, nozzle in frames["nozzle"]:
        if laid[0] < stamp < laid[-1]:
            pose = poses[min(int(np.searchsorted(times, stamp)), len(poses) - 1)]
            off.append(path.query((np.linalg.inv(pose) @ nozzle)[:3, 3])[0])
    return np.array(off)


async def told(window: aiohttp.ClientWebSocketResponse) -> dict[str, Any] | bytes:
    """The next message."""
    message = await window.receive(PATIENCE)
    assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
    return json.loads(message.data) if message.type == aiohttp.WSMsgType.TEXT else message.data


async def advertised(window: aiohttp.ClientWebSocketResponse, topics: set[str]) -> dict[str, dict[str, Any]]:
    """The channels, once those topics are among them."""
    found: dict[str, dict[str, Any]] = {}
    while not topics <= set(found):
        message = await told(window)
        if isinstance(message, dict) and message["op"] == "advertise":
            found |= {each["topic"]: each for each in message["channels"]}
    return found


async def subscribed(window: aiohttp.ClientWebSocketResponse, topics: list[str]) -> dict[int, dict[str, Any]]:
    """The channels of the topics, by subscription."""
    found = await advertised(window, set(topics))
    asked = [{"id": k, "channelId": found[topic]["id"]} for k, topic in enumerate(topics)]
    await window.send_json({"op": "subscribe", "subscriptions": asked})
    return {k: found[topic] for k, topic in enumerate(topics)}


def write_some(recorder: Recorder, k: int) -> None:
    pose = surface_at(k)
    recorder.write(pose)
    recorder.event(pose.stamp, f"set {k}")


def test_a_client_sees_what_is_recorded_and_one_that_comes_late_what_seldom_comes(tmp_path: Path) -> None:
    async def look(recorder: Recorder, port: int) -> dict[str, Any]:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"ws://127.0.0.1:{port}", protocols=(PROTOCOL,)) as window,
        ):
            info = await told(window)
            assert isinstance(info, dict) and info["op"] == "serverInfo" and info["capabilities"] == []
            channels = await subscribed(window, ["/surface", "/tf_static", "/pose"])
            seen: dict[str, Any] = {}
            until = CLOCK.now() + PATIENCE
            k = 10
            while set(seen) != {"/surface", "/tf_static", "/pose"} and CLOCK.now() < until:
                k += 1
                write_some(recorder, k)
                await asyncio.sleep(0.02)
                while True:
                    try:
                        message = await asyncio.wait_for(told(window), 0.02)
                    except TimeoutError:
                        break
                    if isinstance(message, bytes) and message[0] == DATA:
                        channel = channels[int.from_bytes(message[1:5], "little")]
                        seen[channel["topic"]] = channel, message[13:]
            return seen

    port = free_port()
    server = FoxgloveServer(port)
    try:
        with Recorder(tmp_path / "x.mcap", rig(), listener=server.publish) as recorder:
            for k in range(3):  # before anybody is there
                write_some(recorder, k)
            seen = asyncio.run(look(recorder, port))
    finally:
        server.close()
    channel, data = seen["/surface"]
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == (
        "cdr",
        ros_messages.ODOMETRY,
        "ros2msg",
    )
    assert channel["schema"] == ros_messages.definition(ros_messages.ODOMETRY)
    assert ros_messages.unpacked(ros_messages.ODOMETRY, data).child_frame_id == "surface"
    cameras = ros_messages.unpacked(ros_messages.TRANSFORMS, seen["/tf_static"][1]).transforms
    assert len(cameras) == 3 and seen["/pose"][0]["encoding"] == "json"
    assert json.loads(seen["/pose"][1])["state"] == "TRACKING"


def test_a_client_that_floods_or_never_reads_costs_the_recorder_nothing(tmp_path: Path) -> None:
    """Publishing goes on at its pace, memory stays, and what the client wants to publish is refused."""
    picture = PublishedMessage("/camera/a/image", ros_messages.IMAGE, bytes(100_000), 5)
    log = PublishedMessage("/events", ros_messages.LOG, ros_messages.log(20, "x", "y", 5), 5)

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

    async def flood(server: FoxgloveServer, port: int) -> tuple[int, float]:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"ws://127.0.0.1:{port}", protocols=(PROTOCOL,)) as window,
        ):
            server.publish(picture)
            server.publish(log)
            await subscribed(window, ["/camera/a/image"])
            advert = {"id": 1, "topic": "/orders", "encoding": "json", "schemaName": ""}
            await window.send_json({"op": "advertise", "channels": [advert]})
            with suppress(aiohttp.ClientError, ConnectionError):  # the server may drop it for that
                for _ in range(300):
                    await window.send_bytes(b"\x01\x01\0\0\0" + b"stop")
                    await window.send_str("nonsense")
            before, longest = resident(), 0.0
            for _ in range(600):  # 60 MB, none of it read
                start = CLOCK.now()
                server.publish(picture)
                longest = max(longest, CLOCK.now() - start)
            return resident() - before, longest

    port = free_port()
    server = FoxgloveServer(port)
    try:
        grown, longest = asyncio.run(flood(server, port))
    finally:
        server.close()
    assert grown < (FOXGLOVE_BACKLOG + 100) * len(picture.data)
    assert longest < 0.5  # of a machine that may be busy; a blocked publisher would wait for ever


@pytest.mark.parametrize(("port", "words"), [(-1, "1 to 65535"), (70_000, "1 to 65535"), (0, "")])
def test_the_port_is_checked_before_the_run(port: int, words: str, tmp_path: Path) -> None:
    for name in ("rig.toml", "path.csv"):
        (tmp_path / name).write_text("")
    files = {"rig": tmp_path / "rig.toml", "path": tmp_path / "path.csv", "record": tmp_path / "x.mcap"}
    settings = LiveSettings(**files, arm="virtual", foxglove_port=port)
    if not words:
        assert check_settings(settings, "x").foxglove_port == 0
        return
    with pytest.raises(InputError, match=rf"record\.foxglove_port = {port}, allowed {words}"):
        check_settings(settings, "x")


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    for name in ("rig.toml", "path.csv"):
        (tmp_path / name).write_text("")
    files = {"rig": tmp_path / "rig.toml", "path": tmp_path / "path.csv", "record": tmp_path / "x.mcap"}
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match=rf"foxglove_port = {port}, allowed .*free on this machine"):
            check_settings(LiveSettings(**files, arm="virtual", foxglove_port=port), "x")


@pytest.mark.slow  # what a client sees of a recorder is tried above
def test_a_live_run_is_seen_while_it_prints_and_says_who_made_it_of_what(tmp_path: Path) -> None:
    port, record = free_port(), tmp_path / "run.mcap"

    async def watch() -> set[str]:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"ws://127.0.0.1:{port}", protocols=(PROTOCOL,)) as window,
        ):
            wanted = ["/surface", "/path", "/tf", "/landmarks"]
            channels, seen = await subscribed(window, wanted), set[str]()
            await window.send_bytes(b"\x01\x01\0\0\0" + b"stop")  # into a channel that it had no leave to open
            while seen != set(wanted):
                message = await told(window)
                if isinstance(message, bytes) and message[0] == DATA:
                    seen.add(channels[int.from_bytes(message[1:5], "little")]["topic"])
            return seen

    began = utc_now()
    with light_runs(tmp_path, lines=2, speed=8.0) as start:
        run = start(record, "--yes", "--until-printed", f"--foxglove={port}")
        run.wait_for(r"\nprint\n")
        assert len(asyncio.run(watch())) == 4
        assert run.end() == 0, run.said
    assert sum(bool(move["extrude"]) for move in messages(record, "/move")) > 100
    made = json.loads(RunFiles(record).summary.read_text())["provenance"]
    assert made["operator"] == "Ada" and made["inputs_sha256"]["path.csv"] == file_hash(tmp_path / "path.csv")
    (metadata,) = (part.table for part in walk(record) if isinstance(part, FileMetadata))
    assert metadata["operator"] == "Ada" and metadata["sha256 path.csv"] == file_hash(tmp_path / "path.csv")
    assert "by Ada · stillbed" in RunFiles(record).report.read_text()
    with AnyReader([record]) as reader:
        assert began - 1 < reader.start_time / 1e9 < reader.end_time / 1e9 < utc_now() + 1
        assert reader.topics["/surface"].msgcount > 100
    off = nozzle_from_path(record)
    assert len(off) > 50 and np.percentile(off, 90) < 1.0, np.percentile(off, [0, 50, 90, 100])
