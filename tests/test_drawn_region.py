"""A region drawn on the page: only what is a region reaches the run, and only while the run asks for one."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimation.errors import InputError
from hardware.files.region_table import MAX_CORNERS
from hardware.operator.broadcast import RegionMessage, parse_message
from hardware.operator.server import drawn_region
from hardware.operator.settings import WindowLimits
from hardware.operator.shared_state import CameraPicture, PagePictures, scene_from
from hardware.operator.view import DRAW_QUESTION, RunStage, Wish
from tests.browser import Browser, Page
from tests.operator_page import Served, full_view, served
from tests.printed_sheet import SIZE, rig
from tests.test_operator_windows import Socket, window

SQUARE = [[10, 10], [90, 10], [90, 60], [10, 60]]
BOTH = {"camera0": SQUARE, "camera2": SQUARE}
CALM = WindowLimits(stale=30.0, patience=30.0)


def asked_view(turn: int = 1, **changed: Any) -> Any:
    return full_view(1.0 + turn, turn, RunStage.FIND, **{"draws": True, "question": DRAW_QUESTION, **changed})


async def answer(socket: Socket, region: object, turn: int = 1, tag: int = 5) -> str:
    """What is said to a region."""
    await socket.socket.send_str(json.dumps({"region": region, "turn": turn, "tag": tag}))
    said = await socket.next("asked")
    assert said["tag"] == tag and said["wish"] == "region"
    return str(said["words"])


def test_a_region_reaches_the_run_from_a_window_that_shows_what_it_asks_now_and_from_no_other() -> None:
    async def drawing(page: Served) -> None:
        async with window(page.address) as socket:
            await socket.next()
            assert "has changed" in await answer(socket, BOTH, turn=0)
            assert page.link.regions.get() is None
            assert await answer(socket, BOTH) == ""
            drawn = page.link.regions.get()
            assert drawn is not None and dict(drawn) == {k: tuple(map(tuple, v)) for k, v in BOTH.items()}
            page.put(asked_view(2, draws=False))
            while (await socket.next())["view"]["turn"] < 2:
                pass
            assert "no region is asked for" in await answer(socket, {**BOTH, "camera1": SQUARE}, turn=2)
            assert page.link.regions.get() is drawn

    with served() as page:
        page.link.scene.put(scene_from(rig()))
        page.put(asked_view())
        asyncio.run(drawing(page))


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ({}, "no corners"),
        ({"camera0": SQUARE}, "2 cameras"),
        ({**BOTH, "camera9": SQUARE}, "unknown camera"),
        ({**BOTH, "camera1": SQUARE[::2]}, "3 to 64"),
        ({**BOTH, "camera1": [[k, 7 * k % 50] for k in range(MAX_CORNERS + 1)]}, "3 to 64"),
        ({**BOTH, "camera1": [[0, 0], [90, 90], [90, 0], [0, 90]]}, "px^2"),
        ({**BOTH, "camera1": [[0, 0], [100, 90], [120, 0], [0, 60]]}, "meet"),
        ({**BOTH, "camera1": [[0, 0], [90, 0], [90, SIZE[1]]]}, "in the picture"),
        ({**BOTH, "camera1": [[0, 0], [90, 0], [90, "60"]]}, "finite numbers"),
        ({**BOTH, "camera1": [[0, 0], [90, 0], [90, 1e400]]}, "finite numbers"),
        ({**BOTH, "camera1": {"x": 3}}, "finite numbers"),
        ({**BOTH, "by": "picture"}, "no corners|none of them"),
        ({**BOTH, "colour": "#00ff00"}, "none with"),
    ],
)
def test_what_is_no_region_of_these_cameras_is_refused(region: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as refused:
        drawn_region(json.loads(json.dumps(region)), rig().cameras)
    assert any(each in str(refused.value) for each in words.split("|"))


LEAVES = st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5)
THINGS = st.recursive(
    LEAVES, lambda more: st.lists(more, max_size=4) | st.dictionaries(st.text(max_size=5), more, max_size=3)
)


@given(st.dictionaries(st.sampled_from(["camera0", "camera1", "by", "colour", "x"]), THINGS, max_size=3))
def test_whatever_a_window_sends_as_a_region_is_refused_in_words_or_is_one(region: dict[str, Any]) -> None:
    message = parse_message(json.dumps({"region": region, "turn": 1, "tag": 1}))
    assert isinstance(message, RegionMessage)
    with pytest.raises(InputError):
        drawn_region(message.region, rig().cameras)


@pytest.mark.parametrize(
    "text",
    ['{"region":[],"turn":1,"tag":1}', '{"region":{},"turn":-1,"tag":1}', '{"region":{},"turn":1}', '{"region":{}}'],
)
def test_a_region_without_turn_and_tag_makes_no_sense(text: str) -> None:
    assert parse_message(text) is None


def test_the_longest_region_fits_into_a_message() -> None:
    corners = [[round(1919.9 - k / 10, 1), round(1079.9 - k / 10, 1)] for k in range(MAX_CORNERS)]
    region = {f"camera{k}": corners for k in range(6)}
    counts = {"turn": 2**53 - 1, "tag": 2**53 - 1}
    for message in ({"region": region, **counts}, {"ask": "outline", "outline": region, **counts}):
        assert len(json.dumps(message, separators=(",", ":"))) <= WindowLimits().message


async def outline_answer(socket: Socket, outline: object, turn: int = 1) -> dict[str, Any]:
    """What is said to a corrected outline."""
    await socket.socket.send_str(json.dumps({"ask": "outline", "turn": turn, "tag": 6, "outline": outline}))
    return await socket.next("asked")


def test_an_outline_reaches_the_run_where_it_is_offered_and_is_checked_as_a_region_is() -> None:
    async def correcting(page: Served) -> None:
        async with window(page.address) as socket:
            await socket.next()
            assert "has changed" in (await outline_answer(socket, BOTH, turn=0))["words"]
            assert "2 cameras" in (await outline_answer(socket, {"camera0": SQUARE}))["words"]
            assert (
                "in the picture"
                in (await outline_answer(socket, {**BOTH, "camera1": [[0, 0], [9999, 0], [0, 99]]}))["words"]
            )
            assert page.link.take() == []
            assert (await outline_answer(socket, BOTH)) == {
                "kind": "asked", "tag": 6, "wish": "outline", "number": 1, "words": "",
            }  # fmt: skip
            (request,) = page.link.take()
            assert request.wish is Wish.OUTLINE and request.turn == 1
            assert dict(request.outline) == {k: tuple(map(tuple, v)) for k, v in BOTH.items()}
            page.put(full_view(3.0, 2, RunStage.CONFIRM, offers=(Wish.END,)))
            while (await socket.next())["view"]["turn"] < 2:
                pass
            assert "cannot be done" in (await outline_answer(socket, BOTH, turn=2))["words"]
            assert page.link.take() == []

    with served() as page:
        page.link.scene.put(scene_from(rig()))
        page.put(full_view(2.0, 1, RunStage.CONFIRM, offers=(Wish.OUTLINE, Wish.END)))
        asyncio.run(correcting(page))


def pictures() -> PagePictures:
    jpeg = cv2.imencode(".jpg", np.full((SIZE[1], SIZE[0], 3), 140, np.uint8))[1].tobytes()
    return PagePictures(1.0, tuple(CameraPicture(camera.name, jpeg) for camera in rig().cameras))


def place(page: Page, camera: str, x: float, y: float) -> tuple[float, float]:
    """Where a pixel of a camera's picture is in the window."""
    left, top, width, height = page.js(
        f"(() => {{ const r = document.querySelector('[data-camera={camera}] canvas').getBoundingClientRect();"
        " return [r.x, r.y, r.width, r.height]; })()"
    )
    scale = min(width / SIZE[0], height / SIZE[1])
    return left + (width - scale * SIZE[0]) / 2 + scale * (x + 0.5), top + (height - scale * SIZE[1]) / 2 + scale * (
        y + 0.5
    )


