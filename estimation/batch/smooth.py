"""The best estimate of a whole recording: every pose, landmark and camera from all tracks, before and after.

One Gauss-Newton problem over all frame sets (a full batch): robust pixels of landmarks, the continuous-time prior
between poses, and the calibration as prior of the cameras. A frame set's tracks are condensed to its own state; states
are eliminated one after the other, landmarks and cameras last. That is the Schur complement of the whole problem,
with nothing left out: at convergence the gradient of the whole cost is zero, and covariances are those of all unknowns
together. Outliers fall out by graduated non-convexity: the gate of a redescending loss narrows step by step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation import se3
from estimation.batch.initialisation import begin
from estimation.batch.priors import States
from estimation.batch.smoothed import Fitted, Smoothed
from estimation.batch.solve import (
    ANYWHERE,
    HELD,
    Equations,
    Estimate,
    Known,
    Pass,
    shared_covariance,
    shared_step,
)
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.online.pose_solver import EFFICIENCY
from estimation.rig import Rig
from estimation.se3 import Array
from estimation.smoothing.cameras import CalibrationPrior, cameras_of, prior_information, sigmas
from estimation.smoothing.measured import Noise, Problem, whitened_squares
from estimation.smoothing.noise import liveliness, shared_sizes, unit_of
from estimation.smoothing.packed import Packed, packed
from estimation.surface_map import SurfaceMap, local_normals
from estimation.trajectory import Trajectory

FREE = 50.0  # mm: how far a landmark may lie from where it was begun; only there to keep a hardly seen one finite
SHARPEST = 1e-4  # mm: no map is known better
LEAST_SIGHTINGS = 4
KEY_FRAMES = 120  # of which landmarks and cameras are found first; then all frame sets correct them,
STRETCH = 240  # neighbours of which the noise is, in recordings of several times that
WIDENINGS = (8.0, 4.0, 2.0)  # of the gate, solved from coarse to fine (graduated non-convexity)
SLOPE = 0.7  # of Geman-McClure's residuals for normal errors, over the mean of their weights
MOST = 10  # steps at the last width
ARRIVED = 0.3  # sigmas: the largest step of a landmark or camera at the end; the next is a tenth of it
LIVELY = np.array([1e3] * 3 + [1e7] * 3)  # rad^2/s^5, mm^2/s^5: the jerk's density as first believed
LEARNING = 10  # passes at most in which the jerk's density and the tracks' noise are learned,
SAME = 0.15  # until the density changes by no more, on average of its logarithm
LOOSER = 10.0  # times the density of a stretch is where the learning of the whole begins: from above it is safe
SHARES = 1500  # frame sets at which the share of landmarks and cameras in the covariance is found; smooth between
JITTER, UNREST = 5e-4, 0.02  # s, px, as first believed

Told = Callable[[str, int, int], None]  # (what, done, total)


def silent(what: str, done: int, total: int) -> None:
    """Report nothing."""


def smooth(
    rig: Rig,
    observations: Sequence[Observations],
    known: SurfaceMap | None = None,
    start: Trajectory | None = None,
    prior: CalibrationPrior | None = None,
    progress: Told = silent,
) -> Smoothed:
    """Smooth a recording's observations, in order of stamp, from the first frame set that shows anything to the last.

    known: the map of the surface where there is one, such as from a scan: tracks then count its rows, and its
    covariance is its prior. Without it, the pose of the first frame set lays the surface frame and is held. start:
    rough poses of a run, base_from_surface, at any stamps, the first of which is held; without them they are found.
    prior: what of the cameras the recording may correct, by default the clocks alone. Raises InputError where the
    observations do not determine a pose.
    """
    prior = CalibrationPrior() if prior is None else prior
    data = packed(_tracked(observations), len(rig))
    poses, points = begin(rig, data, known, start)
    told = np.isfinite(points[:, 0]) & (np.bincount(data.landmark, minlength=len(points)) >= LEAST_SIGHTINGS)
    if told.sum() < 6:
        raise InputError("observations", "landmarks", f"{int(told.sum())} seen from apart", "6 or more")
    data, points = data.landmarks(told), points[told]
    held = 0 if start is None else int(np.abs(data.stamps - start.stamps[0]).argmin())
    cameras, sigma = cameras_of(rig), sigmas(prior, len(rig))
    before = Known(
        cameras,
        prior_information(sigma, len(rig)),
        points.copy(),
        np.eye(points.size) / FREE**2 if known is None else _information(known, data),
        poses[held],
        held,
        HELD if known is None else ANYWHERE,
        np.tile(LIVELY, (len(data) - 1, 1)),
    )
    estimate = Estimate(_rates(poses, data.stamps), cameras, points)
    noise = Noise(np.ones(len(rig)), JITTER, UNREST)
    return _Solver(rig, Problem(data, np.flatnonzero(sigma > 0)), estimate, before, noise, progress).solve()


def _tracked(observations: Sequence[Observations]) -> Sequence[Observations]:
    """Without those before anything is seen and after it: a motion carried on for seconds goes anywhere."""
    some = [k for k, seen in enumerate(observations) if len(seen)]
    return observations[some[0] : some[-1] + 1] if some else observations


def _rates(poses: Array, stamps: Array) -> States:
    """States (K) whose twists are differences of neighbouring poses."""
    between = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / np.diff(stamps)[:, None]
    twists = np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])
    return States(poses, twists, np.zeros_like(twists))


class _Solver:
    """The steps from a rough beginning to the result."""

    def __init__(
        self, rig: Rig, problem: Problem, estimate: Estimate, known: Known, noise: Noise, progress: Told
    ) -> None:
        self._rig, self._problem, self._estimate = rig, problem, estimate
        self._known, self._noise, self._told, self._passes = known, noise, progress, 0
        self._data = problem.data

    def solve(self) -> Smoothed:
        """The result."""
        if len(self._data) > 3 * STRETCH:
            self._from_key_frames()
            self._from_a_stretch()
            self._carry(WIDENINGS[-1])
        else:
            for gate in WIDENINGS:
                self._carry(gate)
            for gate in WIDENINGS:
                self._step(gate)
        self._learn_all()
        for _ in range(MOST):
            if self._step(1.0) < ARRIVED:
                break
        return self._result()

    def _learn_all(self) -> None:
        """The noise, and with it the states, until it stays."""
        for k in range(LEARNING):
            if self._learn(*self._carry(1.0), settled=k > 1) < SAME and k > 2:
                break

    def _part(self, frames: NDArray[np.int64], known: Known) -> _Solver:
        """The same of some frame sets."""
        whole = self._estimate.states
        states = States(whole.poses[frames], whole.twists[frames], whole.accelerations[frames])
        problem = Problem(self._data.only(frames), self._problem.free)
        known = replace(known, psd=np.tile(LIVELY, (len(frames) - 1, 1)))
        return _Solver(self._rig, problem, replace(self._estimate, states=states), known, self._noise, silent)

    def _from_key_frames(self) -> None:
        """Landmarks and cameras as some frame sets have them: nearly right, at a small part of the work.

        So far apart they tell no velocity, and so nothing of the clocks.
        """
        spread = np.linspace(0, len(self._data) - 1, KEY_FRAMES).round().astype(np.int64)
        frames = np.union1d(spread, [self._known.held])
        few = self._part(frames, replace(self._known, held=int(np.searchsorted(frames, self._known.held))))
        few._problem = replace(few._problem, free=self._problem.free[self._problem.free >= len(self._rig)])
        for gate in (*WIDENINGS, 1.0, 1.0, 1.0):
            few._step(gate)
        self._estimate = replace(self._estimate, cameras=few._estimate.cameras, points=few._estimate.points)
        self._noise = few._noise

    def _from_a_stretch(self) -> None:
        """The noise as a stretch has it that shows most, which all frame sets then correct."""
        seen = np.convolve(np.diff(self._data.starts), np.ones(STRETCH), mode="valid")
        frames = int(seen.argmax()) + np.arange(STRETCH)
        few = self._part(
            frames, replace(self._known, frame=ANYWHERE, held=0, pose=self._estimate.states.poses[frames[0]])
        )
        for gate in WIDENINGS:
            few._carry(gate)
        few._learn_all()
        usual = np.exp(np.log(few._known.psd).mean(0))
        self._known = replace(self._known, psd=np.tile(LOOSER * usual, (len(self._data) - 1, 1)))
        self._noise = few._noise

    def _equations(self, gate: float, slope: float = 1.0) -> Equations:
        unit = unit_of(self._data, self._estimate)
        self._noise = replace(self._noise, unit=unit, gate=gate, slope=slope)
        return Equations(self._problem, self._estimate, self._known, self._noise)

    def _step(self, gate: float) -> float:
        """One step of everything; how far, in sigmas, the landmark or camera moved that moved most."""
        equations = self._equations(gate, SLOPE if gate == 1.0 else 1.0)
        done = equations.whole(self._say("landmarks and poses"))
        step = shared_step(done)
        sigma = np.sqrt(np.diag(shared_covariance(done)))
        self._move(equations.given(step, self._say("poses")), step)
        return float(np.abs(step / sigma).max())

    def _carry(self, gate: float) -> tuple[Equations, Pass]:
        """One step of the states alone, and the equations before it."""
        step = np.zeros(self._problem.size)
        equations = self._equations(gate)
        done = equations.given(step, self._say("poses"))
        self._move(done, step)
        return equations, done

    def _move(self, done: Pass, step: Array) -> None:
        self._estimate = self._estimate.moved(done.chain.steps(), step, self._problem.free)

    def _learn(self, equations: Equations, done: Pass, settled: bool) -> float:
        """Take what a pass tells of the noise; of the images only once the motion is `settled`, or a jerk of the
        surface would be taken for late cameras. How much the density's logarithm changed.
        """
        own, after = done.chain.covariances()
        steps = done.chain.steps()
        if settled:
            jitter, unrest = shared_sizes(done, steps, own, self._noise)
            self._noise = replace(self._noise, jitter=jitter, unrest=unrest)
        before, psd = self._known.psd, liveliness(equations, steps, own, after)
        self._known = replace(self._known, psd=psd)
        return float(np.abs(np.log(psd / before)).mean())

    def _say(self, what: str) -> Callable[[int, int], None]:
        self._passes += 1
        return lambda done, total: self._told(what, done, total)

    def _result(self) -> Smoothed:
        equations = self._equations(1.0)
        done = equations.whole(self._say("covariances"))
        shared = shared_covariance(done)
        own, after = done.chain.covariances()
        share = self._share(equations, done, shared)
        e, q, n = self._estimate, len(self._problem.free), len(self._rig)
        clocks = np.zeros((n, n))
        if q:
            clocks = shared[:n, :n]
        towards = np.mean([camera.base_from_camera[:3, 3] for camera in self._rig.cameras], axis=0)
        outward = se3.transform_points(se3.inverse(e.states.poses[0]), towards)
        surface = SurfaceMap(e.points, local_normals(e.points, outward), shared[q:, q:])
        return Smoothed(
            self._data.stamps,
            e.states,
            own,
            after,
            share,
            self._known.psd,
            surface,
            self._data.tracks,
            e.cameras.rig(self._rig),
            self._rig,
            e.cameras.offsets,
            clocks,
            self._fitted(done.cost + equations.prior_cost()),
        )

    def _share(self, equations: Equations, done: Pass, shared: Array) -> Array:
        """(K, 18, 18), what landmarks and cameras add to the states' covariances."""
        every = -(-len(self._data) // SHARES)
        root = np.linalg.cholesky(shared + 1e-12 * np.diag(np.diag(shared)))
        at, found = list[int](), list[Array]()
        for k, response in equations.responses(done):
            if k % every == 0 or k == len(self._data) - 1:
                through = response @ root
                at.append(k)
                found.append(through @ through.T)
        where, known = np.array(at[::-1]), np.stack(found[::-1])
        if every == 1:
            return known
        frames = np.arange(len(self._data))
        left = np.clip(np.searchsorted(where, frames, side="right") - 1, 0, len(where) - 2)
        part = ((frames - where[left]) / (where[left + 1] - where[left]))[:, None, None]
        return np.asarray((1 - part) * known[left] + part * known[left + 1])

    def _fitted(self, cost: float) -> Fitted:
        data, e, n = self._data, self._estimate, len(self._rig)
        square = whitened_squares(data, e.states, e.cameras, e.points, 0, len(data))
        worth = EFFICIENCY / self._noise.unit[data.camera] ** 2
        agrees = 1 / (1 + square * worth / (9 * EFFICIENCY)) ** 2 > 0.2
        cell = np.repeat(np.arange(len(data)), np.diff(data.starts)) * n + data.camera
        seen, used = np.bincount(cell, minlength=len(data) * n), np.bincount(cell[agrees], minlength=len(data) * n)
        pixels = np.bincount(cell[agrees], (square / data.precision)[agrees], minlength=len(data) * n)
        rms = np.sqrt(np.divide(pixels, 2 * used, out=np.full(len(used), np.nan), where=used > 0))
        shape = len(data), n
        return Fitted(
            used.reshape(shape),
            seen.reshape(shape),
            rms.reshape(shape),
            self._noise.unit,
            self._noise.jitter,
            self._noise.unrest,
            cost,
            self._passes,
        )


def _information(surface: SurfaceMap, data: Packed) -> Array:
    """(3L, 3L) information of the landmarks that are tracked, by the map's own covariance."""
    place = (3 * data.tracks[:, None] + np.arange(3)).ravel()
    return np.asarray(np.linalg.inv(surface.covariance[np.ix_(place, place)] + SHARPEST**2 * np.eye(len(place))))
