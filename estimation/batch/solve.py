"""One Gauss-Newton step over all frame sets, and the covariances at its end.

The information matrix of the states is block tridiagonal, with a border of the shared unknowns (landmarks, cameras). A
Cholesky factorisation from the first state to the last needs 18 rows of the border at a time, so a recording is
processed in segments, in memory independent of its length. GTSAM eliminates the same condensed factors to the same
numbers (`tests/test_smoothing.py`), but needs a dense factor of all landmarks for each frame set: eight times the
memory that ten minutes may take (docs/smoothing.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dtrtri

from estimation import se3
from estimation.batch.normal_equations import BatchProblem, CondensedFrames, Estimate, NoiseModel, condense
from estimation.batch.smoothed import STATE_DOF, CorrectedCameras, PriorFactors, prior_factors
from estimation.se3 import Array

MAX_PRODUCT_NUMBERS = 24e6  # of the products of landmarks and cameras of a segment: 200 MB
MAX_SEGMENT_FRAMES = 256  # frame sets of a segment
# prior of the first twist and acceleration
INITIAL_MOTION_SIGMA = np.array([2.0] * 3 + [300.0] * 3 + [30.0] * 3 + [5e3] * 3)
HELD_POSE_SIGMA = np.array([1e-6] * 3 + [1e-4] * 3)  # rad, mm: of the pose that defines the surface frame
FREE_POSE_SIGMA = np.array([np.pi] * 3 + [1e4] * 3)

PassProgress = Callable[[int, int], None]  # (done, total) frame sets of a pass


class BlockTridiagonal:
    """Cholesky factorisation of K states, one by one; call `eliminate_states` for each segment in order."""

    def __init__(self, count: int) -> None:
        self.count, self._count_eliminated = count, 0
        self._inverse = np.zeros((count, STATE_DOF, STATE_DOF))  # of the Cholesky factors
        self._next_information = np.zeros((count, STATE_DOF, STATE_DOF))  # inverse @ information with the next state
        self.right = np.zeros((count, STATE_DOF))  # gradient times the inverse of the Cholesky factors
        # of the last state's elimination: subtracted from the next one's information (18, 18), border and gradient
        self._carried_information: Array | None = None
        self.carried_border = np.zeros((0, 0))  # (18, S + 1)

    def eliminate_states(self, information: Array, ties: Array, border: Array, gradient: Array) -> Array:
        """Eliminate the next F states; the border's square roots (18 F, S). LinAlgError if not positive definite.

        information: (F, 18, 18). ties: (F, 18, 18) information with the next state, zero for the last one. border:
        (F, 18, S) information with the shared unknowns. gradient: (F, 18).
        """
        frames, size = len(information), border.shape[2]
        roots = np.empty((frames, STATE_DOF, size))
        tall = np.concatenate([ties, border, gradient[..., None]], axis=2)
        if self._carried_information is None:
            self._carried_information = np.zeros((STATE_DOF, STATE_DOF))
            self.carried_border = np.zeros((STATE_DOF, size + 1))
        for f in range(frames):
            k = self._count_eliminated + f
            upper = np.linalg.cholesky(information[f] - self._carried_information).T  # LAPACK reads it column by column
            inverted, failed = dtrtri(upper, lower=0)
            assert failed == 0
            inverse = inverted.T
            tall[f, :, STATE_DOF:] -= self.carried_border
            solved = inverse @ tall[f]
            link = solved[:, :STATE_DOF]
            self._inverse[k], self._next_information[k], roots[f] = inverse, link, solved[:, STATE_DOF:-1]
            self.right[k] = solved[:, -1]
            self._carried_information, self.carried_border = link.T @ link, link.T @ solved[:, STATE_DOF:]
        self._count_eliminated += frames
        return roots.reshape(frames * STATE_DOF, size)

    def roots_again(self, stretch: tuple[int, int], border: Array, entry: Array) -> Array:
        """Recompute the square roots (18 F, S) of a border (F, 18, S). entry: `carried_border` before its segment."""
        first, last = stretch
        roots = np.empty_like(border)
        left = entry[:, :-1] if entry.size else np.zeros(border.shape[1:])
        for k in range(first, last):
            roots[k - first] = self._inverse[k] @ (border[k - first] - left)
            left = self._next_information[k].T @ roots[k - first]
        return roots.reshape((last - first) * STATE_DOF, border.shape[2])

    def steps(self) -> Array:
        """Steps (K, 18) of the states to their optimum, given the shared unknowns."""
        out, after = np.empty((self.count, STATE_DOF)), np.zeros(STATE_DOF)
        for k in range(self.count - 1, -1, -1):
            after = -self._inverse[k].T @ (self.right[k] + self._next_information[k] @ after)
            out[k] = after
        return out

    def covariances(self) -> tuple[Array, Array]:
        """Covariances given the shared unknowns: (K, 18, 18) of the states, (K - 1, 18, 18) of each with the next."""
        own, next_ = (np.empty((max(n, 0), STATE_DOF, STATE_DOF)) for n in (self.count, self.count - 1))
        after = np.zeros((STATE_DOF, STATE_DOF))
        for k in range(self.count - 1, -1, -1):
            root = self._inverse[k].T
            gain = root @ self._next_information[k]
            through = gain @ after
            if k < self.count - 1:
                next_[k] = -through
            after = root @ root.T + through @ gain.T
            own[k] = after = (after + after.T) / 2
        return own, next_

    def responses(self, stretch: tuple[int, int], roots: Array, after: Array) -> Iterator[tuple[int, Array]]:
        """Derivatives (18, S) of the states first <= k < last by the shared unknowns, in reverse order.

        roots: (18 F, S) by `eliminate_states`. after: derivative of the state after them, zero at the end.
        """
        first, last = stretch
        blocks = roots.reshape(last - first, STATE_DOF, -1)
        for k in range(last - 1, first - 1, -1):
            after = -self._inverse[k].T @ (blocks[k - first] + self._next_information[k] @ after)
            yield k, after


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """Priors of the unknowns."""

    cameras: CorrectedCameras  # as calibrated
    calibration: Array  # (11 C, 11 C) information of their corrections
    points: Array  # (L, 3) mm, of the landmarks
    map: Array  # (3L, 3L) information of the landmarks
    pose: Array  # (4, 4) of frame set `held_frame`
    held_frame: int
    pose_sigma: Array  # (6,) sigma of that pose
    psd: Array  # (K - 1, 6) density of the jerk, rad^2/s^5 and mm^2/s^5


@dataclass(frozen=True, slots=True, eq=False)
class Elimination:
    """The result of one pass over all K frame sets."""

    factor: BlockTridiagonal
    shared: Array  # (S, S) information of the shared unknowns, states eliminated; empty if their step was given
    shared_gradient: Array  # (S,)
    errors: Array  # (K, 3C) as in CondensedFrames, like the next two
    error_variances: Array  # (K, 3C)
    error_by_state: Array  # (K, 3C, 18)
    cost: float
    borders: list[Array]  # (18, S + 1) `carried_border` before each segment

    def shared_step(self) -> Array:
        """Step (S,) of the shared unknowns, if they were free."""
        scale, factor = self._scaled_factor()
        return np.asarray(-scale * cho_solve(factor, scale * self.shared_gradient, check_finite=False))

    def shared_covariance(self) -> Array:
        """Covariance (S, S) of the shared unknowns."""
        scale, factor = self._scaled_factor()
        return np.asarray(scale[:, None] * cho_solve(factor, np.eye(len(scale)), check_finite=False) * scale)

    def _scaled_factor(self) -> tuple[Array, tuple[Array, bool]]:
        """Scale (S,) that brings the diagonal to one, and the Cholesky factor of the scaled information."""
        scale = 1 / np.sqrt(np.maximum(np.diag(self.shared), 1e-300))
        return scale, cho_factor(self.shared * scale[:, None] * scale, check_finite=False)


def segments(problem: BatchProblem, cameras: int) -> list[tuple[int, int]]:
    """First and end frame set of segments that fit into memory, whatever the recording's length."""
    numbers_per_frame = (
        3 * max(problem.landmarks, 1) * (10 * cameras + STATE_DOF + 3 * cameras + len(problem.free) + STATE_DOF)
    )
    length = int(np.clip(MAX_PRODUCT_NUMBERS // numbers_per_frame, 8, MAX_SEGMENT_FRAMES))
    count = len(problem.data)
    return [(first, min(first + length, count)) for first in range(0, count, length)]


class NormalEquations:
    """The normal equations at one estimate."""

    def __init__(self, problem: BatchProblem, estimate: Estimate, known: Priors, noise: NoiseModel) -> None:
        self.problem, self.estimate, self.known, self.noise = problem, estimate, known, noise
        self._motion_prior: PriorFactors = prior_factors(estimate.states, problem.data.stamps)
        self._information = self._motion_prior.information(known.psd)

    def eliminate(self, progress: PassProgress, step: Array | None = None) -> Elimination:
        """Eliminate all states. step: (S,) of the shared unknowns, if it is given."""
        problem, coupled = self.problem, step is None
        size = problem.size if coupled else 0
        shared, pull, cost = np.zeros((size, size)), np.zeros(size), 0.0
        chain, entries, own = BlockTridiagonal(len(problem.data)), list[Array](), list[tuple[Array, Array, Array]]()
        for first, last in segments(problem, len(self.estimate.cameras)):
            part = condense(problem, first, last, self.estimate, self.noise, step)
            entries.append(chain.carried_border)
            roots = self._eliminate_segment(chain, first, last, part, part.cross if coupled else part.cross[:, :, :0])
            if coupled:
                shared += part.shared - roots.T @ roots - part.error_roots.T @ part.error_roots
                pull += part.shared_gradient - roots.T @ chain.right[first:last].ravel()
            own.append((part.errors, part.error_variances, part.error_by_state))
            cost += part.cost
            progress(last, len(problem.data))
        if coupled:  # the priors of calibration and map
            known, free = self.known, problem.free
            q, off = len(free), self.estimate.cameras.difference(known.cameras)
            shared[:q, :q] += known.calibration[np.ix_(free, free)]
            pull[:q] += (known.calibration @ off)[free]
            shared[q:, q:] += known.map
            pull[q:] += known.map @ (self.estimate.points - known.points).ravel()
        effects, doubts, follows = (np.concatenate(arrays) for arrays in zip(*own, strict=True))
        return Elimination(chain, shared, pull, effects, doubts, follows, cost, entries)

    def responses(self, done: Elimination) -> Iterator[tuple[int, Array]]:
        """Derivatives (18, S) of each state by the shared unknowns, from the last to the first, if these were free."""
        after = np.zeros((STATE_DOF, self.problem.size))
        parts = segments(self.problem, len(self.estimate.cameras))
        for (first, last), entry in zip(reversed(parts), reversed(done.borders), strict=True):
            part = condense(self.problem, first, last, self.estimate, self.noise, None)
            roots = done.factor.roots_again((first, last), part.cross, entry)
            for k, after in done.factor.responses((first, last), roots, after):  # noqa: B020
                yield k, after

    def _eliminate_segment(
        self, chain: BlockTridiagonal, first: int, last: int, part: CondensedFrames, cross: Array
    ) -> Array:
        """Add the motion prior to a segment and eliminate its states; the border's square roots."""
        information, gradient = part.information, part.gradient
        ties = np.zeros_like(information)
        prior, known = self._motion_prior, self._information
        ahead = slice(first, min(last, len(known)))
        weighted = known[ahead] @ prior.before[ahead]
        count = ahead.stop - ahead.start
        information[:count] += np.swapaxes(prior.before[ahead], 1, 2) @ weighted
        ties[:count] = np.swapaxes(weighted, 1, 2) @ prior.after[ahead]
        gradient[:count] += (np.swapaxes(weighted, 1, 2) @ prior.residual[ahead, :, None])[..., 0]
        behind = slice(max(first, 1) - 1, last - 1)
        weighted = known[behind] @ prior.after[behind]
        offset = 1 if first == 0 else 0
        information[offset:] += np.swapaxes(prior.after[behind], 1, 2) @ weighted
        gradient[offset:] += (np.swapaxes(weighted, 1, 2) @ prior.residual[behind, :, None])[..., 0]
        self._add_initial_priors(first, last, information, gradient)
        return chain.eliminate_states(information, ties, cross, gradient)

    def _add_initial_priors(self, first: int, last: int, information: Array, gradient: Array) -> None:
        """Add the priors of the first state's motion and of the pose that defines the surface frame."""
        states, each = self.estimate.states, np.arange(STATE_DOF)
        if first == 0:
            information[0][each[6:], each[6:]] += INITIAL_MOTION_SIGMA**-2.0
            gradient[0][6:] += np.concatenate([states.twists[0], states.accelerations[0]]) * INITIAL_MOTION_SIGMA**-2.0
        if first <= self.known.held_frame < last:
            f, weight = self.known.held_frame - first, self.known.pose_sigma**-2.0
            off = se3.log(se3.inverse(self.known.pose) @ states.poses[self.known.held_frame])
            information[f][each[:6], each[:6]] += weight
            gradient[f][:6] += weight * off

    def prior_cost(self) -> float:
        """Cost of the continuous-time prior: half of squared sigmas."""
        off = self._motion_prior.residual[..., None]
        return float(0.5 * (np.swapaxes(off, 1, 2) @ self._information @ off).sum())

    def squared_jerks(self, steps: Array, covariances: Array, next_covariances: Array) -> tuple[Array, Array]:
        """Squared jerk between neighbours (K - 1, 6), and its degrees of freedom (K - 1, 6), 0 to 3.

        Their ratio is the density; degrees of freedom that the prior itself determined are left out. steps: (K, 18) of
        the states, next ones. covariances, next_covariances: covariances of them and of each with the next.
        """
        prior = self._motion_prior
        a, b = prior.before, prior.after
        a_turned, b_turned = np.swapaxes(a, 1, 2), np.swapaxes(b, 1, 2)
        cross = a @ next_covariances @ b_turned
        covariance = a @ covariances[:-1] @ a_turned + b @ covariances[1:] @ b_turned + cross + np.swapaxes(cross, 1, 2)
        inverse, each = np.linalg.inv(prior.spread), np.arange(6)
        by_axis = covariance.reshape(-1, 3, 6, 3, 6)[:, :, each, :, each]  # (6, K - 1, 3, 3)
        residual = (prior.residual + (a @ steps[:-1, :, None] + b @ steps[1:, :, None])[..., 0]).reshape(-1, 3, 6)
        square = np.einsum("kia,kij,kja->ka", residual, inverse, residual)
        prior_part = (by_axis * inverse).sum((2, 3)).T / self.known.psd
        return square, np.clip(3 - prior_part, 0.0, 3.0)
