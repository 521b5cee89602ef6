"""`stillbed view`: a recorded session as a page that shows the pictures of each frame set with pose, tracks and nozzle.

It has the access control of the operator's page: this machine only, a token in the address, nothing from outside.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np
from aiohttp import web

from estimation import se3
from estimation.errors import InputError, StillbedError
from estimation.mapping.triangulation import triangulated_map
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.images import small_jpeg
from hardware.files.path_file import read_path
from hardware.files.session import FrameReader, Session, damage_text
from hardware.offline.trajectory_files import PoseSeries, read_pose_series
from hardware.operator.broadcast import pictures_bytes, scene_text, text
from hardware.operator.process import THUMBNAIL_QUALITY, THUMBNAIL_WIDTH, CameraShot, Crop, crop_around
from hardware.operator.server import CONTENT_TYPES, page_files
from hardware.operator.settings import AccessControl, OperatorSettings, check_settings, response_headers
from hardware.operator.shared_state import CameraPicture, PagePictures, PageScene, scene_from
from hardware.operator.view import Activity, MotionView, RunStage, TrackingView, tracking_from_pose
from hardware.recording.mcap_file import ChunkMessages, FileMetadata, epoch_of, walk
from hardware.recording.ros_messages import LOG, unpacked
from hardware.recording.session_reader import (
    open_session,
    read_commands,
    read_observations,
    read_poses,
    read_smoothed,
    used_inputs,
)
from hardware.report.evaluation import associate
from hardware.report.page import open_in_browser
from perception.frames import Frame, FrameSet, frame_set, mean_stamp
from planning.command import Command, Move
from planning.path import Path as Toolpath

MIN_SURFACE_TRACKS = 12  # tracks that make a surface worth showing
MAX_SURFACE_SETS = 60  # first frame sets, of which the one with most tracks gives the surface

Record = TypeVar("Record", SurfacePose, Observations)


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """A session as it is shown, K frame sets."""

    session: Session
    source: str  # of the poses, "" without any
    stamps: Array  # (K,) s, of the frame sets
    poses: tuple[SurfacePose | None, ...]  # K
    tracks: tuple[Observations | None, ...]  # K
    fraction: Array  # (K,) place on the path, counted in checkpoints; NaN where nothing was commanded
    off: Array  # (K,) mm from the truth, aligned at the first pose; NaN without one
    held: tuple[str, ...]  # K, why the nozzle was held at each; "" where it was not
    events: tuple[tuple[float, str], ...]  # s and words of the run's log, in their order
    scene: PageScene

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def places(self) -> Array:
        """(K, 3) mm, the surface's origin in base; NaN where there is no pose."""
        unknown = np.full(3, np.nan)
        return np.array([unknown if p is None else p.base_from_surface[:3, 3] for p in self.poses]).reshape(-1, 3)

    def tracking(self, k: int) -> TrackingView | None:
        """The estimate at frame set k, None where there is none."""
        pose, seen = self.poses[k], self.tracks[k]
        return None if pose is None else tracking_from_pose(pose, pose.stamp, 0 if seen is None else len(seen))

    def motion(self, k: int) -> MotionView | None:
        """The nozzle at frame set k, None where none was recorded."""
        head = self.session.heads.at(float(self.stamps[k]))
        if head is None:
            return None
        doing = Activity.PRINTING if head.extruding else Activity.TRAVELLING
        return MotionView(doing, "", np.nan, np.nan, float(self.off[k]), 0.0, np.nan, head.base_from_nozzle, "")


def open_playback(path: Path, poses: str | None = None, toolpath: Path | None = None) -> Playback:
    """Open a session folder, an .mcap file, or the results of `stillbed smooth`; InputError where that cannot be read.

    poses: an argument of `stillbed compare` whose poses are shown instead. toolpath: instead of the recording's path.
    """
    if (path / "smoothed.mcap").is_file():
        path = path / "smoothed.mcap"
    elif (path / "smoothed.csv").is_file():
        raise InputError(path, "pictures", "none", f"the session that was smoothed, with --poses {path}")
    session = open_session(path)
    stamps = np.array([mean_stamp(refs) for refs in session.sets])
    if not len(stamps):
        raise InputError(path, "frame sets", "none", "a session with pictures")
    recorded, source = _poses(session, poses)
    shown_poses = _at_stamps(stamps, recorded)
    tracks = _at_stamps(stamps, list(read_observations(session.path)) if session.path.is_file() else [])
    off = _off(stamps, shown_poses, session)
    path_shown = _toolpath(session) if toolpath is None else read_path(toolpath)
    scene = scene_from(session.rig, path_shown, _surface(session.rig, shown_poses, tracks))
    commands = list(read_commands(session.path)) if session.path.is_file() else []
    done = _fraction(commands, stamps), off, _held(commands, stamps), _events(session.path)
    return Playback(session, source, stamps, shown_poses, tracks, *done, scene)


