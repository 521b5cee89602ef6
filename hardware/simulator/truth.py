"""The true motion of the surface, its faults, paths laid onto it, and the log that compares commands with execution."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose
from estimation.pose_solver import PointTracks, solve_pose
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.process.faults import Fault, FaultKind, FaultPart, fault_rng, faults_striking
from hardware.simulator.deposit import NozzleLog, planned_line
from hardware.simulator.scene.shape import Deformation, Shape
from planning.command import Command, Move
from planning.kinematics import SimpleArm, nozzle_from_axes
from planning.material import AS_PLANNED, FlowShares
from planning.path import Path, PrintPhase, PrintProgress

GRADIENT_STEP = 0.01  # mm, of the deformation's gradient: it is smooth over centimetres


class TrueMotion(Protocol):
    """A motion about the rest pose: estimation.synthetic.movements.ComposedMotion, or one with its methods."""

    def __call__(self, times: Array) -> Array:
        """rest_from_surface (N, 4, 4) at times (N,), s."""

    def twist(self, times: Array) -> Array:
        """Body twist (N, 6) at times (N,), rad/s and mm/s."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The surface's true motion."""

    rest: Array  # (4, 4) base_from_surface at rest
    motion: TrueMotion
    deformation: Deformation = field(default_factory=Deformation)
    strain: Callable[[Array], Array] | None = None  # amount of the deformation over time
    surface_from_grid: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) mm, of the deformation's frame

    def base_from_surface(self, times: Array) -> Array:
        """(N, 4, 4) mm at times (N,), s."""
        return np.asarray(self.rest @ self.motion(times))

    def twist(self, times: Array) -> Array:
        """Body twist (N, 6), rad/s and mm/s, at times (N,), s."""
        return self.motion.twist(times)

    def amount(self, times: Array) -> Array:
        """Amount of the deformation (N,) at times (N,), s; 0 where there is none."""
        return np.zeros(len(times)) if self.strain is None else np.asarray(self.strain(times))

    def checkpoints(self, times: Array, surface_from_nozzle: Array) -> Array:
        """base_from_target (N, 4, 4) at times (N,), s, of nozzle poses (N, 4, 4) on the undeformed surface.

        The displacement field moves the place, the rotation of its gradient (polar decomposition) turns the tool.
        """
        amount, places = self.amount(times), surface_from_nozzle[:, :3, 3]
        poses = surface_from_nozzle
        if amount.any():
            poses = poses.copy()
            poses[:, :3, 3] += self.displacement(places, amount)
            steps = GRADIENT_STEP / 2 * np.eye(3)
            ahead = np.stack([self.displacement(places + step, amount) for step in steps], -1)
            behind = np.stack([self.displacement(places - step, amount) for step in steps], -1)
            gradient = np.eye(3) + (ahead - behind) / GRADIENT_STEP
            poses[:, :3, :3] = se3.nearest_rotation(gradient) @ poses[:, :3, :3]
        return np.asarray(self.base_from_surface(times) @ poses)

    def material(self, times: Array, points_base: Array) -> Array:
        """Points of the undeformed surface (N, 3), mm, that are at points_base (N, 3) at times (N,), s."""
        surface_from_base = se3.inverse(self.base_from_surface(times))
        points: Array = (surface_from_base[:, :3, :3] @ points_base[..., None])[..., 0] + surface_from_base[:, :3, 3]
        amount = self.amount(times)
        if not amount.any():
            return points
        grid = se3.transform_points(se3.inverse(self.surface_from_grid), points)
        return se3.transform_points(self.surface_from_grid, self.deformation.undo(grid, amount))

    def displacement(self, points: Array, amount: Array) -> Array:
        """Displacement (N, 3), mm, of points (N, 3) of the undeformed surface by amounts (N,); both surface frame."""
        grid = se3.transform_points(se3.inverse(self.surface_from_grid), points)
        shift = self.deformation.displacement(grid, amount)
        return np.asarray(shift @ self.surface_from_grid[:3, :3].T)


FOLD_SIGMA = 8.0  # mm, one sigma of a fold: narrower than a wound, wider than a bead


