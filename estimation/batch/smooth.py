"""Batch smoothing of a whole recording: each pose, landmark and camera estimated from all tracks, past and future.

One Gauss-Newton problem over all frame sets (a full batch): robust reprojection errors, the continuous-time prior
between poses, and the calibration as prior of the cameras.

1. A frame set's tracks are condensed to its state; states are eliminated one after the other, then landmarks and
   cameras are solved. This is the Schur complement of the whole problem, so covariances are those of all unknowns.
2. Outliers are rejected by graduated non-convexity: the gate of a redescending loss narrows step by step.
3. The noise is learned from the recording: the residuals' scale, the delays and shifts that a camera's tracks share,
   and the density of the jerk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.batch import smoothed
from estimation.batch.initialisation import TrackArrays, initial_estimate, pack_tracks
from estimation.batch.normal_equations import BatchProblem, Estimate, NoiseModel, whitened_squares
from estimation.batch.smoothed import CalibrationPrior, FitStatistics, Smoothed, States
from estimation.batch.solve import FREE_POSE_SIGMA, HELD_POSE_SIGMA, Elimination, NormalEquations, Priors
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import Trajectory
from estimation.pose_solver import CHI2_MEDIAN, EFFICIENCY
from estimation.rig import Rig
from estimation.se3 import Array, Index
from estimation.surface_map import SurfaceMap, local_normals

FREE_LANDMARK_MM = 50.0  # one sigma of a landmark's prior: keeps one with few sightings finite
MIN_MAP_SIGMA_MM = 1e-4  # added to a given map's covariance
MIN_LANDMARK_SIGHTINGS = 4
KEY_FRAMES = 120  # of the first estimate of landmarks and cameras
NOISE_STRETCH = 240  # neighbouring frame sets of the first noise estimate, in recordings three times as long
GATE_WIDENINGS = (8.0, 4.0, 2.0)  # factors of the gate, from coarse to fine (graduated non-convexity)
LOSS_SLOPE = 0.7  # of Geman-McClure's residuals for normal errors, over the mean of their weights
MAX_STEPS = 40  # at the narrowest gate
# last step of the cameras and of 95 % of the landmarks: single ones may go on between two places
CONVERGED_SIGMAS = 0.3
INITIAL_JERK_PSD = np.array([1e3] * 3 + [1e7] * 3)  # rad^2/s^5, mm^2/s^5
INITIAL_DELAY_SIGMA_S, INITIAL_SHIFT_SIGMA_PX = 5e-4, 0.02
MAX_NOISE_PASSES = 30  # that estimate the jerk's density and the tracks' noise
PSD_CONVERGED = 0.15  # mean change of the density's logarithm in a last pass
PSD_START_RATIO = 10.0  # initial density of the whole by that of the segment: it converges from above
COVARIANCE_SAMPLES = 1500  # frame sets at which the shared part of the covariance is computed

MIN_RESIDUAL_SCALE = 0.3  # of the stated sigmas
MIN_DELAY_SIGMA_S, MIN_SHIFT_SIGMA_PX = 1e-4, 3e-3
GLOBAL_PSD_WEIGHT = 2.0  # degrees of freedom of the whole recording's density as prior at each moment
FIXED_POINT_EXPONENT = 1.4  # over-relaxation of the fixed point, which otherwise converges slowly
PRIOR_COUNT = 0.1  # degrees of freedom of the prior
PSD_NEIGHBOURS = 1  # frame sets to either side that the density is averaged over
MIN_JERK_PSD = np.array([1e-4] * 3 + [1e-1] * 3)  # rad^2/s^5, mm^2/s^5: of a surface at rest


def residual_scales(data: TrackArrays, estimate: Estimate) -> Array:
    """Median residuals (C,) of each camera, in stated sigmas."""
    square = whitened_squares(data, estimate)
    out = np.ones(len(estimate.cameras))
    for c in range(len(out)):
        squares = square[data.camera == c]
        squares = squares[np.isfinite(squares)]
        if len(squares):
            out[c] = max(np.sqrt(np.median(squares) / CHI2_MEDIAN), MIN_RESIDUAL_SCALE)
    return out


def shared_error_sigmas(done: Elimination, steps: Array, covariances: Array, noise: NoiseModel) -> tuple[float, float]:
    """Sigmas of delay, s, and shift, px, that a camera's tracks share in a frame set: maximum of the evidence.

    steps: (K, 18) of the states, next ones. covariances: (K, 18, 18) of the states.
    """
    by_states = np.einsum("kij,kjl,kil->ki", done.error_by_state, covariances, done.error_by_state, optimize=True)
    cameras, information = len(noise.residual_scale), noise.shared_error_information()
    # the delays sum to zero
    free_share = np.repeat([max(1 - 1 / cameras, 1e-6), 1.0], [cameras, 2 * cameras])
    information = information / free_share
    errors = done.errors + (done.error_by_state @ steps[..., None])[..., 0]
    counts = np.clip(1 - (done.error_variances + by_states) * information, 0.0, 1.0)  # (K, 3C), 0 without tracks
    sigmas = []
    for rows, min_sigma in ((slice(0, cameras), MIN_DELAY_SIGMA_S), (slice(cameras, 3 * cameras), MIN_SHIFT_SIGMA_PX)):
        square, count = float((errors[:, rows] ** 2).sum()), float(counts[:, rows].sum())
        prior_variance = 1 / information[rows.start]
        variance = (square + PRIOR_COUNT * prior_variance) / (count + PRIOR_COUNT) / free_share[rows.start]
        sigmas.append(max(float(np.sqrt(variance)), min_sigma))
    return sigmas[0], sigmas[1]


def jerk_psd(equations: NormalEquations, steps: Array, covariances: Array, next_covariances: Array) -> Array:
    """Density (K - 1, 6) of the jerk at each moment, with that of the whole recording as prior.

    The fixed point of the evidence (MacKay, Neural Computation 4:415, 1992), which expectation maximisation needs
    hundreds of passes for. Each axis has its own density: a chest moves most along its normal.
    """
    square, counts = equations.squared_jerks(steps, covariances, next_covariances)
    before = equations.known.psd
    count = counts.sum(0)
    ratio = ((square / before).sum(0) + PRIOR_COUNT) / (count + PRIOR_COUNT)
    typical = np.exp(np.log(before).mean(0)) * np.clip(ratio**FIXED_POINT_EXPONENT, 1e-3, 1e3)
    window = np.ones(2 * PSD_NEIGHBOURS + 1)
    windowed = [np.stack([np.convolve(c, window, mode="same") for c in a.T], axis=1) for a in (square, counts)]
    psd = (windowed[0] + GLOBAL_PSD_WEIGHT * typical) / (windowed[1] + GLOBAL_PSD_WEIGHT)
    return np.asarray(np.maximum(psd, MIN_JERK_PSD))


PassReport = Callable[[str, int, int], None]  # (what, done, total)


def no_report(what: str, done: int, total: int) -> None:
    """Report nothing."""


def smooth(
    rig: Rig,
    observations: Sequence[Observations],
    known: SurfaceMap | None = None,
    start: Trajectory | None = None,
    prior: CalibrationPrior | None = None,
    progress: PassReport = no_report,
) -> Smoothed:
    """Smooth a recording's observations, from the first frame set with tracks to the last.

    observations: in order of stamp.
    known: the map of the surface if there is one, such as from a scan, with its covariance as prior; tracks count its
        rows. Without it the pose of the first frame set is fixed and defines the surface frame.
    start: poses of a run, base_from_surface, at any stamps, the first of which is fixed. None: found from the tracks.
    prior: corrections of the cameras; by default of their clocks only.

    InputError where the observations do not determine a pose.
    """
    prior = CalibrationPrior() if prior is None else prior
    # without frame sets before the first and after the last tracks: extrapolation over seconds is arbitrary
    non_empty = [k for k, seen in enumerate(observations) if len(seen)]
    data = pack_tracks(observations[non_empty[0] : non_empty[-1] + 1] if non_empty else observations, len(rig))
    poses, points = initial_estimate(rig, data, known, start)
    usable = np.isfinite(points[:, 0]) & (np.bincount(data.landmark, minlength=len(points)) >= MIN_LANDMARK_SIGHTINGS)
    if usable.sum() < 6:
        raise InputError("observations", "landmarks", f"{int(usable.sum())} seen from apart", "6 or more")
    data, points = data.select_landmarks(usable), points[usable]
    held_frame = 0 if start is None else int(np.abs(data.stamps - start.stamps[0]).argmin())
    cameras, sigma = smoothed.cameras_from_rig(rig), smoothed.correction_sigmas(prior, len(rig))
    has_tracks = np.bincount(data.camera, minlength=len(rig)) > 0
    priors = Priors(
        cameras=cameras,
        calibration=smoothed.prior_information(sigma, has_tracks),
        points=points.copy(),
        map=np.eye(points.size) / FREE_LANDMARK_MM**2 if known is None else _information(known, data),
        pose=poses[held_frame],
        held_frame=held_frame,
        pose_sigma=HELD_POSE_SIGMA if known is None else FREE_POSE_SIGMA,
        psd=np.tile(INITIAL_JERK_PSD, (len(data) - 1, 1)),
    )
    estimate = Estimate(_finite_difference_states(poses, data.stamps), cameras, points)
    noise = NoiseModel(np.ones(len(rig)), INITIAL_DELAY_SIGMA_S, INITIAL_SHIFT_SIGMA_PX)
    return _Solver(rig, BatchProblem(data, np.flatnonzero(sigma > 0)), estimate, priors, noise, progress).solve()


def _finite_difference_states(poses: Array, stamps: Array) -> States:
    """States (K) whose twists are differences of neighbouring poses."""
    velocities = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / np.diff(stamps)[:, None]
    twists = np.concatenate([velocities[:1], (velocities[1:] + velocities[:-1]) / 2, velocities[-1:]])
    return States(poses, twists, np.zeros_like(twists))


@dataclass(slots=True, eq=False)
class _Solver:
    """The steps from the initial estimate to the result."""

    rig: Rig
    problem: BatchProblem
    estimate: Estimate
    known: Priors
    noise: NoiseModel
    report: PassReport
    passes: int = 0
    last_step: float = 0.0  # as `_step` returns it

    def solve(self) -> Smoothed:
        """Run them."""
        if len(self.problem.data) > 3 * NOISE_STRETCH:
            self._initialise_from_keyframes()
            self._initialise_noise()
            self._step_states(GATE_WIDENINGS[-1])
        else:
            for gate in GATE_WIDENINGS:
                self._step_states(gate)
            for gate in GATE_WIDENINGS:
                self._step(gate)
        self._learn_noise()
        for _ in range(MAX_STEPS):
            self.last_step = self._step(1.0)
            if self.last_step < CONVERGED_SIGMAS:
                break
        return self._result()

    def _learn_noise(self) -> None:
        """Alternate between the noise and the states until both converge."""
        for k in range(MAX_NOISE_PASSES):
            if self._update_noise(*self._step_states(1.0), converged=k > 1) < PSD_CONVERGED and k > 2:
                break

    def _subproblem(self, frames: Index, known: Priors) -> _Solver:
        """The problem of some frame sets."""
        states = self.estimate.states[frames]
        problem = BatchProblem(self.problem.data.select_frames(frames), self.problem.free)
        known = replace(known, psd=np.tile(INITIAL_JERK_PSD, (len(frames) - 1, 1)))
        return _Solver(self.rig, problem, replace(self.estimate, states=states), known, self.noise, no_report)

    def _initialise_from_keyframes(self) -> None:
        """First estimate of landmarks and cameras from key frames, which are too far apart to determine clocks."""
        even = np.linspace(0, len(self.problem.data) - 1, KEY_FRAMES).round().astype(np.int64)
        frames = np.union1d(even, [self.known.held_frame])
        known = replace(self.known, held_frame=int(np.searchsorted(frames, self.known.held_frame)))
        subproblem = self._subproblem(frames, known)
        subproblem.problem = replace(subproblem.problem, free=self.problem.free[self.problem.free >= len(self.rig)])
        for gate in (*GATE_WIDENINGS, 1.0, 1.0, 1.0):
            subproblem._step(gate)
        self.estimate = replace(self.estimate, cameras=subproblem.estimate.cameras, points=subproblem.estimate.points)
        self.noise = subproblem.noise

    def _initialise_noise(self) -> None:
        """First estimate of the noise from the segment with most observations."""
        counts = np.convolve(np.diff(self.problem.data.starts), np.ones(NOISE_STRETCH), mode="valid")
        frames = int(counts.argmax()) + np.arange(NOISE_STRETCH)
        first_pose = self.estimate.states.poses[frames[0]]
        known = replace(self.known, pose_sigma=FREE_POSE_SIGMA, held_frame=0, pose=first_pose)
        subproblem = self._subproblem(frames, known)
        for gate in GATE_WIDENINGS:
            subproblem._step_states(gate)
        subproblem._learn_noise()
        typical = np.exp(np.log(subproblem.known.psd).mean(0))
        self.known = replace(self.known, psd=np.tile(PSD_START_RATIO * typical, (len(self.problem.data) - 1, 1)))
        self.noise = subproblem.noise

    def _equations(self, gate: float, slope: float = 1.0) -> NormalEquations:
        unit = residual_scales(self.problem.data, self.estimate)
        self.noise = replace(self.noise, residual_scale=unit, gate=gate, slope=slope)
        return NormalEquations(self.problem, self.estimate, self.known, self.noise)

    def _step(self, gate: float) -> float:
        """One step of all unknowns; in sigmas, the larger of the cameras' largest step and 95 % of the landmarks'."""
        equations = self._equations(gate, LOSS_SLOPE if gate == 1.0 else 1.0)
        done = equations.eliminate(self._reporter("landmarks and poses"))
        step = done.shared_step()
        sigma = np.sqrt(np.diag(done.shared_covariance()))
        self._apply_step(equations.eliminate(self._reporter("poses"), step), step)
        sizes, cameras = np.abs(step / sigma), len(self.problem.free)
        return float(max(sizes[:cameras].max(initial=0.0), np.quantile(sizes[cameras:], 0.95)))

    def _step_states(self, gate: float) -> tuple[NormalEquations, Elimination]:
        """One step of the states only; the equations before it."""
        step = np.zeros(self.problem.size)
        equations = self._equations(gate)
        done = equations.eliminate(self._reporter("poses"), step)
        self._apply_step(done, step)
        return equations, done

    def _apply_step(self, done: Elimination, step: Array) -> None:
        self.estimate = self.estimate.retract(done.factor.steps(), step, self.problem.free)

    def _update_noise(self, equations: NormalEquations, done: Elimination, converged: bool) -> float:
        """Estimate the noise from a pass; the mean change of the logarithm of the jerk's density."""
        covariances, next_covariances = done.factor.covariances()
        steps = done.factor.steps()
        if converged:  # before, jerk would be taken for exposure delays
            jitter, unrest = shared_error_sigmas(done, steps, covariances, self.noise)
            self.noise = replace(self.noise, delay_sigma=jitter, shift_sigma=unrest)
        before, psd = self.known.psd, jerk_psd(equations, steps, covariances, next_covariances)
        self.known = replace(self.known, psd=psd)
        return float(np.abs(np.log(psd / before)).mean())

    def _reporter(self, what: str) -> Callable[[int, int], None]:
        self.passes += 1
        return lambda done, total: self.report(what, done, total)

    def _result(self) -> Smoothed:
        equations = self._equations(1.0)
        done = equations.eliminate(self._reporter("covariances"))
        unknowns_covariance = done.shared_covariance()
        state_covariance, next_covariance = done.factor.covariances()
        shared_covariance = self._shared_covariance(equations, done, unknowns_covariance)
        e, q, n = self.estimate, len(self.problem.free), len(self.rig)
        clocks = unknowns_covariance[:n, :n] if q else np.zeros((n, n))
        towards = np.mean([camera.base_from_camera[:3, 3] for camera in self.rig.cameras], axis=0)
        outward = se3.transform_points(se3.inverse(e.states.poses[0]), towards)
        surface = SurfaceMap(e.points, local_normals(e.points, outward), unknowns_covariance[q:, q:])
        return Smoothed(
            self.problem.data.stamps,
            e.states,
            state_covariance,
            next_covariance,
            shared_covariance,
            self.known.psd,
            surface,
            self.problem.data.tracks,
            e.cameras.rig(self.rig),
            self.rig,
            e.cameras.offsets,
            clocks,
            self._fit_statistics(done.cost + equations.prior_cost()),
        )

    def _shared_covariance(self, equations: NormalEquations, done: Elimination, shared: Array) -> Array:
        """Part (K, 18, 18) of the states' covariances by landmarks and cameras, interpolated between samples."""
        stride = -(-len(self.problem.data) // COVARIANCE_SAMPLES)
        root = np.linalg.cholesky(shared + 1e-12 * np.diag(np.diag(shared)))
        frames_done, sampled = list[int](), list[Array]()
        for k, response in equations.responses(done):
            if k % stride == 0 or k == len(self.problem.data) - 1:
                by_unknowns = response @ root
                frames_done.append(k)
                sampled.append(by_unknowns @ by_unknowns.T)
        samples, covariances = np.array(frames_done[::-1]), np.stack(sampled[::-1])
        if stride == 1:
            return covariances
        frames = np.arange(len(self.problem.data))
        before = np.clip(np.searchsorted(samples, frames, side="right") - 1, 0, len(samples) - 2)
        fraction = ((frames - samples[before]) / (samples[before + 1] - samples[before]))[:, None, None]
        return np.asarray((1 - fraction) * covariances[before] + fraction * covariances[before + 1])

    def _fit_statistics(self, cost: float) -> FitStatistics:
        data, e, n = self.problem.data, self.estimate, len(self.rig)
        square = whitened_squares(data, e)
        efficiency = EFFICIENCY / self.noise.residual_scale[data.camera] ** 2
        inlier = 1 / (1 + square * efficiency / (9 * EFFICIENCY)) ** 2 > 0.2
        cell = np.repeat(np.arange(len(data)), np.diff(data.starts)) * n + data.camera
        observed, used = np.bincount(cell, minlength=len(data) * n), np.bincount(cell[inlier], minlength=len(data) * n)
        pixels = np.bincount(cell[inlier], (square / data.precision)[inlier], minlength=len(data) * n)
        rms = np.sqrt(np.divide(pixels, 2 * used, out=np.full(len(used), np.nan), where=used > 0))
        shape, noise = (len(data), n), self.noise
        counts = used.reshape(shape), observed.reshape(shape), rms.reshape(shape)
        sigmas = noise.residual_scale, noise.delay_sigma, noise.shift_sigma
        return FitStatistics(*counts, *sigmas, cost, self.passes, self.last_step, self.last_step < CONVERGED_SIGMAS)


def _information(surface: SurfaceMap, data: TrackArrays) -> Array:
    """Information (3L, 3L) of the tracked landmarks by the map's covariance."""
    place = (3 * data.tracks[:, None] + np.arange(3)).ravel()
    covariance = surface.covariance[np.ix_(place, place)]
    return np.asarray(np.linalg.inv(covariance + MIN_MAP_SIGMA_MM**2 * np.eye(len(place))))
