"""`stillbed view`: each instant shows what was recorded, in a real browser too; strangers are refused."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, executable

from estimation import se3
from estimation.synthetic.follow import steps
from estimation.synthetic.world import synthetic_world
from hardware.cli.main import WRONG_INPUT, main
from hardware.files.path_file import write_path
from hardware.offline.viewer import PictureBook, Playback, open_playback
from hardware.operator.settings import OperatorSettings
from hardware.recording.recorder import Recorder
from hardware.viewing.server import instant_text, serve, session_text
from perception.frames import Frame
from tests.moving import raster
from tests.recorded import whole_recording
from tests.session_files import make_folder

CHROMIUM = executable()
COUNT = 24


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A live run on a swaying surface, its pictures brighter from one frame set to the next."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    world = synthetic_world("lively", seconds=COUNT / 20, rate=20.0, count=40)
    with Recorder(path, world.rig) as recorder:
        recorder.truth(world.truth)
        for k, step in enumerate(steps(world, "seen")):
            for camera in range(3):
                recorder.frame(Frame(camera, step.pose.stamp, np.full((720, 1280), 40 + 8 * k, np.uint8)))
            recorder.write(step.seen)
            recorder.write(step.pose)
    return path


@pytest.fixture(scope="module")
def playback(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Playback:
    way = tmp_path_factory.mktemp("path") / "path.csv"
    write_path(way, raster())
    return open_playback(recording, toolpath=way)


@pytest.fixture(scope="module")
def address(playback: Playback) -> Iterator[str]:
    """Where it is served, by a thread of this process."""
    settings, loop = OperatorSettings(), asyncio.new_event_loop()
    with socket.create_server((settings.host, 0)) as listener:
        thread = threading.Thread(target=loop.run_forever, daemon=True)
        thread.start()
        task = asyncio.run_coroutine_threadsafe(serve(playback, settings, listener), loop)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/{settings.token}/"
        task.cancel()
        loop.call_soon_threadsafe(loop.stop)
        thread.join(5)


def got(address: str, **headers: str) -> bytes:
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=20) as answer:
        return bytes(answer.read())


def test_each_instant_has_its_own_pose_tracks_and_pictures(playback: Playback) -> None:
    assert playback.source == "live" and len(playback) == COUNT
    book = PictureBook(playback)
    for k in (5, 20, 6):  # back as well
        pose, seen = playback.poses[k], playback.tracks[k]
        assert pose is not None and seen is not None
        assert pose.stamp == seen.stamp == playback.stamps[k]
        said = json.loads(instant_text(playback, k))
        assert np.allclose(said["tracking"]["base_from_surface"], pose.base_from_surface, atol=1e-4)
        pictures = book(k)
        assert len(pictures.pictures) == 3 and pictures.stamp == playback.stamps[k]
        assert sum(len(p.tracks) for p in pictures.pictures) == len(seen)
    assert 0 < np.nanmax(playback.off) < 0.3
    book.close()


def test_the_surface_lies_where_its_landmarks_are(playback: Playback) -> None:
    world = synthetic_world("lively", seconds=COUNT / 20, rate=20.0, count=40)
    pose = playback.poses[3]
    assert pose is not None and len(playback.scene.surface) > 30
    shown = se3.transform_points(pose.base_from_surface, playback.scene.surface)
    true = se3.transform_points(world.truth.base_from_surface[3], world.landmarks.points)
    nearest = np.linalg.norm(shown[:, None] - true[None], axis=2).min(1)
    assert np.median(nearest) < 0.5


def test_a_folder_shows_its_truth_or_other_poses(tmp_path: Path, recording: Path) -> None:
    folder = make_folder(tmp_path / "s", pictures=True)
    shown = open_playback(folder)
    assert shown.source in ("truth", "reference") and not any(shown.tracks)
    assert json.loads(session_text(shown))["states"].count("TRACKING") == sum(p is not None for p in shown.poses)
    assert open_playback(recording, poses=f"{recording}:truth").source.endswith(":truth")


def test_only_who_has_the_address_is_let_in(address: str) -> None:
    assert b"stillbed view" in got(address)
    whole = json.loads(got(f"{address}session"))
    assert len(whole["stamps"]) == COUNT and len(whole["scene"]["cameras"]) == 3
    wrong = address.rsplit("/", 2)[0] + "/wrong-token/session"
    for where, headers in ((wrong, {}), (f"{address}session", {"Origin": "http://elsewhere.example"})):
        with pytest.raises(urllib.error.HTTPError) as refused:
            got(where, **headers)
        assert refused.value.code == 403
    for nowhere in (f"at/{COUNT}", "pictures/99999", "secret.txt"):
        with pytest.raises(urllib.error.HTTPError) as missing:
            got(address + nowhere)
        assert missing.value.code == 404


def test_a_picture_that_cannot_be_read_is_said(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "s", pictures=True)
    shown = open_playback(folder)
    pictures = sorted(p for p in folder.rglob("*.png"))
    pictures[-1].write_bytes(b"no picture")
    book, failed = PictureBook(shown), 0
    for k in range(len(shown)):
        try:
            book(k)
        except Exception as error:
            failed += 1
            assert pictures[-1].name in str(error)
    assert failed == 1


@pytest.mark.parametrize("what", ["missing", "garbage", "empty", "poses"])
def test_a_bad_file_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recording: Path, what: str
) -> None:
    file, words = tmp_path / f"{what}.mcap", list[str]()
    if what == "garbage":
        file.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    elif what == "empty":
        file.touch()
    elif what == "poses":
        file, words = recording, ["--poses", str(tmp_path / "no.tum")]
    assert main(["view", str(file), *words]) == WRONG_INPUT
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "allowed" in said and (words or [file.name])[-1].rsplit("/", 1)[-1] in said


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
def test_the_slider_moves_the_scene(address: str) -> None:
    assert CHROMIUM is not None
    browser = Browser(CHROMIUM)
    try:
        page = browser.page(address, (1280, 860))
        page.until("document.body.dataset.shown !== undefined && document.querySelectorAll('.camera').length === 3")
        scene = "document.querySelector('#scene canvas').toDataURL()"
        bright = (
            "(() => { const c = document.querySelector('.camera canvas');"
            " return c.getContext('2d').getImageData(c.width / 2, 20, 1, 1).data[0]; })()"
        )
        before, dark = page.js(scene), page.js(bright)
        page.js(f"(() => {{ const t = document.getElementById('time'); t.value = {COUNT - 4};"
                " t.dispatchEvent(new Event('input')); })()")  # fmt: skip
        page.until(f"document.body.dataset.shown === '{COUNT - 4}'")
        page.until(f"{scene} !== {json.dumps(before)}")
        assert page.until(f"{bright} > {dark + 60}")
        assert f"{COUNT - 3} of {COUNT}" in page.text("#now") and page.js("document.getElementById('alarm').hidden")
        page.key("Home", "Home")
        page.until("document.body.dataset.shown === '0'")
        page.key("Space", " ")
        page.until(f"document.body.dataset.playing === 'no' && document.body.dataset.shown === '{COUNT - 1}'")
    finally:
        browser.close()


def test_a_recording_without_tracks_has_no_surface(tmp_path: Path) -> None:
    shown = open_playback(whole_recording(tmp_path))
    assert shown.source == "live" and len(shown.scene.surface) == 0