def fault_pulse(fault: Fault, times: Array) -> tuple[Array, Array]:
    """A rise from 0 to 1 and back without a corner while a fault lasts, and its rate, 1/s; both (N,) at times (N,)."""
    phase = np.clip((times - fault.start) / fault.duration, 0.0, 1.0) * np.pi
    return np.sin(phase) ** 2, np.sin(2 * phase) * np.pi / fault.duration


@dataclass(frozen=True, slots=True, eq=False)
class DisturbedMotion:
    """A motion with faults of kind FAST on top: along a straight line, at their amount at most."""

    motion: TrueMotion
    faults: Sequence[Fault]

    def __call__(self, times: Array) -> Array:
        """rest_from_surface (N, 4, 4) at times (N,), s."""
        return np.asarray(se3.make(np.eye(3), self._shift_and_speed(times)[0]) @ self.motion(times))

    def twist(self, times: Array) -> Array:
        """Body twist (N, 6) at times (N,), rad/s and mm/s."""
        surface_from_rest = np.swapaxes(self.motion(times)[:, :3, :3], -1, -2)
        twist = self.motion.twist(times).copy()
        twist[:, 3:] += (surface_from_rest @ self._shift_and_speed(times)[1][..., None])[..., 0]
        return np.asarray(twist)

    def _shift_and_speed(self, times: Array) -> tuple[Array, Array]:
        shift, speed = np.zeros((len(times), 3)), np.zeros((len(times), 3))
        for fault in self.faults:
            pulse, rate = fault_pulse(fault, times)
            direction = fault_rng(fault).normal(size=3)
            stroke = fault.amount * fault.duration / np.pi * direction / np.linalg.norm(direction)
            shift += pulse[:, None] * stroke
            speed += rate[:, None] * stroke
        return shift, speed


def disturbed_motion(motion: TrueMotion, faults: Sequence[Fault]) -> TrueMotion:
    """The motion with all faults of kind FAST."""
    fast = faults_striking(faults, FaultPart.SURFACE, FaultKind.FAST)
    return DisturbedMotion(motion, fast) if fast else motion


def _fold_heights(faults: Sequence[Fault], times: Array) -> Array:
    """Height of the folds (N,), mm, at times (N,), s: an amount over time, like a scenario's [strain]."""
    return np.asarray(sum(fault.amount * fault_pulse(fault, times)[0] for fault in faults))


def fold_deformation(
    where: object, deformation: Deformation, faults: Sequence[Fault]
) -> tuple[Deformation, Callable[[Array], Array]] | None:
    """The deformation of folds and its amount over time; None without any.

    InputError where the surface is deformed already: there is one deformation at a time.
    """
    folds = faults_striking(faults, FaultPart.SURFACE, FaultKind.FOLD)
    if not folds:
        return None
    if deformation != Deformation():
        raise InputError(where, "faults", str(folds[0]), "a scenario without [scene.deformation]")
    return Deformation(bulge=1.0, radius=FOLD_SIGMA), partial(_fold_heights, folds)


ROW_STEP = 0.001  # s between rows
FlowAt = Callable[[Array, Array], Array]  # times (N,), s, and planned flow (N,) -> true flow (N,), mm^3/s