def _poses(session: Session, named: str | None) -> tuple[list[SurfacePose], str]:
    """The poses to show and where they are from: the named ones, else smoothed, live or true ones."""
    if named is not None:
        series = read_pose_series(named)
        return _as_poses(series), series.name
    if session.path.is_file():
        for name, read in (("smoothed", read_smoothed), ("live", read_poses)):
            finite = [pose for pose in read(session.path) if np.isfinite(pose.base_from_surface).all()]
            if finite:
                return finite, name
    truth = session.truth
    if truth is None:
        return [], ""
    unknown = np.full((len(truth), 6, 6), np.nan)
    return _as_poses(PoseSeries("truth", truth, unknown)), "truth" if truth.exact else "reference"


def _as_poses(series: PoseSeries) -> list[SurfacePose]:
    rows = zip(series.trajectory.stamps, series.trajectory.base_from_surface, series.covariance, strict=True)
    return [SurfacePose(float(t), pose, covariance, np.zeros(6), TrackState.TRACKING) for t, pose, covariance in rows]


def _at_stamps(stamps: Array, records: list[Record]) -> tuple[Record | None, ...]:
    """The record at each of the stamps (K,), s; None where there is none."""
    records = sorted(records, key=lambda record: record.stamp)
    rows, theirs = associate(stamps, np.array([record.stamp for record in records]))
    out: list[Record | None] = [None] * len(stamps)
    for row, their in zip(rows.tolist(), theirs.tolist(), strict=True):
        out[row] = records[their]
    return tuple(out)


def _surface(rig: Rig, poses: tuple[SurfacePose | None, ...], tracks: tuple[Observations | None, ...]) -> Array | None:
    """Landmarks (V, 3) mm in the surface frame, triangulated in the frame set with most tracks; None without one."""
    pairs = zip(poses, tracks, strict=True)
    candidates = [(pose, seen) for pose, seen in pairs if pose is not None and seen is not None][:MAX_SURFACE_SETS]
    if not candidates:
        return None
    pose, seen = max(candidates, key=lambda pair: len(pair[1]))
    if len(seen) < MIN_SURFACE_TRACKS:
        return None
    try:
        first = triangulated_map(rig, seen)
    except InputError:  # no two cameras see the same
        return None
    return se3.transform_points(se3.inverse(pose.base_from_surface) @ first.base_from_surface, first.map.points)


def _off(stamps: Array, poses: tuple[SurfacePose | None, ...], session: Session) -> Array:
    out, truth = np.full(len(stamps), np.nan), session.truth
    tracked = np.array([k for k, pose in enumerate(poses) if pose is not None], np.int64)
    if truth is None or not len(tracked):
        return out
    rows, theirs = associate(stamps[tracked], truth.stamps)
    if len(rows):
        ours = np.array([pose.base_from_surface for pose in poses if pose is not None])[rows]
        target = truth.base_from_surface[theirs]
        target = target @ se3.inverse(target[0]) @ ours[0]
        out[tracked[rows]] = np.linalg.norm((ours - target)[:, :3, 3], axis=1)
    return out


def _toolpath(session: Session) -> Toolpath | None:
    """The recording's path; None where it has none."""
    with suppress(InputError):
        return used_inputs(session.path).path if session.path.is_file() else None
    return None


def _fraction(commands: list[Command], stamps: Array) -> Array:
    """(K,) the checkpoint that the arm was last sent to; NaN before the first move."""
    out = np.full(len(stamps), np.nan)
    moves = [(c.stamp, c.checkpoint) for c in commands if isinstance(c, Move)]
    if moves:
        stamps_known, where = np.array(sorted(moves), float).T
        last = np.searchsorted(stamps_known, stamps, side="right") - 1
        out[last >= 0] = where[last[last >= 0]]
    return out


