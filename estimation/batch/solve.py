"""One Gauss-Newton step over all frame sets, and the covariances at its end.

The information of all states is block tridiagonal, with a border: every state is tied to the same landmarks and
cameras. A Cholesky factorisation from the first state to the last needs only what the state before left of the border
(18 rows). So a recording is taken in stretches that join exactly, in memory that does not grow with the border's size.
GTSAM eliminates the same condensed factors to the same numbers (`tests/test_smoothing.py`), but needs a dense factor of
all landmarks for each frame set: eight times the memory that ten minutes may take (docs/smoothing.md).
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

MAX_PRODUCT_NUMBERS = 24e6  # that the products of landmarks and cameras of one stretch may take: 200 MB
MAX_STRETCH_FRAMES = 256  # frame sets of a stretch
# twist and acceleration before anything is seen
INITIAL_MOTION_SIGMA = np.array([2.0] * 3 + [300.0] * 3 + [30.0] * 3 + [5e3] * 3)
HELD_POSE_SIGMA = np.array([1e-6] * 3 + [1e-4] * 3)  # rad, mm: of the pose that lays the surface frame
FREE_POSE_SIGMA = np.array([np.pi] * 3 + [1e4] * 3)

PassProgress = Callable[[int, int], None]  # (done, total) frame sets of a pass


class BlockTridiagonal:
    """The factorisation of K states, eliminated one by one; `take` is called for each stretch, from first to last."""

    def __init__(self, count: int) -> None:
        self.count, self._done = count, 0
        self._inverse = np.zeros((count, STATE_DOF, STATE_DOF))  # of the Cholesky factors
        self._links = np.zeros((count, STATE_DOF, STATE_DOF))  # inverse @ information with the next state
        self.right = np.zeros((count, STATE_DOF))  # gradient times the inverse of the Cholesky factors
        self._left: Array | None = None  # (18, 18) what the last state takes from the next one's information,
        self.border = np.zeros((0, 0))  # (18, S + 1) and from its border and gradient

    def take(self, information: Array, ties: Array, border: Array, gradient: Array) -> Array:
        """Eliminate the next F states; the border's square roots (18 F, S). LinAlgError where not positive definite.

        information: (F, 18, 18). ties: (F, 18, 18), with the state after each, zero for the last of all. border:
        (F, 18, S). gradient: (F, 18).
        """
        frames, size = len(information), border.shape[2]
        roots = np.empty((frames, STATE_DOF, size))
        tall = np.concatenate([ties, border, gradient[..., None]], axis=2)
        if self._left is None:
            self._left, self.border = np.zeros((STATE_DOF, STATE_DOF)), np.zeros((STATE_DOF, size + 1))
        for f in range(frames):
            k = self._done + f
            upper = np.linalg.cholesky(information[f] - self._left).T  # LAPACK reads it column by column
            inverted, failed = dtrtri(upper, lower=0)
            assert failed == 0
            inverse = inverted.T
            tall[f, :, STATE_DOF:] -= self.border
            solved = inverse @ tall[f]
            link = solved[:, :STATE_DOF]
            self._inverse[k], self._links[k], roots[f] = inverse, link, solved[:, STATE_DOF:-1]
            self.right[k] = solved[:, -1]
            self._left, self.border = link.T @ link, link.T @ solved[:, STATE_DOF:]
        self._done += frames
        return roots.reshape(frames * STATE_DOF, size)

    def again(self, stretch: tuple[int, int], border: Array, entry: Array) -> Array:
        """Square roots (18 F, S) of a border (F, 18, S) that `take` had before. entry: `border` before it."""
        first, last = stretch
        roots = np.empty_like(border)
        left = entry[:, :-1] if entry.size else np.zeros(border.shape[1:])
        for k in range(first, last):
            roots[k - first] = self._inverse[k] @ (border[k - first] - left)
            left = self._links[k].T @ roots[k - first]
        return roots.reshape((last - first) * STATE_DOF, border.shape[2])

    def steps(self) -> Array:
        """(K, 18) that bring the states to their optimum, the shared unknowns as in the gradient."""
        out, after = np.empty((self.count, STATE_DOF)), np.zeros(STATE_DOF)
        for k in range(self.count - 1, -1, -1):
            after = -self._inverse[k].T @ (self.right[k] + self._links[k] @ after)
            out[k] = after
        return out

    def covariances(self) -> tuple[Array, Array]:
        """(K, 18, 18) of the states, and (K - 1, 18, 18) of each with the next, were the shared unknowns known."""
        own, next_ = (np.empty((max(n, 0), STATE_DOF, STATE_DOF)) for n in (self.count, self.count - 1))
        after = np.zeros((STATE_DOF, STATE_DOF))
        for k in range(self.count - 1, -1, -1):
            root = self._inverse[k].T
            gain = root @ self._links[k]
            through = gain @ after
            if k < self.count - 1:
                next_[k] = -through
            after = root @ root.T + through @ gain.T
            own[k] = after = (after + after.T) / 2
        return own, next_

    def responses(self, stretch: tuple[int, int], roots: Array, after: Array) -> Iterator[tuple[int, Array]]:
        """How states follow the shared unknowns, (18, S), of first <= k < last, from the last one on backwards.

        roots: (18 F, S) as `take` gave them for this stretch. after: of the state behind it, zero at the end.
        """
        first, last = stretch
        blocks = roots.reshape(last - first, STATE_DOF, -1)
        for k in range(last - 1, first - 1, -1):
            after = -self._inverse[k].T @ (blocks[k - first] + self._links[k] @ after)
            yield k, after


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """What is known besides the tracks."""

    calibrated: CorrectedCameras  # the C cameras before
    calibration: Array  # (11 C, 11 C) information of their corrections
    points: Array  # (L, 3) mm, landmarks before
    map: Array  # (3L, 3L) their information
    pose: Array  # (4, 4) of frame set `held`
    held: int
    frame: Array  # (6,) sigma of that pose
    psd: Array  # (K - 1, 6) density of the jerk, rad^2/s^5 and mm^2/s^5


@dataclass(frozen=True, slots=True, eq=False)
class Elimination:
    """What one pass over all K frame sets gave."""

    chain: BlockTridiagonal
    shared: Array  # (S, S) information of the shared unknowns, the states eliminated; empty where their step was given
    pull: Array  # (S,) their gradient
    effects: Array  # (K, 3C) as in CondensedFrames,
    doubts: Array  # (K, 3C)
    follows: Array  # (K, 3C, 18)
    cost: float
    entries: list[Array]  # (18, S + 1): what a stretch takes over from the one before

    def shared_step(self) -> Array:
        """(S,) of the shared unknowns, where they were free."""
        scale, factor = self._scaled_factor()
        return np.asarray(-scale * cho_solve(factor, scale * self.pull, check_finite=False))

    def shared_covariance(self) -> Array:
        """(S, S) of the shared unknowns."""
        scale, factor = self._scaled_factor()
        return np.asarray(scale[:, None] * cho_solve(factor, np.eye(len(scale)), check_finite=False) * scale)

    def _scaled_factor(self) -> tuple[Array, tuple[Array, bool]]:
        """Scale (S,) that brings the diagonal to one, and the Cholesky factor of the scaled information."""
        scale = 1 / np.sqrt(np.maximum(np.diag(self.shared), 1e-300))
        return scale, cho_factor(self.shared * scale[:, None] * scale, check_finite=False)


def stretches(problem: BatchProblem, cameras: int) -> list[tuple[int, int]]:
    """The frame sets in stretches that fit into memory, whatever the recording's length."""
    each = 3 * max(problem.landmarks, 1) * (10 * cameras + STATE_DOF + 3 * cameras + len(problem.free) + STATE_DOF)
    length = int(np.clip(MAX_PRODUCT_NUMBERS // each, 8, MAX_STRETCH_FRAMES))
    count = len(problem.data)
    return [(first, min(first + length, count)) for first in range(0, count, length)]


class NormalEquations:
    """The normal equations at one estimate."""

    def __init__(self, problem: BatchProblem, estimate: Estimate, known: Priors, noise: NoiseModel) -> None:
        self.problem, self.estimate, self.known, self.noise = problem, estimate, known, noise
        self._links: PriorFactors = prior_factors(estimate.states, problem.data.stamps)
        self._information = self._links.information(known.psd)

    def eliminate(self, progress: PassProgress, step: Array | None = None) -> Elimination:
        """Eliminate all states; what is left are the shared unknowns. step: (S,), where theirs is given."""
        problem, coupled = self.problem, step is None
        size = problem.size if coupled else 0
        shared, pull, cost = np.zeros((size, size)), np.zeros(size), 0.0
        chain, entries, own = BlockTridiagonal(len(problem.data)), list[Array](), list[tuple[Array, Array, Array]]()
        for first, last in stretches(problem, len(self.estimate.cameras)):
            part = condense(problem, first, last, self.estimate, self.noise, step)
            entries.append(chain.border)
            roots = self._take(chain, first, last, part, part.cross if coupled else part.cross[:, :, :0])
            if coupled:
                shared += part.shared - roots.T @ roots - part.own.T @ part.own
                pull += part.pull - roots.T @ chain.right[first:last].ravel()
            own.append((part.effects, part.doubts, part.follows))
            cost += part.cost
            progress(last, len(problem.data))
        if coupled:  # the priors of calibration and map
            known, free = self.known, problem.free
            q, off = len(free), self.estimate.cameras.since(known.calibrated)
            shared[:q, :q] += known.calibration[np.ix_(free, free)]
            pull[:q] += (known.calibration @ off)[free]
            shared[q:, q:] += known.map
            pull[q:] += known.map @ (self.estimate.points - known.points).ravel()
        effects, doubts, follows = (np.concatenate(arrays) for arrays in zip(*own, strict=True))
        return Elimination(chain, shared, pull, effects, doubts, follows, cost, entries)

    def responses(self, done: Elimination) -> Iterator[tuple[int, Array]]:
        """How each state follows the shared unknowns (18, S), from the last to the first, where those were free."""
        after = np.zeros((STATE_DOF, self.problem.size))
        parts = stretches(self.problem, len(self.estimate.cameras))
        for (first, last), entry in zip(reversed(parts), reversed(done.entries), strict=True):
            part = condense(self.problem, first, last, self.estimate, self.noise, None)
            roots = done.chain.again((first, last), part.cross, entry)
            for k, after in done.chain.responses((first, last), roots, after):  # noqa: B020
                yield k, after

    def _take(self, chain: BlockTridiagonal, first: int, last: int, part: CondensedFrames, cross: Array) -> Array:
        """Add the motion prior to a stretch and eliminate its states; the border's square roots."""
        information, gradient = part.information, part.gradient
        ties = np.zeros_like(information)
        prior, known = self._links, self._information
        ahead = slice(first, min(last, len(known)))
        weighted = known[ahead] @ prior.before[ahead]
        count = ahead.stop - ahead.start
        information[:count] += np.swapaxes(prior.before[ahead], 1, 2) @ weighted
        ties[:count] = np.swapaxes(weighted, 1, 2) @ prior.after[ahead]
        gradient[:count] += (np.swapaxes(weighted, 1, 2) @ prior.off[ahead, :, None])[..., 0]
        behind = slice(max(first, 1) - 1, last - 1)
        weighted = known[behind] @ prior.after[behind]
        offset = 1 if first == 0 else 0
        information[offset:] += np.swapaxes(prior.after[behind], 1, 2) @ weighted
        gradient[offset:] += (np.swapaxes(weighted, 1, 2) @ prior.off[behind, :, None])[..., 0]
        self._begin(first, last, information, gradient)
        return chain.take(information, ties, cross, gradient)

    def _begin(self, first: int, last: int, information: Array, gradient: Array) -> None:
        """What is known of the first state's motion, and of the pose that lays the surface frame."""
        states, each = self.estimate.states, np.arange(STATE_DOF)
        if first == 0:
            information[0][each[6:], each[6:]] += INITIAL_MOTION_SIGMA**-2.0
            gradient[0][6:] += np.concatenate([states.twists[0], states.accelerations[0]]) * INITIAL_MOTION_SIGMA**-2.0
        if first <= self.known.held < last:
            f, weight = self.known.held - first, self.known.frame**-2.0
            off = se3.log(se3.inverse(self.known.pose) @ states.poses[self.known.held])
            information[f][each[:6], each[:6]] += weight
            gradient[f][:6] += weight * off

    def prior_cost(self) -> float:
        """Half the squared sigmas by which the states part from the continuous-time prior."""
        off = self._links.off[..., None]
        return float(0.5 * (np.swapaxes(off, 1, 2) @ self._information @ off).sum())

    def jerks(self, steps: Array, own: Array, after: Array) -> tuple[Array, Array]:
        """Squared jerk between neighbours (K - 1, 6), a density times three, and the numbers (0 to 3) it counts for.

        The second, (K - 1, 6), leaves out what the prior itself determined. steps: (K, 18) that the states are about to
        take. own, after: covariances of them and of each with the next.
        """
        prior = self._links
        a, b = prior.before, prior.after
        a_turned, b_turned = np.swapaxes(a, 1, 2), np.swapaxes(b, 1, 2)
        both = a @ after @ b_turned
        spread = a @ own[:-1] @ a_turned + b @ own[1:] @ b_turned + both + np.swapaxes(both, 1, 2)
        inverse, each = np.linalg.inv(prior.spread), np.arange(6)
        by_axis = spread.reshape(-1, 3, 6, 3, 6)[:, :, each, :, each]  # (6, K - 1, 3, 3)
        off = (prior.off + (a @ steps[:-1, :, None] + b @ steps[1:, :, None])[..., 0]).reshape(-1, 3, 6)
        square = np.einsum("kia,kij,kja->ka", off, inverse, off)
        open_ = (by_axis * inverse).sum((2, 3)).T / self.known.psd
        return square, np.clip(3 - open_, 0.0, 3.0)
