"""A recorded session to be looked at: at each of its frame sets the pictures and all that is known beside them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose, TrackState
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.triangulated import triangulated
from hardware.channels import read_commands, read_observations, read_poses, read_smoothed
from hardware.comparing.posed import Posed, read_posed
from hardware.files.images import small_jpeg
from hardware.files.path_file import read_path
from hardware.files.session import FrameReader, Session, open_session
from hardware.live.kept import used_in
from hardware.operator.pictures import CameraPicture, Pictures
from hardware.operator.scene import Scene, scene_from
from hardware.operator.taker import QUALITY, WIDTH
from hardware.operator.view import Activity, MotionView, TrackingView, tracking_from_pose
from hardware.report.evaluation import associate
from perception.frames import Frame, FrameSet
from perception.pairing import frame_set
from planning.command import Move
from planning.path import Path as Toolpath

FEWEST = 12  # tracks that make a surface worth showing
LOOKED_AT = 60  # frame sets among which the one that shows most of the surface is sought


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """A session as it is shown. stamps: (K,) s, of the frame sets. poses: K of them, None where there is none.

    source: where the poses are from, "" without any. tracks: of each frame set, None without. fraction: (K,) of the
    path, by checkpoint, NaN where nothing was commanded. off: (K,) mm from the truth, laid at the first pose, NaN
    without one.
    """

    session: Session
    source: str
    stamps: Array
    poses: tuple[SurfacePose | None, ...]
    tracks: tuple[Observations | None, ...]
    fraction: Array
    off: Array
    scene: Scene

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
    """A session folder, an .mcap file, or what was smoothed of one. poses: of another file, as `stillbed compare` reads
    them. toolpath: a path, where the recording has none. Raises InputError.
    """
    if (path / "smoothed.mcap").is_file():
        path = path / "smoothed.mcap"
    session = open_session(path)
    sets = _stamps(session)
    if not len(sets):
        raise InputError(path, "frame sets", "none", "a session with pictures")
    found, source = _poses(session, poses)
    seen = _tracks(session, sets)
    placed = _beside(sets, found)
    off = _off(sets, placed, session)
    way = _toolpath(session) if toolpath is None else read_path(toolpath)
    scene = scene_from(session.rig, way, _surface(session.rig, placed, seen))
    return Playback(session, source, sets, placed, seen, _fraction(session, sets), off, scene)


def _stamps(session: Session) -> Array:
    """(K,) s, as frame sets have them: the mean of their images'."""
    blank = np.zeros((1, 1), np.uint8)
    return np.array([frame_set([Frame(r.camera, r.stamp, blank) for r in refs]).stamp for refs in session.sets])


def _poses(session: Session, named: str | None) -> tuple[list[SurfacePose], str]:
    """The poses to show and where they are from: those asked for, else smoothed, live or true ones."""
    if named is not None:
        posed = read_posed(named)
        return _as_poses(posed), posed.name
    if session.path.is_file():
        for name, read in (("smoothed", read_smoothed), ("live", read_poses)):
            found = [pose for pose in read(session.path) if np.isfinite(pose.base_from_surface).all()]
            if found:
                return sorted(found, key=lambda pose: pose.stamp), name
    truth = session.truth
    if truth is None:
        return [], ""
    unknown = np.full((len(truth), 6, 6), np.nan)
    return _as_poses(Posed("truth", truth, unknown)), "truth" if truth.exact else "reference"


def _as_poses(posed: Posed) -> list[SurfacePose]:
    rows = zip(posed.trajectory.stamps, posed.trajectory.base_from_surface, posed.covariance, strict=True)
    return [SurfacePose(float(t), pose, spread, np.zeros(6), TrackState.TRACKING) for t, pose, spread in rows]


def _beside(stamps: Array, poses: list[SurfacePose]) -> tuple[SurfacePose | None, ...]:
    rows, theirs = associate(stamps, np.array([pose.stamp for pose in poses]))
    out: list[SurfacePose | None] = [None] * len(stamps)
    for row, their in zip(rows.tolist(), theirs.tolist(), strict=True):
        out[row] = poses[their]
    return tuple(out)


