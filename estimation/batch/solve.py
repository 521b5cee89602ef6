"""One Gauss-Newton step over all frame sets, and the covariances at its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from estimation import se3
from estimation.batch.priors import STATE, Links, States, links
from estimation.se3 import Array
from estimation.smoothing.cameras import Cameras
from estimation.smoothing.chain import Chain
from estimation.smoothing.measured import Condensed, Noise, Problem, condensed

ROOM = 24e6  # numbers that the products of landmarks and cameras of one stretch may take: 200 MB
LONGEST = 256  # frame sets of a stretch
WIDE = np.array([2.0] * 3 + [300.0] * 3 + [30.0] * 3 + [5e3] * 3)  # twist and acceleration before anything is seen
HELD = np.array([1e-6] * 3 + [1e-4] * 3)  # rad, mm: of the pose that lays the surface frame
ANYWHERE = np.array([np.pi] * 3 + [1e4] * 3)

Step = Callable[[int, int], None]  # (done, total) frame sets of a pass


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All unknowns: K states, the cameras, and landmarks (L, 3) mm in the surface frame."""

    states: States
    cameras: Cameras
    points: Array

    def moved(self, steps: Array, shared: Array, free: NDArray[np.int64]) -> Estimate:
        """The same after steps of the states (K, 18) and of the shared unknowns (S,), the `free` cameras' first."""
        corrections = np.zeros(11 * len(self.cameras))
        corrections[free] = shared[: len(free)]
        points = self.points + shared[len(free) :].reshape(-1, 3)
        return Estimate(self.states.moved(steps), self.cameras.moved(corrections), points)


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known besides the tracks.

    calibrated: the cameras before; calibration: (11 C, 11 C) information of their corrections. points: (L, 3) and
    map: (3L, 3L), landmarks before and their information. pose: (4, 4), of frame set `held`; frame: (6,) its sigma.
    psd: (K - 1, 6) density of the jerk, rad^2/s^5 and mm^2/s^5.
    """

    calibrated: Cameras
    calibration: Array
    points: Array
    map: Array
    pose: Array
    held: int
    frame: Array
    psd: Array


@dataclass(slots=True, eq=False)
class Pass:
    """What one pass over all frame sets gave. shared: (S, S) information and pull: (S,) of the shared unknowns with
    the states eliminated; both empty where their step was given. effects, doubts, follows: as in Condensed, of all K.
    """

    chain: Chain
    shared: Array
    pull: Array
    effects: Array
    doubts: Array
    follows: Array
    cost: float
    entries: list[Array] = field(default_factory=list)  # (18, S + 1): what a stretch takes over from the one before


def stretches(problem: Problem, cameras: int) -> list[tuple[int, int]]:
    """The frame sets in stretches that fit into memory, whatever the recording's length."""
    each = 3 * max(problem.landmarks, 1) * (10 * cameras + STATE + 3 * cameras + len(problem.free) + STATE)
    length = int(np.clip(ROOM // each, 8, LONGEST))
    count = len(problem.data)
    return [(first, min(first + length, count)) for first in range(0, count, length)]


class Equations:
    """The normal equations at one estimate."""

    def __init__(self, problem: Problem, estimate: Estimate, known: Known, noise: Noise) -> None:
        self.problem, self.estimate, self.known, self.noise = problem, estimate, known, noise
        self._links: Links = links(estimate.states, problem.data.stamps)
        self._information = self._links.information(known.psd)

    def whole(self, progress: Step) -> Pass:
        """Eliminate all states; what is left are the shared unknowns."""
        problem, size = self.problem, self.problem.size
        out = Pass(Chain(len(problem.data)), np.zeros((size, size)), np.zeros(size), *self._noted(), 0.0)
        for first, last in stretches(problem, len(self.estimate.cameras)):
            part = self._condensed(first, last, None)
            out.entries.append(out.chain.border)
            roots = self._eliminate(out.chain, first, last, part, part.cross)
            out.shared += part.shared - roots.T @ roots - part.own.T @ part.own
            out.pull += part.pull - roots.T @ out.chain.right[first:last].ravel()
            self._note(out, first, last, part)
            progress(last, len(problem.data))
        self._add_prior(out)
        return out

    def given(self, step: Array, progress: Step) -> Pass:
        """Eliminate all states where the shared unknowns take a step (S,)."""
        none = np.zeros((0, 0))
        out = Pass(Chain(len(self.problem.data)), none, np.zeros(0), *self._noted(), 0.0)
        for first, last in stretches(self.problem, len(self.estimate.cameras)):
            part = self._condensed(first, last, step)
            self._eliminate(out.chain, first, last, part, part.cross[:, :, :0])
            self._note(out, first, last, part)
            progress(last, len(self.problem.data))
        return out

    def responses(self, done: Pass) -> Iterator[tuple[int, Array]]:
        """How each state follows the shared unknowns (18, S), from the last to the first, of a `whole` pass."""
        after = np.zeros((STATE, self.problem.size))
        parts = stretches(self.problem, len(self.estimate.cameras))
        for (first, last), entry in zip(reversed(parts), reversed(done.entries), strict=True):
            part = self._condensed(first, last, None)
            roots = done.chain.again((first, last), part.cross, entry)
            for k, after in done.chain.responses((first, last), roots, after):  # noqa: B020
                yield k, after

    def _condensed(self, first: int, last: int, step: Array | None) -> Condensed:
        e = self.estimate
        return condensed(self.problem, first, last, e.states, e.cameras, e.points, self.noise, step)

    def _eliminate(self, chain: Chain, first: int, last: int, part: Condensed, cross: Array) -> Array:
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
        states, each = self.estimate.states, np.arange(STATE)
        if first == 0:
            information[0][each[6:], each[6:]] += WIDE**-2.0
            gradient[0][6:] += np.concatenate([states.twists[0], states.accelerations[0]]) * WIDE**-2.0
        if first <= self.known.held < last:
            f, weight = self.known.held - first, self.known.frame**-2.0
            off = se3.log(se3.inverse(self.known.pose) @ states.poses[self.known.held])
            information[f][each[:6], each[:6]] += weight
            gradient[f][:6] += weight * off

    def _add_prior(self, out: Pass) -> None:
        known, estimate, free = self.known, self.estimate, self.problem.free
        q = len(free)
        off = estimate.cameras.since(known.calibrated)
        out.shared[:q, :q] += known.calibration[np.ix_(free, free)]
        out.pull[:q] += (known.calibration @ off)[free]
        out.shared[q:, q:] += known.map
        out.pull[q:] += known.map @ (estimate.points - known.points).ravel()

    def _noted(self) -> tuple[Array, Array, Array]:
        shape = len(self.problem.data), 3 * len(self.estimate.cameras)
        return np.zeros(shape), np.zeros(shape), np.zeros((*shape, STATE))

    def _note(self, out: Pass, first: int, last: int, part: Condensed) -> None:
        out.effects[first:last], out.doubts[first:last] = part.effects, part.doubts
        out.follows[first:last] = part.follows
        out.cost += part.cost

    def prior_cost(self) -> float:
        """Half the squared sigmas by which the states part from the continuous-time prior."""
        off = self._links.off[..., None]
        return float(0.5 * (np.swapaxes(off, 1, 2) @ self._information @ off).sum())

    def jerks(self, steps: Array, own: Array, after: Array) -> tuple[Array, Array]:
        """What each tie between neighbours tells of the jerk: its square (K - 1, 6), as a density times three, and for
        how many of three numbers it counts (K - 1, 6): what the prior itself determined tells nothing of it.

        steps: (K, 18) that the states are about to take. own, after: covariances of them and of each with the next.
        """
        prior = self._links
        a, b = prior.before, prior.after
        turned = np.swapaxes(a, 1, 2), np.swapaxes(b, 1, 2)
        both = a @ after @ turned[1]
        spread = a @ own[:-1] @ turned[0] + b @ own[1:] @ turned[1] + both + np.swapaxes(both, 1, 2)
        inverse, each = np.linalg.inv(prior.spread), np.arange(6)
        by_axis = spread.reshape(-1, 3, 6, 3, 6)[:, :, each, :, each]  # (6, K - 1, 3, 3)
        off = prior.off + (a @ steps[:-1, :, None] + b @ steps[1:, :, None])[..., 0]
        off = off.reshape(-1, 3, 6)
        square = np.einsum("kia,kij,kja->ka", off, inverse, off)
        open_ = (by_axis * inverse).sum((2, 3)).T / self.known.psd
        return square, np.clip(3 - open_, 0.0, 3.0)


def shared_step(done: Pass) -> Array:
    """(S,) of the shared unknowns, from a `whole` pass."""
    scale = 1 / np.sqrt(np.maximum(np.diag(done.shared), 1e-300))
    factor = cho_factor(done.shared * scale[:, None] * scale, check_finite=False)
    return np.asarray(-scale * cho_solve(factor, scale * done.pull, check_finite=False))


def shared_covariance(done: Pass) -> Array:
    """(S, S) of the shared unknowns."""
    scale = 1 / np.sqrt(np.maximum(np.diag(done.shared), 1e-300))
    factor = cho_factor(done.shared * scale[:, None] * scale, check_finite=False)
    return np.asarray(scale[:, None] * cho_solve(factor, np.eye(len(scale)), check_finite=False) * scale)
