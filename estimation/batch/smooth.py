"""Batch smoothing of a whole recording: each pose, landmark and camera estimated from all tracks, past and future.

One Gauss-Newton problem over all frame sets (a full batch): robust reprojection errors, the continuous-time prior
between poses, and the calibration as prior of the cameras. A frame set's tracks are condensed to its own state; states
are eliminated one after the other, landmarks and cameras last. That is the Schur complement of the whole problem: at
convergence the gradient of the whole cost is zero, and covariances are those of all unknowns together. Outliers are
rejected by graduated non-convexity: the gate of a redescending loss narrows step by step. The noise is learned from the
recording too: the tracks' size, the jitter and unrest that images share, and the density of the jerk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation import se3
from estimation.batch import smoothed
from estimation.batch.initialisation import TrackArrays, pack_tracks, rough_start
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

FREE_LANDMARK_MM = 50.0  # from where a landmark was begun: a prior that only keeps a hardly seen one finite
MIN_MAP_SIGMA_MM = 1e-4  # no map is known better
MIN_LANDMARK_SIGHTINGS = 4
KEY_FRAMES = 120  # from which landmarks and cameras are estimated first; then all frame sets correct them
NOISE_STRETCH = 240  # neighbouring frame sets from which the noise is learned first, in recordings thrice as long
GATE_WIDENINGS = (8.0, 4.0, 2.0)  # of the gate, solved from coarse to fine (graduated non-convexity)
LOSS_SLOPE = 0.7  # of Geman-McClure's residuals for normal errors, over the mean of their weights
MAX_STEPS = 10  # at the last width
CONVERGED_SIGMAS = 0.3  # the largest step of a landmark or camera at the end; the next is a tenth of it
INITIAL_JERK_PSD = np.array([1e3] * 3 + [1e7] * 3)  # rad^2/s^5, mm^2/s^5, as first believed
INITIAL_JITTER_S, INITIAL_UNREST_PX = 5e-4, 0.02  # as first believed
MAX_NOISE_PASSES = 10  # in which the jerk's density and the tracks' noise are learned,
PSD_CONVERGED = 0.15  # until the density changes by no more, on average of its logarithm
PSD_START_RATIO = 10.0  # times the density of a stretch: where learning of the whole begins; from above it is safe
COVARIANCE_SAMPLES = 1500  # frame sets at which the landmarks' and cameras' part of the covariance is computed

MIN_UNIT = 0.3  # of what is claimed: better than that no track is believed to be
MIN_JITTER_S, MIN_UNREST_PX = 1e-4, 3e-3  # no stamp and no lens is steadier
GLOBAL_PSD_WEIGHT = 2.0  # numbers that the density of the whole recording counts for, at each moment
FIXED_POINT_EXPONENT = 1.4  # over-relaxation of the fixed point, which otherwise converges slowly
PRIOR_COUNT = 0.1  # numbers that the belief before counts for
PSD_NEIGHBOURS = 1  # frame sets to either side over which the density is taken
MIN_JERK_PSD = np.array([1e-4] * 3 + [1e-1] * 3)  # rad^2/s^5, mm^2/s^5: less is rest


def unit_of(data: TrackArrays, estimate: Estimate) -> Array:
    """(C,) residuals in parts of what is claimed of them: by the median, so that outliers do not count."""
    square = whitened_squares(data, estimate)
    out = np.ones(len(estimate.cameras))
    for c in range(len(out)):
        mine = square[data.camera == c]
        mine = mine[np.isfinite(mine)]
        if len(mine):
            out[c] = max(np.sqrt(np.median(mine) / CHI2_MEDIAN), MIN_UNIT)
    return out


def shared_sizes(done: Elimination, steps: Array, own: Array, noise: NoiseModel) -> tuple[float, float]:
    """Jitter, s, and unrest, px, of what each camera's tracks share in a frame set, by their evidence.

    steps: (K, 18) that the states are about to take. own: (K, 18, 18) their covariances, the effects' own doubt apart.
    """
    through = np.einsum("kij,kjl,kil->ki", done.follows, own, done.follows, optimize=True)
    n, known = len(noise.unit), noise.own_information()
    apart = np.repeat([max(1 - 1 / n, 1e-6), 1.0], [n, 2 * n])  # of the delays, whose sum is held
    known = known / apart
    effects = done.effects + (done.follows @ steps[..., None])[..., 0]
    counts = np.clip(1 - (done.doubts + through) * known, 0.0, 1.0)  # (K, 3C): zero where the camera was blind
    sizes = []
    for part, least in ((slice(0, n), MIN_JITTER_S), (slice(n, 3 * n), MIN_UNREST_PX)):
        square, count = float((effects[:, part] ** 2).sum()), float(counts[:, part].sum())
        before = 1 / known[part.start]
        variance = (square + PRIOR_COUNT * before) / (count + PRIOR_COUNT) / apart[part.start]
        sizes.append(max(float(np.sqrt(variance)), least))
    return sizes[0], sizes[1]


def jerk_psd(equations: NormalEquations, steps: Array, own: Array, after: Array) -> Array:
    """(K - 1, 6) density of the jerk at each moment, as far as that is determined, else of the whole recording.

    The fixed point of the evidence (MacKay, Neural Computation 4:415, 1992), which expectation maximisation needs
    hundreds of passes for. Each axis has its own: a chest is lively along its normal only.
    """
    square, counts = equations.jerks(steps, own, after)
    before = equations.known.psd
    count = counts.sum(0)
    ratio = ((square / before).sum(0) + PRIOR_COUNT) / (count + PRIOR_COUNT)
    usual = np.exp(np.log(before).mean(0)) * np.clip(ratio**FIXED_POINT_EXPONENT, 1e-3, 1e3)
    window = np.ones(2 * PSD_NEIGHBOURS + 1)
    near = [np.stack([np.convolve(c, window, mode="same") for c in a.T], axis=1) for a in (square, counts)]
    return np.asarray(np.maximum((near[0] + GLOBAL_PSD_WEIGHT * usual) / (near[1] + GLOBAL_PSD_WEIGHT), MIN_JERK_PSD))


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
    """Smooth a recording's observations, in order of stamp, from the first frame set that shows anything to the last.

    known: the map of the surface where there is one, such as from a scan: tracks then count its rows, and its
    covariance is its prior. Without it, the pose of the first frame set lays the surface frame and is held. start:
    rough poses of a run, base_from_surface, at any stamps, the first of which is held; without them they are found.
    prior: what of the cameras the recording may correct, by default the clocks alone. Raises InputError where the
    observations do not determine a pose.
    """
    prior = CalibrationPrior() if prior is None else prior
    # without those before anything is seen and after it: a motion carried on for seconds goes anywhere
    some = [k for k, seen in enumerate(observations) if len(seen)]
    data = pack_tracks(observations[some[0] : some[-1] + 1] if some else observations, len(rig))
    poses, points = rough_start(rig, data, known, start)
    usable = np.isfinite(points[:, 0]) & (np.bincount(data.landmark, minlength=len(points)) >= MIN_LANDMARK_SIGHTINGS)
    if usable.sum() < 6:
        raise InputError("observations", "landmarks", f"{int(usable.sum())} seen from apart", "6 or more")
    data, points = data.landmarks(usable), points[usable]
    held = 0 if start is None else int(np.abs(data.stamps - start.stamps[0]).argmin())
    cameras, sigma = smoothed.cameras_of(rig), smoothed.correction_sigmas(prior, len(rig))
    seeing = np.bincount(data.camera, minlength=len(rig)) > 0
    before = Priors(
        calibrated=cameras,
        calibration=smoothed.prior_information(sigma, seeing),
        points=points.copy(),
        map=np.eye(points.size) / FREE_LANDMARK_MM**2 if known is None else _information(known, data),
        pose=poses[held],
        held=held,
        frame=HELD_POSE_SIGMA if known is None else FREE_POSE_SIGMA,
        psd=np.tile(INITIAL_JERK_PSD, (len(data) - 1, 1)),
    )
    estimate = Estimate(_rates(poses, data.stamps), cameras, points)
    noise = NoiseModel(np.ones(len(rig)), INITIAL_JITTER_S, INITIAL_UNREST_PX)
    return _Solver(rig, BatchProblem(data, np.flatnonzero(sigma > 0)), estimate, before, noise, progress).solve()


def _rates(poses: Array, stamps: Array) -> States:
    """States (K) whose twists are differences of neighbouring poses."""
    between = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / np.diff(stamps)[:, None]
    twists = np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])
    return States(poses, twists, np.zeros_like(twists))


@dataclass(slots=True, eq=False)
class _Solver:
    """The steps from a rough start to the result."""

    rig: Rig
    problem: BatchProblem
    estimate: Estimate
    known: Priors
    noise: NoiseModel
    report: PassReport
    passes: int = 0

    def solve(self) -> Smoothed:
        """The result."""
        if len(self.problem.data) > 3 * NOISE_STRETCH:
            self._from_key_frames()
            self._from_a_stretch()
            self._step_states(GATE_WIDENINGS[-1])
        else:
            for gate in GATE_WIDENINGS:
                self._step_states(gate)
            for gate in GATE_WIDENINGS:
                self._step(gate)
        self._learn_all()
        for _ in range(MAX_STEPS):
            if self._step(1.0) < CONVERGED_SIGMAS:
                break
        return self._result()

    def _learn_all(self) -> None:
        """The noise, and with it the states, until it stays."""
        for k in range(MAX_NOISE_PASSES):
            if self._learn(*self._step_states(1.0), settled=k > 1) < PSD_CONVERGED and k > 2:
                break

    def _part(self, frames: Index, known: Priors) -> _Solver:
        """The same of some frame sets."""
        states = self.estimate.states[frames]
        problem = BatchProblem(self.problem.data.only(frames), self.problem.free)
        known = replace(known, psd=np.tile(INITIAL_JERK_PSD, (len(frames) - 1, 1)))
        return _Solver(self.rig, problem, replace(self.estimate, states=states), known, self.noise, no_report)

    def _from_key_frames(self) -> None:
        """Landmarks and cameras from some frame sets, nearly right. These are too far apart to determine clocks."""
        spread = np.linspace(0, len(self.problem.data) - 1, KEY_FRAMES).round().astype(np.int64)
        frames = np.union1d(spread, [self.known.held])
        few = self._part(frames, replace(self.known, held=int(np.searchsorted(frames, self.known.held))))
        few.problem = replace(few.problem, free=self.problem.free[self.problem.free >= len(self.rig)])
        for gate in (*GATE_WIDENINGS, 1.0, 1.0, 1.0):
            few._step(gate)
        self.estimate = replace(self.estimate, cameras=few.estimate.cameras, points=few.estimate.points)
        self.noise = few.noise

    def _from_a_stretch(self) -> None:
        """The noise from the stretch with most observations, which all frame sets then correct."""
        seen = np.convolve(np.diff(self.problem.data.starts), np.ones(NOISE_STRETCH), mode="valid")
        frames = int(seen.argmax()) + np.arange(NOISE_STRETCH)
        first_pose = self.estimate.states.poses[frames[0]]
        few = self._part(frames, replace(self.known, frame=FREE_POSE_SIGMA, held=0, pose=first_pose))
        for gate in GATE_WIDENINGS:
            few._step_states(gate)
        few._learn_all()
        usual = np.exp(np.log(few.known.psd).mean(0))
        self.known = replace(self.known, psd=np.tile(PSD_START_RATIO * usual, (len(self.problem.data) - 1, 1)))
        self.noise = few.noise

    def _equations(self, gate: float, slope: float = 1.0) -> NormalEquations:
        unit = unit_of(self.problem.data, self.estimate)
        self.noise = replace(self.noise, unit=unit, gate=gate, slope=slope)
        return NormalEquations(self.problem, self.estimate, self.known, self.noise)

    def _step(self, gate: float) -> float:
        """One step of everything; how far, in sigmas, the landmark or camera moved that moved most."""
        equations = self._equations(gate, LOSS_SLOPE if gate == 1.0 else 1.0)
        done = equations.eliminate(self._reporter("landmarks and poses"))
        step = done.shared_step()
        sigma = np.sqrt(np.diag(done.shared_covariance()))
        self._move(equations.eliminate(self._reporter("poses"), step), step)
        return float(np.abs(step / sigma).max())

    def _step_states(self, gate: float) -> tuple[NormalEquations, Elimination]:
        """One step of the states alone, and the equations before it."""
        step = np.zeros(self.problem.size)
        equations = self._equations(gate)
        done = equations.eliminate(self._reporter("poses"), step)
        self._move(done, step)
        return equations, done

    def _move(self, done: Elimination, step: Array) -> None:
        self.estimate = self.estimate.moved(done.chain.steps(), step, self.problem.free)

    def _learn(self, equations: NormalEquations, done: Elimination, settled: bool) -> float:
        """Learn the noise from a pass; how much the logarithm of the jerk's density changed on average."""
        own, after = done.chain.covariances()
        steps = done.chain.steps()
        if settled:  # before, a jerk would be taken for late cameras
            jitter, unrest = shared_sizes(done, steps, own, self.noise)
            self.noise = replace(self.noise, jitter=jitter, unrest=unrest)
        before, psd = self.known.psd, jerk_psd(equations, steps, own, after)
        self.known = replace(self.known, psd=psd)
        return float(np.abs(np.log(psd / before)).mean())

    def _reporter(self, what: str) -> Callable[[int, int], None]:
        self.passes += 1
        return lambda done, total: self.report(what, done, total)

    def _result(self) -> Smoothed:
        equations = self._equations(1.0)
        done = equations.eliminate(self._reporter("covariances"))
        shared = done.shared_covariance()
        own, after = done.chain.covariances()
        share = self._share(equations, done, shared)
        e, q, n = self.estimate, len(self.problem.free), len(self.rig)
        clocks = shared[:n, :n] if q else np.zeros((n, n))
        towards = np.mean([camera.base_from_camera[:3, 3] for camera in self.rig.cameras], axis=0)
        outward = se3.transform_points(se3.inverse(e.states.poses[0]), towards)
        surface = SurfaceMap(e.points, local_normals(e.points, outward), shared[q:, q:])
        return Smoothed(
            self.problem.data.stamps,
            e.states,
            own,
            after,
            share,
            self.known.psd,
            surface,
            self.problem.data.tracks,
            e.cameras.rig(self.rig),
            self.rig,
            e.cameras.offsets,
            clocks,
            self._fitted(done.cost + equations.prior_cost()),
        )

    def _share(self, equations: NormalEquations, done: Elimination, shared: Array) -> Array:
        """(K, 18, 18), what landmarks and cameras add to the states' covariances."""
        every = -(-len(self.problem.data) // COVARIANCE_SAMPLES)
        root = np.linalg.cholesky(shared + 1e-12 * np.diag(np.diag(shared)))
        at, shares = list[int](), list[Array]()
        for k, response in equations.responses(done):
            if k % every == 0 or k == len(self.problem.data) - 1:
                through = response @ root
                at.append(k)
                shares.append(through @ through.T)
        where, known = np.array(at[::-1]), np.stack(shares[::-1])
        if every == 1:
            return known
        frames = np.arange(len(self.problem.data))
        left = np.clip(np.searchsorted(where, frames, side="right") - 1, 0, len(where) - 2)
        part = ((frames - where[left]) / (where[left + 1] - where[left]))[:, None, None]
        return np.asarray((1 - part) * known[left] + part * known[left + 1])

    def _fitted(self, cost: float) -> FitStatistics:
        data, e, n = self.problem.data, self.estimate, len(self.rig)
        square = whitened_squares(data, e)
        worth = EFFICIENCY / self.noise.unit[data.camera] ** 2
        agrees = 1 / (1 + square * worth / (9 * EFFICIENCY)) ** 2 > 0.2
        cell = np.repeat(np.arange(len(data)), np.diff(data.starts)) * n + data.camera
        seen, used = np.bincount(cell, minlength=len(data) * n), np.bincount(cell[agrees], minlength=len(data) * n)
        pixels = np.bincount(cell[agrees], (square / data.precision)[agrees], minlength=len(data) * n)
        rms = np.sqrt(np.divide(pixels, 2 * used, out=np.full(len(used), np.nan), where=used > 0))
        shape, noise = (len(data), n), self.noise
        counts = used.reshape(shape), seen.reshape(shape), rms.reshape(shape)
        return FitStatistics(*counts, noise.unit, noise.jitter, noise.unrest, cost, self.passes)


def _information(surface: SurfaceMap, data: TrackArrays) -> Array:
    """(3L, 3L) information of the landmarks that are tracked, by the map's own covariance."""
    place = (3 * data.tracks[:, None] + np.arange(3)).ravel()
    covariance = surface.covariance[np.ix_(place, place)]
    return np.asarray(np.linalg.inv(covariance + MIN_MAP_SIGMA_MM**2 * np.eye(len(place))))
