"""The reference recordings: what they hold, how they are replayed, and what of the result is compared.

breathing, outage    tracks of a synthetic wound (`estimation.synthetic`) -> poses -> commands -> frames of the arm
pictures             small pictures of a simulated wound -> tracks -> poses -> commands -> frames of the arm
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.mapping.triangulation import triangulated_map
from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.rig import Rig
from estimation.synthetic.follow import Follower
from hardware.arm.profile import ArmProfile
from hardware.arm.protocol import FRAME_LENGTH
from hardware.files.path_file import read_path
from hardware.files.rig_file import read_rig
from hardware.motion.loop import Tick
from hardware.motion.step import BeginPrint
from hardware.offline.replay import placed_by, replay
from planning.command import Move
from planning.kinematics import axes_from_nozzle
from planning.path import Path as Route

FOLDER = Path(__file__).parent / "reference"
TRACKS = ("breathing", "outage")
CASES = (*TRACKS, "pictures")
ABOVE = 1.0  # mm

Arrays = dict[str, NDArray[np.generic]]  # by name; the first word of a name is what has a row each: pose, tick, track


def replayed(case: str) -> Arrays:
    """What the estimator, the motion and, of `pictures`, the tracker make of a recording."""
    if case in TRACKS:
        poses, tracks = list(_followed(read_rig(FOLDER / case / "rig.toml").rig, *recorded_tracks(case))), Arrays()
    else:
        poses, tracks = _tracked(FOLDER / case / "session.mcap")
    path = read_path(FOLDER / "path.csv")
    given, profile = placed_by(poses)
    near, ticks = _near(profile, next(pose for pose in poses if pose.state.measured), path), list[Tick]()
    replay(given, BeginPrint(path, near, 0.0, {}, ""), lambda tick, progress: ticks.append(tick))
    return tracks | _pose_arrays(poses) | _tick_arrays(ticks)


def recorded_tracks(case: str) -> list[Observations]:
    """The frame sets of a recording of tracks."""
    with np.load(FOLDER / case / "tracks.npz", allow_pickle=False) as file:
        ends = np.cumsum(file["counts"])[:-1]
        split = [np.split(file[name].astype(float), ends) for name in ("pixels", "sigma")]
        numbers = [np.split(file[name].astype(np.int64), ends) for name in ("camera", "track")]
        rows = zip(file["stamps"].tolist(), *numbers, *split, strict=True)
        return [Observations(*row) for row in rows]


def _followed(rig: Rig, first: Observations, *rest: Observations) -> Iterator[SurfacePose]:
    follower = Follower(rig, first, triangulated_map(rig, first), refine=True)
    yield follower.estimator.pose
    for seen in rest:
        yield follower(seen)
        follower.idle()
        follower.estimator.learn()


def _near(profile: ArmProfile, pose: SurfacePose, path: Route) -> ArmProfile:
    """The arm with its home over the first checkpoint: the way there would take longer than the recording."""
    nozzle = pose.base_from_surface @ path.surface_from_nozzle[:1]
    nozzle[:, :3, 3] += ABOVE * nozzle[:, :3, 2]
    return replace(profile, arm=replace(profile.arm, home=axes_from_nozzle(profile.arm, nozzle)[0]))


def _tracked(recording: Path) -> tuple[list[SurfacePose], Arrays]:
    from hardware.recording.session_reader import open_session  # these load cv2
    from perception.tracking.step import TrackingStep

    session, poses, seen = open_session(recording), [], []
    step = TrackingStep(session.rig, session.roi)
    for frames in session.frame_sets():
        poses.append(step(frames))
        seen.append(step.last.observations)
        step.idle()
    stamps = np.repeat([each.stamp for each in seen], [len(each) for each in seen])

    def joined(name: str) -> NDArray[np.generic]:
        return np.concatenate([getattr(each, name) for each in seen])

    return poses, {
        "track stamp": stamps,
        "track camera": joined("camera").astype(np.uint8),
        "track id": joined("track").astype(np.uint16),
        "track pixels": joined("pixels").astype(np.float32),
    }


def _pose_arrays(poses: list[SurfacePose]) -> Arrays:
    def stacked(name: str) -> NDArray[np.generic]:
        return np.stack([getattr(pose, name) for pose in poses])

    return {
        "pose stamp": np.array([pose.stamp for pose in poses]),
        "pose base_from_surface": stacked("base_from_surface"),
        "pose covariance": stacked("covariance"),
        "pose twist": stacked("twist"),
        "pose twist_covariance": stacked("twist_covariance"),
        "pose state": np.array([pose.state.value for pose in poses]),
        "pose reason": np.array([pose.reason for pose in poses]),
    }


def _tick_arrays(ticks: list[Tick]) -> Arrays:
    nothing, commands = np.full(6, np.nan), [tick.command for tick in ticks]
    moves = [command if isinstance(command, Move) else None for command in commands]
    return {
        "tick stamp": np.array([command.stamp for command in commands]),
        "tick axes": np.array([nothing if move is None else move.axes for move in moves]),
        "tick feed": np.array([np.nan if move is None else move.feed for move in moves]),
        "tick checkpoint": np.array([-1 if move is None else move.checkpoint for move in moves]),
        "tick extrude": np.array([move is not None and move.extrude for move in moves]),
        "tick reason": np.array([command.reason for command in commands]),
        "tick frame": np.array([list(tick.frame.ljust(FRAME_LENGTH, b"\0")) for tick in ticks], np.uint8),
    }


def kept(case: str) -> Arrays:
    """The outcome that a recording is to have; nothing where none is kept yet."""
    file = FOLDER / case / "outcome.npz"
    if not file.exists():
        return {}
    with np.load(file, allow_pickle=False) as found:
        return {name: found[name] for name in found.files}


def keep(case: str, arrays: Arrays) -> None:
    """Let this be the outcome that a recording is to have."""
    np.savez_compressed(FOLDER / case / "outcome.npz", **arrays)