def _held(commands: list[Command], stamps: Array) -> tuple[str, ...]:
    """Why the nozzle was held at each of the stamps (K,), s, by the last command before it; "" where it was not."""
    by_stamp = sorted(commands, key=lambda command: command.stamp)
    last = np.searchsorted([command.stamp for command in by_stamp], stamps, side="right") - 1
    return tuple("" if k < 0 else by_stamp[k].reason for k in last.tolist())


def _events(path: Path) -> tuple[tuple[float, str], ...]:
    """Stamps, s, and words of a recording's log; none of a folder's."""
    epoch, events = 0, list[tuple[float, str]]()
    for part in walk(path) if path.is_file() else ():
        if isinstance(part, FileMetadata):
            epoch = epoch_of(part.table) or 0
        elif isinstance(part, ChunkMessages):
            for log in (unpacked(LOG, each.data) for each in part.messages if each.topic == "/events"):
                events.append(((log.stamp.sec * 1_000_000_000 + log.stamp.nanosec - epoch) / 1e9, log.msg))
    return tuple(sorted(events))


STAGES = {stage.value for stage in RunStage}  # as the log tells them, alone or before a colon


class PictureReader:
    """The pictures of a session by frame set, in any order and from any thread, one frame set at a time."""

    def __init__(self, playback: Playback) -> None:
        self._playback, self._lock = playback, Lock()
        self._reader: FrameReader | None = None
        self._next = 0
        self._crops: dict[int, Crop | None] = {}  # of each camera, as it was last

    def __call__(self, k: int) -> PagePictures:
        """The pictures of frame set k; InputError where one cannot be read."""
        with self._lock:
            frames = self._read(k)
        pose, seen = self._playback.poses[k], self._playback.tracks[k]
        cameras = self._playback.session.rig.cameras
        pictures = []
        for frame in frames.frames:
            name, jpeg = cameras[frame.camera].name, small_jpeg(frame.image, THUMBNAIL_WIDTH, THUMBNAIL_QUALITY)
            pixels = np.zeros((0, 2)) if seen is None else seen.pixels[seen.camera == frame.camera]
            outline = tuple(r.polygon for r in self._playback.session.roi if r.camera == frame.camera)
            shot = CameraShot(name, frame.image, outline if not len(pixels) else (), pixels)
            crop, near = crop_around(shot, self._crops.get(frame.camera)), b""
            self._crops[frame.camera] = crop
            if crop is not None:  # the wound, pixel by pixel
                x, y, width, height = crop
                near = small_jpeg(frame.image[y : y + height, x : x + width], width, THUMBNAIL_QUALITY)
            pictures.append(CameraPicture(name, jpeg, (), pixels, near, crop))
        return PagePictures(frames.stamp, tuple(pictures), None if pose is None else pose.base_from_surface)

    def _read(self, k: int) -> FrameSet:
        """The frame set k. Readers go forward only; to go back, a new one is opened."""
        refs = self._playback.session.sets[k]
        if self._reader is None or k < self._next:
            self.close()
            self._reader = self._playback.session.open_reader()
        self._next = k + 1
        try:
            return frame_set([Frame(ref.camera, ref.stamp, self._reader.read(ref)) for ref in refs])
        except InputError:
            self.close()
            raise

    def close(self) -> None:
        """Close the reader."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


OPERATOR_FILES = (  # of its page
    *("camera.js", "canvas.js", "delaunator.js", "lens.js", "panes.js", "scene.js", "theme.js", "words.js"),
    *("page.css", "icon.svg"),
)
STATUS_UNREADABLE = 422  # HTTP, unprocessable content; its text says why

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ViewServer:
    """One session's viewer."""

    def __init__(self, playback: Playback, settings: OperatorSettings, port: int) -> None:
        self._playback, self._pictures = playback, PictureReader(playback)
        self._access = AccessControl(settings, port)
        self._headers = {**response_headers(settings, port), "Server": "stillbed"}
        own = {each.name: each.read_bytes() for each in (files("hardware.offline") / "viewer_page").iterdir()}
        self._files = {**{name: page_files()[name] for name in OPERATOR_FILES}, **own}
        self._session = session_text(playback)

    def application(self) -> web.Application:
        """The routes, all behind the access control."""
        application = web.Application(middlewares=[self._check_access])
        application.router.add_get("/{token}/session", self._get_session)
        application.router.add_get("/{token}/at/{k:[0-9]{1,9}}", self._get_instant)
        application.router.add_get("/{token}/pictures/{k:[0-9]{1,9}}", self._get_pictures)
        application.router.add_get("/{token}/{name:[a-z_.]*}", self._get_file)
        return application

    @web.middleware
    async def _check_access(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        token = request.path.partition("/")[2].partition("/")[0]
        if reason := self._access.refusal(token, request.headers, request.method != "GET"):
            return web.Response(status=403, text=f"refused: {reason}\n", headers=self._headers)
        try:
            return await handler(request)
        except web.HTTPException as error:
            return web.Response(status=error.status, text=f"{error.reason}\n", headers=self._headers)
        except StillbedError as error:
            return web.Response(status=STATUS_UNREADABLE, text=str(error), headers=self._headers)

    async def _get_file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"] or "view.html"
        if name not in self._files:
            raise web.HTTPNotFound
        kind = CONTENT_TYPES[name.rsplit(".", 1)[1]]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8", headers=self._headers)

    async def _get_session(self, _: web.Request) -> web.StreamResponse:
        return web.Response(text=self._session, content_type="application/json", headers=self._headers)

    async def _get_instant(self, request: web.Request) -> web.StreamResponse:
        instant = instant_text(self._playback, self._number(request))
        return web.Response(text=instant, content_type="application/json", headers=self._headers)

    async def _get_pictures(self, request: web.Request) -> web.StreamResponse:
        k = self._number(request)
        body = await asyncio.to_thread(lambda: pictures_bytes(self._pictures(k)))
        return web.Response(body=body, content_type="application/octet-stream", headers=self._headers)

    def _number(self, request: web.Request) -> int:
        k = int(request.match_info["k"])
        if k >= len(self._playback):
            raise web.HTTPNotFound
        return k


def session_text(playback: Playback) -> str:
    """What does not change with time, as JSON: the scene, and the surface's position at every frame set."""
    truth = playback.session.truth
    whole = text(
        title=playback.session.path.name,
        source=playback.source,
        damage=playback.session.damage,
        truth="" if truth is None else "truth" if truth.exact else "reference",
        stamps=np.round(playback.stamps - playback.stamps[0], 4),
        first=float(playback.stamps[0]),
        places=[None if np.isnan(place[0]) else np.round(place, 4) for place in playback.places],
        states=["" if pose is None else pose.state for pose in playback.poses],
        off=playback.off,
        held=playback.held,
        events=[[round(stamp - playback.stamps[0], 3), words] for stamp, words in playback.events],
        stages=[
            [round(stamp - playback.stamps[0], 3), name]
            for stamp, words in playback.events
            if (name := words.partition(":")[0]) in STAGES
        ],
    )
    return f'{whole[:-1]},"scene":{scene_text(playback.scene)}}}'


def instant_text(playback: Playback, k: int) -> str:
    """Estimate, nozzle, place on the path and error at frame set k, as JSON."""
    tracking, motion = playback.tracking(k), playback.motion(k)
    return text(k=k, tracking=tracking, motion=motion, fraction=playback.fraction[k], off=playback.off[k])


async def serve(playback: Playback, settings: OperatorSettings, listener: socket.socket) -> None:
    """Serve until cancelled."""
    server = ViewServer(playback, settings, listener.getsockname()[1])
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        await web.SockSite(runner, listener).start()
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


def run_view(session: Path, poses: str | None, toolpath: Path | None, port: int, shown: bool = False) -> None:
    """Print the page's address and serve it until interrupted; InputError where the session cannot be opened.

    shown: open it in a browser as well.
    """
    settings = check_settings(OperatorSettings(port=port))
    playback = open_playback(session, poses, toolpath)
    with socket.create_server((settings.host, settings.port)) as listener:
        port = listener.getsockname()[1]
        seconds = playback.stamps[-1] - playback.stamps[0]
        if playback.session.damage:
            print(damage_text(playback.session.damage))
        print(f"{len(playback)} frame sets over {seconds:.1f} s, poses: {playback.source or 'none'}")
        address = f"http://{settings.host}:{port}/{settings.token}/"
        print(f"open {address} in a browser; Ctrl-C ends", flush=True)
        if shown:
            open_in_browser(address)
        asyncio.run(serve(playback, settings, listener))
