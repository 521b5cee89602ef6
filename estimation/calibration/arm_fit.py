"""Pose, tool offset and latency of an arm by nonlinear least squares (GTSAM): from tips in pictures, or touched points.

Sightings are reweighted (Tukey) until outliers are out; a last fit without weights gives the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import gtsam
import numpy as np

from estimation import se3
from estimation.calibration.arm_model import (
    ARM_CALIBRATION,
    ArmParameters,
    Kinematics,
    SetPoint,
    Sightings,
    TipPrediction,
    check_places,
    check_turns,
    predict,
)
from estimation.calibration.lens_model import CAMERA_PARAMETERS
from estimation.errors import InputError
from estimation.observations import RAYLEIGH_MEDIAN
from estimation.rig import Rig
from estimation.runtime import median
from estimation.se3 import Array, Mask

REWEIGHT_ROUNDS = 6  # outliers are out after two or three
TUKEY_CUTOFF = 5.0  # scatters at which a sighting's weight is zero (Tukey's biweight)
MAX_SCATTERS = 4.0  # scatters beyond which a sighting is left out of the last fit: of pure noise one in 3000
TOOL_SIGMA, TIMING_SIGMA, BLUNT_SIGMA = 100.0, 0.2, 0.2  # mm, s, mm: one sigma of the priors
ARM_KEY, TIMING_KEY, TOOL_KEY, BLUNT_KEY, CAMERAS_KEY = (gtsam.symbol(letter, 0) for letter in "ptxer")


@dataclass(frozen=True, slots=True)
class ArmUnknowns:
    """What is estimated beside the arm's pose; the rest stays as given."""

    tool: bool = True
    latency: bool = True
    blunt: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class ArmFit:
    """The estimate from N sightings."""

    state: ArmParameters
    # (12, 12) of [rx ry rz tx ty tz] (right perturbation of base_from_arm, rad and mm), tool mm, dead time s, lag s,
    # blunt mm; zero for what was not estimated
    covariance: Array
    residuals: Array  # (N, 2) px, prediction less measurement
    used: Mask  # (N,) which sightings are inliers
    scatter: float  # of the inliers' residuals, in their stated sigmas
    widened_by: float = 1.0  # factor on the covariance by `jackknife`

    @property
    def sigma(self) -> Array:
        """One standard deviation (12,) of each number."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


@dataclass(frozen=True, slots=True, eq=False)
class _ArmProblem:
    """The sightings and their model; `graph` makes factors with given weights."""

    sightings: Sightings
    set_point: SetPoint
    kinematics: Kinematics
    rig: Rig
    start: ArmParameters
    unknowns: ArmUnknowns
    rig_covariance: Array | None

    @property
    def keys(self) -> list[int]:
        free = self.unknowns
        optional = {TOOL_KEY: free.tool, TIMING_KEY: free.latency, BLUNT_KEY: free.blunt}
        optional[CAMERAS_KEY] = self.rig_covariance is not None
        return [ARM_KEY, *(key for key, is_free in optional.items() if is_free)]

    def state(self, values: gtsam.Values) -> ArmParameters:
        """The parameters in GTSAM's values; what is not estimated is the start's."""
        tool = values.atVector(TOOL_KEY) if self.unknowns.tool else self.start.tool
        dead, lag = values.atVector(TIMING_KEY) if self.unknowns.latency else (self.start.dead_time, self.start.lag)
        blunt = float(values.atVector(BLUNT_KEY)[0]) if self.unknowns.blunt else self.start.blunt
        return ArmParameters(values.atPose3(ARM_KEY).matrix(), np.asarray(tool), float(dead), abs(float(lag)), blunt)

    def values(self, state: ArmParameters) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(ARM_KEY, gtsam.Pose3(state.base_from_arm))
        for key, vector in self._vectors(state):
            if key in self.keys:
                values.insert(key, vector)
        if self.rig_covariance is not None:
            values.insert(CAMERAS_KEY, np.zeros(CAMERA_PARAMETERS * len(self.rig)))
        return values

    def _vectors(self, state: ArmParameters) -> list[tuple[int, Array]]:
        timing = np.array([state.dead_time, state.lag])
        return [(TOOL_KEY, np.asarray(state.tool, float)), (TIMING_KEY, timing), (BLUNT_KEY, np.array([state.blunt]))]

    def predict(self, values: gtsam.Values) -> tuple[TipPrediction, Array]:
        """The predicted pixels, and residuals (N, 2), px."""
        s = self.sightings
        prediction = predict(self.state(values), self.set_point, self.kinematics, self.rig, s.stamp, s.camera)
        residuals = prediction.pixels - s.pixels
        if self.rig_covariance is not None:
            own = values.atVector(CAMERAS_KEY).reshape(-1, CAMERA_PARAMETERS)[s.camera]
            residuals = residuals + np.einsum("nij,nj->ni", prediction.by_camera, own)
        return prediction, residuals

    def graph(self, weights: Array, rows: Mask) -> gtsam.NonlinearFactorGraph:
        """All factors. weights: (N,) of the sightings. rows: (N,) which of them are used."""
        graph, root, keys = gtsam.NonlinearFactorGraph(), (np.sqrt(weights) / self.sightings.sigma)[rows], self.keys

        def error(_: object, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            prediction, residuals = self.predict(values)
            if jacobians is not None:
                for i, slope in enumerate(self._slopes(prediction, values)):
                    jacobians[i] = np.asfortranarray((slope[rows] * root[:, None, None]).reshape(2 * len(root), -1))
            return np.asarray((residuals[rows] * root[:, None]).ravel())

        unit = gtsam.noiseModel.Unit.Create(2 * int(rows.sum()))
        graph.add(gtsam.CustomFactor(unit, keys, error))
        priors = {TOOL_KEY: TOOL_SIGMA, TIMING_KEY: TIMING_SIGMA, BLUNT_KEY: BLUNT_SIGMA}
        for key, vector in self._vectors(self.start):
            if key in keys:
                isotropic = gtsam.noiseModel.Isotropic.Sigma(len(vector), priors[key])
                graph.add(gtsam.PriorFactorVector(key, vector, isotropic))
        if self.rig_covariance is not None:
            scale = np.sqrt(np.maximum(np.diag(self.rig_covariance), 1e-16))
            scales = np.outer(scale, scale)
            invertible = (self.rig_covariance / scales + 1e-9 * np.eye(len(scale))) * scales  # also with zero variances
            noise = gtsam.noiseModel.Gaussian.Covariance(invertible)
            graph.add(gtsam.PriorFactorVector(CAMERAS_KEY, np.zeros(CAMERA_PARAMETERS * len(self.rig)), noise))
        return graph

    def _slopes(self, p: TipPrediction, values: gtsam.Values) -> list[Array]:
        by = {ARM_KEY: p.by_arm, TOOL_KEY: p.by_tool, TIMING_KEY: p.by_time, BLUNT_KEY: p.by_blunt}
        if self.unknowns.latency and values.atVector(TIMING_KEY)[1] < 0:  # a negative lag stands for its absolute value
            by[TIMING_KEY] = p.by_time * [1.0, -1.0]
        slopes = [by[key] for key in self.keys if key in by]
        if self.rig_covariance is not None:
            by_cameras = np.zeros((len(self.sightings), 2, len(self.rig), CAMERA_PARAMETERS))
            by_cameras[np.arange(len(self.sightings)), :, self.sightings.camera] = p.by_camera
            slopes.append(by_cameras.reshape(len(self.sightings), 2, -1))
        return slopes

    def covariance(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Array:
        """The marginal covariance (12, 12) of `ArmFit`."""
        rows = {ARM_KEY: slice(6), TOOL_KEY: slice(6, 9), TIMING_KEY: slice(9, 11), BLUNT_KEY: slice(11, 12)}
        return _joint_covariance(graph, values, {key: rows[key] for key in self.keys if key in rows}, 12)


def _joint_covariance(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, rows: dict[int, slice], size: int
) -> Array:
    """Joint marginal covariance (size, size), each key's numbers in its rows, zero elsewhere."""
    joint, out = gtsam.Marginals(graph, values).jointMarginalCovariance(list(rows)), np.zeros((size, size))
    for a, b in product(rows, rows):
        out[rows[a], rows[b]] = joint.at(a, b)
    return out


