"""The messages of the page: what all windows are sent, encoded once for all of them, and what a window sends.

A window is sent JSON of the records, and pictures behind a head that says whose they are. What it sends is parsed
strictly, and limited in its rate.
"""

from __future__ import annotations

import asyncio
import json
import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from math import nan
from typing import Any

import numpy as np

from estimation.rig import Camera
from hardware.operator.shared_state import OperatorLink, PagePictures, PageScene, RecordingView, WavingView
from hardware.operator.view import (
    NORMAL_95,
    Activity,
    LogLine,
    MoveRequest,
    OperatorView,
    Wish,
)

_HEAD_SIZE = struct.Struct("<I")
JSON_DIGITS = 7  # significant ones of a number below 1
STAMP_DECIMALS = 6  # of all others: seven digits of a number would leave whole seconds of a stamp after 100 days
PIXEL_DECIMALS = 1
TIMELINE_ROWS = 2400  # of the error over the run, more than a screen has columns; two become one when all are full
TIMELINE_STEP = 0.1  # s of a row at first
LOG_ROWS = 1000  # lines of the log that a window is sent when it is opened
AGED = 1.0  # s, after which an error is one of earlier
MAX_BROWSER_INTEGER = 2**53 - 1  # up to which a browser's numbers count


def text(**parts: Any) -> str:
    """One message: keyword by keyword, records as objects of their fields, NaN as null."""
    return text_of(parts)


def text_of(value: Any) -> str:
    """One record in JSON."""
    return json.dumps(plain(value), separators=(",", ":"), allow_nan=False)


def plain(value: Any) -> Any:
    """What JSON can hold of a record, an array, an enum, or of what contains them."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float):
        return rounded(value) if math.isfinite(value) else None
    return value.value if hasattr(value, "value") else value


def rounded(value: float) -> float:
    """A finite number to as many digits as are shown: of a stamp, a microsecond whatever the uptime."""
    return round(value, STAMP_DECIMALS) if abs(value) >= 1.0 else float(f"{value:.{JSON_DIGITS}g}")


def scene_text(scene: PageScene) -> str:
    """The scene, its coordinates in rows one after the other."""
    return text(
        kind="scene",
        cameras=scene.cameras,
        path=np.round(scene.path, 3).ravel(),
        checkpoint=scene.checkpoint,
        extrude=scene.extrude.astype(np.uint8),
        layer=scene.layer,
        surface=np.round(scene.surface, 2).ravel(),
        triangles=scene.triangles.ravel(),
        scan=np.round(scene.scan, 2).ravel(),
        laid=[] if scene.laid is None else np.round(scene.laid.pieces, 2).ravel(),
        share=[] if scene.laid is None else np.round(scene.laid.share, 2),
    )


def pictures_bytes(pictures: PagePictures, kind: str = "live") -> bytes:
    """Length of the head (4 bytes, little-endian), the head as JSON, each camera's JPEGs: the whole, the near one.

    kind: "live", or "sheet" of the pictures on which the wound's outline is corrected.
    """
    head = text(
        kind=kind,
        stamp=pictures.stamp,
        base_from_surface=pictures.base_from_surface,
        pictures=[
            {
                "camera": each.camera,
                "size": len(each.jpeg),
                "near": len(each.near),
                "crop": each.crop,
                "outline": [np.round(polygon, PIXEL_DECIMALS).ravel() for polygon in each.outline],
                "tracks": np.round(each.tracks, PIXEL_DECIMALS).ravel(),
            }
            for each in pictures.pictures
        ],
    ).encode()
    return b"".join([_HEAD_SIZE.pack(len(head)), head, *(each.jpeg + each.near for each in pictures.pictures)])


ENCODERS: dict[str, Callable[[Any], str | bytes]] = {  # in the order in which a window is sent them
    "scene": scene_text,
    "sheet": partial(pictures_bytes, kind="sheet"),
    "pictures": pictures_bytes,
}


@dataclass(slots=True)
class TimelineRow:
    """A moment of the run: the largest errors, mm, NaN of none, the limit, mm, and whether the nozzle was held."""

    stamp: float  # s
    error: float
    true_error: float
    limit: float
    held: bool

    def add(self, other: TimelineRow) -> None:
        """Take in a later one."""
        self.error = float(np.fmax(self.error, other.error))
        self.true_error = float(np.fmax(self.true_error, other.true_error))
        self.limit, self.held = other.limit, self.held or other.held


class ErrorHistory:
    """The error over the whole run in at most TIMELINE_ROWS rows. step: s of a row."""

    def __init__(self) -> None:
        self.rows: list[TimelineRow] = []
        self.step = TIMELINE_STEP

    def add(self, row: TimelineRow) -> None:
        """Add a moment, which is later than the last."""
        if self.rows and row.stamp - self.rows[-1].stamp < self.step:
            self.rows[-1].add(row)
        else:
            self.rows.append(row)
        if len(self.rows) > TIMELINE_ROWS:
            self.step *= 2
            rows, self.rows = self.rows, []
            for each in rows:
                self.add(each)


class Broadcast:
    """The newest of everything that the run has put out, encoded once for all windows.

    view: None before the first. encoded: scene, sheet and pictures, by their names in the link, once they are there.
    gone: whether the run has ended. refused: requests that were turned away.
    """

    def __init__(self, link: OperatorLink) -> None:
        self._link = link
        self._newest: dict[str, PageScene | PagePictures | None] = dict.fromkeys(ENCODERS)
        self._view_time = nan
        self._history, self._log = ErrorHistory(), deque[LogLine](maxlen=LOG_ROWS)
        self.view: OperatorView | WavingView | RecordingView | None = None
        self.gone, self.refused = False, 0
        self.view_text, self.encoded = "null", dict[str, str | bytes]()
        self.news = asyncio.Event()  # set, and replaced, when there is something new
        self.request_event = asyncio.Event()  # something was asked of the run: its answer is looked for more often

    def update(self, now: float, watched: bool) -> None:
        """Take what is new at `now`, s; pictures only where they are watched."""
        view = self._link.views.get()
        changed = view is not None and (self.view is None or view.stamp > self.view.stamp)
        if view is not None and changed:
            self.view, self.view_text, self._view_time = view, text_of(view), now
            if isinstance(view, OperatorView):
                self._remember(view)
        for name, encode in ENCODERS.items():
            if name != "scene" and not watched:
                continue
            newest = getattr(self._link, name).get()
            if newest is not self._newest[name] and newest is not None:
                self._newest[name], self.encoded[name], changed = newest, encode(newest), True
        if changed:
            self.wake()

    def wake(self) -> None:
        """Wake all windows."""
        self.news.set()
        self.news = asyncio.Event()

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the scene, none before it is known."""
        scene = self._newest["scene"]
        return scene.cameras if isinstance(scene, PageScene) else ()

    def age(self, now: float) -> float:
        """For how long, s, the newest view has been the newest; NaN before the first."""
        return now - self._view_time

    def history_text(self) -> str:
        """The error over the run and its log, for a window that has just been opened."""
        rows = [[row.stamp, row.error, row.true_error, row.limit, row.held] for row in self._history.rows]
        return text(kind="course", step=self._history.step, rows=rows, log=list(self._log))

    def _remember(self, view: OperatorView) -> None:
        last = self._log[-1].number if self._log else 0
        self._log.extend(line for line in view.log if line.number > last)
        if (motion := view.motion) is None:
            return
        is_old = motion.error_age > AGED  # nothing is extruded: the errors are of earlier
        errors = (nan, nan) if is_old else (motion.error, motion.true_error)
        limit, held = NORMAL_95 * motion.limit, motion.activity is Activity.HOLDING
        self._history.add(TimelineRow(view.stamp, *errors, limit, held))


