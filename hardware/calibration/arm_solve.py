"""A recorded calibration of an arm, solved: the tip in its pictures, parameters, held-out residuals, the arm file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.calibration.arm_fit import ArmFit, ArmUnknowns, cross_validate, fit_arm, jackknife
from estimation.calibration.arm_model import (
    ArmParameters,
    Kinematics,
    SetPoint,
    Sightings,
    check_latency,
    check_places,
    check_turns,
    first_pose,
    predict,
    tip_positions,
)
from estimation.calibration.lens_model import CAMERA_PARAMETERS
from estimation.errors import InputError
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.surface_map import farthest_points
from hardware.arm.profile import ArmProfile
from hardware.calibration.arm_record import ARM_FILE, COMMANDED_FILE, read_commanded
from hardware.files.arm_file import read_arm
from hardware.files.session import FrameRef, Session
from hardware.files.session_folder import open_folder
from hardware.process import checks
from hardware.process.progress import ProgressReport
from perception.boards.needle_tip import MIN_NEEDLE_LENGTH, Tip, TipFinder, background
from perception.frames import Image
from planning.kinematics import SimpleArm, nozzle_from_axes

HELD_OUT_FOLDS = 8  # with fewer, each fit lacks too many sightings
REST_AFTER = 0.25  # s after its last command, when the arm is at rest: ten times a servo's lag
PICTURES_PER_PLACE = 3  # more show the same
MAX_MOVING_SETS = 300  # frame sets with the arm moving, spread over all of them
BACKGROUND_PICTURES = 11  # of which the background is the median
MIN_BACKGROUND_PICTURES = 5
MIN_TIP_SIGMA = 0.1  # px: effect of pixels and shading on a needle two or three pixels wide
CROP_SIZE = 40  # px, of the pictures of tips for the report
CROPS_PER_CAMERA = 6
NEEDLE_RADIUS_RATIO = 1.5  # to the tip's radius, up to which a tool is a needle


@dataclass(frozen=True, slots=True, eq=False)
class TipObservations:
    """The tips in a recording's pictures."""

    sightings: Sightings  # one per camera and resting place: the median
    looked: NDArray[np.int64]  # (C,) number of pictures searched
    detections: NDArray[np.int64]  # (C,) number of pictures with a tip
    crops: tuple[tuple[Array, Array], ...]  # by camera: pictures (K, H, W, 3) about tips, and the tips' pixels (K, 2)
    missed: tuple[Array, NDArray[np.int64]]  # stamps (M,), s, and cameras (M,) of pictures without a tip


@dataclass(frozen=True, slots=True, eq=False)
class _TipPicture:
    ref: FrameRef
    place: int
    tip: Tip | None
    crop: tuple[Image, Array] | None


def needle_radius(rig: Rig, tool: Array) -> float:
    """Upper bound, px, of the radius of a needle where the cameras' axes meet; tool: (K, 2) [height, radius] mm."""
    poses = np.stack([c.base_from_camera for c in rig.cameras])
    across = np.eye(3) - poses[:, :3, 2, None] * poses[:, None, :3, 2]
    middle = np.linalg.lstsq(across.sum(0), (across @ poses[:, :3, 3, None]).sum(0)[:, 0], rcond=None)[0]
    focal = rig.matrices[:, 0, 0] / np.linalg.norm(poses[:, :3, 3] - middle, axis=1)
    return float(1.6 * focal.max() * tool[0, 1] + 1.5)


def find_tips(session: Session, set_point: SetPoint, tool: Array, report: ProgressReport) -> TipObservations:
    """Find the tip in a session's pictures. InputError where there are too few of them."""
    selected = _select_sets(session, set_point)
    finders = _finders(session, set_point, needle_radius(session.rig, tool))
    pictures: list[_TipPicture] = []
    with closing(session.open_reader()) as reader, ThreadPoolExecutor(2) as pool:
        for done, (refs, places) in enumerate(selected, 1):
            images = [reader.read(ref) for ref in refs]
            pictures += pool.map(partial(_find, finders), refs, places, images)
            report(done, len(selected))
    return _collect(pictures, len(session.rig))


def _select_sets(session: Session, set_point: SetPoint) -> list[tuple[tuple[FrameRef, ...], list[int]]]:
    """The frame sets to search, with each frame's place."""
    first, last = set_point.instants[0], set_point.instants[-1]
    rows = [refs for refs in session.sets if refs and first <= refs[0].stamp <= last + REST_AFTER * 4]
    if not rows:
        raise InputError(session.path, "stamps", "none while the arm was moved", "pictures by the same clock")
    places = [set_point.places(np.array([ref.stamp for ref in refs]), REST_AFTER).tolist() for refs in rows]
    counts: dict[int, int] = {}
    resting, moving = [], []
    for refs, numbers in zip(rows, places, strict=True):
        number = min(numbers)
        if number < 0:
            moving.append((refs, numbers))
        elif counts.setdefault(number, 0) < PICTURES_PER_PLACE:
            counts[number] += 1
            resting.append((refs, numbers))
    keep = np.unique(np.linspace(0, len(moving) - 1, min(MAX_MOVING_SETS, len(moving))).round().astype(int))
    return sorted(resting + [moving[i] for i in keep], key=lambda one: one[0][0].stamp)