def fit_arm(
    sightings: Sightings,
    set_point: SetPoint,
    kinematics: Kinematics,
    rig: Rig,
    start: ArmParameters,
    unknowns: ArmUnknowns | None = None,
    rig_covariance: Array | None = None,
) -> ArmFit:
    """The parameters that fit the sightings best, from a start within some degrees and millimetres.

    rig_covariance: (16 C, 16 C) of lens, pose and clock of each camera, if known: then the covariance includes the
    rig's uncertainty. InputError where nothing fits.
    """
    problem = _ArmProblem(sightings, set_point, kinematics, rig, start, unknowns or ArmUnknowns(), rig_covariance)
    values, away, scatter = _reweighted_fit(problem, problem.values(start))
    first = problem.state(values)
    if problem.unknowns.latency:  # two local minima: dead time taken for lag, and lag for dead time
        late = max(first.dead_time + first.lag, 0.0)
        shares = (0.2, 0.8) if first.lag < first.dead_time else (0.8, 0.2)
        other = replace(first, dead_time=shares[0] * late, lag=shares[1] * late)
        again = _reweighted_fit(problem, problem.values(other))
        if again[2] < scatter:
            values, away, scatter = again
    used = away < MAX_SCATTERS * scatter
    values = _solve(problem.graph(np.ones(len(sightings)), used), values)
    residuals = problem.predict(values)[1]
    spare = 2 * int(used.sum()) - 12  # degrees of freedom
    if spare <= 0:
        raise InputError(ARM_CALIBRATION, "sightings that agree", int(used.sum()), "12 or more")
    scatter = float(np.sqrt(((residuals[used] / sightings.sigma[used, None]) ** 2).sum() / spare))
    graph = problem.graph(np.full(len(sightings), 1 / max(scatter, 1e-6) ** 2), used)
    return ArmFit(problem.state(values), problem.covariance(graph, values), residuals, used, scatter)