@dataclass(frozen=True, slots=True)
class RequestMessage:
    """A wish that a window sends."""

    wish: Wish
    turn: int  # of the view it was asked under
    tag: int  # the window's own number for it
    move: MoveRequest | None = None  # of Wish.MOVE, and of no other
    outline: dict[str, Any] | None = None  # of Wish.OUTLINE alone: corners by camera's name, not checked yet


@dataclass(frozen=True, slots=True)
class RegionMessage:
    """The region that a window has drawn; nothing of it is checked but that it is a table."""

    region: dict[str, Any]  # corners by camera's name
    turn: int  # of the view it was drawn under
    tag: int  # the window's own number for it


@dataclass(frozen=True, slots=True)
class ShownMessage:
    """The window has shown the bundle of this number."""

    bundle: int


def parse_message(text: str) -> RequestMessage | RegionMessage | ShownMessage | None:
    """The message in a text; None where it makes no sense."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(message, dict):
        return None
    if message.keys() == {"shown"}:
        return ShownMessage(message["shown"]) if _is_count(message["shown"]) else None
    if message.keys() == {"region", "turn", "tag"}:
        valid = isinstance(message["region"], dict) and _is_count(message["turn"]) and _is_count(message["tag"])
        return RegionMessage(message["region"], message["turn"], message["tag"]) if valid else None
    wish = message.get("ask")
    if not isinstance(wish, str) or wish not in Wish.__members__.values():
        return None
    payload_key = wish if wish in (Wish.MOVE, Wish.OUTLINE) else None  # what it carries has its name
    if message.keys() != {"ask", "turn", "tag", *([] if payload_key is None else [payload_key])}:
        return None
    if not (_is_count(message["turn"]) and _is_count(message["tag"])):
        return None
    move = _parse_move(message["move"]) if payload_key == Wish.MOVE else None
    outline = message["outline"] if payload_key == Wish.OUTLINE else None
    if (payload_key == Wish.MOVE and move is None) or (payload_key == Wish.OUTLINE and not isinstance(outline, dict)):
        return None
    return RequestMessage(Wish(wish), message["turn"], message["tag"], move, outline)


def _parse_move(shift: object) -> MoveRequest | None:
    """The move in [x_mm, y_mm, turn_deg]; None where it is none, not finite, or too far."""
    if not isinstance(shift, list) or len(shift) != 3 or not all(type(v) in (int, float) for v in shift):
        return None
    if not MoveRequest(*shift).allowed:  # before the figures are floats: an integer may be too long for one
        return None
    return MoveRequest(*map(float, shift))


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value <= MAX_BROWSER_INTEGER


class RateLimiter:
    """A token bucket: `rate` a second, and as many at once as a second's worth and ten."""

    def __init__(self, rate: float, now: float) -> None:
        self._rate, self._max_tokens = rate, rate + 10
        self._tokens, self._update_time = self._max_tokens, now

    def take(self, now: float) -> bool:
        """Whether one more is allowed at `now`, s."""
        self._tokens = min(self._max_tokens, self._tokens + self._rate * (now - self._update_time))
        self._update_time = now
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True