def _tracks(session: Session, stamps: Array) -> tuple[Observations | None, ...]:
    out: list[Observations | None] = [None] * len(stamps)
    if session.path.is_file():
        found = sorted(read_observations(session.path), key=lambda seen: seen.stamp)
        rows, theirs = associate(stamps, np.array([seen.stamp for seen in found]))
        for row, their in zip(rows.tolist(), theirs.tolist(), strict=True):
            out[row] = found[their]
    return tuple(out)


def _surface(rig: Rig, poses: tuple[SurfacePose | None, ...], tracks: tuple[Observations | None, ...]) -> Array | None:
    """Landmarks (V, 3) mm in the surface frame, by the rays of the frame set that shows most; None without."""
    both = [k for k, pose in enumerate(poses) if pose is not None and tracks[k] is not None][:LOOKED_AT]
    sizes = {k: len(seen) for k in both if (seen := tracks[k]) is not None}
    k = max(sizes, key=lambda each: sizes[each], default=None)
    if k is None or sizes[k] < FEWEST:
        return None
    pose, seen = poses[k], tracks[k]
    assert pose is not None and seen is not None
    laid = triangulated(rig, seen)
    return se3.transform_points(se3.inverse(pose.base_from_surface) @ laid.base_from_surface, laid.map.points)


def _off(stamps: Array, poses: tuple[SurfacePose | None, ...], session: Session) -> Array:
    out, truth = np.full(len(stamps), np.nan), session.truth
    known = np.array([k for k, pose in enumerate(poses) if pose is not None], np.int64)
    if truth is None or not len(known):
        return out
    rows, theirs = associate(stamps[known], truth.stamps)
    if len(rows):
        ours = np.array([pose.base_from_surface for pose in poses if pose is not None])[rows]
        target = truth.base_from_surface[theirs]
        target = target @ se3.inverse(target[0]) @ ours[0]
        out[known[rows]] = np.linalg.norm((ours - target)[:, :3, 3], axis=1)
    return out


def _toolpath(session: Session) -> Toolpath | None:
    """The path that a live run recorded; None where it has none."""
    if not session.path.is_file():
        return None
    try:
        return used_in(session.path)[0]
    except InputError:
        return None


def _fraction(session: Session, stamps: Array) -> Array:
    """(K,) the checkpoint that the arm was last sent to."""
    out = np.full(len(stamps), np.nan)
    if not session.path.is_file():
        return out
    moves = [(c.stamp, c.checkpoint) for c in read_commands(session.path) if isinstance(c, Move)]
    if moves:
        when, where = np.array(sorted(moves), float).T
        last = np.searchsorted(when, stamps, side="right") - 1
        out[last >= 0] = where[last[last >= 0]]
    return out


class PictureBook:
    """The pictures of a session by frame set, in any order; one page is made at a time, from any thread."""

    def __init__(self, playback: Playback) -> None:
        self._playback, self._lock = playback, Lock()
        self._reader: FrameReader | None = None
        self._next = 0

    def __call__(self, k: int) -> Pictures:
        """The pictures of frame set k; InputError where one cannot be read."""
        with self._lock:
            frames = self._read(k)
        pose, seen = self._playback.poses[k], self._playback.tracks[k]
        cameras = self._playback.session.rig.cameras
        pictures = tuple(
            CameraPicture(cameras[f.camera].name, small_jpeg(f.image, WIDTH, QUALITY), (), _pixels(seen, f.camera))
            for f in frames.frames
        )
        return Pictures(frames.stamp, pictures, None if pose is None else pose.base_from_surface)

    def _read(self, k: int) -> FrameSet:
        """Readers go forward only: going back, a new one is begun."""
        refs = self._playback.session.sets[k]
        if self._reader is None or k < self._next:
            self.close()
            self._reader = self._playback.session.store.open()
        self._next = k + 1
        try:
            return frame_set([Frame(ref.camera, ref.stamp, self._reader.read(ref)) for ref in refs])
        except InputError:
            self.close()
            raise

    def close(self) -> None:
        """Give the reader back."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _pixels(seen: Observations | None, camera: int) -> NDArray[np.float64]:
    return np.zeros((0, 2)) if seen is None else seen.pixels[seen.camera == camera]