def _reweighted_fit(problem: _ArmProblem, values: gtsam.Values) -> tuple[gtsam.Values, Array, float]:
    """The values once outliers have no weight, each sighting's residual (N,) in sigmas, and their scatter."""
    sightings = problem.sightings
    weights, rows, away, scatter = np.ones(len(sightings)), np.ones(len(sightings), bool), np.zeros(0), 0.0
    for _ in range(REWEIGHT_ROUNDS):
        values = _solve(problem.graph(weights, rows), values)
        away = np.linalg.norm(problem.predict(values)[1], axis=1) / sightings.sigma
        scatter = max(median(away[weights > 0]) / RAYLEIGH_MEDIAN, 1e-9)
        weights = np.clip(1 - (away / (TUKEY_CUTOFF * scatter)) ** 2, 0.0, None) ** 2
    return values, away, scatter


def _solve(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setDiagonalDamping(True)  # radians, mm and s differ by orders of magnitude
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def cross_validate(
    sightings: Sightings,
    fold: Callable[[Sightings], ArmFit],
    residuals_of: Callable[[ArmParameters, Sightings], Array],
    folds: int,
) -> tuple[Array, list[ArmParameters]]:
    """Residuals (N, 2), px, of sightings under fits without their place, and the parameters of those fits."""
    numbers = np.unique(sightings.place[sightings.place >= 0])
    starts = np.array([sightings.stamp[sightings.place == number].min() for number in numbers])
    # sightings on the way belong to the place that follows them in time
    group = np.where(sightings.place >= 0, sightings.place, np.searchsorted(starts, sightings.stamp))
    out, states = np.full((len(sightings), 2), np.nan), list[ArmParameters]()
    for number in range(folds):
        mine = group % folds == number
        if mine.any() and not mine.all():
            states.append(fold(sightings.take(~mine)).state)
            out[mine] = residuals_of(states[-1], sightings.take(mine))
    return out, states


def jackknife(fit: ArmFit, states: Sequence[ArmParameters]) -> ArmFit:
    """The fit with its covariance scaled to the spread of fits that each left out some places; never narrower.

    Errors common to all pictures of a place, as the end of a needle seen at one angle, do not average out over more
    pictures. Leaving out whole places shows their effect (delete-a-group jackknife, Kott 2001). One factor for all
    parameters, as a few groups tell no more.
    """
    off = np.array([_state_difference(state, fit.state) for state in states])
    known = np.diag(fit.covariance) > 0
    if len(states) < 2 or not known.any():
        return fit
    away = (off - off.mean(0))[:, known]
    inverse = np.linalg.inv(fit.covariance[np.ix_(known, known)])
    square = float(np.einsum("ki,ij,kj->", away, inverse, away)) / int(known.sum())
    factor = max((1 - 1 / len(states)) * square, 1.0)
    return replace(fit, covariance=fit.covariance * factor, widened_by=factor)


def _state_difference(state: ArmParameters, other: ArmParameters) -> Array:
    """Difference (12,) of two states in the order of the covariance."""
    pose = se3.log(se3.inverse(other.base_from_arm) @ state.base_from_arm)
    rest = [state.dead_time - other.dead_time, state.lag - other.lag, state.blunt - other.blunt]
    return np.concatenate([pose, np.asarray(state.tool) - other.tool, rest])


@dataclass(frozen=True, slots=True, eq=False)
class TouchFit:
    """An arm's pose from touched points."""

    base_from_arm: Array  # (4, 4) mm
    tool: Array  # (3,) mm
    covariance: Array  # (9, 9) of base_from_arm (right perturbation, rad and mm) and tool; zero for a given tool
    residuals: Array  # (N, 3) mm, prediction less known point


def fit_touches(arm_from_nozzle: Array, points: Array, sigma: Array, tool: Array, seek_tool: bool) -> TouchFit:
    """The arm's pose from its own nozzle poses (N, 4, 4), mm, and the points (N, 3), mm, base, that the tip touched.

    sigma: (N,) mm, of each point. tool: (3,) mm, tip in the nozzle's frame, or the start of its estimate. InputError
    unless there are four points or more, not in a plane, and for the tool turned ones.
    """
    check_places(arm_from_nozzle[:, :3, 3])
    if seek_tool:
        check_turns(arm_from_nozzle)
    keys = [ARM_KEY, TOOL_KEY] if seek_tool else [ARM_KEY]

    def parts(values: gtsam.Values) -> tuple[Array, Array, Array]:
        pose = values.atPose3(ARM_KEY).matrix()
        at = np.asarray(values.atVector(TOOL_KEY)) if seek_tool else tool
        return pose, at, se3.transform_points(arm_from_nozzle, at[None])[:, 0]

    def error(_: object, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        pose, _tool, inside = parts(values)
        residuals = (se3.transform_points(pose, inside) - points) / sigma[:, None]
        if jacobians is not None:
            turn = pose[:3, :3]
            held = np.broadcast_to(turn, (len(inside), 3, 3))
            by = [np.concatenate([turn @ -se3.hat(inside), held], -1), turn @ arm_from_nozzle[:, :3, :3]]
            for i in range(len(keys)):
                jacobians[i] = np.asfortranarray((by[i] / sigma[:, None, None]).reshape(3 * len(inside), -1))
        return np.asarray(residuals.ravel())

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3 * len(points)), keys, error))
    tips = se3.transform_points(arm_from_nozzle, tool[None])[:, 0]
    values.insert(ARM_KEY, gtsam.Pose3(se3.rigid_from_points(tips, points)))
    if seek_tool:
        values.insert(TOOL_KEY, np.asarray(tool, float))
        graph.add(gtsam.PriorFactorVector(TOOL_KEY, tool, gtsam.noiseModel.Isotropic.Sigma(3, TOOL_SIGMA)))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    covariance = _joint_covariance(graph, values, dict(zip(keys, (slice(6), slice(6, 9)), strict=False)), 9)
    pose, at, inside = parts(values)
    return TouchFit(pose, at, covariance, se3.transform_points(pose, inside) - points)