@pytest.mark.slow
def test_corners_that_are_clicked_are_the_regions_corners(browser: Browser) -> None:
    with served() as made:
        made.link.scene.put(scene_from(rig()))
        made.put(asked_view())
        page = browser.page(made.address, (1400, 900))
        page.until('!document.getElementById("draw").hidden')
        end = time.monotonic() + 20
        while (
            not page.js('document.querySelector("[data-camera=camera1] canvas")?.dataset.drawn')
            and time.monotonic() < end
        ):
            made.link.pictures.put(replace(pictures(), stamp=time.monotonic()))
            time.sleep(0.1)
        assert page.text("#question") == DRAW_QUESTION
        wanted = {
            "camera0": [[60, 50], [400, 60], [390, 220], [70, 200]],
            "camera1": [[100, 40], [300, 50], [200, 230]],
        }
        for camera, corners in wanted.items():
            if not page.js(f"document.querySelector('[data-camera={camera}]').classList.contains('chosen')"):
                page.click(f"[data-camera={camera}] canvas")
                page.until(f"document.querySelector('[data-camera={camera}]').classList.contains('chosen')")
                time.sleep(0.2)  # until it is laid out
            assert page.js('document.querySelector("[data-draw=use]").disabled')
            for corner in corners:
                page.press(*place(page, camera, *corner))
            page.press(*place(page, camera, 10, 10))
            page.until(
                f"document.querySelector('[data-camera={camera}] canvas').dataset.corners === '{len(corners) + 1}'"
            )
            page.click("[data-draw=undo]")
            page.until(f"document.querySelector('[data-camera={camera}] canvas').dataset.corners === '{len(corners)}'")
        page.until('!document.querySelector("[data-draw=use]").disabled')
        page.click("[data-draw=use]")
        page.until('document.getElementById("toast").textContent.includes("was taken")')
        drawn = made.link.regions.get()
        assert drawn is not None
        for name, corners in drawn:
            assert np.abs(np.array(corners) - wanted[name]).max() < 1.0
        assert {name for name, _ in drawn} == set(wanted)
        made.put(asked_view(2, draws=False))
        page.until('document.getElementById("draw").hidden')
        page.close()