def _finders(session: Session, set_point: SetPoint, radius: float) -> list[TipFinder]:
    """A finder for each camera, whose background is the median of pictures far apart."""
    cameras = session.rig.cameras
    refs = [[ref for refs in session.sets for ref in refs if ref.camera == c] for c in range(len(cameras))]
    spread = [ref for own in refs for ref in _spread_pictures(own, set_point)]
    stacks: list[list[Image]] = [[] for _ in cameras]
    with closing(session.open_reader()) as reader:
        for ref in sorted(spread, key=lambda one: one.stamp):
            stacks[ref.camera].append(reader.read(ref))
    for camera, stack in zip(cameras, stacks, strict=True):
        if len(stack) < MIN_BACKGROUND_PICTURES:
            allowed = f"{MIN_BACKGROUND_PICTURES} or more, while it moves"
            raise InputError(session.path, f"pictures of {camera.name}", len(stack), allowed)
    return [TipFinder(background(stack), radius) for stack in stacks]


def _spread_pictures(refs: Sequence[FrameRef], set_point: SetPoint) -> Sequence[FrameRef]:
    """Pictures with the arm far apart: farthest point sampling."""
    if not refs:
        return ()
    points = set_point.lagged(np.array([ref.stamp for ref in refs]), 0.0, 0.0)[:, :3]
    rows = farthest_points(points, 0, min(BACKGROUND_PICTURES, len(points)))
    return [refs[i] for i in sorted(set(rows.tolist()))]


def _find(finders: list[TipFinder], ref: FrameRef, place: int, image: Image) -> _TipPicture:
    tip = finders[ref.camera](image)
    return _TipPicture(ref, place, tip, None if tip is None else _crop(image, np.array(tip.pixel)))


