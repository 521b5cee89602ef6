"""Arm, tool and latency from all sightings at once, in GTSAM: robust first, then honest about what is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.arm_calibration.set_point import SetPoint
from estimation.calibration.arm_model import OWN, ArmState, Kinematics, Predicted, Sightings, predict
from estimation.errors import InputError
from estimation.median import median
from estimation.rig import Rig
from estimation.se3 import Array

ROUNDS = 6  # of weighing and solving: blunders are out after two or three
CUT = 5.0  # scatters at which a sighting counts for nothing while weighing (Tukey's biweight)
OUT = 4.0  # scatters beyond which a sighting is left out in the end: of pure noise one in 3000
RAYLEIGH = 1.1774  # median length of a vector whose two entries are normal, in their sigmas
TOOL, TIME, BLUNT = 100.0, 0.2, 0.2  # mm, s, mm: one sigma of what is believed before anything is seen
PLACE, TIMING, TIP, END, CAMERAS = (gtsam.symbol(letter, 0) for letter in "ptxer")


@dataclass(frozen=True, slots=True)
class Asked:
    """What is sought beside the arm's place; what is not stays as it was given."""

    tool: bool = True
    latency: bool = True
    blunt: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class ArmFit:
    """state: as found. covariance: (12, 12) of [rx ry rz tx ty tz] of base_from_arm, rad and mm, right perturbation,
    tool offset mm, dead time s, lag s, blunt mm; zero for what was not asked. residuals: (N, 2) px, as predicted less
    seen. used: (N,) sightings that lie where they should. scatter: of those, in the sigmas they came with. widened_by:
    what the covariance was multiplied by, beyond what the scatter says.
    """

    state: ArmState
    covariance: Array
    residuals: Array
    used: NDArray[np.bool_]
    scatter: float
    widened_by: float = 1.0

    @property
    def sigma(self) -> Array:
        """One standard deviation (12,) of each number."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


class _Problem:
    """The sightings and what explains them; `graph` puts them into factors with given weights."""

    def __init__(
        self,
        sightings: Sightings,
        set_point: SetPoint,
        kinematics: Kinematics,
        rig: Rig,
        start: ArmState,
        asked: Asked,
        rig_covariance: Array | None,
    ) -> None:
        self.sightings, self.start, self.asked, self.rig_covariance = sightings, start, asked, rig_covariance
        self._world = set_point, kinematics, rig
        self._cameras = len(rig)
        self.keys: list[int] = [PLACE]
        for key, wanted in ((TIP, asked.tool), (TIMING, asked.latency), (END, asked.blunt)):
            self.keys += [key] * wanted
        self.keys += [CAMERAS] * (rig_covariance is not None)

    def state(self, values: gtsam.Values) -> ArmState:
        """The state in GTSAM's values; what is not asked is the start's."""
        tool = values.atVector(TIP) if self.asked.tool else self.start.tool
        dead, lag = values.atVector(TIMING) if self.asked.latency else (self.start.dead_time, self.start.lag)
        blunt = float(values.atVector(END)[0]) if self.asked.blunt else self.start.blunt
        return ArmState(values.atPose3(PLACE).matrix(), np.asarray(tool), float(dead), abs(float(lag)), blunt)

    def values(self, state: ArmState) -> gtsam.Values:
        """GTSAM's values of a state."""
        values = gtsam.Values()
        values.insert(PLACE, gtsam.Pose3(state.base_from_arm))
        for key, vector in self._vectors(state):
            if key in self.keys:
                values.insert(key, vector)
        if self.rig_covariance is not None:
            values.insert(CAMERAS, np.zeros(OWN * self._cameras))
        return values

    def _vectors(self, state: ArmState) -> list[tuple[int, Array]]:
        timing = np.array([state.dead_time, state.lag])
        return [(TIP, np.asarray(state.tool, float)), (TIMING, timing), (END, np.array([state.blunt]))]

    def seen(self, values: gtsam.Values) -> tuple[Predicted, Array]:
        """What should be seen, and residuals (N, 2), px."""
        s, (set_point, kinematics, rig) = self.sightings, self._world
        found = predict(self.state(values), set_point, kinematics, rig, s.stamp, s.camera)
        left = found.pixels - s.pixels
        if self.rig_covariance is not None:
            own = values.atVector(CAMERAS).reshape(-1, OWN)[s.camera]
            left = left + np.einsum("nij,nj->ni", found.by_camera, own)
        return found, left

    def graph(self, weights: Array, rows: NDArray[np.bool_]) -> gtsam.NonlinearFactorGraph:
        """All factors; weights: (N,) of the sightings, rows: (N,) which take part."""
        graph, root = gtsam.NonlinearFactorGraph(), (np.sqrt(weights) / self.sightings.sigma)[rows]

        def error(_: object, values: gtsam.Values, slopes: list[Array] | None) -> Array:
            found, left = self.seen(values)
            if slopes is not None:
                for i, slope in enumerate(self._slopes(found, values)):
                    slopes[i] = np.asfortranarray((slope[rows] * root[:, None, None]).reshape(2 * len(root), -1))
            return np.asarray((left[rows] * root[:, None]).ravel())

        unit = gtsam.noiseModel.Unit.Create(2 * int(rows.sum()))
        graph.add(gtsam.CustomFactor(unit, self.keys, error))
        beliefs = {TIP: TOOL, TIMING: TIME, END: BLUNT}
        for key, vector in self._vectors(self.start):
            if key in self.keys:
                noise = gtsam.noiseModel.Isotropic.Sigma(len(vector), beliefs[key])
                graph.add(gtsam.PriorFactorVector(key, vector, noise))
        if self.rig_covariance is not None:
            doubt = gtsam.noiseModel.Gaussian.Covariance(_positive(self.rig_covariance))
            graph.add(gtsam.PriorFactorVector(CAMERAS, np.zeros(OWN * self._cameras), doubt))
        return graph

    def _slopes(self, found: Predicted, values: gtsam.Values) -> list[Array]:
        by = {PLACE: found.by_arm, TIP: found.by_tool, TIMING: found.by_time, END: found.by_blunt}
        if self.asked.latency and values.atVector(TIMING)[1] < 0:  # which stands for a lag as long
            by[TIMING] = found.by_time * [1.0, -1.0]
        slopes = [by[key] for key in self.keys if key in by]
        if self.rig_covariance is not None:
            spread = np.zeros((len(self.sightings), 2, self._cameras, OWN))
            spread[np.arange(len(self.sightings)), :, self.sightings.camera] = found.by_camera
            slopes.append(spread.reshape(len(self.sightings), 2, -1))
        return slopes

    def covariance(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Array:
        """(12, 12) as `ArmFit` has it."""
        sizes = {PLACE: (0, 6), TIP: (6, 3), TIMING: (9, 2), END: (11, 1)}
        marginals = gtsam.Marginals(graph, values)
        keys = [key for key in self.keys if key in sizes]
        joint, out = marginals.jointMarginalCovariance(keys), np.zeros((12, 12))
        for a in keys:
            for b in keys:
                rows, columns = (slice(sizes[k][0], sum(sizes[k])) for k in (a, b))
                out[rows, columns] = joint.at(a, b)
        return out


def fit_arm(
    sightings: Sightings,
    set_point: SetPoint,
    kinematics: Kinematics,
    rig: Rig,
    start: ArmState,
    asked: Asked | None = None,
    rig_covariance: Array | None = None,
) -> ArmFit:
    """The state under which the sightings lie where they should; from a start within some degrees and millimetres.

    rig_covariance: (16 C, 16 C) of lens, place and clock of each camera, as cameras' calibration states it, if it is
    known: then what the rig may be off by is in the covariance too. InputError where nothing fits.
    """
    problem = _Problem(sightings, set_point, kinematics, rig, start, asked or Asked(), rig_covariance)
    values, away, scatter = _weighed(problem, problem.values(start))
    found = problem.state(values)
    if problem.asked.latency:  # two valleys: dead time taken for lag, and lag for dead time
        late = max(found.dead_time + found.lag, 0.0)
        shares = (0.2, 0.8) if found.lag < found.dead_time else (0.8, 0.2)
        other = replace(found, dead_time=shares[0] * late, lag=shares[1] * late)
        again = _weighed(problem, problem.values(other))
        if again[2] < scatter:
            values, away, scatter = again
    used = away < OUT * scatter
    values = _solve(problem.graph(np.ones(len(sightings)), used), values)
    left = problem.seen(values)[1]
    spare = 2 * int(used.sum()) - 12
    if spare <= 0:
        raise InputError("arm calibration", "sightings that agree", int(used.sum()), "12 or more")
    scatter = float(np.sqrt(((left[used] / sightings.sigma[used, None]) ** 2).sum() / spare))
    graph = problem.graph(np.full(len(sightings), 1 / max(scatter, 1e-6) ** 2), used)
    return ArmFit(problem.state(values), problem.covariance(graph, values), left, used, scatter)


def _weighed(problem: _Problem, values: gtsam.Values) -> tuple[gtsam.Values, Array, float]:
    """The values once blunders have lost their weight, how far off (N,) sightings are, in sigmas, and their scatter."""
    sightings = problem.sightings
    weights, rows, away, scatter = np.ones(len(sightings)), np.ones(len(sightings), bool), np.zeros(0), 0.0
    for _ in range(ROUNDS):
        values = _solve(problem.graph(weights, rows), values)
        away = np.linalg.norm(problem.seen(values)[1], axis=1) / sightings.sigma
        scatter = max(median(away[weights > 0]) / RAYLEIGH, 1e-9)
        weights = np.clip(1 - (away / (CUT * scatter)) ** 2, 0.0, None) ** 2
    return values, away, scatter


def _solve(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    wishes = gtsam.LevenbergMarquardtParams()
    wishes.setDiagonalDamping(True)  # in each number's own unit: radians, mm and s lie far apart
    return gtsam.LevenbergMarquardtOptimizer(graph, values, wishes).optimize()


def _positive(covariance: Array) -> Array:
    """A covariance that can be inverted: what is exactly known is known to a millionth of the rest."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-16))
    correlated = covariance / np.outer(scale, scale)
    return np.asarray((correlated + 1e-9 * np.eye(len(scale))) * np.outer(scale, scale))


def held_out(
    sightings: Sightings, fold: Callable[[Sightings], ArmFit], again: Callable[[ArmState, Sightings], Array], folds: int
) -> tuple[Array, list[ArmState]]:
    """Residuals (N, 2), px, of sightings by fits that did not see their place; on the way, their stretch of time.

    And what those fits found, one for each part of the places that was left out.
    """
    group = np.where(sightings.place >= 0, sightings.place, np.searchsorted(_ends(sightings), sightings.stamp))
    out, states = np.full((len(sightings), 2), np.nan), list[ArmState]()
    for number in range(folds):
        mine = group % folds == number
        if mine.any() and not mine.all():
            states.append(fold(sightings.take(~mine)).state)
            out[mine] = again(states[-1], sightings.take(mine))
    return out, states


def widened(fit: ArmFit, states: Sequence[ArmState]) -> ArmFit:
    """The fit, its covariance as wide as fits that left out a part of the places each say it is, never narrower.

    What is off alike in all pictures of a place, as the end of a needle is that a camera sees at one angle, is no noise
    that more pictures of it would average. Left out in turn, whole places tell what it does (delete-a-group jackknife,
    Kott 2001); by the mean over all numbers, as a few parts tell no more.
    """
    off = np.array([_apart(state, fit.state) for state in states])
    known = np.diag(fit.covariance) > 0
    if len(states) < 2 or not known.any():
        return fit
    away = (off - off.mean(0))[:, known]
    inverse = np.linalg.inv(fit.covariance[np.ix_(known, known)])
    square = float(np.einsum("ki,ij,kj->", away, inverse, away)) / int(known.sum())
    factor = max((1 - 1 / len(states)) * square, 1.0)
    return replace(fit, covariance=fit.covariance * factor, widened_by=factor)


def _apart(state: ArmState, other: ArmState) -> Array:
    """How far (12,) a state lies from another one, in the order of a fit's covariance."""
    pose = se3.log(se3.inverse(other.base_from_arm) @ state.base_from_arm)
    rest = [state.dead_time - other.dead_time, state.lag - other.lag, state.blunt - other.blunt]
    return np.concatenate([pose, np.asarray(state.tool) - other.tool, rest])


def _ends(sightings: Sightings) -> Sequence[float] | Array:
    """Stamps at which one place after the other begins."""
    places = np.unique(sightings.place[sightings.place >= 0])
    return np.array([sightings.stamp[sightings.place == p].min() for p in places])