class TruthLog:
    """The commands of a run, and the rows of its NozzleLog.

    A tick's command is the target one tick and the arm's known lag later. Between two such instants the place on the
    path is interpolated linearly. All other delay of the arm is error.
    """

    def __init__(self, path: Path, arm: SimpleArm, truth: Truth, tick: float, lag: float) -> None:
        """path: in the true surface frame. arm: the true one. tick, lag: s, as the motion knows them."""
        self._path, self._arm, self._truth, self._tick, self._lag = path, arm, truth, tick, lag
        self._line = planned_line(path)
        self._places = self._line.knots  # (N,) mm along the path, of each checkpoint
        self._due_times: list[float] = []  # s, rising, of each command
        self._fraction: list[float] = []  # checkpoints, at each due time; NaN before printing began
        self._extrude: list[bool] = []
        self._reason: list[str] = []
        self._shares = AS_PLANNED

    def adapt(self, shares: FlowShares | None) -> None:
        """From here on planned flows are those of `shares`, as ordered from the motion; None: as before."""
        self._shares = self._shares if shares is None else self._shares.then(shares)

    def write(self, command: Command, progress: PrintProgress) -> None:
        """The command of one tick, and the progress of the print by it."""
        started = progress.place > 0 or progress.phase is PrintPhase.PRINTING
        self._due_times.append(command.stamp + self._tick + self._lag)
        self._fraction.append(progress.fraction if started else np.nan)
        self._extrude.append(isinstance(command, Move) and command.extrude)
        self._reason.append(command.reason)

    @property
    def last_due(self) -> float:
        """The due time, s, of the last command; minus infinity before any."""
        return self._due_times[-1] if self._due_times else -np.inf

    def extruding(self, times: Array) -> NDArray[np.bool_]:
        """Whether the motion prints (N,) at times (N,), s."""
        return np.array([self._extrude[i] if 0 <= i < len(self._due_times) else False for i in self._rows(times)], bool)

    def planned_flow(self, times: Array) -> Array:
        """Planned flow (N,), mm^3/s, at times (N,), s; 0 where nothing is printed."""
        index = self._rows(times)
        fraction, rate = self._fractions(times, index, (index >= 0) & (index < len(self._due_times)))
        return self._planned_flow(np.nan_to_num(fraction), rate)

    def rows(self, times: Array, executed_axes: Callable[[Array], Array], flow: FlowAt | None = None) -> NozzleLog:
        """The log at times (N,), s; executed_axes: machine axes (N, 6) at times (N,).

        flow: the true flow; None: the planned flow wherever the motion prints.
        """
        index = self._rows(times)
        valid = (index >= 0) & (index < len(self._due_times))
        fraction, rate = self._fractions(times, index, valid)
        target = np.full((len(times), 4, 4), np.nan)
        due = np.isfinite(fraction)
        target[due] = self._truth.checkpoints(times[due], self._interpolated(fraction[due]))
        nozzle = nozzle_from_axes(self._arm, executed_axes(times))
        place = np.interp(fraction, np.arange(len(self._places)), self._places)
        filled = np.where(due, fraction, 0.0)
        extruding, planned_flow = self.extruding(times), self._planned_flow(filled, rate)
        reasons = [self._reason[i] if ok else "no surface is followed yet" for i, ok in zip(index, valid, strict=True)]
        return NozzleLog(
            stamps=times,
            base_from_surface=self._truth.base_from_surface(times),
            base_from_nozzle=nozzle,
            base_from_target=target,
            place=np.where(due, place, np.nan),
            checkpoint=np.where(due, np.minimum(np.ceil(filled), len(self._places) - 1), -1).astype(np.int64),
            extrude=extruding,
            reason=np.array(reasons, dtype=np.str_),
            surface_from_tip=self._truth.material(times, nozzle[:, :3, 3]),
            flow=planned_flow * extruding if flow is None else flow(times, planned_flow),
        )

    def _rows(self, times: Array) -> NDArray[np.int64]:
        """Index (N,) of the command that is being executed at each instant, -1 before the first."""
        first = self._due_times[0] - self._tick if self._due_times else np.inf
        return np.array([-1 if t <= first else bisect_left(self._due_times, t) for t in times.tolist()], np.int64)

    def _planned_flow(self, fraction: Array, rate: Array) -> Array:
        """Planned flow (N,), mm^3/s, at fractional checkpoints (N,) passed at a rate (N,), 1/s."""
        piece = np.clip(np.ceil(fraction).astype(np.int64) - 1, 0, len(self._places) - 2)
        return np.asarray(self._line.area[piece] * np.diff(self._places)[piece] * rate * self._shares.at(fraction))

    def _fractions(self, times: Array, index: NDArray[np.int64], valid: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Fractional checkpoint (N,) due at times (N,), NaN where there is none; and its rate (N,), 1/s."""
        fractions, rate = np.full(len(times), np.nan), np.zeros(len(times))
        for row, i in enumerate(index.tolist()):
            if valid[row]:
                end = self._fraction[i]
                start = self._fraction[i - 1] if i > 0 and np.isfinite(self._fraction[i - 1]) else end
                share = 1.0 - (self._due_times[i] - times[row]) / self._tick
                fractions[row] = start + min(max(share, 0.0), 1.0) * (end - start)
                rate[row] = max(end - start, 0.0) / self._tick  # NaN where there is none
        return fractions, np.nan_to_num(rate)

    def _interpolated(self, fraction: Array) -> Array:
        """surface_from_nozzle (N, 4, 4) at fractional checkpoints (N,), interpolated linearly."""
        poses = self._path.surface_from_nozzle
        i = np.minimum(fraction.astype(int), len(poses) - 2)
        share = (fraction - i)[:, None]
        places = poses[i, :3, 3] + share * (poses[i + 1, :3, 3] - poses[i, :3, 3])
        turn = se3.log_rotation(np.swapaxes(poses[i, :3, :3], -1, -2) @ poses[i + 1, :3, :3])
        return se3.make(poses[i, :3, :3] @ se3.exp_rotation(share * turn), places)


def row_instants(start: float, end: float) -> Array:
    """Instants (N,) of the rows after `start` up to `end`, s, on whole milliseconds."""
    first, last = np.floor(start / ROW_STEP + 1e-6) + 1, np.floor(end / ROW_STEP + 1e-6)
    return np.minimum(np.arange(first, last + 1) * ROW_STEP, end)  # a product may exceed it by rounding


PIECE_LENGTH = 1.0  # mm: wound beds are uneven over a few
PROJECTION_STEPS = 12  # towards the surface along z; one is enough unless a scan's frame is tilted against its plane
MAX_MISS = 1e-3  # mm from the surface


def drape_path(path: Path, shape: Shape, clearance: float, where: object = "path") -> Path:
    """The path with its checkpoints `clearance` mm above the surface, stretches divided into pieces of about 1 mm.

    Tools keep the direction that the path gives them; a path's own height (z) is kept on top of the surface's.
    InputError with `where` for a checkpoint that lies beyond the surface's edge.
    """
    fine = divide_path(path, PIECE_LENGTH)
    poses = fine.surface_from_nozzle.copy()
    points, outwards = np.column_stack([poses[:, :2, 3], np.zeros(len(poses))]), shape.surface_from_grid[:3, 2]
    for _ in range(PROJECTION_STEPS):
        offset = shape.points(shape.material(points)) - points  # along the grid's own z
        points[:, 2] += (offset @ outwards) / outwards[2]
    material = shape.material(points)
    on_surface = shape.covers(material) & (np.linalg.norm(shape.points(material) - points, axis=1) < MAX_MISS)
    if not on_surface.all():
        x, y = poses[~on_surface][0, :2, 3]
        allowed = "on the surface, {:g} x {:g} mm about its middle".format(*shape.size)
        raise InputError(where, "a place on the path", f"x = {x:.2f}, y = {y:.2f} mm", allowed)
    poses[:, 2, 3] += points[:, 2] + clearance
    return replace(fine, surface_from_nozzle=poses)


def divide_path(path: Path, piece: float) -> Path:
    """The path with stretches over `piece` mm cut evenly, unless the tool turns; a new checkpoint copies its next."""
    poses = path.surface_from_nozzle
    counts = np.ceil(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / piece).astype(int)
    turns = np.abs(np.diff(poses[:, :3, :3], axis=0)).max(axis=(1, 2)) >= 1e-9
    counts = np.maximum(np.where(turns, 1, counts), 1)
    source = np.concatenate([[0], np.repeat(np.arange(1, len(poses)), counts)])
    share = np.concatenate([[1.0], *(np.arange(1, n + 1) / n for n in counts)])
    pieces = poses[source].copy()
    before = poses[np.maximum(source - 1, 0), :3, 3]
    pieces[:, :3, 3] = before + share[:, None] * (poses[source, :3, 3] - before)
    columns = {name: getattr(path, name)[source] for name in ("speed", "material", "temperature", "layer", "extrude")}
    extra = {name: column[source] for name, column in path.extra.items()}
    number = np.concatenate([[0], *(np.arange(n) for n in counts)])  # of a piece on its way
    if "wait_s" in extra:  # at the beginning of the way
        extra["wait_s"] = np.where(number == 0, extra["wait_s"], np.zeros((), extra["wait_s"].dtype))
    if "look" in extra:  # at the end
        last = np.append(source[1:] != source[:-1], True)
        extra["look"] = np.where(last, extra["look"], np.zeros((), extra["look"].dtype))
    if "volume_mm3" in extra and extra["volume_mm3"].dtype.kind in "if":  # whoever reads a text says what is wrong
        extra["volume_mm3"] = extra["volume_mm3"] / np.concatenate([[1], np.repeat(counts, counts)])
    return replace(path, surface_from_nozzle=pieces, extra=extra, **columns)


NEWTON_STEPS = 12  # from the mean plane onto the surface; a wound takes four
SLOPE_STEP = 1e-3  # mm, for the slope along the surface
MAX_RAY_MISS = 1e-3  # mm between ray and surface: beyond, a track is not on it
MIN_REGISTRATION_TRACKS = 12


def truth_from_estimate(
    pose: SurfacePose, observations: Observations, rigs: tuple[Rig, Rig], truth: Truth, shape: Shape, exposed: Array
) -> Array | None:
    """truth_surface_from_estimated_surface (4, 4) from one frame set; None where too few tracks are on the surface.

    Without a scan the tracker chooses its own surface frame, and the path must be registered to it, live by a person.
    Here every track is cast along its true ray onto the true surface, and the pose of these points is solved with the
    tracker's cameras and pixels. Calibration errors are in both poses and stay in the error.

    rigs: the true one and the tracker's. exposed: (C,) s, true instant of each camera's picture.
    """
    true_rig, known_rig = rigs
    points, hits = surface_points(observations, true_rig, truth, shape, exposed)
    if hits.sum() < MIN_REGISTRATION_TRACKS:
        return None
    start = truth.base_from_surface(np.array([pose.stamp]))[0]
    tracks = PointTracks.from_observations(observations.select(hits), points[hits])
    estimate = solve_pose(known_rig, tracks, start, tolerance=1e-9, iterations=20)
    return np.asarray(se3.inverse(estimate.base_from_surface) @ pose.base_from_surface)


def surface_points(
    observations: Observations, rig: Rig, truth: Truth, shape: Shape, exposed: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (N, 3) mm of the undeformed surface under each track's pixel, and whether (N,) the ray hits one."""
    camera, amount = observations.camera, truth.amount(exposed)[observations.camera]
    base_from_camera = np.stack([c.base_from_camera for c in rig.cameras])[camera]
    surface_from_camera = se3.inverse(truth.base_from_surface(exposed)[camera]) @ base_from_camera
    matrices = rig.matrices[camera]
    focal, centre = matrices[:, [0, 1], [0, 1]], matrices[:, :2, 2]
    rays = np.column_stack([(observations.pixels - centre) / focal, np.ones(len(observations))])
    rays = (surface_from_camera[:, :3, :3] @ rays[..., None])[..., 0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = surface_from_camera[:, :3, 3]

    def miss(xy: Array) -> Array:  # (N, 3) mm, from the ray to the surface point
        points = shape.points(xy)
        from_origin = points + truth.displacement(points, amount) - origin
        return np.asarray(from_origin - np.sum(from_origin * rays, 1, keepdims=True) * rays)

    up, middle = shape.surface_from_grid[:3, 2], shape.surface_from_grid[:3, 3]
    depth = ((middle - origin) @ up) / (rays @ up)
    xy = shape.material(origin + depth[:, None] * rays)
    for _ in range(NEWTON_STEPS):
        error = miss(xy)
        slope = np.stack([(miss(xy + SLOPE_STEP * axis) - error) / SLOPE_STEP for axis in np.eye(2)], -1)  # (N, 3, 2)
        xy = xy - (np.linalg.pinv(slope) @ error[..., None])[..., 0]
    return shape.points(xy), shape.covers(xy) & (np.linalg.norm(miss(xy), axis=1) < MAX_RAY_MISS)