def _crop(image: Image, pixel: Array) -> tuple[Image, Array]:
    x, y = (int(v) - CROP_SIZE // 2 for v in pixel)
    x, y = min(max(x, 0), image.shape[1] - CROP_SIZE), min(max(y, 0), image.shape[0] - CROP_SIZE)
    part = image[y : y + CROP_SIZE, x : x + CROP_SIZE]
    return np.repeat(part[..., None], 3, -1) if part.ndim == 2 else part.copy(), pixel - [x, y]


def _collect(pictures: Sequence[_TipPicture], cameras: int) -> TipObservations:
    camera = np.array([one.ref.camera for one in pictures], np.int64)
    with_tip = np.array([one.tip is not None for one in pictures], bool)
    rows: dict[tuple[int, int], list[_TipPicture]] = {}
    for number, one in enumerate(pictures):
        if one.tip is not None:
            rows.setdefault((one.place if one.place >= 0 else -1 - number, one.ref.camera), []).append(one)
    tips = [[o.tip for o in ones if o.tip is not None] for ones in rows.values()]
    sightings = Sightings(
        stamp=np.array([np.mean([o.ref.stamp for o in ones]) for ones in rows.values()]),
        camera=np.array([own for _, own in rows], np.int64),
        pixels=np.array([np.median([t.pixel for t in mine], axis=0) for mine in tips]).reshape(-1, 2),
        sigma=np.array([np.hypot(MIN_TIP_SIGMA, np.mean([t.sigma for t in mine])) for mine in tips]),
        place=np.array([max(place, -1) for place, _ in rows], np.int64),
    )
    missed = np.array([one.ref.stamp for one in pictures if one.tip is None], float), camera[~with_tip]
    looked, detections = (np.bincount(each, minlength=cameras) for each in (camera, camera[with_tip]))
    return TipObservations(sightings, looked, detections, tuple(_crops(pictures, c) for c in range(cameras)), missed)


def _crops(pictures: Sequence[_TipPicture], camera: int) -> tuple[Array, Array]:
    mine = [one.crop for one in pictures if one.crop is not None and one.ref.camera == camera]
    selected = mine[:: max(1, len(mine) // CROPS_PER_CAMERA)][:CROPS_PER_CAMERA]
    if not selected:
        return np.zeros((0, CROP_SIZE, CROP_SIZE, 3), np.uint8), np.zeros((0, 2))
    return np.stack([image for image, _ in selected]), np.stack([at for _, at in selected])


def visible_needle(profile: Array, along: Array) -> Array:
    """Visible length (N,), mm, of the needle as seen from afar, up to where the rest of the tool hides it.

    profile: (K, 2) [height, radius], mm. along: (N,) cosine between the tool's axis and the way from its tip to the
    camera. In the picture a disc of the tool at height h with radius r reaches down to h sin - r cos above the tip.
    """
    height, radius = profile.T
    thick = radius > NEEDLE_RADIUS_RATIO * radius[0]
    if thick.any():
        first, limit = int(np.argmax(thick)), NEEDLE_RADIUS_RATIO * radius[0]
        end = float(np.interp(limit, radius[first - 1 : first + 1], height[first - 1 : first + 1]))
        height, radius = np.append(end, height[first:]), np.append(limit, radius[first:])
    else:
        height, radius = height[-1:], radius[-1:]
    square = np.sqrt(np.clip(1 - along**2, 0.0, None))
    reach = square[:, None] * height - np.maximum(along, 0.0)[:, None] * radius
    return np.asarray(np.maximum(reach.min(1), 0.0))


def hidden_tips(
    state: ArmParameters,
    profile: Array,
    set_point: SetPoint,
    kinematics: Kinematics,
    rig: Rig,
    stamp: Array,
    camera: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether (N,) the tool hides so much of its needle at stamps (N,), s, that cameras (N,) cannot find the tip.

    profile: (K, 2) [height, radius] of the tool, mm.
    """
    axes = set_point.lagged(stamp, state.dead_time, state.lag)
    axis = (state.base_from_arm @ kinematics(axes))[:, :3, 2]
    poses = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    view_direction = poses[:, :3, 3] - tip_positions(state, set_point, kinematics, stamp)
    distance = np.linalg.norm(view_direction, axis=1)
    visible = visible_needle(profile, np.sum(view_direction * axis, 1) / distance)
    return np.asarray(visible * rig.matrices[camera, 0, 0] / distance < MIN_NEEDLE_LENGTH)


@dataclass(frozen=True, slots=True, eq=False)
class ArmCalibration:
    """A solved calibration of an arm."""

    rig: Rig
    profile: ArmProfile  # before the calibration
    tips: TipObservations
    set_point: SetPoint
    fit: ArmFit
    places: Array  # (P, 3) mm, base: the resting places
    error: Array  # (P,) mm, one sigma of the tip there
    held_px: Array  # (N,) px, residuals under fits without the sighting's place; nan for outliers
    held_mm: Array  # (N,) mm, the same at the tip's depth
    unknowns: ArmUnknowns
    hidden: NDArray[np.int64]  # (C,) number of pictures in which the tool hides its own tip


def kinematics_of(arm: SimpleArm) -> Kinematics:
    """An arm's own kinematics: arm_from_nozzle (N, 4, 4) at axes (N, 6)."""
    local_arm = replace(arm, arm_from_base=np.eye(4), tool_offset=np.zeros(3))
    return lambda axes: nozzle_from_axes(local_arm, axes)


def solve_folder(folder: Path, rig_json: Path | None, unknowns: ArmUnknowns, report: ProgressReport) -> ArmCalibration:
    """Solve a recorded calibration; InputError says what is missing, or what its moves do not determine."""
    for name in (COMMANDED_FILE, ARM_FILE):
        if not (folder / name).is_file():
            allowed = "a folder that `stillbed calibrate arm` has recorded"
            raise InputError(folder, name, "missing", allowed)
    session, profile = open_folder(folder), read_arm(folder / ARM_FILE)
    set_point = read_commanded(folder / COMMANDED_FILE)
    covariance = None if rig_json is None else read_covariance(rig_json, len(session.rig))
    tips = find_tips(session, set_point, profile.tool, report)
    return solve(session.rig, profile, set_point, tips, unknowns, covariance)


def solve(
    rig: Rig,
    profile: ArmProfile,
    set_point: SetPoint,
    tips: TipObservations,
    unknowns: ArmUnknowns,
    rig_covariance: Array | None = None,
) -> ArmCalibration:
    """Estimate the unknowns from the tips. rig_covariance: (16 C, 16 C), if known."""
    if not unknowns.latency:  # then the arm's position is unknown while it moves
        tips = replace(tips, sightings=tips.sightings.take(tips.sightings.place >= 0))
    kinematics, sightings = kinematics_of(profile.arm), tips.sightings
    pose, axes, _ = first_pose(sightings, set_point, kinematics, rig)
    check_places(axes[:, :3])
    if unknowns.tool:
        check_turns(kinematics(axes))
    if unknowns.latency:
        check_latency(set_point, kinematics, sightings.stamp[sightings.place < 0])
    late = max(profile.lag - profile.frame_time, 0.0)
    start = ArmParameters(pose, profile.arm.tool_offset, late / 2, late / 2, float(profile.tool[0, 1]))

    def fit(subset: Sightings, begin: ArmParameters = start) -> ArmFit:
        return fit_arm(subset, set_point, kinematics, rig, begin, unknowns, rig_covariance)

    full_fit = fit(sightings)
    first_guess = replace(start, base_from_arm=full_fit.state.base_from_arm)

    def residuals_of(state: ArmParameters, subset: Sightings) -> Array:
        return predict(state, set_point, kinematics, rig, subset.stamp, subset.camera).pixels - subset.pixels

    residuals, states = cross_validate(sightings, lambda subset: fit(subset, first_guess), residuals_of, HELD_OUT_FOLDS)
    full_fit = jackknife(full_fit, states)
    state, held_out = full_fit.state, np.where(full_fit.used, np.linalg.norm(residuals, axis=1), np.nan)
    points = tip_positions(state, set_point, kinematics, sightings.stamp)
    bases = np.stack([c.base_from_camera for c in rig.cameras])[sightings.camera]
    depth = np.einsum("ni,ni->n", points - bases[:, :3, 3], bases[:, :3, 2])
    in_mm = held_out * depth / rig.matrices[sightings.camera, 0, 0]
    arm_from_nozzle = kinematics(axes)
    at = se3.transform_points(state.base_from_arm @ arm_from_nozzle, state.tool[None])[:, 0]
    error = tip_error(state.base_from_arm, state.tool, full_fit.covariance[:9, :9], arm_from_nozzle)
    shaded = hidden_tips(state, profile.tool, set_point, kinematics, rig, *tips.missed)
    hidden = np.bincount(tips.missed[1][shaded], minlength=len(rig))
    return ArmCalibration(rig, profile, tips, set_point, full_fit, at, error, held_out, in_mm, unknowns, hidden)


def tip_error(base_from_arm: Array, tool: Array, covariance: Array, arm_from_nozzle: Array) -> Array:
    """One sigma in 3D (N,), mm, of the tip at arm_from_nozzle (N, 4, 4).

    covariance: (9, 9) of base_from_arm (right perturbation, rad and mm) and tool (3,), mm.
    """
    turn = base_from_arm[:3, :3]
    inside = se3.transform_points(arm_from_nozzle, tool[None])[:, 0]
    held = np.broadcast_to(turn, (len(inside), 3, 3))
    by = np.concatenate([turn @ -se3.hat(inside), held, turn @ arm_from_nozzle[:, :3, :3]], -1)
    return np.asarray(np.sqrt(np.einsum("nij,jk,nik->n", by, covariance, by)))


def calibrated_profile(profile: ArmProfile, state: ArmParameters, unknowns: ArmUnknowns) -> ArmProfile:
    """The profile with the estimated pose, tool offset and latency."""
    arm = replace(profile.arm, arm_from_base=se3.inverse(state.base_from_arm), tool_offset=np.array(state.tool))
    lag = profile.frame_time + state.dead_time + state.lag if unknowns.latency else profile.lag
    return replace(profile, arm=arm, lag=max(lag, 0.0))


def read_covariance(path: Path, cameras: int) -> Array:
    """The covariance (16 C, 16 C) in the .json of `calibrate cameras`; InputError where it has none."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        value = table["covariance"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(path, "covariance", "missing", "the .json that `stillbed calibrate cameras` writes") from None
    size = CAMERA_PARAMETERS * cameras
    covariance = checks.numbers(path, "covariance", value, (size, size))
    return (covariance + covariance.T) / 2


def numbers_text(result: ArmCalibration) -> str:
    """All parameters with their covariance as JSON, mm, rad, s and px."""
    state, sigma = result.fit.state, result.fit.sigma
    arm_from_base = se3.inverse(state.base_from_arm)
    table = {
        "arm_from_base": arm_from_base.tolist(),
        "tool_offset_mm": np.asarray(state.tool).tolist(),
        "dead_time_s": state.dead_time,
        "servo_lag_s": state.lag,
        "end_radius_mm": state.blunt,
        "arm_from_camera": {c.name: (arm_from_base @ c.base_from_camera).tolist() for c in result.rig.cameras},
        "numbers": ["rx", "ry", "rz", "tx", "ty", "tz", "tool x", "tool y", "tool z", "dead_time_s", "lag_s", "end_mm"],
        "sigma": sigma.tolist(),
        "covariance": result.fit.covariance.tolist(),
        "scatter": result.fit.scatter,
        "widened_by": result.fit.widened_by,
        "held_out_median_px": float(np.nanmedian(result.held_px)),
        "held_out_median_mm": float(np.nanmedian(result.held_mm)),
    }
    return json.dumps(table, indent=1, allow_nan=False) + "\n"
